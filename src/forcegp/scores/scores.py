"""`Scores`: what was found of several models on the same rows, and which of them is better.

Squared errors over stretches and seeds are compared by the logarithm of their ratio. What other stretches and seeds
would change are jackknife variances (Efron & Stein 1981), added as Welch & Satterthwaite do.
"""

import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student
from typing_extensions import override

from forcegp.errors import FitError, InvalidInput, require_known
from forcegp.posterior.posterior import Posterior
from forcegp.scores.accuracy import ACCELERATION, TORQUE, median_and_range, over_columns
from forcegp.summary import Summary, listed

CERTAINTY = 0.95
MARGIN = 0.02  # of a ratio: a difference below it matters to nobody, however sure it is
CLEAR, MOSTLY = 0.67, 0.8  # ratio and share of stretches that decide where a log is too short to show anything
MOST_LOG = 700.0  # of a ratio that is still a finite number
USABLE = 0.5  # largest share of a torque's deviation, or of an acceleration's, that a model may leave in a joint

CRITERIA: Mapping[str, str] = {"motion": "error of predicted motions", "force": "force-space error"}
"""What decides, the first that there is, motions over all horizons: where a robot goes is what simulators need."""

Errors = Float[np.ndarray, "seeds horizons stretches"]


@dataclass(frozen=True)
class PairedDifference:
    """Challenger against baseline by one criterion.

    `value` is the ratio of root mean square errors (0.8: a fifth less), with its interval; None for one stretch and one
    seed. The challenger was better in `wins` of `runs` and, over all seeds, in `ahead` of `stretches` (motions, for
    that score). A ratio within `MARGIN` of 1 is no difference; to diverge in `lost` of them more often is worse.
    """

    criterion: str
    challenger: str
    baseline: str
    runs: int
    wins: int
    value: float
    interval: tuple[float, float] | None
    ahead: int = 0
    stretches: int = 0
    lost: int = 0

    @property
    def outcome(self) -> str:
        """`better`, `worse` or `no difference`."""
        if self.lost > 0:
            return "worse"
        if self.interval is None or abs(self.value - 1.0) < MARGIN:
            return "no difference"
        low, high = self.interval
        return "better" if high < 1.0 else "worse" if low > 1.0 else "no difference"

    @property
    def favours_challenger(self) -> bool:
        """Whether to take the challenger: shown to be better, or a third better in most stretches."""
        large = self.value <= CLEAR and self.ahead >= MOSTLY * self.stretches
        return self.outcome == "better" or (self.outcome == "no difference" and large)

    @property
    def sentence(self) -> str:
        """The outcome with its numbers."""
        answer = "no difference that the data show" if self.outcome == "no difference" else self.outcome
        how = "one stretch and one seed, so no interval"
        if self.interval is not None:
            how = "95 % interval {:.3g} to {:.3g}".format(*self.interval)
        what = "motions" if self.criterion == "motion" else "held-out stretches of time"
        better = f"better in {self.wins} of {self.runs} runs and in {self.ahead} of {self.stretches} {what}"
        ratio = f"{CRITERIA[self.criterion]}, {self.challenger} / {self.baseline} = {self.value:.3g}"
        lost = f"; it diverged in {self.lost} more" if self.lost > 0 else ""
        return f"{answer}: {ratio} ({how}); {better}{lost}."


def paired_difference(
    criterion: str, challenger: str, baseline: str, one: Errors, other: Errors
) -> PairedDifference | None:
    """Compare squared errors on the stretches of both. None without any, or with a 0."""
    going, others = (np.isfinite(each).all(axis=(0, 1)) for each in (one, other))
    usable, lost = going & others, int(others.sum() - going.sum())
    one, other = one[..., usable], other[..., usable]

    def difference(seeds: np.ndarray, stretches: np.ndarray) -> float:
        a, b = (each[seeds][..., stretches].mean(axis=(0, 2)) for each in (one, other))
        return float(0.5 * (np.log(a) - np.log(b)).mean())

    if not one.size or bool((np.minimum(one, other).mean(axis=(0, 2)) <= 0.0).any()):
        return None
    every, variances, freedoms = [np.arange(one.shape[axis]) for axis in (0, 2)], [], []
    for axis, members in enumerate(every):
        count = len(members)
        if count > 1:
            left_out = np.array(
                [difference(*(np.delete(e, k) if n == axis else e for n, e in enumerate(every))) for k in members]
            )
            variances.append((count - 1) * float(left_out.var()))
            freedoms.append(count - 1)
    value, interval = difference(*every), None

    def shown(log: float) -> float:
        return math.exp(min(log, MOST_LOG))

    if freedoms:
        spread = sum(variances)
        # Welch and Satterthwaite; the larger one's freedom where nothing varies
        weights = sum(variance**2 / freedom for variance, freedom in zip(variances, freedoms, strict=True))
        half = float(student.ppf(0.5 + 0.5 * CERTAINTY, spread**2 / weights if weights else max(freedoms)))
        half *= math.sqrt(spread)
        interval = (shown(value - half), shown(value + half))
    wins = int((one.mean(axis=(1, 2)) < other.mean(axis=(1, 2))).sum())
    ahead = int((one.mean(axis=(0, 1)) < other.mean(axis=(0, 1))).sum())
    return PairedDifference(
        criterion, challenger, baseline, len(one), wins, shown(value), interval, ahead, one.shape[2], lost
    )


