"""Which model is better? PairedTest over runs, in which both saw the same training rows and predicted the same others.

With the difference d of one run (of logarithms for errors, so that it is a ratio; of nats for densities), n runs show
that one model is better if the 95 % interval of the mean of d excludes 0: mean -+ t(0.975, n - 1) s / sqrt(n)
(Student's paired test). Runs differ by their training rows; that recordings differ as well, only several splits show.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool
from scipy.stats import t as student

from forcegp.validation.scores import over_joints

CERTAINTY = 0.95
MOST_LOG = 700.0
"""Of a ratio that is still a finite number."""

SCORES: Mapping[str, str] = {
    "nrmse": "normalised error of the acceleration",
    "force_rms": "force-space error",
    "nlpd": "negative log predictive density",
    "motion": "error of predicted motions",
}
"""What is compared, by the name of the score; `motion` is at the longest horizon. Ratios, but densities differences."""

QUESTIONS: Sequence[tuple[str, tuple[str, ...], tuple[str, ...]]] = (
    ("Is the identified model better than the system as given?", ("identified",), ("given",)),
    ("Does a Gaussian process on forces beat the identified model?", ("force prior",), ("identified",)),
    ("Does a model without physics beat the identified model?", ("black box",), ("identified",)),
    ("Does a Gaussian process on forces beat models without physics?", ("force prior",), ("black box",)),
)
"""Question, kinds of the challenger and of the baseline; of both the one with the best median is taken."""


@dataclass(frozen=True)
class PairedTest:
    """Challenger against baseline in one score.

    `value` is the geometric mean of the ratios of errors (0.8: a fifth less), or the mean difference in nats; the
    interval is of the same kind, None for one run. In `wins` of `runs` the challenger was better, and in `ahead` of
    `stretches` of the held-out time its median over seeds was (none for motions).
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

    @property
    def outcome(self) -> str:
        """`better`, `worse` or `undecided`."""
        equal = 0.0 if self.score == "nlpd" else 1.0  # where both are equal
        if self.interval is None or self.interval[0] <= equal <= self.interval[1]:
            return "undecided"
        return "better" if self.interval[1] < equal else "worse"

    @property
    def sentence(self) -> str:
        """The outcome with its numbers."""
        answer = {"better": "**Yes**", "worse": "**No**", "undecided": "**Undecided**"}[self.outcome]
        interval = "one run, so no interval"
        if self.interval is not None:
            low, high = (_formatted(self.score, end) for end in self.interval)
            interval = f"95 % interval {low} to {high}"
        if self.score == "nlpd":
            pair = f"{self.challenger} − {self.baseline} = {_formatted(self.score, self.value)} nats"
        else:
            pair = f"{self.challenger} / {self.baseline} = {_formatted(self.score, self.value)}"
        better = f"better in {self.wins} of {self.runs} runs"
        if self.stretches:
            better += f" and in {self.ahead} of {self.stretches} held-out stretches of time"
        return f"{answer} by the {SCORES[self.score]}: {pair} ({interval}; {better})."

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {**asdict(self), "verdict": self.outcome, "sentence": self.sentence}


def _formatted(score: str, value: float) -> str:
    return f"{value:+.3g}" if score == "nlpd" else f"{value:.3g}"


def paired_test(
    score: str, challenger: str, baseline: str, one: Sequence[float], other: Sequence[float]
) -> PairedTest | None:
    """Compare the scores of two models run by run, the lower the better; None without runs, or with an error of 0."""
    a, b = np.asarray(one, dtype=np.float64), np.asarray(other, dtype=np.float64)
    in_nats = score == "nlpd"
    if not a.size or (not in_nats and bool((np.minimum(a, b) <= 0.0).any())):
        return None
    difference = a - b if in_nats else np.log(a) - np.log(b)

    def shown(value: float) -> float:
        return value if in_nats else math.exp(min(value, MOST_LOG))

    mean, interval = float(difference.mean()), None
    if len(a) > 1:
        half = student.ppf(0.5 + 0.5 * CERTAINTY, len(a) - 1) * float(difference.std(ddof=1)) / math.sqrt(len(a))
        interval = (shown(mean - half), shown(mean + half))
    return PairedTest(score, challenger, baseline, len(a), int((difference < 0.0).sum()), shown(mean), interval)


