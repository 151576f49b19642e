"""From a raw log to rows that can be learned from, and what that costs: filter, align, differentiate, thin out."""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeGuard
from warnings import warn

import numpy as np

from forcegp.data.dataset import Dataset
from forcegp.data.delay import estimate_delay, torques_of_joints
from forcegp.data.filters import LowPass, Signal, differentiated, episodes_in_order, low_pass, shifted, uniform_step
from forcegp.data.spectrum import FEWEST_ROWS, held_out_cutoff, motion_spectrum, with_strokes_of_rests
from forcegp.data.stance import estimate_stance
from forcegp.data.views import at_rest, decided
from forcegp.data.wind import thruster_columns
from forcegp.errors import DatasetError, DataWarning, InvalidInput, usable_arguments
from forcegp.robots.arguments import whole_number
from forcegp.summary import plain

PASSED = 3.0  # rows in a period of a cut-off, of which more repeat their neighbours (`LowPass.memory`)
FEW = 2_000  # rows of a whole log
SETTLED = 5.0  # time constants of an actuator after which what it did before the log is forgotten
EXPLAINED, SLOW = 1.1, 0.25
"""Times their noise by which a sensor of a base may differ from positions; of the cut-off, below which these hold."""
BEYOND_BASE = 1.5
"""The cut-off of a robot on contacts is at most so many times that of its base, whose accelerations are noise there."""


