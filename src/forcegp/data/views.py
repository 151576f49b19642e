"""Views of a log: rows that follow each other, windows, motions of equal length, and which rows to take."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from forcegp.data.dataset import Dataset
from forcegp.data.filters import JITTER
from forcegp.errors import InvalidInput
from forcegp.mechanics.gauss_principle import OPEN
from forcegp.model import Model
from forcegp.robots.arguments import whole_number

Select = Callable[[Dataset, int], Int[np.ndarray, " chosen"]]
"""Which rows: numbers of at most so many of a log, such as `evenly` gives."""
Marked = Bool[np.ndarray, " rows"]
Numbered = Int[np.ndarray, " rows"]

BLOCK = 4096  # rows
EVEN_STEPS = 1e-3  # of a duration: rounding
LEAP = 0.3  # median step of a position over its standard deviation, from which rows are no motion (random states: 0.95)
RESTS, IDLE = 0.01, 0.1
"""Share of its whole range within which a joint rests; of the largest range, which counts for idle joints."""
STILL, SHORTEST, OFTEN, ALONE = 1e-3, 0.3, 0.25, 0.95
"""Share of its range within which a joint stays for the shortest rest [s]; shares of rests in postures, and alone."""
CLIPPED_RATIO = 8.0  # rows at the extreme value over rows in the next thousandth of the range: a smooth peak has 2.4
CLIPPED_ROWS = 10
FORGOTTEN = 3.0
"""Way times sigma after which what a joint remembered before an episode counts for less than a twentieth."""
GAP = 1.5  # a pause of more than this many median steps is a gap, over which no motion goes
MOTION = 1.5  # ratio of noise as seen by third and by fourth differences above which they see motion instead
FEWEST_DIFFERENCES, MOST_DIFFERENCES = 30, 3000
ROUNDING = 1e-13  # standard deviation, relative to the largest entry, below which a column is constant but for rounding


def tensors(rows: Dataset, device: torch.device | str = "cpu") -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """q, v, u and a of the rows."""
    return tuple(torch.tensor(getattr(rows, name), device=device) for name in "qvua")  # type: ignore[return-value]  # four


def in_blocks(
    rows: Dataset, of: Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, ...]], device: torch.device | str
) -> list[np.ndarray]:
    """What `of(q, v, u, a)` gives for blocks of rows, joined; without gradients, and with little memory."""
    blocks = zip(*(x.split(BLOCK) for x in tensors(rows, device)), strict=True)
    with torch.no_grad():
        parts = [of(*block) for block in blocks]
    return [torch.cat(own).cpu().numpy() for own in zip(*parts, strict=True)]


def evenly(dataset: Dataset, count: int) -> Int[np.ndarray, " chosen"]:
    """Rows at even distances over the log, the first and the last among them; a `Select`."""
    return np.unique(np.linspace(0, len(dataset) - 1, min(count, len(dataset))).astype(int))


def decided(dataset: Dataset) -> Dataset:
    """The rows of which it is known which contacts act: only torques show anything in the others."""
    known = (dataset.u[:, dataset.u.shape[1] - len(dataset.model.switches) :] != OPEN).all(axis=1)
    return dataset if known.all() else dataset.rows(np.flatnonzero(known))


def consecutive(dataset: Dataset) -> Marked:
    """Whether the next row belongs to the same episode and follows; False for the last row."""
    return np.append(dataset.episode[1:] == dataset.episode[:-1], False)


def move_on(dataset: Dataset) -> bool:
    """Whether rows that follow each other belong to one motion; a sample of rows or of random states leaps about."""
    steps, spread = np.abs(np.diff(dataset.q, axis=0))[consecutive(dataset)[:-1]], dataset.q.std(axis=0)
    moving = spread > 0.0
    if not len(steps) or not moving.any():
        return bool(len(steps))
    return bool((np.median(steps, axis=0)[moving] < LEAP * spread[moving]).any())


def postures(dataset: Dataset) -> Numbered | None:
    """The rest that each row belongs to or comes after; None for a log of other motions.

    A log of postures rests three times or more, in a quarter of its rows, with all joints at once.
    """
    return _numbered(dataset, OFTEN)


def rests_alone(dataset: Dataset) -> Numbered | None:
    """The rest of each row of a log of postures alone, three or more: an episode each, or one after the other."""
    of_episode = np.unique(dataset.episode, return_inverse=True)[1]
    within = [np.ptp(dataset.q[of_episode == each], axis=0) for each in range(of_episode.max() + 1)]
    if len(within) > 2 and (np.max(within, axis=0) <= _within(dataset)).all():
        return of_episode
    return _numbered(dataset, ALONE)


def _numbered(dataset: Dataset, share: float) -> Numbered | None:
    """The rest that each row belongs to or comes after; None for fewer than three, or less than a share of the rows."""
    if not dataset.time_ordered:
        return None
    found = rests(dataset)
    ends = np.array([rows[-1] for rows in found], int)
    number = np.searchsorted(ends, np.arange(len(dataset)))
    elsewhere = np.append(dataset.episode[ends], dataset.episode.max() + 1)[number] != dataset.episode
    often = len(found) > 2 and sum(map(len, found)) >= share * len(dataset)
    return np.maximum(number - elsewhere, 0) if often else None


def rests(dataset: Dataset) -> list[Int[np.ndarray, " _"]]:
    """Rows of each rest: all joints stand still at once."""
    least, found = _within(dataset), list[np.ndarray]()
    for episode in dataset.episodes:
        rows = np.flatnonzero(dataset.episode == episode)
        q, time = dataset.q[rows], dataset.time[rows]
        ahead = np.minimum(np.searchsorted(time, time + SHORTEST), len(rows) - 1)
        for begin, end in runs(np.asarray((np.abs(q[ahead] - q) <= STILL / RESTS * least).all(1))):
            end = int(ahead[end - 1]) + 1
            if time[end - 1] - time[begin] >= 0.99 * SHORTEST and (np.ptp(q[begin:end], axis=0) <= least).all():
                found.append(rows[begin:end])
    return found


def stays(dataset: Dataset, q: Float[np.ndarray, " rows"]) -> Marked:
    """Rows from which on a joint with these positions stays where it is for the shortest rest."""
    found = np.zeros(len(q), dtype=bool)
    for episode in dataset.episodes:
        rows = np.flatnonzero(dataset.episode == episode)
        ahead = np.minimum(np.searchsorted(dataset.time[rows], dataset.time[rows] + SHORTEST), len(rows) - 1)
        found[rows] = np.abs(q[rows[ahead]] - q[rows]) <= STILL * np.ptp(q)
    return found


def at_rest(dataset: Dataset) -> bool:
    """Whether the log is of postures alone, in which every joint rests."""
    return rests_alone(dataset) is not None


def one_row_per_rest(dataset: Dataset) -> Dataset:
    """A log of postures alone as its medians, an episode each, without motion; other logs as they are.

    Strokes of a log whose times rise throughout lead from rest to rest, so that friction knows the last move.
    """
    from forcegp.data.strokes import strokes  # of views

    # stiction holds the same share of the load in all rows of a rest, so they are one observation of it
    if (number := rests_alone(dataset)) is None:
        return dataset
    _, first, label = np.unique(number, return_index=True, return_inverse=True)

    def median(values: np.ndarray) -> np.ndarray:
        return np.stack([np.median(values[label == each], axis=0) for each in range(len(first))])

    still = np.zeros((len(first), dataset.nv))
    rows = {"q": median(dataset.q), "v": still, "a": still, "u": median(dataset.u)}
    measured = {name: median(values) for name, values in dataset.measured.items()}
    if dataset.strokes is not None and (np.diff(dataset.time) > 0.0).all():
        path = strokes(replace(dataset, episode=0 * dataset.episode), transmission=dataset.transmission)
        rows["strokes"] = np.stack([path[label == each][-1] for each in range(len(first))])
    return replace(dataset.rows(first), **rows, measured=measured, episode=label[first])


def _within(dataset: Dataset) -> Float[np.ndarray, " nq"]:
    span = np.ptp(dataset.q, axis=0)
    return RESTS * np.maximum(span, IDLE * span.max())


def runs(marked: Marked) -> Int[np.ndarray, "runs 2"]:
    """First rows of all runs of True, and the rows after them."""
    return np.flatnonzero(np.diff(marked, prepend=False, append=False)).reshape(-1, 2)


def resolution(values: Float[np.ndarray, " rows"]) -> float:
    """The least step between two values of a channel that is not constant."""
    return float(np.diff(np.unique(np.round(values / np.ptp(values), 9))).min() * np.ptp(values))


def ends_of_range(values: Float[np.ndarray, " rows"], moves: Marked) -> Iterator[tuple[float, Marked]]:
    """Extremes at which a channel stays while something `moves`, and where: far more rows there than just below."""
    if moves.sum() < CLIPPED_ROWS or not np.ptp(values[moves]) > 0.0:
        return
    same, width = 1e-9 * np.ptp(values[moves]), max(np.ptp(values[moves]) / 1000.0, 1.5 * resolution(values))
    for extreme in (float(values.max()), float(values.min())):
        below = abs(extreme - values)
        at, near = (int((there & moves).sum()) for there in (below <= same, (below > same) & (below <= same + width)))
        longest = np.diff(runs(below <= same)).max(initial=0)
        if at >= CLIPPED_ROWS and at > CLIPPED_RATIO * max(near, 1) and longest >= 3:
            yield extreme, below <= same


def whole_windows(dataset: Dataset, width: int) -> Int[np.ndarray, " windows"]:
    """First rows of the windows of so many rows that lie within an episode."""
    breaks, first = np.cumsum(np.insert(~consecutive(dataset), 0, False)), np.arange(max(0, len(dataset) - width + 1))
    return first[breaks[first + width - 1] == breaks[first]]


def window_means(values: Float[np.ndarray, "rows k"], first: np.ndarray, width: int) -> Float[np.ndarray, "windows k"]:
    """Means over `width` rows from each of the `first` on."""
    sums = np.cumsum(np.insert(values, 0, 0.0, axis=0), axis=0)
    return (sums[first + width] - sums[first]) / width


def with_memory(dataset: Dataset, model: Model) -> Dataset:
    """The log with the columns of u that `model.memory` names, as its laws have them at their numbers.

    Rows before the first reversal depend on where the episode began, which no log tells. Raises InvalidInput for rows
    that are not in order of time and do not carry their past, since a sample has none.
    """
    from forcegp.data.strokes import with_strokes  # of views

    memory, own = model.memory, dataset.model.memory.names
    if not memory.names or (own == memory.names and dataset.strokes is None):
        return dataset
    if not (dataset := with_strokes(dataset, memory.transmission)).knows_strokes(memory.transmission):
        seen = f"{', '.join(memory.titles)} remembers, and the rows are not in order of time"
        raise InvalidInput(f"{seen}; give the whole log.")
    bare = dataset.u[:, ~np.isin(dataset.model.inputs, own)]
    columns = memory.past_of(torch.as_tensor(np.array(dataset.strokes), device=model.robot.device)).cpu().numpy()
    first = model.memory_column
    u = np.concatenate([bare[:, :first], columns, bare[:, first:]], axis=1)
    return replace(dataset, u=u, model=replace(dataset.model, forces=model.laws))


def past_known(dataset: Dataset, model: Model) -> Marked:
    """Rows in which what joints remember does not depend on what was before their episode."""
    # A joint that never goes so far in an episode does not count: what sticks there is in its offset
    known = np.ones(len(dataset), dtype=bool)
    for law in model.laws:
        if dataset.strokes is None or not (joints := law.memory_joints(model.robot)):
            continue
        sigma = law.values["sigma"].expand(model.robot.nv).cpu().numpy()[joints]
        near = np.abs(dataset.strokes[:, joints]).sum(-1) * sigma < FORGOTTEN
        for episode in dataset.episodes:
            rows = dataset.episode == episode
            begin = np.logical_and.accumulate(near[rows])  # what rests later trembles in many short strokes
            known[rows] &= ~(begin & ~begin.all(0)).any(1)
    return known


@dataclass(frozen=True, eq=False)
class RecordedMotions:
    """B recorded motions of T steps of `dt` seconds; in row k of a motion u[k] acts until row k + 1.

    q, v: (B, T+1, nv) and u: (B, T, nv) in the units of the Dataset; `rows` where each begins in it.
    """

    rows: tuple[int, ...]
    dt: float
    q: Float[np.ndarray, "motions rows nq"]
    v: Float[np.ndarray, "motions rows nv"]
    u: Float[np.ndarray, "motions steps nu"]

    @classmethod
    def joined(cls, each: Sequence["RecordedMotions"]) -> "RecordedMotions":
        """One after the other, of the same steps; rows are those of their own datasets."""
        motions = {name: np.concatenate([getattr(one, name) for one in each]) for name in ("q", "v", "u")}
        return cls(tuple(row for one in each for row in one.rows), each[0].dt, **motions)


def require_order_of_time(dataset: Dataset) -> None:
    """Raises InvalidInput for rows out of it."""
    if not dataset.time_ordered:
        raise InvalidInput("the rows of the dataset are not in the order of time; give a whole recording.")


def recorded_motions(dataset: Dataset, starts: int | Sequence[int], seconds: float) -> RecordedMotions:
    """The motions of that length that begin at the given rows, or at so many rows spread evenly over the recording.

    A number of starts takes motions without a gap, where there are any. Raises InvalidInput for rows at which no motion
    of that length begins, for steps of time that are not equal, and for a length of less than one step.
    """
    require_order_of_time(dataset)
    dt, before = _even_steps(dataset)
    if not (np.isfinite(seconds) and seconds > 0 and round(seconds / dt) >= 1):
        raise InvalidInput(f"the length is {seconds} s; it must be at least one step of the recording, {dt:.4g} s.")
    steps = round(seconds / dt)
    possible = whole_windows(dataset, steps + 1)
    if not possible.size:
        longest = np.unique(dataset.episode, return_counts=True)[1].max() - 1
        raise InvalidInput(f"no episode lasts {steps * dt:.4g} s: the longest has {dt * longest:.4g} s; ask for less.")
    if isinstance(starts, int):
        if starts < 1:
            raise InvalidInput(f"the number of starts is {starts}; it must be at least 1.")
        whole = possible[before[possible + steps] == before[possible]]
        possible = whole if whole.size else possible  # which is refused then
        chosen = possible[np.unique(np.linspace(0, len(possible) - 1, starts).round().astype(int))]
    else:
        chosen = np.asarray(starts, dtype=int)
        for row in chosen[~np.isin(chosen, possible)][:1]:
            seen = f"no motion of {steps * dt:.4g} s begins at row {row} of the {len(dataset)} rows within its episode"
            raise InvalidInput(f"{seen}; start earlier, or ask for fewer seconds.")
    for row in chosen[before[chosen + steps] != before[chosen]][:1]:
        pauses = np.diff(dataset.time[row : row + steps + 1])
        worst = int(np.abs(pauses - dt).argmax())
        seen = f"the time steps are uneven: {pauses[worst]:.6g} s after row {row + worst}, {dt:.6g} s elsewhere"
        raise InvalidInput(f"{seen}; resample the recording to equal steps, or start where there is no gap.")
    index = chosen[:, None] + np.arange(steps + 1)
    return RecordedMotions(tuple(chosen.tolist()), dt, dataset.q[index], dataset.v[index], dataset.u[index[:, :-1]])


def median_step(recording: Dataset) -> float:
    """Of time, in s; infinite where every episode has one row."""
    pauses = np.diff(recording.time)[consecutive(recording)[:-1]]
    return float(np.median(pauses)) if pauses.size else float("inf")


def stretches_without_gap(recording: Dataset, part: Marked) -> list[Int[np.ndarray, " _"]]:
    """Numbers of rows of a part that follow each other in one episode without a gap."""
    rows = np.flatnonzero(part)
    apart = (np.diff(rows) > 1) | (np.diff(recording.episode[rows]) != 0)
    apart |= np.diff(recording.time[rows]) > GAP * median_step(recording)
    return [each for each in np.split(rows, np.flatnonzero(apart) + 1) if len(each) > 1]


def all_motions(dataset: Dataset, seconds: float, longest_step: float) -> tuple[RecordedMotions, int]:
    """The recording cut into stretches of that length, and of how many of its rows a step of `longest_step` s may be.

    Stretches with a gap are left out; their length is a multiple of the steps. Raises InvalidInput where none is left.
    """
    dt, before = _even_steps(dataset)
    stride = max(1, int(longest_step / dt * (1.0 + EVEN_STEPS)))
    steps, starts = stride * max(1, round(seconds / dt / stride)), list[int]()
    for number in dataset.episodes:
        rows = np.flatnonzero(dataset.episode == number)
        firsts = rows[: len(rows) - steps : steps]
        starts += firsts[before[firsts + steps] == before[firsts]].tolist()
    if not starts:
        seen = f"no stretch of {steps * dt:.4g} s has equal steps of {dt:.4g} s"
        raise InvalidInput(f"{seen}; give fewer seconds, or resample the recording (forcegp import does).")
    return recorded_motions(dataset, starts, steps * dt), stride


def _even_steps(dataset: Dataset) -> tuple[float, Numbered]:
    """The median step of time [s], and how many steps before each row are not of that length."""
    if not np.isfinite(dt := median_step(dataset)):
        raise InvalidInput("every episode has one row only; a rollout is compared with a motion of several rows.")
    return dt, np.concatenate([[0], np.cumsum(np.abs(np.diff(dataset.time) - dt) > JITTER * dt)])


def white_noise(log: Dataset, width: int = 1, signal: str = "a") -> Float[np.ndarray, " nv"] | None:
    """Standard deviation of noise on a signal, or on its means over `width` rows, from differences of successive ones.

    The k-th difference of white noise has the variance binomial(2k, k), that of a smooth motion falls with k: NaN where
    it is motion that is seen. Medians, since impacts are no noise. None for rows out of order and fewer than 30.
    """
    if not log.time_ordered:
        return None
    noise = []
    for order, variance in ((3, 20.0), (4, 70.0)):
        first = whole_windows(log, width * (order + 1))
        if len(first) < FEWEST_DIFFERENCES:
            return None
        first = first[:: max(1, len(first) // MOST_DIFFERENCES)]
        means = np.stack([window_means(getattr(log, signal), first + k * width, width) for k in range(order + 1)])
        noise.append(1.4826 * np.median(np.abs(np.diff(means, order, axis=0)[0]), axis=0) / np.sqrt(variance))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where((noise[0] < MOTION * noise[1]) & (noise[1] > 0.0), noise[1], np.nan)


def repeated_rows(trained: tuple[np.ndarray, np.ndarray, np.ndarray], test: Dataset) -> Int[np.ndarray, " repeated"]:
    """Numbers of the rows of `test` whose (q, v, u) is exactly one of those in `trained`, each (rows, k)."""
    # -0.0 becomes 0.0: equal numbers have equal bytes
    known, rows = (np.hstack(each) + 0.0 for each in (trained, (test.q, test.v, test.u)))
    found = {row.tobytes() for row in known}
    return np.array([number for number, row in enumerate(rows) if row.tobytes() in found], dtype=np.int64)


def farthest_point_sampling(
    points: Float[np.ndarray, "rows features"], count: int, *, start: int = 0
) -> Int[np.ndarray, " count"]:
    """Numbers of `count` rows of which each is the farthest from all rows chosen before it, from `start` on.

    Greedy k-centre (Gonzalez 1985), Euclidean on columns standardised to mean 0 and deviation 1; deterministic and
    nested; repeated rows come last. Time O(rows * count * features). Raises InvalidInput for
    a `count` or `start` outside the rows.
    """
    rows = len(points)
    count = whole_number("count", count, 1, rows, "the number of rows")
    columns = np.ascontiguousarray(points.T, dtype=np.float64)
    columns = columns / np.maximum(np.abs(columns).max(axis=1, keepdims=True), 1e-300)  # so that std cannot overflow
    centred, spread = columns - columns.mean(axis=1, keepdims=True), columns.std(axis=1, keepdims=True)
    columns = np.where(spread >= ROUNDING, centred / np.maximum(spread, ROUNDING), 0.0)
    distance, difference, chosen = np.full(rows, np.inf), np.empty_like(columns), np.empty(count, dtype=np.int64)
    chosen[0] = whole_number("start", start, 0, rows - 1, "the last row")
    for position in range(count):
        if position:
            chosen[position] = np.argmax(distance)  # the lowest row number among equals
        row = chosen[position]
        # Differences, not |x|^2 - 2 x.y + |y|^2: a repeated row must have distance exactly 0.
        np.subtract(columns, columns[:, row, None], out=difference)
        np.minimum(distance, np.square(difference, out=difference).sum(axis=0), out=distance)
        distance[row] = -1.0  # never chosen again, not even among repeated rows
    return chosen


def farthest_rows(dataset: Dataset, count: int, *, start: int = 0) -> Dataset:
    """The rows that cover the inputs (q, v, u) best, in order: for fewer points, take the first of them."""
    return dataset.rows(farthest_point_sampling(np.hstack([dataset.q, dataset.v, dataset.u]), count, start=start))
