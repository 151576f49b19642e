"""What a fit learns from: measured accelerations, torques, windows of raw signals, motions.

Everything that can be measured on a robot is affine in its forces, so each kind of evidence gives the same rows: a
residual that is the effect of forces, how it depends on them, and the noise (docs/explanation/model.md). A new kind is
one class, and an entry in `EVIDENCE`.

Windows: with a test function phi of integral 1, y = int phi a dt comes from q or v alone, the weak form (Messenger &
Bortz 2021, "Weak SINDy"; docs/how-to/without-accelerations.md). It is linear in the unknown forces, and no filter comes
before. White noise of the signal makes independent noise of y. Positions of a base that moves are steps from the middle
of their window, and what turns on the way is added.
"""

import warnings
from abc import ABC
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.special import beta

from forcegp.data.configurations import as_vectors, chart_acceleration, space_of, switches
from forcegp.data.dataset import Dataset
from forcegp.data.filters import episodes_in_order, require_no_turns
from forcegp.data.preparation import preparation_report
from forcegp.data.views import farthest_point_sampling
from forcegp.errors import DatasetError, DataWarning, InvalidInput, require_known, require_type, usable_arguments
from forcegp.forces.registry import called
from forcegp.robots.arguments import whole_number


class Evidence(ABC):
    """One kind of evidence; a frozen dataclass."""

    name: ClassVar[str]
    columns: ClassVar[tuple[str, ...]] = ("q", "v", "u", "a")
    """Signals of a log that it needs."""
    in_order: ClassVar[bool] = False
    """Whether it needs rows in order of time."""

    def check(self, dataset: Dataset) -> None:
        """Raise InvalidInput where a log lacks what this needs."""
        if self.in_order and not dataset.time_ordered:
            raise InvalidInput(
                f"{self.name} need rows in order of time, and these are a sample; give the whole recording."
            )

    def __str__(self) -> str:
        given = [f"{f.name} {getattr(self, f.name)}" for f in fields(self) if getattr(self, f.name) != f.default]  # type: ignore[arg-type]  # every evidence is a dataclass
        return ", ".join([self.name, *given])


@dataclass(frozen=True)
class Accelerations(Evidence):
    """Accelerations of single rows: of forward dynamics, with noise of accelerations and of forces.

    For models without unknown forces it is maximum likelihood of both levels of noise; right where arms are light, and
    where accelerations are measured well.

    robust: count residuals beyond 1.5 standard deviations by their absolute value (soft L1); not for unknown forces.
    """

    name: ClassVar[str] = "accelerations"
    robust: bool = False
    of_torque: ClassVar[bool] = False
    noisy_in_both: ClassVar[bool] = False


@dataclass(frozen=True)
class Torques(Evidence):
    """Torques of single rows: what inverse dynamics needs less what was measured; right where torque sensors are good.

    noisy: "u": torques are noisy. "both": accelerations, too, as those of differentiated positions are; then it is
        maximum likelihood about the accelerations that were there (errors in variables), and what a base that moves
        needs, whose rows noise of a alone would draw to masses of zero.
    robust: count residuals beyond 1.5 standard deviations by their absolute value (soft L1); with "both", whole rows by
        their logarithm (Cauchy).
    mean: average the equations over windows of so many s, which takes noise of the acceleration, under which inertias
        look too small, but leaves friction as sharp as it is.
    """

    name: ClassVar[str] = "torques"
    noisy: Literal["u", "both"] = "u"
    robust: bool = False
    mean: float | None = None
    of_torque: ClassVar[bool] = True

    @usable_arguments("Torques")
    def __post_init__(self) -> None:
        if self.noisy not in ("u", "both"):
            raise InvalidInput(f"Torques noisy is {self.noisy!r}; give 'u' or 'both'.")
        require_type("robust", self.robust, bool)
        if self.mean is not None and not 0.0 < self.mean < float("inf"):
            raise InvalidInput(f"Torques mean is {self.mean!r}; give the length of a window in s, or None.")

    @property
    def noisy_in_both(self) -> bool:
        """Whether accelerations are noisy as well."""
        return self.noisy == "both"