def conclusions(summary: Mapping[str, Any], runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """The answers to all questions for which there are models of both kinds, as plain JSON values."""
    out = []
    for question, challengers, baselines in QUESTIONS:
        answers = []
        for score in SCORES:
            names = [best_of(summary, runs, kinds, score) for kinds in (challengers, baselines)]
            if names[0] is None or names[1] is None:
                continue
            answer = compared(score, names[0], names[1], runs)
            if answer is not None:
                answers.append(answer.to_dict())
        if answers:
            out.append({"question": question, "answers": answers})
    return out


def against_baseline(
    summary: Mapping[str, Any], runs: Mapping[str, Sequence[Mapping[str, Any]]]
) -> dict[str, Any] | None:
    """Every model against the best identified one (without any: the system as given), as plain JSON values.

    None where neither has finished a run.
    """
    baseline = best_of(summary, runs, ("identified",), "nrmse") or best_of(summary, runs, ("given",), "nrmse")
    if baseline is None:
        return None
    compare = {
        name: {score: compared(score, name, baseline, runs) for score in SCORES}
        for name, model in summary.items()
        if name != baseline and model["runs"]
    }
    return {
        "baseline": baseline,
        "models": {
            name: {score: None if each is None else each.to_dict() for score, each in scores.items()}
            for name, scores in compare.items()
        },
    }


def best_of(
    summary: Mapping[str, Any], runs: Mapping[str, Sequence[Mapping[str, Any]]], kinds: Sequence[str], score: str
) -> str | None:
    """The model of these kinds with the lowest median, among those that failed least and diverged least."""
    found = []
    for name, model in summary.items():
        values = list(runs_of(score, runs[name]).values())
        if model["kind"] in kinds and values:
            missing = len(runs[name]) - len(values)
            found.append((missing, _diverged(model) if score == "motion" else 0, float(np.median(values)), name))
    return min(found)[-1] if found else None


def compared(
    score: str, challenger: str, baseline: str, runs: Mapping[str, Sequence[Mapping[str, Any]]]
) -> PairedTest | None:
    """`paired_test` over the runs that both models finished."""
    one, other = runs_of(score, runs[challenger]), runs_of(score, runs[baseline])
    shared = [run for run in one if run in other]
    found = paired_test(score, challenger, baseline, [one[run] for run in shared], [other[run] for run in shared])
    if found is None or score == "motion":
        return found
    ahead = _ahead(score, shared, runs[challenger], runs[baseline])
    return replace(found, ahead=int(ahead.sum()), stretches=len(ahead))


def _ahead(
    score: str, runs: Sequence[tuple[str, int]], one: Sequence[Mapping[str, Any]], other: Sequence[Mapping[str, Any]]
) -> Bool[np.ndarray, " stretches"]:
    """In which held-out stretches of time the median over seeds of the first model is lower."""
    out = []
    for split in dict.fromkeys(split for split, _ in runs):
        sides = []
        for side in (one, other):
            kept = [run["result"] for run in side if run["split"] == split and (split, run["seed"]) in runs]
            values = np.array([result["stretches"][score] for result in kept], dtype=np.float64)
            sides.append(np.median(values, axis=0))
        out.append(sides[0] < sides[1])
    return np.concatenate(out)


def runs_of(score: str, runs: Sequence[Mapping[str, Any]]) -> dict[tuple[str, int], float]:
    """One number per run, by split and seed: over all joints, at the longest horizon where it is of motions."""
    out = {}
    for run in runs:
        result = run["result"]
        if result is None:
            continue
        if score == "motion":
            value = None if result["motions"] is None else result["motions"]["rms"][-1]
        elif score == "nlpd":
            value = result["nlpd"]
        else:
            value = over_joints(score, result[score])
        if value is not None:
            out[run["split"], run["seed"]] = float(value)
    return out


def _diverged(model: Mapping[str, Any]) -> int:
    return 0 if model.get("motions") is None else model["motions"]["diverged"][-1]
