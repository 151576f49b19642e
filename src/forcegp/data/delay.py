"""How much later than they act torques were logged, and behind which filter; and waves over positions, beside them."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from forcegp.data.dataset import Dataset
from forcegp.data.filters import LowPass, episodes_in_order, lagged, low_pass
from forcegp.data.strokes import joint_positions, with_strokes
from forcegp.errors import DatasetError, InvalidInput
from forcegp.forces.joint_laws import law_columns, usual_columns
from forcegp.forces.presliding import after_strokes

LEAST_DELAY, USUAL_DELAY, LARGEST_DELAY = 5e-4, 0.05, 0.2  # s
STEPS = 100  # shifts that are tried to either side
BLOCKS = 8
TINY = 1e-12
MOST_ROWS = 5_000
SIGNIFICANT = 3.0  # standard deviations by which a delay must differ from zero to be used
FRICTION_WIDTHS = 0.01, 0.03, 0.1, 0.3, 1.0  # of dry friction, relative to the root mean square velocity
STIFFNESSES = 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0  # of its memory, over the reciprocal deviation of the position
MEMORIES = 2 * len(STIFFNESSES)  # the last of `torque_columns`, where strokes are known: those of memory
REMEMBERS = 0.3
"""Square sum with friction that remembers, over that without, below which the delay is that beside memory.

Hysteresis of gears reads as a delay: 43 ms on arms with a presliding of 1 mrad and none, where it is below .2. Beside
memory a delay is less sharp, though: where a low-pass filter of dry friction alone makes it .5, velocity is asked, too.
"""
ROWS_PER_PARAMETER = 3

FEWEST, FINEST, STEP = 3.0, 300.0, 0.2
"""Repetitions over the reach of a joint: fewest, most, and steps of what is tried."""
REPEATS, LITTLE = 0.5, 0.02  # of what is left, that a wave explains (wrong friction: .26); of a force, to seek one
PLACES = 2048  # bins of the reach, in which a wave is sought first: seven of the finest
APART = 0.01  # width of the 95 % interval of a delay [s] beyond which the log is said not to tell it
LAGS, LAGGING, LAG_ROWS, IN_BAND = (0.5, 3.0), 0.6, 2_500, 1.5
"""Bounds of the lag of a filter, over the delay that it looks like; the share of what that leaves, below which it is a
lag; the rows that tell it; and times its corner at which it is sought, for below it lags are delays."""
WORTH = 0.95
"""Unexplained torque with the common delay, relative to that without, above which the delay explains nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Delay:
    """Delay of the torque behind the motion [s], with standard deviations [s]; NaN where the log shows none.

    `common` suits all joints best; `seconds` (nv,) is that of each joint alone, which may be one of friction. `remains`
    is what the common delay leaves of what was unexplained, as the geometric mean over the joints, and `left` that of
    the square sums themselves. With a `lag` [s] the torque was logged behind a filter of first order, and then shifted.
    """

    common: float
    common_std: float
    seconds: Float[np.ndarray, " nv"]
    std: Float[np.ndarray, " nv"]
    remains: float
    left: float = float("nan")
    lag: float = 0.0

    @property
    def significant(self) -> float:
        """The common delay if most joints show it and it is more than three standard deviations from zero, else 0."""
        each, std = (x[np.isfinite(self.seconds)] for x in (self.seconds, self.std))
        near = np.abs(each - self.common) <= np.maximum(SIGNIFICANT * np.nan_to_num(std), 0.5 * abs(self.common))
        if 2 * near.sum() <= len(near) or self.remains >= WORTH:
            return 0.0
        spread = max(self.common_std, float(np.std(each[near])) / near.sum() ** 0.5)
        return self.common if abs(self.common) > max(SIGNIFICANT * spread, LEAST_DELAY) else 0.0

    @property
    def behind(self) -> str:
        """The filter that the `lag` is of."""
        return f"behind a low-pass of first order at {0.5 / np.pi / self.lag:.2g} Hz"

    @property
    def reason(self) -> str:
        """The common delay and what became of it, for people."""
        if self.lag:
            left = f"{100.0 * self.remains:.2g} % of what inverse dynamics does not explain are left"
            return f"u is logged {self.behind}, which is undone; {left}"
        if not np.isfinite(self.common):
            return "the torques show no common delay"
        size, used = f"{1e3 * self.common:.1f} ms ± {1e3 * self.common_std:.1f} ms", self.significant
        if used:
            return f"{size}, which leaves {100.0 * self.remains:.0f} % of what inverse dynamics does not explain"
        ends = (self.common - 2.0 * self.common_std, self.common + 2.0 * self.common_std)
        low, high = 1e3 * np.clip(ends, -LARGEST_DELAY, LARGEST_DELAY)
        if high - low > 1e3 * APART:
            return f"{low:.0f} to {high:.0f} ms cannot be told apart here from friction: none is assumed"
        if self.remains >= WORTH:
            return "u is taken to be on time: a delay explains hardly anything"
        return f"{size}, but not more than three standard deviations in most joints: none is assumed"