Kind = Literal["given", "identified", "residual", "black box", "force prior"]
"""Parametric physics as given or identified, a Gaussian process on what it leaves of the acceleration, a model without
physics, and Gaussian processes on unknown forces.
"""
PARAMETRIC, LEARNED = ("given", "identified"), ("force prior", "residual", "black box")


def alike(texts: Iterable[tuple[str, Any]]) -> list[list[tuple[str, Any]]]:
    """Texts and what they are about, in groups whose texts differ in numbers alone."""
    groups: dict[str, list[tuple[str, Any]]] = {}
    for text, about in texts:
        groups.setdefault(re.sub(r"\d[\d.e+-]*", "#", text), []).append((text, about))
    return list(groups.values())


class Winner(NamedTuple):
    """The model to take, the difference that decides, and what else there is to say."""

    model: str
    difference: PairedDifference | None
    why: str

    @property
    def sentence(self) -> str:
        """All of it."""
        return ": ".join(filter(None, (self.why, (None if self.difference is None else self.difference.sentence))))


@dataclass(frozen=True, kw_only=True, repr=False)
class Scores(Summary):
    """One table: model x run (split and seed) x quantity x score x joint, and paired differences of models.

    models: name -> "kind" and "summary".
    runs: name -> one entry per split and seed, with "table" (`accuracy.row_scores`, `motions.motion_scores`),
        "stretches" and "motions" for differences, "warnings", and "error" where it failed.
    joint_names, units: of the log.
    about: what was done, for the page.
    fit: how a model by this name is fitted to all rows, beside identifications that were made from these before.
    """

    models: Mapping[str, Mapping[str, str]]
    runs: Mapping[str, Sequence[Mapping[str, Any]]]
    joint_names: tuple[str, ...]
    units: Mapping[str, Any]
    about: Mapping[str, Any] = field(default_factory=dict)
    fit: Callable[[str, Mapping[str, Posterior]], Posterior] | None = field(default=None, compare=False)

    def value(self, score: str, quantity: str = ACCELERATION, model: str | None = None) -> float | None:
        """One number for all joints, the median over runs: `value("rmse", "position after 1 s")`."""
        found = self.spread(score, quantity, model)
        return None if found is None else found["median"]

    def columns(self, score: str, quantity: str = ACCELERATION, model: str | None = None) -> list[float | None]:
        """The same for every joint (contact, axis)."""
        spreads = [median_and_range(each) for each in zip(*self._each(score, quantity, model), strict=True)]
        return [None if each is None else each["median"] for each in spreads]

    def spread(self, score: str, quantity: str = ACCELERATION, model: str | None = None) -> dict[str, Any] | None:
        """Median, least and largest over runs of the number over all joints, and "values" of the runs."""
        return median_and_range(over_columns(quantity, score, each) for each in self._each(score, quantity, model))

    def quantities(self, model: str | None = None) -> dict[str, list[str]]:
        """What the table holds in every finished run of a model: quantity -> scores."""
        tables = [run["table"] for run in self.finished(self._named(model))]
        first = tables[0] if tables else {}
        held = {name: scores for name, scores in first.items() if all(name in each for each in tables)}
        return {name: [score for score in scores if all(score in each[name] for each in tables)]
                for name, scores in held.items()}  # fmt: skip

    def finished(self, model: str) -> list[Mapping[str, Any]]:
        """The runs of a model that did not fail."""
        return [run for run in self.runs[model] if run["error"] is None]

    @property
    def horizons(self) -> list[float]:
        """After how many seconds motions were scored."""
        found = [run["motions"]["horizons"] for name in self.models for run in self.finished(name) if run["motions"]]
        return [h for h in found[0] if all(h in each for each in found)] if found else []

    def _named(self, model: str | None) -> str:
        if model is None and len(self.models) > 1:
            raise InvalidInput(f"`model` is not given; name one of {', '.join(self.models)}.")
        model = next(iter(self.models)) if model is None else model
        require_known("model", model, "these scores", self.models)
        return model

    def _each(self, score: str, quantity: str, model: str | None) -> list[list[float | None]]:
        name = self._named(model)
        held = self.quantities(name)
        if score not in held.get(quantity, ()):
            words = f"the scores of {name} hold no {score} of {quantity}; they hold {', '.join(held) or 'nothing'}"
            there = f", and of {quantity} {', '.join(held[quantity])}" if quantity in held else ""
            raise InvalidInput(f"{words}{there}. Errors of forces need their truth in the log, and motions `horizons`.")
        return [run["table"][quantity][score] for run in self.finished(name)]

    def left(self, model: str, beside: Iterable[str] = ()) -> tuple[str, dict[str, float | None]]:
        """What a model leaves of torques where it and those beside it tell, else of accelerations; by joint."""
        held = self.quantities(model)
        if all("share" in self.quantities(name).get(TORQUE, ()) for name in (model, *beside)):
            shares = zip(self.joint_names, self.columns("share", TORQUE, model), strict=True)
            return TORQUE, {name: share for name, share in shares if share is not None}
        known = self.columns("nrmse", ACCELERATION, model) if "nrmse" in held.get(ACCELERATION, ()) else ()
        return ACCELERATION, dict(zip(self.joint_names, known, strict=False))

    def unusable(self, model: str, beside: Iterable[str] = ()) -> int:
        """In how many joints a model leaves more than `USABLE`, or it is not known what it leaves."""
        return sum(share is None or share > USABLE for share in self.left(model, beside)[1].values())

    def not_known(self, model: str, still: Collection[str] = ()) -> list[str]:
        """Joints that stand still, or of which it leaves more than `USABLE`: what it has of them is no number."""
        left = self.left(model)[1]
        return [name for name in self.joint_names if name in still or (left.get(name) or 0.0) > USABLE]

    def errors(self, criterion: str, model: str) -> dict[tuple[str, int], Float[np.ndarray, "horizons stretches"]]:
        """Squared errors by split and seed; one horizon but for motions, of which those that all splits last for."""
        out = {}
        for run in self.finished(model):
            values = [run["stretches"]]
            if criterion == "motion":
                motions = run["motions"] or {"horizons": [], "squared": []}
                by_horizon = dict(zip(motions["horizons"], motions["squared"], strict=True))
                values = [by_horizon[h] for h in self.horizons if by_horizon]
            array = np.array(values, dtype=np.float64)
            if array.size:
                out[run["split"], run["seed"]] = array
        return out

    def difference(self, criterion: str, challenger: str, baseline: str) -> PairedDifference | None:
        """Of two models, over the seeds of which both finished all splits, by one of `CRITERIA`."""
        one, other = self.errors(criterion, challenger), self.errors(criterion, baseline)
        shared = [run for run in one if run in other]
        splits = list(dict.fromkeys(split for split, _ in shared))
        seeds = [k for k in dict.fromkeys(seed for _, seed in shared) if all((split, k) in shared for split in splits)]
        if not seeds:
            return None
        a, b = (
            np.concatenate([np.stack([side[split, seed] for seed in seeds]) for split in splits], axis=2)
            for side in (one, other)
        )
        return paired_difference(criterion, challenger, baseline, a, b)

    def best_of(self, kinds: Sequence[str], criterion: str, but: str | None = None) -> str | None:
        """The model of these kinds with the lowest error, among those that failed, lost joints and diverged least."""
        found, asked = [], (name for name, model in self.models.items() if model["kind"] in kinds and name != but)
        beside = [name for name in asked if self.errors(criterion, name)]
        for name in beside:
            errors = self.errors(criterion, name)
            every = np.ma.masked_invalid(np.concatenate(list(errors.values()), axis=1))
            if every.count():
                # over runs and stretches as differences are; of motions the geometric mean over horizons
                level = float(np.log(np.maximum(every.mean(axis=1).compressed(), np.finfo(float).tiny)).mean())
                failed, diverged = len(self.runs[name]) - len(errors), int(every.mask.sum())
                found.append((failed, self.unusable(name, beside), diverged, level, name))
        return min(found)[-1] if found else None

    @cached_property
    def winner(self) -> Winner | None:
        """The best parametric model, unless another is better, or usable in more joints; None where none was scored."""
        for criterion in CRITERIA:
            simple, other = (self.best_of(kinds, criterion) for kinds in (PARAMETRIC, LEARNED))
            if simple is not None and other is not None:
                found = self.difference(criterion, other, simple)
                if more := self.unusable(simple, [other]) - self.unusable(other, [simple]):
                    why = f"usable in {abs(more)} more joint{'s' if abs(more) > 1 else ''}"
                    return Winner(other if more > 0 else simple, found, why)
                if found is None or not found.favours_challenger:
                    return Winner(simple, found, "nothing is shown to be better than the best parametric")
                sure = found.outcome == "better"
                return Winner(other, found, "" if sure else "a third better or more, on too little time to be sure")
            if (only := simple or other) is not None:
                second = self.best_of((*PARAMETRIC, *LEARNED), criterion, but=only)
                found = None if second is None else self.difference(criterion, only, second)
                return Winner(only, found, "" if found else "no other model was scored")
        return None

    @property
    def recommended(self) -> str | None:
        """The model to take, by motions, else forces; None where no model was scored."""
        return None if self.winner is None else self.winner.model

    def fitted_on_all_rows(self, identified: Mapping[str, Posterior] | None = None) -> Posterior:
        """The recommended model from all rows; `identified` are made from them already. Raises FitError if none is."""
        if self.recommended is None:
            raise FitError(f"no model was fitted: {'; '.join(self.failures)}.")
        if self.fit is None:
            raise FitError("these scores came without their models.")
        return self.fit(self.recommended, identified or {})

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a reader has to know beside the numbers; of several models with their names, alike ones once."""
        told = [(text, name) for name in self.models for run in self.runs[name] for text in run["warnings"]]
        if len(self.models) == 1:
            return tuple(dict.fromkeys(text for text, _ in told))
        each = [alike((text, name) for text, name in told if name == own) for own in self.models]
        return tuple(f"{found[0][1]}: {found[0][0]}" for groups in each for found in groups)

    @property
    def failures(self) -> list[str]:
        """Which models failed in which runs, and why."""
        lines = []
        for name, runs in self.runs.items():
            failed: dict[str, list[str]] = {}
            for run in runs:
                if run["error"] is not None:
                    failed.setdefault(run["error"], []).append(f"{run['split']}, seed {run['seed']}")
            lines += [f"{name} failed in {len(where)} of {len(runs)} runs ({'; '.join(where)}): {reason}"
                      for reason, where in failed.items()]  # fmt: skip
        return lines

    @override
    def facts(self) -> dict[str, object]:
        """The scores that say most; all are in `to_dict()`."""
        name = next(iter(self.models)) if len(self.models) == 1 else self.recommended or ""
        held = self.quantities(name)[ACCELERATION] if name and self.finished(name) else ()
        known = [score for score in ("mae", "noise_floor", "known_physics_mae", "coverage_95") if score in held]
        facts = {f"{score} of acceleration": f"{self.value(score, model=name):.3g}" for score in known}
        best = {"recommended": name or "none"} if len(self.models) > 1 else {}
        return {"models": listed(self.models), **best, **facts, "warnings": listed(self.warnings, most=1)}

    def to_dict(self) -> dict[str, Any]:
        """Everything but the models as plain JSON values."""
        models, taken = dict[str, Any](), self.winner
        difference = taken and taken.difference and asdict(taken.difference)
        for name, model in self.models.items():
            table = {
                quantity: {
                    score: {"all": self.spread(score, quantity, name), "each": self.columns(score, quantity, name)}
                    for score in scores
                }
                for quantity, scores in self.quantities(name).items()
            }
            models[name] = {**model, "finished": len(self.finished(name)), "scores": table}
        return {
            **self.about,
            "joint_names": list(self.joint_names),
            "units": dict(self.units),
            "models": models,
            "recommended": self.recommended,
            "winner": taken and {"model": taken.model, "sentence": taken.sentence, "difference": difference},
            "warnings": list(self.warnings),
            "failures": self.failures,
            "runs": {name: [dict(run) for run in runs] for name, runs in self.runs.items()},
        }
