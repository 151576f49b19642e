"""Which model is better, and is it shown? PairedTest of two models that predicted the same held-out stretches of time.

Errors are squared, averaged over stretches and seeds, and compared by the logarithm of their ratio (densities by the
difference of nats). What other stretches, and other choices of training rows, would have changed is the jackknife's
variance over each (Efron & Stein, "The jackknife estimate of variance", 1981); both are added, with the degrees of
freedom of Welch & Satterthwaite. So a pair of models that use no chance at all still has an interval, and many seeds
on one short recording do not make it narrow.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student

CERTAINTY = 0.95
MARGIN = 0.02  # of a ratio: a difference below it matters to nobody, however sure it is
CLEAR, MOSTLY = 0.67, 0.8  # ratio and share of stretches that decide where a log is too short to show anything
MOST_LOG = 700.0  # of a ratio that is still a finite number

SCORES: Mapping[str, str] = {
    "motion": "error of predicted motions",
    "force_rms": "force-space error",
    "nrmse": "normalised error of the acceleration",
    "nlpd": "negative log predictive density",
}
"""What is compared, by the name of the score: `motion` over all horizons. Ratios, but densities differences."""

PARAMETRIC, NO_FORCES = ("given", "identified"), ("black box", "residual")
QUESTIONS: Sequence[tuple[str, tuple[str, ...], tuple[str, ...]]] = (
    ("Is the identified model better than the system as given?", ("identified",), ("given",)),
    ("Does a Gaussian process on forces beat the best parametric model?", ("force prior",), PARAMETRIC),
    ("Does a model without physics beat the best parametric model?", ("black box",), PARAMETRIC),
    ("Does a Gaussian process on forces beat models without force priors?", ("force prior",), NO_FORCES),
)
"""Question, kinds of the challenger and of the baseline; of both the one with the lowest error is taken."""

Runs = Mapping[str, Sequence[Mapping[str, Any]]]
Errors = Float[np.ndarray, "seeds horizons stretches"]


@dataclass(frozen=True)
class PairedTest:
    """Challenger against baseline in one score.

    `value` is the ratio of root mean square errors (0.8: a fifth less), or the mean difference in nats; the interval is
    of the same kind, None for one stretch and one seed. The challenger was better in `wins` of `runs` and, over all
    seeds, in `ahead` of `stretches` (motions, for that score). A ratio within `margin` of 1 is no difference.
    """

    score: str
    challenger: str
    baseline: str
    runs: int
    wins: int
    value: float
    interval: tuple[float, float] | None
    ahead: int = 0
    stretches: int = 0
    margin: float = MARGIN

    @property
    def outcome(self) -> str:
        """`better`, `worse` or `no difference`."""
        equal = 0.0 if self.score == "nlpd" else 1.0  # where both are equal
        if self.interval is None or abs(self.value - equal) < self.margin:
            return "no difference"
        low, high = self.interval
        return "better" if high < equal else "worse" if low > equal else "no difference"

    @property
    def favours_challenger(self) -> bool:
        """Whether the challenger is the one to take: shown to be better, or a third better in most stretches.

        A short log shows nothing, however large the difference; to stay with the worse model would be no caution.
        """
        large = self.score != "nlpd" and self.value <= CLEAR and self.ahead >= MOSTLY * self.stretches
        return self.outcome == "better" or (self.outcome == "no difference" and large)

    @property
    def sentence(self) -> str:
        """The outcome with its numbers."""
        answer = {"better": "**Yes**", "worse": "**No**", "no difference": "**No difference that the data show**"}
        interval = "one stretch and one seed, so no interval"
        if self.interval is not None:
            low, high = (_formatted(self.score, end) for end in self.interval)
            interval = f"95 % interval {low} to {high}"
        if self.score == "nlpd":
            pair = f"{self.challenger} − {self.baseline} = {_formatted(self.score, self.value)} nats"
        else:
            pair = f"{self.challenger} / {self.baseline} = {_formatted(self.score, self.value)}"
        what = "motions" if self.score == "motion" else "held-out stretches of time"
        better = f"better in {self.wins} of {self.runs} runs and in {self.ahead} of {self.stretches} {what}"
        return f"{answer[self.outcome]} by the {SCORES[self.score]}: {pair} ({interval}; {better})."

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {**asdict(self), "verdict": self.outcome, "sentence": self.sentence}


def _formatted(score: str, value: float) -> str:
    return f"{value:+.3g}" if score == "nlpd" else f"{value:.3g}"


def paired_test(
    score: str, challenger: str, baseline: str, one: Errors, other: Errors, margin: float = MARGIN
) -> PairedTest | None:
    """Compare squared errors (nats for `nlpd`) of two models, the lower the better.

    Stretches that one of them could not predict are left out. None without any, or with an error of 0.
    """
    usable = (np.isfinite(one) & np.isfinite(other)).all(axis=(0, 1))
    one, other = one[..., usable], other[..., usable]
    nats = score == "nlpd"

    def difference(seeds: np.ndarray, stretches: np.ndarray) -> float:
        a, b = (each[seeds][..., stretches].mean(axis=(0, 2)) for each in (one, other))
        return float((a - b if nats else 0.5 * (np.log(a) - np.log(b))).mean())

    if not one.size or (not nats and bool((np.minimum(one, other).mean(axis=(0, 2)) <= 0.0).any())):
        return None
    every = [np.arange(one.shape[axis]) for axis in (0, 2)]
    variances, freedoms = [], []
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
        return log if nats else math.exp(min(log, MOST_LOG))

    if freedoms:
        spread = sum(variances)
        # Welch and Satterthwaite; the larger one's freedom where nothing varies
        weights = sum(variance**2 / freedom for variance, freedom in zip(variances, freedoms, strict=True))
        half = float(student.ppf(0.5 + 0.5 * CERTAINTY, spread**2 / weights if weights else max(freedoms)))
        half *= math.sqrt(spread)
        interval = (shown(value - half), shown(value + half))
    wins = int((one.mean(axis=(1, 2)) < other.mean(axis=(1, 2))).sum())
    ahead = int((one.mean(axis=(0, 1)) < other.mean(axis=(0, 1))).sum())
    return PairedTest(score, challenger, baseline, len(one), wins, shown(value), interval, ahead, one.shape[2], margin)


def conclusions(summary: Mapping[str, Any], runs: Runs, margin: float = MARGIN) -> list[dict[str, Any]]:
    """The answers to all questions for which there are models of both kinds, as plain JSON values."""
    out = []
    for question, challengers, baselines in QUESTIONS:
        answers = []
        for score in SCORES:
            names = [best_of(summary, runs, kinds, score) for kinds in (challengers, baselines)]
            if names[0] is None or names[1] is None:
                continue
            answer = compared(score, names[0], names[1], runs, margin)
            if answer is not None:
                answers.append(answer.to_dict())
        if answers:
            out.append({"question": question, "answers": answers})
    return out


def winners(summary: Mapping[str, Any], runs: Runs, margin: float = MARGIN) -> dict[str, dict[str, str]]:
    """By score the model to take, and why: the best parametric one, unless the test favours another.

    A score that no model has is missing.
    """
    out = {}
    for score, words in SCORES.items():
        simple = best_of(summary, runs, PARAMETRIC, score)
        other = best_of(summary, runs, ("force prior", "residual", "black box"), score)
        if simple is None or other is None:
            if (only := simple or other) is not None:
                out[score] = {"model": only, "why": f"the lowest {words}; there is no other kind of model"}
            continue
        answer = compared(score, other, simple, runs, margin)
        if answer is not None and answer.favours_challenger:
            sure = "" if answer.outcome == "better" else "a third better or more, on too little time to be sure: "
            out[score] = {"model": other, "why": sure + answer.sentence}
        else:
            shown = "no comparison was possible" if answer is None else answer.sentence
            out[score] = {"model": simple, "why": f"nothing is shown to be better than the best parametric: {shown}"}
    return out


def against_baseline(summary: Mapping[str, Any], runs: Runs, margin: float = MARGIN) -> dict[str, Any] | None:
    """Every model against the best identified one (without any: the system as given), as plain JSON values.

    The best in motions where they were predicted, else in accelerations. None where neither has finished a run.
    """
    baseline = None
    for kind in ("identified", "given"):
        for score in ("motion", "nrmse"):
            baseline = baseline or best_of(summary, runs, (kind,), score)
    if baseline is None:
        return None
    models: dict[str, dict[str, Any]] = {}
    for name, model in summary.items():
        if name != baseline and model["runs"]:
            tests = {score: compared(score, name, baseline, runs, margin) for score in SCORES}
            models[name] = {score: None if each is None else each.to_dict() for score, each in tests.items()}
    return {"baseline": baseline, "models": models}


def best_of(summary: Mapping[str, Any], runs: Runs, kinds: Sequence[str], score: str) -> str | None:
    """The model of these kinds with the lowest error, among those that failed least and diverged least."""
    found = []
    for name, model in summary.items():
        errors = _errors(score, runs[name])
        if model["kind"] not in kinds or not errors:
            continue
        every = np.concatenate([np.where(np.isfinite(e), e, np.nan).reshape(len(e), -1) for e in errors.values()], 1)
        if np.isfinite(every).any():
            lost = int(np.isnan(every).sum())
            # the median over runs of the error over stretches; of motions the geometric mean over horizons
            means = [np.ma.masked_invalid(each).mean(axis=1).filled(np.nan) for each in errors.values()]
            levels = means if score == "nlpd" else [np.log(np.maximum(each, np.finfo(float).tiny)) for each in means]
            level = float(np.median([each.mean() for each in levels]))
            found.append((len(runs[name]) - len(errors), lost, level, name))
    return min(found)[-1] if found else None


def compared(score: str, challenger: str, baseline: str, runs: Runs, margin: float = MARGIN) -> PairedTest | None:
    """`paired_test` over the seeds of which both models finished all splits."""
    one, other = _errors(score, runs[challenger]), _errors(score, runs[baseline])
    shared = [run for run in one if run in other]
    splits = list(dict.fromkeys(split for split, _ in shared))
    seeds = [k for k in dict.fromkeys(seed for _, seed in shared) if all((split, k) in shared for split in splits)]
    if not seeds:
        return None
    a, b = (
        np.concatenate([np.stack([side[split, seed] for seed in seeds]) for split in splits], axis=2)
        for side in (one, other)
    )
    return paired_test(score, challenger, baseline, a, b, margin)


def _errors(
    score: str, runs: Sequence[Mapping[str, Any]]
) -> dict[tuple[str, int], Float[np.ndarray, "horizons stretches"]]:
    """Squared errors (nats for `nlpd`) of the runs that have them, by split and seed; one horizon for accelerations."""
    out = {}
    for run in runs:
        result = run["result"]
        if result is None or (score == "motion" and result["motions"] is None):
            continue
        if score == "motion":
            values = np.array(result["motions"]["squared"], dtype=np.float64)
        else:
            values = np.array([result["stretches"][score]], dtype=np.float64)
            values = values if score == "nlpd" else values**2
        if values.size:
            out[run["split"], run["seed"]] = values
    return out