def estimate_delay(dataset: Dataset, cutoff: float | None = None, filters: bool = True) -> Delay:
    """The delay of u behind the motion, joint by joint: `u_logged(t + delay)` acts at t.

    For every shift up to .2 s, u is fitted by least squares to the torque regressor of the model's robot, a rotor,
    friction of several widths, a constant, and the model's laws; and to friction that remembers, which may take the
    delay's place. The best shift is the vertex of a parabola; its standard deviation is a block jackknife (Kuensch
    1989). Where a filter of first order explains a late torque far better, that is its `lag`, if `filters` are sought.
    Filter q, v, u and a alike before, by a `LowPass` at `cutoff` Hz: friction is filtered as u is, else it seems to
    turn late. Raises InvalidInput with contacts, or without torques; DatasetError for a log shorter than .4 s.
    """
    if dataset.model.contacts:
        seen = "the forces of contacts are not known, so a delay cannot be found in this log"
        raise InvalidInput(f"{seen}. Give the delay in s, or use a log without contact.")
    if not torques_of_joints(dataset):
        why = "which u does not hold for a base that moves or actuators of another kind"
        raise InvalidInput(f"a delay is found from the torque of every joint, {why}; give the delay in s.")
    near = _told_apart(dataset, USUAL_DELAY, cutoff)
    open_ones = np.isnan(near.seconds) & np.array([bool(np.ptp(u)) for u in dataset.u.T])
    at_end = np.isnan(near.common + near.common_std)  # that of a part of the log lies beyond
    if not (open_ones.any() or at_end):
        return _with_lag(dataset, near, cutoff) if filters else near
    try:
        far = _told_apart(dataset, LARGEST_DELAY, cutoff)
    except DatasetError:  # too short for that
        return near
    if at_end:
        return far
    parts = {name: np.where(open_ones, getattr(far, name), getattr(near, name)) for name in ("seconds", "std")}
    return replace(near, **parts)


def _with_lag(dataset: Dataset, delay: Delay, cutoff: float | None) -> Delay:
    """The delay behind a filter of first order, where that leaves far less than the delay alone."""
    late, step = delay.significant, float(np.median(np.diff(dataset.time)))
    if not 0.0 < late < USUAL_DELAY or 2.0 * np.pi * (cutoff or 0.5 / step) * late <= IN_BAND:
        return delay  # beyond the cut-off, or half the rate, nothing is told
    rate = max(1, int(late / (3.0 * step)))  # that still shows it
    # near the corner of such a filter and below: above it a lag explains noise of the motion, too
    cutoff = 0.5 * IN_BAND / np.pi / late
    some = with_strokes(low_pass(dataset, cutoff).rows(slice(0, rate * LAG_ROWS, rate)))

    def left(lag: float) -> float:  # beside memory, as of friction of velocity alone other lags would be favoured
        return _estimated(some, USUAL_DELAY, cutoff, lag)[1].left

    try:
        before = left(0.0)
        if all(left(share * late) >= LAGGING * before for share in (1.0, 1.4, 2.0)):
            return delay
    except DatasetError:  # too short for that
        return delay
    ends = LAGS[0] * late, LAGS[1] * late
    lag = float(minimize_scalar(left, bounds=ends, method="bounded", options={"xatol": 0.03 * late}).x)
    if not 1.1 * ends[0] < lag < 0.9 * ends[1]:
        return delay  # an end of what was tried is no estimate
    found = _told_apart(some, USUAL_DELAY, cutoff, lag)
    return replace(found, remains=delay.remains * found.left / before, lag=lag)


def _told_apart(dataset: Dataset, largest: float, cutoff: float | None, lag: float = 0.0) -> Delay:
    """The delay under friction of velocity if it shows beside friction that remembers, too, else that beside memory."""
    alone, beside = _estimated(with_strokes(dataset), largest, cutoff, lag)
    if beside.left < REMEMBERS * alone.left:
        return beside
    used, width = alone.significant, 4.0 * beside.common_std
    apart = abs(used - beside.common) > max(SIGNIFICANT * (alone.common_std + beside.common_std), 0.5 * abs(used))
    return alone if not used or (not apart and (beside.significant or width <= APART)) else beside


