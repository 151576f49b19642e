"""From a raw log to rows that can be learned from, and what that costs: filter, align, differentiate, thin out."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal
from warnings import warn

import numpy as np
from jaxtyping import Float

from forcegp.data.configurations import actuators
from forcegp.data.dataset import Dataset
from forcegp.data.delay import estimate_delay, estimate_thruster_lag, thruster_columns, torques_of_joints
from forcegp.data.filters import (
    PASSED,
    LowPass,
    Signal,
    differentiated,
    episodes_in_order,
    low_pass,
    shifted,
    uniform_step,
)
from forcegp.data.spectrum import FEWEST_ROWS, MotionSpectrum, held_out_cutoff, motion_spectrum
from forcegp.data.stance import estimate_stance
from forcegp.errors import DatasetError, DataWarning, InvalidInput, usable_arguments
from forcegp.robots.arguments import whole_number
from forcegp.summary import plain

LATE: tuple[Literal["delay"], Literal["lag"]] = "delay", "lag"
FEW = 2_000  # rows of a whole log
SETTLED = 5.0  # time constants of an actuator after which what it did before the log is forgotten


@dataclass(frozen=True, kw_only=True)
class Preparation:
    """What to do with a raw log, the same for every episode. The default changes nothing.

    cutoff: zero-phase Butterworth low-pass of that many Hz on q and u (with `differentiate="v"` on v as well), after
        which v and a are computed anew; "auto" reads it from the spectrum (`motion_spectrum`), None leaves q, v, a
        and u as they are.
    delay: how much later than it acts u was logged [s], one number or one per actuator: `u(t) := u_logged(t + delay)`;
        "auto" estimates one for all joints (`estimate_delay`), used where it is sure and explains something.
    lag: time constant of the actuators [s], one or one per actuator: `u` becomes what an actuator of first order makes
        of it, T u_a' + u_a = u; "auto" estimates that of thrusters (`estimate_thruster_lag`).
    every: keep every so many rows.
    trim: seconds to drop at both ends of each episode, where a filter has samples of one side only.
    differentiate: "q" computes v and a from the filtered positions, "v" only a from the filtered velocities.
    stance: "auto" sets the switches of contacts in u to what motion and forces show (`estimate_stance`), after the
        filter, and drops rows that leave one open; "log" keeps them.
    why: reasons for the numbers in place of "auto", of a preparation that was `resolved`.

    Raises InvalidInput for values that are not allowed.
    """

    cutoff: float | Literal["auto"] | None = None
    delay: float | tuple[float, ...] | Literal["auto"] = 0.0
    lag: float | tuple[float, ...] | Literal["auto"] = 0.0
    every: int = 1
    trim: float = 0.0
    differentiate: Literal["q", "v"] = "q"
    stance: Literal["log", "auto"] = "log"
    why: Mapping[str, Any] = field(default_factory=dict, compare=False)

    @usable_arguments("Preparation")
    def __post_init__(self) -> None:
        if self.cutoff not in (None, "auto") and not (_finite(self.cutoff) and self.cutoff > 0):
            raise InvalidInput(f"cutoff is {self.cutoff!r}; give a frequency > 0 in Hz, 'auto', or None for no filter.")
        for name in LATE:
            given = getattr(self, name)
            if isinstance(given, Sequence | np.ndarray) and not isinstance(given, str):
                object.__setattr__(self, name, tuple(given))
            each = seconds_of(getattr(self, name))
            if given != "auto" and not (each and all(_finite(value) for value in each)):
                raise InvalidInput(f"{name} is {given!r}; give seconds, one number per joint, or 'auto'.")
            if name == "lag" and given != "auto" and min(each) < 0.0:
                raise InvalidInput(f"lag is {given!r}; an actuator acts after its command: at least 0 s.")
        whole_number("every", self.every, 1)
        if not _finite(self.trim) or self.trim < 0:
            raise InvalidInput(f"trim is {self.trim!r}; it must be at least 0 s.")
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
        """The same with numbers in place of "auto", and `why`. Raises as `motion_spectrum` and `estimate_delay`."""
        return _resolve(self, dataset)

    def rows(self, dataset: Dataset) -> Dataset:
        """The prepared rows without their price, as `apply` gives them but with the metadata of `dataset`."""
        chosen = self.resolved(dataset)
        return _chosen_rows(chosen, dataset, _filtered(chosen, dataset))[0]

    def apply(self, dataset: Dataset) -> Dataset:
        """The prepared Dataset, with its price under "preparation" in the metadata.

        The price holds the settings; "why" for what was chosen; "rows" and "sample_rate" [Hz] before and after; per
        joint "acceleration_noise" before and after the filter [rad/s^2 or m/s^2] (None where the log shows no noise
        floor); and the price that was paid "earlier". `truth` and `noise_std` are dropped as `low_pass` and
        `differentiated` drop them. Raises DatasetError for rows that are out of order, sampled unevenly or too few, and
        InvalidInput for a cut-off above half the sample rate.
        """
        chosen = self.resolved(dataset)
        prepared, found = _chosen_rows(chosen, dataset, _filtered(chosen, dataset))
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


def _resolve(given: Preparation, dataset: Dataset) -> Preparation:
    reasons: dict[str, Any] = dict(given.why)
    for name in LATE:
        value = getattr(given, name)
        if isinstance(value, tuple) and len(value) != (count := actuators(dataset)):
            of = "joints" if torques_of_joints(dataset) else "actuators"
            raise InvalidInput(f"{name} has {len(value)} numbers; the dataset has {count} {of}.")
    chosen = given
    if given.cutoff == "auto":
        spectrum = motion_spectrum(dataset, given.differentiate)
        decisive = _decisive(spectrum.cutoff, dataset)
        cutoff = float(f"{np.nanmax(decisive):.3g}") if np.isfinite(decisive).any() else None
        reasons["cutoff"] = _why(cutoff, decisive, spectrum, dataset)
        model = dataset.model
        if cutoff is not None and model is not None and not model.contacts and torques_of_joints(dataset):
            with contextlib.suppress(DatasetError):  # too short, or sampled too slowly: the spectrum has to do
                best, tried = held_out_cutoff(dataset, model.robot, cutoff, given.differentiate)
                shares = ", ".join(f"{100.0 * share:.2g} % at {frequency:g} Hz" for frequency, share in tried.items())
                reasons["cutoff"] += f"; of held-out torques stay unexplained {shares}"
                cutoff = best
        chosen = replace(given, cutoff=cutoff)
    if given.lag == "auto":
        seconds, std = estimate_thruster_lag(_filtered(replace(chosen, lag=0.0, delay=0.0), dataset))
        pushing = thruster_columns(dataset.model)  # joints beside them do not follow so
        each = tuple(seconds * (column in pushing) for column in range(actuators(dataset)))
        chosen = replace(chosen, lag=seconds if all(each) else each)
        reasons["lag"] = f"{1e3 * seconds:.1f} ms ± {1e3 * std:.1f} ms"
    if given.delay == "auto":
        found = estimate_delay(_filtered(replace(chosen, delay=0.0), dataset))
        chosen = replace(chosen, delay=found.significant)
        reasons["delay"] = found.reason
    return replace(chosen, why=reasons)


BEYOND_BASE = 8.0
"""The cut-off of a robot on contacts is at most so many times that of its base, whose accelerations are noise there."""


def _decisive(each: Float[np.ndarray, " nv"], dataset: Dataset) -> Float[np.ndarray, " nv"]:
    """The cut-offs that count: of a robot whose base stands on contacts none far beyond those of the base."""
    for group in dataset.model.robot.layout.groups[:1] if dataset.model and dataset.model.touching else ():
        if np.isfinite(each[group.rows]).any():
            return np.minimum(each, BEYOND_BASE * np.nanmax(each[group.rows]))
    return each


def _why(cutoff: float | None, decisive: Float[np.ndarray, " nv"], spectrum: MotionSpectrum, dataset: Dataset) -> str:
    if cutoff is None:
        return f"the spectrum of {spectrum.source} shows no noise worth a filter; nothing is filtered"
    joint, fastest = dataset.joint_names[int(np.nanargmax(decisive))], np.nanmax(spectrum.cutoff)
    others = "no other joint moves faster"
    if np.nanmax(decisive) < fastest:
        others = f"joints do up to {fastest:.3g} Hz, where accelerations of the base are noise"
    return (
        f"up to {cutoff:g} Hz the motion of joint {joint!r} is stronger than the noise of {spectrum.source}; {others}"
    )


def _filtered(chosen: Preparation, dataset: Dataset) -> Dataset:
    """Filtered, differentiated and shifted, with all its rows."""
    assert chosen.cutoff != "auto"
    if chosen.cutoff is not None:
        signals: tuple[Signal, ...] = ("q", "u") if chosen.differentiate == "q" else ("q", "v", "u")
        dataset = low_pass(dataset, float(chosen.cutoff), signals=signals)
        dataset = differentiated(dataset, chosen.differentiate)
    shifts, lags = (_per_actuator(given, dataset) for given in (chosen.delay, chosen.lag))
    if not any((*shifts, *lags)):
        return dataset
    return shifted(dataset, shifts, lags)


def seconds_of(given: float | tuple[float, ...] | str) -> tuple[Any, ...]:
    """Numbers of a delay or lag, one or one per joint; of text, itself."""
    return given if isinstance(given, tuple) else (given,)


def _per_actuator(given: float | tuple[float, ...] | str, dataset: Dataset) -> list[float]:
    each, count = seconds_of(given), actuators(dataset)
    return [float(value) for value in (each if len(each) == count else each * count)]


def _kept(chosen: Preparation, dataset: Dataset) -> np.ndarray:
    """Row numbers that stay: not trimmed, with a torque at their shifted time, every so many."""
    shifts = seconds_of(chosen.delay)
    early, late = max(0.0, -min(shifts), SETTLED * max(seconds_of(chosen.lag))), max(0.0, *shifts)
    if chosen.changes_nothing:
        return np.arange(len(dataset))
    kept = []
    for number, rows, label in episodes_in_order(dataset):
        step = uniform_step(rows.time, label) if len(rows) > 1 else 0.0
        slack = 1e-6 * step  # times are sums of steps
        first, last = rows.time[0] + max(chosen.trim, early) - slack, rows.time[-1] - max(chosen.trim, late) + slack
        own = np.flatnonzero(dataset.episode == number)[(rows.time >= first) & (rows.time <= last)][:: chosen.every]
        if not len(own):
            raise DatasetError(
                f"{label} lasts {rows.time[-1] - rows.time[0]:.6g} s; nothing is left of it after "
                f"{chosen.trim:g} s are trimmed at both ends. Trim less, or leave the episode out."
            )
        kept.append(own)
        if chosen.cutoff is not None and 0.5 / (chosen.every * step) < float(chosen.cutoff):
            warn(
                f"every {chosen.every}. row is {1.0 / (chosen.every * step):.4g} Hz, of which only half can carry "
                f"motion; the filter passes {chosen.cutoff:g} Hz. Rows stay true, but spectra, derivatives and filters "
                "of them do not: keep more rows or filter lower.",
                DataWarning,
                stacklevel=3,
            )
    return np.sort(np.concatenate(kept))


def _chosen_rows(chosen: Preparation, raw: Dataset, filtered: Dataset) -> tuple[Dataset, dict[str, Any]]:
    """The rows that stay, with flags of stance where they are to be found, and shares of what was found."""
    kept = _kept(chosen, raw)
    if chosen.stance == "log":
        return filtered.rows(kept), {}
    found = estimate_stance(filtered)
    rows = found.rows(kept).written(filtered.rows(kept))
    stands = {name: float(share) for name, share in zip(found.names, np.nanmean(found.flags, axis=0), strict=True)}
    return rows, {"stance": {"standing": stands, "open_rows": len(kept) - len(rows)}}


def _report(chosen: Preparation, raw: Dataset, prepared: Dataset) -> dict[str, Any]:
    report: dict[str, Any] = {
        "cutoff": chosen.cutoff,
        **{name: _per_actuator(getattr(chosen, name), raw) for name in LATE},
        "every": chosen.every,
        "trim": chosen.trim,
        "differentiate": chosen.differentiate if chosen.cutoff is not None else None,
        "why": chosen.why,
        "rows": [len(raw), len(prepared)],
    }
    if chosen.changes_nothing:
        return report
    rate = 1.0 / float(np.median([uniform_step(rows.time) for _, rows, _ in episodes_in_order(raw) if len(rows) > 1]))
    report["sample_rate"] = [rate, rate / chosen.every]
    if chosen.cutoff is None:
        return report
    before = after = np.full(raw.nv, np.nan)
    if max(np.bincount(np.unique(raw.episode, return_inverse=True)[1])) >= FEWEST_ROWS:
        spectrum = motion_spectrum(raw, chosen.differentiate)
        before = spectrum.acceleration_noise()
        after = spectrum.acceleration_noise(LowPass(float(chosen.cutoff)))
    report["acceleration_noise"] = {"before": plain(before), "after": plain(after)}
    return report


def _finite(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and bool(np.isfinite(value))