@dataclass(frozen=True, kw_only=True)
class Preparation:
    """What to do with a raw log, the same for every episode. The default changes nothing.

    cutoff: zero-phase Butterworth low-pass of that many Hz on q and u (with `differentiate="v"` on v as well), after
        which v and a are computed anew; "auto" as `motion_spectrum` and `held_out_cutoff` find it, None for none.
    delay: how much later than it acts u was logged [s]: `u(t) := u_logged(t + delay)`; "auto": `estimate_delay`, 0
        where u does not hold the torques of all joints, or something is touched.
    lag: time constant of the actuators [s], of thrusters where a base has them: T u_a' + u_a = u. Below zero, that of
        a filter behind which u was logged, which is undone; a delay of "auto" finds one where `lag` is 0.
    every: keep every so many rows.
    trim: seconds to drop at both ends of each episode, where a filter has samples of one side only.
    differentiate: "q" computes v and a from the filtered positions, "v" only a from the filtered velocities. With "q"
        a base that moves keeps, above a quarter of the cut-off, what v, a gyroscope or an accelerometer measured, where
        that is quieter than positions differentiated.
    stance: "auto" sets the switches of contacts in u to what motion and forces show (`estimate_stance`), after the
        filter, .5 where they leave it open; "log" keeps what u has.
    why: reasons for the numbers in place of "auto", of a preparation that was `resolved`.

    Raises InvalidInput for values that are not allowed.
    """

    cutoff: float | Literal["auto"] | None = None
    delay: float | Literal["auto"] = 0.0
    lag: float = 0.0
    every: int = 1
    trim: float = 0.0
    differentiate: Literal["q", "v"] = "q"
    stance: Literal["log", "auto"] = "log"
    why: Mapping[str, Any] = field(default_factory=dict, compare=False)

    @usable_arguments("Preparation")
    def __post_init__(self) -> None:
        if self.cutoff not in (None, "auto") and not (_finite(self.cutoff) and self.cutoff > 0):
            raise InvalidInput(f"cutoff is {self.cutoff!r}; give a frequency > 0 in Hz, 'auto', or None for no filter.")
        for name, limit in (("delay", ", or auto"), ("lag", ""), ("trim", ", at least 0")):
            given = getattr(self, name)
            if not (_finite(given) and (name != "trim" or given >= 0.0)) and not (name == "delay" and given == "auto"):
                raise InvalidInput(f"{name} is {given!r}; give seconds{limit}.")
        whole_number("every", self.every, 1)
        for name, allowed in (("differentiate", ("q", "v")), ("stance", ("log", "auto"))):
            if getattr(self, name) not in allowed:
                raise InvalidInput(f"{name} is {getattr(self, name)!r}; allowed: {' or '.join(map(repr, allowed))}.")

    def thinning(self, dataset: Dataset) -> int:
        """N, so that every N-th row of the log holds what the filter leaves: `PASSED` rows per period, `FEW` in all."""
        if self.cutoff in (None, "auto"):
            return 1
        step = uniform_step(dataset.time[dataset.episode == dataset.episodes[0]])
        return max(1, min(int(1.0 / (step * PASSED * float(self.cutoff))), len(dataset) // FEW))

    @property
    def changes_nothing(self) -> bool:
        """Whether the rows stay as they are."""
        return self == Preparation(differentiate=self.differentiate)

    def resolved(self, dataset: Dataset) -> "Preparation":
        """The same with numbers in place of "auto", and `why`. DatasetError as `motion_spectrum`, `estimate_delay`."""
        reasons, chosen = dict(self.why), self
        if self.cutoff == "auto":
            cutoff, reasons["cutoff"] = _cutoff(dataset, self.differentiate)
            chosen = replace(chosen, cutoff=cutoff)
        if self.delay == "auto" and at_rest(dataset):
            chosen, reasons["delay"] = replace(chosen, delay=0.0), "in a log of postures alone none shows"
        elif self.delay == "auto":
            chosen = replace(chosen, delay=0.0)
            try:
                cutoff = None if chosen.cutoff is None else float(chosen.cutoff)
                found = estimate_delay(_filtered(chosen, dataset), cutoff)
                chosen = replace(chosen, delay=found.significant, lag=chosen.lag or 0.0 - found.lag)
                reasons["delay"] = found.reason
            except InvalidInput as error:
                reasons["delay"] = f"u is taken to be on time: {error}"
        return replace(chosen, why=reasons)

    def rows(self, dataset: Dataset) -> Dataset:
        """The prepared rows without their price, as `apply` gives them but with the metadata of `dataset`."""
        return _prepared(self.resolved(dataset), dataset)[0]

    def apply(self, dataset: Dataset) -> Dataset:
        """The prepared Dataset, with its price under "preparation" in the metadata.

        The price: the settings and "why", "rows" and "sample_rate" [Hz] before and after, per joint
        "acceleration_noise" before and after [rad/s^2 or m/s^2], and what was "earlier". Raises DatasetError for rows
        out of order, uneven or too few, InvalidInput for a cut-off above half the sample rate.
        """
        chosen = self.resolved(dataset)
        prepared, found = _prepared(chosen, dataset)
        report = _report(chosen, dataset, prepared) | found
        if "preparation" in dataset.metadata:
            report["earlier"] = dataset.metadata["preparation"]
        return replace(prepared, metadata={**dataset.metadata, "preparation": report})


def memory(metadata: Mapping[str, Any]) -> float:
    """Time in s within which rows of a filtered log repeat their neighbours; 0 where the metadata name no filter."""
    cutoff = preparation_report(metadata).get("cutoff")
    return 0.0 if cutoff is None else LowPass(float(cutoff)).memory


def preparation_report(metadata: Mapping[str, Any]) -> Mapping[str, Any]:
    """`metadata["preparation"]` as a `Preparation` leaves it; empty for what others may have put there."""
    report = metadata.get("preparation")
    return report if isinstance(report, Mapping) and {"cutoff", "why", "rows"} <= report.keys() else {}


def _cutoff(dataset: Dataset, source: Literal["q", "v"]) -> tuple[float | None, str]:
    """What the spectrum shows, not far beyond a base on contacts, and what torques make of it [Hz]; and why."""
    if at_rest(dataset):
        return None, "the log is of postures, within which nothing moves; nothing is filtered"
    spectrum, model = motion_spectrum(dataset, source), dataset.model
    fastest = decisive = spectrum.cutoff
    for group in model.robot.layout.groups[:1] if model.contacts else ():
        if np.isfinite(fastest[group.rows]).any():
            decisive = np.minimum(fastest, BEYOND_BASE * np.nanmax(fastest[group.rows]))
    if not np.isfinite(decisive).any():
        return None, f"the spectrum of {source} shows no noise worth a filter; nothing is filtered"
    cutoff, joint = float(f"{np.nanmax(decisive):.3g}"), dataset.joint_names[int(np.nanargmax(decisive))]
    why = f"up to {cutoff:g} Hz the motion of joint {joint!r} is stronger than the noise of {source}; "
    if np.nanmax(decisive) < np.nanmax(fastest):
        why += f"joints do up to {np.nanmax(fastest):.3g} Hz, where accelerations of the base are noise"
    else:
        why += "no other joint moves faster"
    if not model.contacts and torques_of_joints(dataset):
        with contextlib.suppress(DatasetError):  # too short, or sampled too slowly: the spectrum has to do
            cutoff, tried = held_out_cutoff(dataset, cutoff, source)
            shares = ", ".join(f"{100.0 * share:.2g} % at {frequency:g} Hz" for frequency, share in tried.items())
            why += f"; of held-out torques stay unexplained {shares}"
    return cutoff, why


def _filtered(chosen: Preparation, dataset: Dataset) -> Dataset:
    if chosen.cutoff is not None:
        sensors = chosen.differentiate == "q" and bool(dataset.model.robot.space.groups)
        signals: tuple[Signal, ...] = ("q", "u") if chosen.differentiate == "q" else ("q", "v", "u")
        low = low_pass(dataset, float(chosen.cutoff), signals=("q", "v", "u", "a") if sensors else signals)
        derived = differentiated(low, chosen.differentiate)
        raw = dataset
        dataset = _with_sensors_of_base(derived, low, dataset, float(chosen.cutoff)) if sensors else derived
        dataset = with_strokes_of_rests(dataset, raw)
    if not chosen.delay and not chosen.lag:
        return dataset
    pushing = [*thruster_columns(dataset.model)]  # joints beside them do not follow so
    return shifted(dataset, float(chosen.delay), float(chosen.lag), pushing or None)


def _with_sensors_of_base(derived: Dataset, measured: Dataset, raw: Dataset, cutoff: float) -> Dataset:
    """v and a of a base that moves, from sensors that differ from positions by no more than noise of those explains."""
    # below `SLOW` of the cut-off all are those of positions, which have neither bias nor tilt
    groups = raw.model.robot.space.groups
    if max(np.bincount(np.unique(raw.episode, return_inverse=True)[1])) < FEWEST_ROWS:
        return derived
    noise, by_v = motion_spectrum(raw, "q").acceleration_noise(LowPass(cutoff)), differentiated(measured, "v").a
    parts = [slice(group.row + k, group.row + k + 3) for group in groups for k in (0, 3)]

    def quieter(a: np.ndarray) -> np.ndarray:
        """Entries of a base in whose linear or angular part this differs from positions by their noise alone."""
        found = np.zeros(raw.nv, dtype=bool)
        for part in parts:
            known = np.isfinite(noise[part])  # fast motion hides that of an axis
            off = float(np.square(a - derived.a)[:, part].mean())
            if known.any() and np.ptp(a[:, part], axis=0).all():
                found[part] = off < np.square(EXPLAINED * noise[part][known]).mean()
        return found

    def raised(values: np.ndarray, slow: np.ndarray) -> np.ndarray:
        """What filtered values have above the slow part."""
        return values - low_pass(replace(derived, a=values - slow), SLOW * cutoff, signals=("a",)).a

    by_sensors = np.where(quieter(measured.a), measured.a, by_v)
    try:
        v = np.where(quieter(by_v), raised(measured.v, derived.v), derived.v)
        a = np.where(quieter(by_sensors), raised(by_sensors, derived.a), derived.a)
    except DatasetError:  # episodes too short for so slow a filter
        return derived
    return replace(derived, v=v, a=a)


def _kept(chosen: Preparation, dataset: Dataset) -> np.ndarray:
    """Row numbers that stay: not trimmed, with a torque at their shifted time, every so many."""
    if chosen.changes_nothing:
        return np.arange(len(dataset))
    early = max(chosen.trim, -float(chosen.delay), SETTLED * float(chosen.lag))
    late, kept = max(chosen.trim, float(chosen.delay)), []
    for number, rows, label in episodes_in_order(dataset):
        step = uniform_step(rows.time, label) if len(rows) > 1 else 0.0
        slack = 1e-6 * step  # times are sums of steps
        inside = (rows.time >= rows.time[0] + early - slack) & (rows.time <= rows.time[-1] - late + slack)
        own = np.flatnonzero(dataset.episode == number)[inside][:: chosen.every]
        if not len(own):
            seen = f"{label} lasts {rows.time[-1] - rows.time[0]:.6g} s"
            why = f"nothing is left of it after {chosen.trim:g} s are trimmed at both ends"
            raise DatasetError(f"{seen}; {why}. Trim less, or leave the episode out.")
        kept.append(own)
        if chosen.cutoff is not None and 0.5 / (chosen.every * step) < float(chosen.cutoff):
            kept_rate = f"every {chosen.every}. row is {1.0 / (chosen.every * step):.4g} Hz"
            seen = f"{kept_rate}, of which only half can carry motion; the filter passes {chosen.cutoff:g} Hz"
            effect = "Rows stay true, but spectra, derivatives and filters of them do not"
            warn(f"{seen}. {effect}: keep more rows or filter lower.", DataWarning, stacklevel=3)
    return np.sort(np.concatenate(kept))


def _prepared(chosen: Preparation, raw: Dataset) -> tuple[Dataset, dict[str, Any]]:
    """The rows that stay, with flags of stance where they are to be found, and shares of what was found."""
    filtered, kept = _filtered(chosen, raw), _kept(chosen, raw)
    if chosen.stance == "log":
        return filtered.rows(kept), {}
    found = estimate_stance(filtered)
    rows = found.rows(kept).written(filtered.rows(kept))
    stands = {name: float(share) for name, share in zip(found.names, np.nanmean(found.flags, axis=0), strict=True)}
    return rows, {"stance": {"standing": stands, "open_rows": len(rows) - len(decided(rows))}}


def _report(chosen: Preparation, raw: Dataset, prepared: Dataset) -> dict[str, Any]:
    names = ("cutoff", "delay", "lag", "every", "trim", "why")
    report: dict[str, Any] = {name: getattr(chosen, name) for name in names}
    report |= {"differentiate": chosen.differentiate if chosen.cutoff is not None else None}
    report |= {"rows": [len(raw), len(prepared)]}
    if chosen.changes_nothing:
        return report
    rate = 1.0 / float(np.median([uniform_step(rows.time) for _, rows, _ in episodes_in_order(raw) if len(rows) > 1]))
    report["sample_rate"] = [rate, rate / chosen.every]
    if chosen.cutoff is not None:
        before = after = np.full(raw.nv, np.nan)
        if max(np.bincount(np.unique(raw.episode, return_inverse=True)[1])) >= FEWEST_ROWS:
            spectrum = motion_spectrum(raw, chosen.differentiate)
            before, after = spectrum.acceleration_noise(), spectrum.acceleration_noise(LowPass(float(chosen.cutoff)))
        report["acceleration_noise"] = {"before": plain(before), "after": plain(after)}
    return report


def _finite(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and bool(np.isfinite(value))