def _estimated(dataset: Dataset, largest: float, cutoff: float | None, lag: float) -> list[Delay]:
    """The delay behind a `lag`; then that beside memory."""
    thin, shifts = max(1, -(-len(dataset) // MOST_ROWS)), np.linspace(-largest, largest, 2 * STEPS + 1)
    episodes = []
    for number, part, _ in episodes_in_order(dataset):
        inner = (part.time >= part.time[0] + largest) & (part.time <= part.time[-1] - largest)
        own = np.flatnonzero(dataset.episode == number)
        episodes.append((own, own[inner][::thin]))
    compared = np.concatenate([inner for _, inner in episodes])
    if len(compared) < 10 * BLOCKS:
        seen = f"{len(compared)} rows lie more than {largest} s from the ends of their episodes"
        raise DatasetError(f"{seen}; a delay needs at least {10 * BLOCKS}. Record longer, or give the delay in s.")
    features, positions = torque_columns(dataset, slice(None) if lag else compared, cutoff), joint_positions(dataset)
    for own, _ in episodes if lag else ():
        features[:, own] = lagged(features[:, own].swapaxes(0, 1), dataset.time[own], lag).swapaxes(0, 1)
    features = features[:, compared] if lag else features
    profiles = np.full((2, dataset.nv, BLOCKS + 1, len(shifts)), np.nan)  # of all rows, and of all but one block
    for joint in range(dataset.nv):
        splines = [(CubicSpline(dataset.time[own], dataset.u[own, joint]), dataset.time[at]) for own, at in episodes]
        shifted = np.concatenate([spline(at + shifts[:, None]) for spline, at in splines], axis=1)
        spread = np.square(shifted - shifted.mean(axis=1, keepdims=True)).sum(axis=1)
        if spread.min() > 1e-12 * np.square(shifted).sum(axis=1).max():  # else it has no delay
            bases = [orthonormal(columns) for columns in (features[joint][:, :-MEMORIES], features[joint])]
            q = positions[compared, joint]
            if rate := rate_of_waves(q, shifted[STEPS], bases[1]):
                bases = [orthonormal(np.c_[basis, waves(q, rate)]) for basis in bases]
            for own, basis in zip(profiles, bases, strict=True):
                own[joint] = least_squares(basis, shifted.T)
    return [_from_profiles(each, shifts) for each in profiles]


def _from_profiles(profiles: Float[np.ndarray, "nv parts shifts"], shifts: np.ndarray) -> Delay:
    """The best shift of all rows, and how much it differs without each block."""
    seconds = np.array([[lowest(profile, shifts) for profile in own] for own in profiles])
    # Noise of every joint is unknown: the likelihood of one delay is the product of powers of the residuals.
    finite = profiles[np.isfinite(profiles[:, 0, 0])]
    likelihoods = np.log(finite + TINY * finite.max(initial=0.0)).sum(axis=0)
    common = np.array([lowest(profile, shifts) for profile in likelihoods])
    gained = likelihoods[0].min() - likelihoods[0, STEPS]
    remains, spread = float(np.exp(gained / max(len(finite), 1))), float(jackknife(common[None, 1:])[0])
    each, std = seconds[:, 0], jackknife(seconds[:, 1:])
    left = float(np.exp(likelihoods[0].min() / max(len(finite), 1)))
    return Delay(common=float(common[0]), common_std=spread, seconds=each, std=std, remains=remains, left=left)


def orthonormal(columns: Float[np.ndarray, "rows columns"], least: float = 1e-6) -> Float[np.ndarray, "rows k"]:
    """A basis of what the columns span, without directions of which they have less than that share of the largest."""
    size = np.linalg.norm(columns, axis=0)
    used = size > 1e-9 * size.max()
    basis, values, _ = np.linalg.svd(columns[:, used] / size[used], full_matrices=False)
    return basis[:, values > least * values[0]]


def least_squares(
    basis: Float[np.ndarray, "rows columns"], targets: Float[np.ndarray, "rows targets"]
) -> Float[np.ndarray, "parts targets"]:
    """What columns leave of the square sum of every target: of all rows, then of all but each block of them."""
    blocks = list(zip(np.array_split(basis, BLOCKS), np.array_split(targets, BLOCKS), strict=True))
    normal, right = np.stack([own.T @ own for own, _ in blocks]), np.stack([own.T @ target for own, target in blocks])
    square = np.stack([np.einsum("rt,rt->t", target, target) for _, target in blocks])
    sums = [np.concatenate([part.sum(axis=0)[None], part.sum(axis=0) - part]) for part in (normal, right, square)]
    values, vectors = np.linalg.eigh(sums[0])
    told = values > 1e-9 * values[:, -1:]
    along = np.square(vectors.mT @ sums[1]) * (told / np.where(told, values, 1.0))[..., None]
    return np.maximum(sums[2] - along.sum(axis=1), 0.0)


def jackknife(each: Float[np.ndarray, "estimates blocks"]) -> np.ndarray:
    """Standard deviation of an estimate from its values without each block; NaN where one of them is."""
    return np.sqrt((each.shape[-1] - 1) * np.var(each, axis=-1))


def torque_columns(
    dataset: Dataset, chosen: Int[np.ndarray, " n"] | slice = slice(None), cutoff: float | None = None
) -> Float[np.ndarray, "nv n columns"]:
    """What the torque of each joint may be made of in the `chosen` rows, except for its parameters.

    The laws of the dataset's model are among it. Forces of laws are behind a low-pass at `cutoff` Hz.
    """
    robot, some = dataset.model.robot, dataset.rows(chosen)
    q, v, a = (torch.tensor(getattr(some, name), device=robot.device) for name in ("q", "v", "a"))
    with torch.no_grad():
        if len(some) > ROWS_PER_PARAMETER * 10 * robot.nv:
            torque = robot.kinematics(q, v).torque_regressor(a).flatten(-2)
        else:  # factors of the robot's own torques, of which there are three
            gravity, bias = robot.gravity_forces(q), robot.bias_forces(q, v)
            torque = torch.stack((robot.inverse_dynamics(q, v, a) - bias, bias - gravity, gravity), dim=-1)
    rows, kept = (dataset.q, dataset.v, dataset.u, dataset.a), chosen if cutoff is None else slice(None)
    own = [*usual_columns(robot, *rows, FRICTION_WIDTHS), *law_columns(dataset.model.laws, robot, *rows)]
    own = [column[kept] for column in own]
    if dataset.strokes is not None:  # friction that remembers, of several stiffnesses and as it rises with speed
        past, spread = torch.tensor(dataset.strokes[kept]), torch.tensor(joint_positions(dataset).std(0))
        states = [after_strokes(past, sigma / spread.clamp_min(1e-9)).numpy() for sigma in STIFFNESSES]
        own += [part for z in states for part in (z, z * np.sqrt(np.abs(dataset.v[kept])))]
    forces = np.stack(own, axis=-1)
    if cutoff is not None:
        for there in (dataset.episode == number for number in dataset.episodes):
            forces[there] = LowPass(cutoff)(forces[there], dataset.time[there])
        forces = forces[chosen]
    return np.concatenate([torque.cpu().numpy(), forces], axis=-1).transpose(1, 0, 2)


def lowest(values: Float[np.ndarray, " shifts"], shifts: Float[np.ndarray, " shifts"]) -> float:
    """Place of the least value, by a parabola; NaN at either end."""
    at = int(np.argmin(values))
    if at in (0, len(values) - 1):
        return float("nan")
    left, middle, right = values[at - 1 : at + 2]
    curvature = left - 2.0 * middle + right
    offset = 0.5 * (left - right) / curvature if curvature > 0.0 else 0.0
    return float(shifts[at] + offset * (shifts[1] - shifts[0]))


def torques_of_joints(dataset: Dataset) -> bool:
    """Whether u has one torque per degree of freedom."""
    model = dataset.model
    return model.actuators == model.robot.joint_names and model.actuation.matrix is None


def rate_of_waves(
    q: Float[np.ndarray, " rows"], force: Float[np.ndarray, " rows"], basis: Float[np.ndarray, "rows k"]
) -> float:
    """The rate [1/rad or 1/m] of a wave over positions that explains most of what orthonormal columns leave of a force.

    It is that of the largest power (Lomb 1976, Scargle 1982); 0 where no wave explains most, and what the best of so
    many would of noise: twice the logarithm of their number over that of the rows.
    """
    reach, left = float(np.ptp(q)), force - basis @ (basis.T @ force)
    left = left - left.mean()
    if not reach > 0.0 or not np.square(left).sum() > LITTLE * np.square(force - force.mean()).sum():
        return 0.0
    from scipy.signal import lombscargle  # half a second, which only few logs should cost

    bins = np.bincount(((q - q.min()) / reach * (PLACES - 1)).round().astype(int), left, PLACES)
    size = round((PLACES - 1) / STEP)  # of which one frequency is a step of repetitions
    tried = np.abs(np.fft.rfft(bins, size))[round(FEWEST / STEP) : round(FINEST / STEP)]
    repetitions = FEWEST + STEP * int(np.argmax(tried)) + np.linspace(-STEP, STEP, 41)  # then closer
    rates = 2.0 * np.pi / reach * repetitions
    found = lombscargle(q - q.mean(), left, rates)
    best, power = float(rates[int(np.argmax(found))]), float(found.max())
    return best if 2.0 * power > (REPEATS + 2.0 * np.log(len(tried)) / len(q)) * np.square(left).sum() else 0.0


def waves(q: Float[np.ndarray, " rows"], rate: float) -> Float[np.ndarray, "rows 2"]:
    """Sine and cosine over positions."""
    return np.stack([np.sin(rate * q), np.cos(rate * q)], axis=1)
