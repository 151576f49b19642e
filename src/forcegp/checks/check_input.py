"""The log as every check sees it: mended, at even times, filtered, and as it is compared with the robot."""

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from forcegp.checks.torques import in_motion
from forcegp.data import Dataset, Preparation, preparation_report, resample, uniform_step
from forcegp.data.dataset import ROTATION, TRANSLATION
from forcegp.data.spectrum import FEWEST_ROWS, HIGHEST, motion_spectrum
from forcegp.data.views import consecutive, move_on, resolution, runs, white_noise, whole_windows, window_means
from forcegp.doubts import Doubt, wrong
from forcegp.errors import DatasetError, InvalidInput
from forcegp.forces import JointLaw
from forcegp.model import Model
from forcegp.robots import Robot

GAP = 5.0  # median steps without a row at which a motion is taken for two
COMPARED = 0.5  # of the cut-off: where torques are compared
LONGEST_TRIM = 0.1  # most that is trimmed from either end, as a share of the shortest stretch
MOST_ROWS = 250  # rows on which torques are compared: neighbouring rows hold the same information
FEW_MOVE = 30  # of these, in which each joint moves
QUICK_ROWS = 200  # the same before a fit
HALF_CUTOFF = COMPARED**2.5  # noise of an acceleration that is differenced twice, relative to that at the whole cut-off
DEGREE = np.pi / 180.0
FEW_JOINTS = 3  # of more joints, half as many rows
STRETCHES, STRETCH_ROWS = 3, 400  # of a log that are looked at before a fit, where it is longer
SMOOTH_SECONDS, SMOOTH_ROWS = 0.03, 15  # of the running mean before a fit: SciPy's filters take half a second to import
STOOD = 5  # equal positions in front of a jump, from which on the encoder had stopped
JUMP = 10.0  # steps that nine of ten rows stay below, by which a signal that is not measured jumps to 0
LEAST_JUMP = 0.02  # and by more than this share of its range
FEWEST_DROPS = 2
STILL = 0.02, 0.002  # range in rad or m below which a joint does not move
FAR_OFF = 20.0  # times all others, by which a single value is off the middle of its neighbours
MOST_SPIKES = 5  # of a signal: more are its nature
BACK = 0.4  # of that, by which each neighbour is off as well: half of it, unlike at a kink or a step
STEPS = 2.5  # of its resolution by which a channel in steps changes from row to row