@dataclass(frozen=True)
class Motions(Evidence):
    """Recorded positions over windows of so many `seconds`: what a model predicts is what it is fitted to.

    It refines what other evidence found: forces, the bodies of the robot with `bodies`, and unknown functions, near
    that start. q and u of each row count, and v where a window begins. See docs/how-to/motions.md.
    """

    name: ClassVar[str] = "motions"
    columns: ClassVar[tuple[str, ...]] = ("q", "v", "u")
    in_order: ClassVar[bool] = True
    seconds: float = 1.0
    bodies: bool = True

    @usable_arguments("Motions")
    def __post_init__(self) -> None:
        if not isinstance(self.seconds, int | float) or self.seconds is True or not 0.0 < self.seconds < float("inf"):
            raise InvalidInput(
                f"Motions seconds is {self.seconds!r}; give the length of windows in s, a positive number."
            )


EXACT_DEGREE = 5
"""Weights are exact for polynomials of time up to this degree, however uneven the steps."""

FEWEST_ROWS = EXACT_DEGREE + 3
LONGEST_STEP = 2.5
"""Steps of time longer than this multiple of the median are gaps, and no window spans one."""
PATH_DEGREE = 3
"""Of the polynomials that show how much a moving base turns in a window."""

WINDOWS_AT_ONCE = 4096
SMALLEST_SHARE = 1e-6
"""Of the largest weight: rows at the ends of a window keep some, so that every node is the mean of its rows."""


@dataclass(frozen=True, eq=False)
class WindowedRows:
    """N windows of n nodes, in place of rows with accelerations.

    Rows k n to (k + 1) n - 1 of `nodes` are the states (q, v, u) of window k; their `a` is y of the window, the same in
    all of them, and `noise_std` the noise that the sensors give it. `weights` c (N, n), of sum 1: y = sum_i c_i a_i.
    """

    nodes: Dataset
    weights: Float[np.ndarray, "N n"]

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def noise_level(self) -> Float[np.ndarray, " nv"] | None:
        """The noise of the sensors in y as one number per joint; None where a signal shows none."""
        return self.nodes.noise_level

    @property
    def observed(self) -> Float[np.ndarray, "N nv"]:
        """y of every window, a weighted mean of the acceleration [units of a]."""
        return self.nodes.a[:: self.weights.shape[1]]


