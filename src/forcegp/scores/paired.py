"""Which model is better, and is it shown? The difference of two models that predicted the same stretches of time.

Errors are squared, averaged over stretches and seeds, and compared by the logarithm of their ratio (densities by the
difference of nats). What other stretches, and other choices of training rows, would have changed is the jackknife's
variance over each (Efron & Stein, "The jackknife estimate of variance", 1981); both are added, with the degrees of
freedom of Welch & Satterthwaite. So a pair of models that use no chance at all still has an interval, and many seeds
on one short recording do not make it narrow.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student

CERTAINTY = 0.95
MARGIN = 0.02  # of a ratio: a difference below it matters to nobody, however sure it is
CLEAR, MOSTLY = 0.67, 0.8  # ratio and share of stretches that decide where a log is too short to show anything
MOST_LOG = 700.0  # of a ratio that is still a finite number

CRITERIA: Mapping[str, str] = {
    "motion": "error of predicted motions",
    "force": "force-space error",
    "acceleration": "normalised error of the acceleration",
    "density": "negative log predictive density",
}
"""What is compared: `motion` over all horizons. Ratios, but densities differences."""

Errors = Float[np.ndarray, "seeds horizons stretches"]


@dataclass(frozen=True)
class PairedDifference:
    """Challenger against baseline by one criterion.

    `value` is the ratio of root mean square errors (0.8: a fifth less), or the mean difference in nats; the interval is
    of the same kind, None for one stretch and one seed. The challenger was better in `wins` of `runs` and, over all
    seeds, in `ahead` of `stretches` (motions, for that score). A ratio within `MARGIN` of 1 is no
    difference.
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

    @property
    def outcome(self) -> str:
        """`better`, `worse` or `no difference`."""
        equal = 0.0 if self.criterion == "density" else 1.0  # where both are equal
        if self.interval is None or abs(self.value - equal) < MARGIN:
            return "no difference"
        low, high = self.interval
        return "better" if high < equal else "worse" if low > equal else "no difference"

    @property
    def favours_challenger(self) -> bool:
        """Whether the challenger is the one to take: shown to be better, or a third better in most stretches.

        A short log shows nothing, however large the difference; to stay with the worse model would be no caution.
        """
        large = self.criterion != "density" and self.value <= CLEAR and self.ahead >= MOSTLY * self.stretches
        return self.outcome == "better" or (self.outcome == "no difference" and large)

    @property
    def sentence(self) -> str:
        """The outcome with its numbers; what it goes by is for the reader to name."""
        answer = {"better": "**Better**", "worse": "**Worse**", "no difference": "**No difference that the data show**"}
        interval = "one stretch and one seed, so no interval"
        if self.interval is not None:
            low, high = (_formatted(self.criterion, end) for end in self.interval)
            interval = f"95 % interval {low} to {high}"
        if self.criterion == "density":
            pair = f"{self.challenger} − {self.baseline} = {_formatted(self.criterion, self.value)} nats"
        else:
            pair = f"{self.challenger} / {self.baseline} = {_formatted(self.criterion, self.value)}"
        what = "motions" if self.criterion == "motion" else "held-out stretches of time"
        better = f"better in {self.wins} of {self.runs} runs and in {self.ahead} of {self.stretches} {what}"
        return f"{answer[self.outcome]}: {pair} ({interval}; {better})."

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {**asdict(self), "verdict": self.outcome, "sentence": self.sentence}


def _formatted(criterion: str, value: float) -> str:
    return f"{value:+.3g}" if criterion == "density" else f"{value:.3g}"


def paired_difference(
    criterion: str, challenger: str, baseline: str, one: Errors, other: Errors
) -> PairedDifference | None:
    """Compare squared errors (nats for `density`) of two models, the lower the better.

    Stretches that one of them could not predict are left out. None without any, or with an error of 0.
    """
    usable = (np.isfinite(one) & np.isfinite(other)).all(axis=(0, 1))
    one, other = one[..., usable], other[..., usable]
    nats = criterion == "density"

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
    return PairedDifference(
        criterion, challenger, baseline, len(one), wins, shown(value), interval, ahead, one.shape[2]
    )