@dataclass(frozen=True, kw_only=True, eq=False)
class CheckInput:
    """One log and, if known, its robot with its known `laws` of joints.

    `log` is the Dataset as given; `even` its stretches without gaps at even times; `prepared` these after the filter;
    `compared` the same after a filter at half the cut-off: what torques are compared on, so that the noise of the
    acceleration is not taken for a wrong torque; both None where jumps forbid derivatives. `rotates` (nv,) are joints
    that turn, `jumps` marks after which rows (rows, nv) a position of these jumps by more than pi,
    `dropped` where a signal is 0 because it was not measured (interpolated in `mended`). `compared_noise` (nv,) is the
    standard deviation of the acceleration in `compared`, None where it is not known; `compared_cutoff` is that
    of its filter [Hz], and `sharper` the same behind a higher one, where the spectrum asks for one.
    """

    log: Dataset
    even: Dataset
    mended: Dataset
    jumps: Bool[np.ndarray, "rows nv"]
    rotates: Bool[np.ndarray, " nv"]
    robot: Robot
    laws: tuple[JointLaw, ...] = ()
    contacts: int = 0
    prepared: Dataset | None = None
    compared: Dataset | None = None
    dropped: Mapping[str, Bool[np.ndarray, "rows nv"]] = field(default_factory=dict)
    compared_noise: Float[np.ndarray, " nv"] | None = None
    most_rows: int = MOST_ROWS
    compared_cutoff: float = np.inf
    sharper: Dataset | None = None

    @classmethod
    def as_recorded(cls, dataset: Dataset, model: Model, **more: Any) -> "CheckInput":
        """A log of which nothing is filtered, compared or mended, but for `more`."""
        nowhere = np.zeros(dataset.v.shape, dtype=bool)
        laws = tuple(law for law in model.laws if isinstance(law, JointLaw) and not law.learned)
        known: dict[str, Any] = {"robot": model.loaded_robot, "laws": laws, "contacts": len(model.contacts)}
        same = {"log": dataset, "even": dataset, "mended": dataset, "jumps": nowhere}
        same["rotates"] = dataset.turns
        return cls(**same | known | more)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(self.log.joint_names)

    def unit_of_each(self, name: str) -> tuple[str, ...]:
        """The unit of a signal, one per joint."""
        return tuple((ROTATION if turns else TRANSLATION)[name] for turns in self.rotates)

    def stated_units(self, name: str) -> list[str]:
        """The same as it was imported, which a correction of some joints keeps for the others."""
        found: Any = self.log.metadata.get("import")  # others may have put anything there
        for key in ("units", name):
            found = found.get(key) if isinstance(found, Mapping) else None
        return found if isinstance(found, list) and len(found) == self.log.nv else [*self.unit_of_each(name)]

    def named(self, joints: Iterable[int] | np.ndarray) -> tuple[str, ...]:
        """The names of the joints with these numbers."""
        return tuple(self.names[joint] for joint in joints)

    def rows(self) -> Dataset:
        """Up to `most_rows` rows of `compared`, evenly over the log, and others of joints that move in few of them."""
        assert self.compared is not None
        step, moves = max(1, -(-len(self.compared) // self.most_rows)), in_motion(self.compared)
        chosen = np.arange(0, len(moves), step)
        for own in map(np.flatnonzero, moves[:, moves[::step].sum(axis=0) < FEW_MOVE].T):
            chosen = np.union1d(chosen, own[:: max(1, len(own) // FEW_MOVE)])
        return self.compared.rows(chosen)

    @property
    def cutoff(self) -> float | None:
        """Of the filter of the check [Hz]."""
        return None if self.prepared is None else preparation_report(self.prepared.metadata)["cutoff"]

    def below(self, cutoff: float) -> "CheckInput":
        """The same behind a filter at this frequency [Hz]."""
        shortest = min(np.ptp(self.even.time[self.even.episode == number]) for number in self.even.episodes)
        rows = Preparation(cutoff=cutoff, trim=float(min(1.0 / cutoff, LONGEST_TRIM * shortest))).apply(self.even)
        noise = np.array(preparation_report(rows.metadata)["acceleration_noise"]["after"], float)
        found = {"prepared": rows, "compared": rows, "compared_noise": np.nan_to_num(noise), "sharper": None}
        return replace(self, **found, compared_cutoff=cutoff)

    @classmethod
    def of(cls, dataset: Dataset, model: Model) -> "CheckInput":
        """Prepare a log for the checks. Raises InvalidInput for one that is too short, or whose rows lack an order."""
        if not dataset.time_ordered:
            raise InvalidInput("the rows are not in order of time (a sample of rows?); check the whole recording.")
        found = _mended(dataset)
        mended, jumps = found["mended"], found["jumps"]
        found["even"] = even = _even(mended, jumps)
        if not jumps.any():
            shortest = min(np.ptp(even.time[even.episode == number]) for number in even.episodes)
            chosen = Preparation(cutoff="auto").resolved(even)

            def trimmed(cutoff: float) -> Preparation:
                return replace(chosen, cutoff=cutoff, trim=float(min(1.0 / cutoff, LONGEST_TRIM * shortest)))

            chosen = chosen if chosen.cutoff is None else trimmed(float(chosen.cutoff))
            found["prepared"] = found["compared"] = prepared = chosen.apply(even)
            report = preparation_report(dataset.metadata)
            while report and report.get("cutoff") is None:  # to the last one with a filter
                report = preparation_report({"preparation": report.get("earlier")})
            lower = COMPARED * float(chosen.cutoff or report.get("cutoff") or np.inf)
            if lower < HIGHEST * 0.5 / uniform_step(even.time[even.episode == even.episode[0]]):
                with contextlib.suppress(DatasetError):  # too short for that
                    found["compared"] = trimmed(lower).rows(even)
                    if chosen.cutoff is not None:  # what wrong torques ask for is too low
                        seen = float(np.nanmax(motion_spectrum(even).cutoff))
                        found["sharper"] = trimmed(seen).rows(even) if seen > 1.5 * lower else None
            # white noise as logged, or what the filter left
            left = preparation_report(prepared.metadata).get("acceleration_noise", {}).get("after")
            seen = white_noise(mended) if left is None else np.array(left, float) * HALF_CUTOFF
            found["compared_noise"] = np.zeros(mended.nv) if seen is None else np.nan_to_num(seen)
            found["compared_cutoff"] = lower
        return cls.as_recorded(dataset, model, **found)

    @classmethod
    def quick(cls, dataset: Dataset, model: Model) -> "CheckInput":
        """The same without filters and from few rows, for a look before a fit; also for short and unordered logs."""
        found: dict[str, Any] = {"compared": dataset, "compared_noise": dataset.noise_std, "most_rows": QUICK_ROWS}
        if dataset.time_ordered and not move_on(dataset):
            dataset = replace(dataset, time_ordered=False)
        if dataset.time_ordered:
            found |= _mended(dataset)
            mended, jump = found["mended"], found["jumps"].any()
            rows, width = (mended, 1) if jump else _smoothed(mended)
            found["compared"] = None if jump else rows
            if not jump:
                seen = white_noise(mended, width)
                found["compared_noise"] = found["compared_noise"] if seen is None else np.nan_to_num(seen)
            with contextlib.suppress(InvalidInput):
                found["even"] = _even(_few_stretches(rows), found["jumps"])
                found["prepared"] = None if jump else Preparation().apply(found["even"])
        return cls.as_recorded(dataset, model, **found)


def _mended(dataset: Dataset) -> dict[str, Any]:
    """The log with straight lines over its drop-outs, and where they are; rows after which an angle jumps."""
    dropped, changed = {name: _drop_outs(dataset, name) for name in ("q", "v", "u", "a")}, dict[str, np.ndarray]()
    for name, lost in dropped.items():
        for joint in np.flatnonzero(lost.any(axis=0)):
            values, gone = changed.setdefault(name, getattr(dataset, name).copy()), lost[:, joint]
            values[gone, joint] = np.interp(np.flatnonzero(gone), np.flatnonzero(~gone), values[~gone, joint])
    mended = replace(dataset, **changed, truth={}) if changed else dataset
    change = np.abs(np.diff(mended.q, axis=0, append=mended.q[-1:]))
    change[~consecutive(mended)] = 0.0
    return {"mended": mended, "dropped": dropped, "jumps": (change > np.pi) & mended.turns}


def _drop_outs(dataset: Dataset, name: str) -> Bool[np.ndarray, "rows nv"]:
    """Where a signal is exactly 0 between values far from 0, or else jumps and comes back: it was not measured."""
    values = getattr(dataset, name)
    if name == "u":  # the last columns may be switches of contacts, which are 0 by right
        values = values[:, : min(dataset.nv, len(dataset.model.actuators))]
    lost, follows = np.zeros(values.shape if name == "q" else dataset.v.shape, dtype=bool), consecutive(dataset)[:-1]
    for joint in np.flatnonzero(((values == 0.0).sum(axis=0) >= FEWEST_DROPS) & (np.ptp(values, axis=0) > 0.0)):
        x = values[:, joint]
        steps = np.abs(np.diff(x))
        usual = max(
            JUMP * float(np.quantile(steps, 0.9)), LEAST_JUMP * float(np.ptp(x)), 1e-9 * float(np.abs(values).max()),
            STEPS * resolution(x),
        )  # fmt: skip
        zeros = runs(x == 0.0)
        zeros = zeros[(zeros[:, 0] > 0) & (zeros[:, 1] <= len(steps))]
        into, out = zeros.T - 1  # the steps that lead into a run of zeros, and out of it
        sudden = (steps[into] > usual) & (steps[out] > usual) & follows[into] & follows[out]
        for start, stop in zeros[sudden] if sudden.sum() >= FEWEST_DROPS else []:
            lost[start:stop, joint] = True
    if not lost.any() and not (name == "q" and (np.abs(np.diff(values, axis=0)) > np.pi).any()):  # an angle that wraps
        for joint in range(values.shape[1]):
            lost[single_rows(values[:, joint], follows), joint] = True
    return lost


def single_rows(x: np.ndarray, follows: np.ndarray) -> np.ndarray:
    """Single rows of a signal that are far from those before and after, unlike all others."""
    off = np.zeros(len(x))
    off[1:-1] = np.where(follows[:-1] & follows[1:], np.abs(x[1:-1] - 0.5 * (x[2:] + x[:-2])), 0.0)
    alone = np.flatnonzero(np.minimum(off[:-2], off[2:]) > BACK * off[1:-1]) + 1
    tops, rest = alone[np.argsort(-off[alone])][:MOST_SPIKES], off.copy()
    rest[np.add.outer(tops, [-1, 0, 1])] = 0.0
    return tops[off[tops] > max(FAR_OFF * rest.max(), STEPS * resolution(x))] if rest.any() else tops[:0]


def _few_stretches(dataset: Dataset) -> Dataset:
    """A few stretches of successive rows, evenly over the log, each an episode."""
    length = STRETCH_ROWS if dataset.nv <= FEW_JOINTS else STRETCH_ROWS // 2
    if len(dataset) <= STRETCHES * length:
        return dataset
    rows = (np.linspace(0, len(dataset) - length, STRETCHES).astype(int)[:, None] + np.arange(length)).ravel()
    pieces = np.repeat(np.arange(STRETCHES), length)
    _, numbers = np.unique(np.stack([pieces, dataset.episode[rows]]), axis=1, return_inverse=True)
    return replace(dataset.rows(rows), episode=numbers.ravel())


def _smoothed(dataset: Dataset) -> tuple[Dataset, int]:
    """Running means of all signals within each episode, and their width: the equation of motion keeps holding."""
    steps = np.diff(dataset.time)[consecutive(dataset)[:-1]]
    width = int(min(SMOOTH_SECONDS / np.median(steps), SMOOTH_ROWS)) // 2 * 2 + 1 if len(steps) else 1
    width = width if len(dataset) >= 10 * width else 1
    inside = whole_windows(dataset, width)
    if width < 3 or not len(inside):
        return dataset, width
    means = {name: window_means(getattr(dataset, name), inside, width) for name in ("q", "v", "u", "a")}
    return replace(dataset.rows(inside + width // 2), **means, noise_std=None, truth={}), width


def _even(dataset: Dataset, jumps: np.ndarray) -> Dataset:  # stretches without gaps, each an episode
    pieces: list[np.ndarray] = []
    for number in dataset.episodes:
        rows = np.flatnonzero(dataset.episode == number)
        steps = np.diff(dataset.time[rows])
        breaks = np.flatnonzero(steps > GAP * np.median(steps)) + 1 if len(steps) else []
        pieces += [piece for piece in np.split(rows, breaks) if len(piece) >= FEWEST_ROWS]
    if not pieces:
        seen = f"no stretch of {FEWEST_ROWS} rows without a gap; a check needs one"
        raise InvalidInput(f"{seen}. Give a longer recording, or number the episodes.")
    rows, numbers = np.concatenate(pieces), np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    even = replace(dataset.rows(rows), episode=numbers, noise_std=None, truth={}, time_ordered=True)
    with contextlib.suppress(DatasetError):
        steps = [uniform_step(even.time[even.episode == number]) for number in even.episodes]
        if max(steps) - min(steps) <= 1e-3 * max(steps):
            return even
    if jumps.any():
        return even  # a spline through a jump would be of no use, and nothing is differentiated then
    return resample(even, float(np.median(np.concatenate([np.diff(dataset.time[piece]) for piece in pieces]))))


def slips(inputs: CheckInput) -> Iterator[Doubt]:
    """Single steps of positions that are far from those just before and after, unlike all others."""
    log, follows = inputs.log, consecutive(inputs.log)[:-1]
    for joint, name in enumerate(() if inputs.jumps.any() else inputs.names):
        steps = np.diff(log.q[:, joint])
        for row in single_rows(steps, follows[:-1] & follows[1:])[:1].tolist():
            moved = np.flatnonzero(steps[:row])
            first = int(moved[-1]) + 1 if len(moved) else 0
            begin, then, at, end = log.time[[0, first, row + 1, -1]].tolist()
            size, stood = f"{steps[row]:+.3g} {inputs.unit_of_each('q')[joint]}", row - first >= STOOD
            seen = f"jumps by {size} at {at:.3f} s and stays there: its encoder has slipped, or was set anew."
            left_out = (then, at) if stood else (at, end) if at - begin > end - at else (begin, at)
            if stood:
                seen = f"stands still from {then:.3f} s on and jumps by {size} at {at:.3f} s: its encoder was dead."
            yield wrong(
                about="frozen channel" if stood else "jumps",
                what=f"the position of {name} {seen}",
                do="Leave {} out by forcegp import LOG --without {:.3f},{:.3f}{}.".format(
                    "these rows" if stood else "the shorter part", *left_out, "" if stood else ", or correct it"
                ),
                joints=(name,),
                numbers={"jump": float(steps[row]), "time": at, "stood": at - then},
            )