@dataclass(frozen=True)
class Windows(Evidence):
    """Means of the acceleration over windows of raw positions or velocities, without a derivative: the weak form.

    phi = (1 - s^2)^order on s from -1 to 1, scaled to integral 1; `signal` is "q" (with phi'') or "v" (with phi').

    `seconds` is the length of a window, `nodes` the states that stand for its rows (n): each is the weighted mean of
    the rows around it, so that what is linear along a window enters without error, and noise of the states is averaged.

    Order 2 on q is the second derivative of the parabola that fits a window best, and order 1 on v the slope of the
    straight line: among all unbiased ones these have the least noise (Savitzky & Golay 1964). Higher orders look at the
    middle of a window only, and need longer ones.
    """

    name: ClassVar[str] = "windows"
    in_order: ClassVar[bool] = True
    seconds: float = 0.1
    nodes: int = 6
    signal: Literal["q", "v"] = "q"
    order: int = 2

    @usable_arguments("Windows")
    def __post_init__(self) -> None:
        if not (isinstance(self.seconds, int | float) and 0.0 < self.seconds < float("inf")):
            raise InvalidInput(f"Windows seconds is {self.seconds!r}; it must be positive and finite.")
        whole_number("nodes", self.nodes, 1)
        if self.signal not in ("q", "v"):
            raise InvalidInput(f"Windows signal is {self.signal!r}; allowed: 'q' (positions) or 'v' (velocities).")
        whole_number("order", self.order, 2 if self.signal == "q" else 1, 16, f"of windows of {self.signal}")

    def signal_weights(self, time: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "N m"]:
        """w with y = sum_i w_i signal(t_i)."""
        s, half, step = _scaled(time)
        p, rest = self.order, 1.0 - s**2
        size = 1.0 / beta(0.5, p + 1)
        powers, moments = np.arange(EXACT_DEGREE + 1), np.zeros(EXACT_DEGREE + 1)
        if self.signal == "v":
            slope = -2.0 * p * s * rest ** (p - 1)
            moments[1:] = powers[1:] * self._moments(EXACT_DEGREE)
            return _exact(-size * slope * step, s, moments) / half
        bend = -2.0 * p * rest ** (p - 1) + 4.0 * p * (p - 1) * s**2 * np.maximum(rest, 0.0) ** max(p - 2, 0)
        moments[2:] = powers[2:] * powers[1:-1] * self._moments(EXACT_DEGREE - 1)
        return _exact(size * bend * step, s, moments) / half**2

    def acceleration_weights(self, time: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "N m"]:
        """c with y = sum_i c_i a(t_i), of sum 1."""
        s, _, step = _scaled(time)
        phi = (1.0 - s**2) ** self.order / beta(0.5, self.order + 1)
        return _exact(phi * step, s, self._moments(EXACT_DEGREE + 1))

    def _moments(self, count: int) -> Float[np.ndarray, " count"]:
        """int phi s^k ds, k = 0, 1, ...."""
        k = np.arange(count)
        return np.where(k % 2 == 0, beta(0.5 * (k + 1), self.order + 1) / beta(0.5, self.order + 1), 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Name and settings as plain JSON values."""
        return {"name": self.name, **asdict(self)}

    def count(self, dataset: Dataset) -> int:
        """How many windows the dataset has; raises as `windows`."""
        return len(_window_rows(dataset, self))

    def windows(self, dataset: Dataset, points: int | None = None) -> WindowedRows:
        """The `points` windows whose mean states (q, v, u) lie farthest apart; all of them for None.

        Windows follow each other without sharing a row, so their noise is independent; none holds a row at which a
        contact is switched. Rows must be in order of time, at the rate of the sensors and unfiltered: noise of filtered
        signals is not white (a DataWarning reports it). Raises DatasetError for rows in another order, positions that
        jump by a turn and logs without a window; InvalidInput for more points than windows, windows of too few rows and
        more nodes than rows.
        """
        rows = _window_rows(dataset, self)
        _warn_of_filtered(dataset)
        if points is not None:
            why = f"the windows of {self.seconds:g} s in the dataset; give fewer points or shorter windows"
            points = whole_number("points", points, 2, len(rows), why)
        if points is not None and points < len(rows):
            rows = rows[farthest_point_sampling(self._mean_states(dataset, rows), points)]
        time = dataset.time[rows]
        weights, c = self.signal_weights(time), self.acceleration_weights(time)
        middle, near = _near_middle(dataset, rows)
        observed = np.einsum("km,kmj->kj", weights, near if self.signal == "q" else dataset.v[rows])
        if self.signal == "q":
            observed += np.einsum("km,kmj->kj", c, _turning(dataset, near, time))
        noise = white_noise(dataset, self.signal) * np.linalg.norm(weights, axis=1)[:, None]
        parts = np.array_split(np.arange(rows.shape[1]), self.nodes)
        positive = np.maximum(c, SMALLEST_SHARE * c.max(axis=1, keepdims=True))

        def at_nodes(values: np.ndarray) -> np.ndarray:
            shares = (positive[:, part] / positive[:, part].sum(axis=1, keepdims=True) for part in parts)
            means = [np.einsum("km,kmj->kj", w, values[:, part]) for w, part in zip(shares, parts, strict=True)]
            return np.stack(means, axis=1).reshape(len(rows) * self.nodes, values.shape[-1])

        v, u = at_nodes(dataset.v[rows]), at_nodes(dataset.u[rows])
        held = switches(dataset)
        first = dataset.u[rows[:, 0]][:, held]  # means would not be exactly 0 or 1
        u[:, held] = np.repeat(first, self.nodes, axis=0)
        repeat = {name: np.repeat(values, self.nodes, axis=0) for name, values in (("a", observed), ("noise", noise))}
        nodes = replace(
            dataset,
            q=_moved(dataset, np.repeat(middle, self.nodes, axis=0), at_nodes(near)),
            v=v,
            u=u,
            a=repeat["a"],
            time=at_nodes(dataset.time[rows][..., None])[:, 0],
            episode=np.repeat(dataset.episode[rows[:, 0]], self.nodes),
            noise_std=repeat["noise"] if (noise > 0).all() else None,
            truth={},
            metadata={**dataset.metadata, "windows": self.to_dict()},
            time_ordered=False,
        )
        return WindowedRows(nodes, np.stack([c[:, part].sum(axis=1) for part in parts], axis=1))

    def _mean_states(self, dataset: Dataset, rows: Int[np.ndarray, "N m"]) -> Float[np.ndarray, "N columns"]:
        """q, v and u of every window, weighted as its acceleration is; some windows at a time, for logs may be long."""
        means = []
        for start in range(0, len(rows), WINDOWS_AT_ONCE):
            some = rows[start : start + WINDOWS_AT_ONCE]
            c = self.acceleration_weights(dataset.time[some])
            middle, near = _near_middle(dataset, some)
            near, v, u = (np.einsum("km,kmj->kj", c, values) for values in (near, dataset.v[some], dataset.u[some]))
            means.append(np.hstack([_moved(dataset, middle, near), v, u]))
        return np.concatenate(means)


def white_noise(dataset: Dataset, signal: Literal["q", "v"]) -> Float[np.ndarray, " nv"]:
    """Standard deviation of the white noise of a signal, from its third differences within episodes [its units].

    Third differences of white noise have 20 times its variance, those of a motion at the rate of a sensor next to none.
    """
    signals = [as_vectors(rows) if signal == "q" else rows.v for _, rows, _ in episodes_in_order(dataset)]
    thirds = [np.diff(values, 3, axis=0) for values in signals if len(values) > 3]
    return np.sqrt(np.square(np.concatenate(thirds)).mean(axis=0) / 20.0)


def _window_rows(dataset: Dataset, how: Windows) -> Int[np.ndarray, "N m"]:
    """Row numbers of all windows: one after the other through every episode, none over a gap."""
    steps = np.diff(dataset.time)[np.diff(dataset.episode) == 0]
    median = float(np.median(steps)) if steps.size else 0.0
    length = round(how.seconds / median) + 1 if median > 0.0 else 0
    if 0 < length < FEWEST_ROWS:
        raise InvalidInput(
            f"a window of {how.seconds:g} s has {length} rows at steps of {median:.4g} s; at least {FEWEST_ROWS} are "
            f"needed: give {(FEWEST_ROWS - 1) * median:.3g} s or more, or the log at the rate of its sensors."
        )
    if how.nodes > length > 0:
        raise InvalidInput(f"{how.nodes} nodes for windows of {length} rows; give at most {length}.")
    found = []
    for number, rows, label in episodes_in_order(dataset):
        require_no_turns(rows, label)
        at = np.flatnonzero(dataset.episode == number)
        blocks = at[: len(at) // length * length].reshape(-1, length) if length else at[:0].reshape(0, 1)
        gaps = np.diff(dataset.time[blocks], axis=1) > LONGEST_STEP * median
        switched = np.diff(dataset.u[blocks][..., switches(dataset)], axis=1).any(axis=2)
        found.append(blocks[~(gaps | switched).any(axis=1)])
    every = np.concatenate(found)
    if not len(every):
        raise DatasetError(
            f"no episode has {how.seconds:g} s without a gap (a step of more than {LONGEST_STEP:g} times the median, "
            f"{median:.4g} s) or a contact that is switched; give shorter windows, or a log without gaps."
        )
    return every


def _near_middle(dataset: Dataset, rows: Int[np.ndarray, "N m"]) -> tuple[np.ndarray, np.ndarray]:
    """Positions in the middle of every window (N, nq), and those of its rows as steps from there (N, m, nv)."""
    space, q = space_of(dataset), dataset.q[rows]
    middle = q[:, q.shape[1] // 2]
    if space.is_vector_space:
        return np.zeros_like(middle), q
    return middle, space.difference(torch.tensor(middle)[:, None], torch.tensor(q)).numpy()


def _moved(dataset: Dataset, middle: np.ndarray, step: np.ndarray) -> np.ndarray:
    return space_of(dataset).integrate(torch.tensor(middle), torch.tensor(step)).numpy()


def _turning(dataset: Dataset, near: np.ndarray, time: np.ndarray) -> np.ndarray:
    """What a lacks in the second derivative of steps from the middle, (N, m, nv): body axes turn on the way.

    From the polynomials of degree `PATH_DEGREE` through a window, for this is small and noise must stay small in it.
    """
    space = space_of(dataset)
    if space.is_vector_space:
        return np.zeros_like(near)
    s, half, _ = _scaled(time)
    powers = s[..., None] ** np.arange(PATH_DEGREE + 1)
    path = np.linalg.pinv(powers) @ near
    k = np.arange(1, PATH_DEGREE + 1)[:, None]
    rate = powers[..., :-1] @ (k * path[:, 1:]) / half[..., None]
    bend = powers[..., :-2] @ (k[1:] * k[:-1] * path[:, 2:]) / np.square(half)[..., None]
    return chart_acceleration(space, powers @ path, rate, bend) - bend


def _warn_of_filtered(dataset: Dataset) -> None:
    cutoff = preparation_report(dataset.metadata).get("cutoff")
    if cutoff is not None:
        warnings.warn(
            f"the dataset was filtered at {cutoff:g} Hz, so the noise of its windows is not what they take it for; "
            "learn from windows of the raw log.",
            DataWarning,
            stacklevel=4,
        )


def _scaled(time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times of every window as s from -1 to 1, half its length [s], and the weights of the trapezoidal rule in s."""
    half = 0.5 * (time[:, -1:] - time[:, :1])
    s = (time - time[:, :1]) / half - 1.0
    steps = np.diff(s, axis=1)
    zero = np.zeros_like(half)
    return s, half, 0.5 * (np.hstack([steps, zero]) + np.hstack([zero, steps]))


def _exact(weights: np.ndarray, s: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """The nearest weights with sum_i w_i s_i^k = moments_k for all k: what the trapezoidal rule only approximates."""
    powers = s[..., None] ** np.arange(len(moments))
    missing = moments - np.einsum("km,kmj->kj", weights, powers)
    gram = np.einsum("kmi,kmj->kij", powers, powers)
    return weights + np.einsum("kmj,kj->km", powers, np.linalg.solve(gram, missing[..., None])[..., 0])


EVIDENCE: dict[str, type[Evidence]] = {
    "accelerations": Accelerations,
    "torques": Torques,
    "windows": Windows,
    "motions": Motions,
}
"""Kinds by the name that commands and files have for them. Add yours: EVIDENCE["mine"] = Mine."""


@usable_arguments("parse_evidence")
def parse_evidence(words: str | Sequence[str]) -> tuple[Evidence, ...]:
    """The evidence of a text or of its parts: `NAME[:VALUE][:FIELD=VALUE...]` with commas: "torques,motions:1"."""
    found = []
    for word in words.split(",") if isinstance(words, str) else words:
        name, *options = word.strip().split(":")
        require_known("evidence", name, "forcegp", EVIDENCE)
        found.append(called(f"evidence {name!r}", EVIDENCE[name], options))
    return tuple(found)
