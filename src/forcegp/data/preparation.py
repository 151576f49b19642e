"""From a raw log to rows that can be learned from, and what that costs: filter, align, differentiate, thin out."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal
from warnings import warn

import numpy as np
import torch
from jaxtyping import Float

from forcegp.data.configurations import actuators, as_vectors, space_of
from forcegp.data.dataset import Dataset
from forcegp.data.delay import estimate_delay, shifted, torques_of_joints
from forcegp.data.filtering import Signal, differentiated, episodes_in_order, low_pass, low_pass_gain, uniform_step
from forcegp.data.spectrum import FEWEST_ROWS, MotionSpectrum, held_out_cutoff, motion_spectrum
from forcegp.data.stance import estimate_stance
from forcegp.data.thruster_lag import estimate_thruster_lag, thruster_columns
from forcegp.errors import DatasetError, DataWarning, InvalidInput, usable_arguments
from forcegp.robots.arguments import whole_number
from forcegp.summary import plain

LATE: tuple[Literal["delay"], Literal["lag"]] = "delay", "lag"
PASSED, FEW = 3.0, 2_000  # rows in a period of the cut-off, of which more repeat their neighbours; of a whole log
SETTLED = 5.0  # time constants of an actuator after which what it did before the log is forgotten


@dataclass(frozen=True, kw_only=True)
class Preparation:
    """What to do with a raw log, the same for every episode. The default changes nothing.

    cutoff: zero-phase Butterworth low-pass of that many Hz on q and u (with `differentiate="v"` on v as well), after
        which v and a are computed anew; "auto" reads it from the spectrum (`motion_spectrum`), None leaves q, v, a
        and u as they are.
    order: of the filter; it runs forwards and backwards.
    delay: how much later than it acts u was logged [s], one number or one per actuator: `u(t) := u_logged(t + delay)`;
        "auto" estimates one for all joints (`estimate_delay`), used where it is sure and explains something.
    lag: time constant of the actuators [s], one or one per actuator: `u` becomes what an actuator of first order makes
        of it, T u_a' + u_a = u; "auto" as for the delay. Delay and lag look alike: estimate one of them.
    every: keep every so many rows.
    trim: seconds to drop at both ends of each episode, where a filter has samples of one side only.
    differentiate: "q" computes v and a from the filtered positions, "v" only a from the filtered velocities.
    stance: "auto" sets the switches of contacts in u to what motion and forces show (`estimate_stance`), after the
        filter, and drops rows that leave one open; "log" keeps them.

    Raises InvalidInput for values that are not allowed.
    """

    cutoff: float | Literal["auto"] | None = None
    order: int = 4
    delay: float | tuple[float, ...] | Literal["auto"] = 0.0
    lag: float | tuple[float, ...] | Literal["auto"] = 0.0
    every: int = 1
    trim: float = 0.0
    differentiate: Literal["q", "v"] = "q"
    stance: Literal["log", "auto"] = "log"

    @usable_arguments("Preparation")
    def __post_init__(self) -> None:
        if self.cutoff not in (None, "auto") and not (_finite(self.cutoff) and self.cutoff > 0):
            raise InvalidInput(f"cutoff is {self.cutoff!r}; give a frequency > 0 in Hz, 'auto', or None for no filter.")
        whole_number("order", self.order, 1, 12)
        for name in LATE:
            given = getattr(self, name)
            if isinstance(given, Sequence | np.ndarray) and not isinstance(given, str):
                object.__setattr__(self, name, tuple(given))
            each = seconds_of(getattr(self, name))
            if given != "auto" and not (each and all(_finite(value) for value in each)):
                raise InvalidInput(f"{name} is {given!r}; give seconds, one number per joint, or 'auto'.")
            if name == "lag" and given != "auto" and min(each) < 0.0:
                raise InvalidInput(f"lag is {given!r}; an actuator acts after its command: at least 0 s.")
        if self.delay == self.lag == "auto":
            raise InvalidInput("delay and lag are both to be estimated, and look alike; give one of them in s.")
        whole_number("every", self.every, 1)
        if not _finite(self.trim) or self.trim < 0:
            raise InvalidInput(f"trim is {self.trim!r}; it must be at least 0 s.")
        if self.differentiate not in ("q", "v"):
            raise InvalidInput(f"differentiate is {self.differentiate!r}; allowed: 'q' or 'v'.")
        if self.stance not in ("log", "auto"):
            raise InvalidInput(f"stance is {self.stance!r}; allowed: 'log' or 'auto'.")

    def thinning(self, dataset: Dataset) -> int:
        """N, so that every N-th row of the log holds what the filter leaves: `PASSED` rows per period, `FEW` in all."""
        if self.cutoff in (None, "auto"):
            return 1
        step = uniform_step(dataset.time[dataset.episode == dataset.episodes[0]])
        return max(1, min(int(1.0 / (step * PASSED * float(self.cutoff))), len(dataset) // FEW))

    @property
    def changes_nothing(self) -> bool:
        """Whether the rows stay as they are."""
        return self == Preparation(order=self.order, differentiate=self.differentiate)

    def resolved(self, dataset: Dataset) -> "Preparation":
        """The same with numbers in place of "auto". Raises as `motion_spectrum` and `estimate_delay`."""
        return _resolve(self, dataset)[0]

    def rows(self, dataset: Dataset) -> Dataset:
        """The prepared rows without their price, as `apply` gives them but with the metadata of `dataset`."""
        chosen = self.resolved(dataset)
        return _chosen_rows(chosen, dataset, _filtered(chosen, dataset))[0]

    def apply(self, dataset: Dataset) -> "Prepared":
        """The prepared Dataset and its price.

        `truth` and `noise_std` are dropped as `low_pass` and `differentiated` drop them. Raises DatasetError for rows
        that are out of order, sampled unevenly or too few, and InvalidInput for a cut-off above half the sample rate.
        """
        chosen, reasons = _resolve(self, dataset)
        filtered = _filtered(chosen, dataset)
        prepared, found = _chosen_rows(chosen, dataset, filtered)
        report = _report(chosen, reasons, dataset, filtered, prepared) | found
        metadata = {**dataset.metadata, "preparation": report}
        if "preparation" in dataset.metadata:
            metadata["preparation"] = {**report, "earlier": dataset.metadata["preparation"]}
        prepared = replace(prepared, metadata=metadata)
        return Prepared(dataset=prepared, report=metadata["preparation"], preparation=chosen)


def memory(metadata: Mapping[str, Any]) -> float:
    """Time in s within which rows of a filtered log repeat their neighbours; 0 where the metadata name no filter."""
    cutoff = preparation_report(metadata).get("cutoff")
    return 0.0 if cutoff is None else 1.0 / (PASSED * float(cutoff))


def preparation_report(metadata: Mapping[str, Any]) -> Mapping[str, Any]:
    """`metadata["preparation"]` as a `Preparation` leaves it; empty for what others may have put there."""
    report = metadata.get("preparation")
    return report if isinstance(report, Mapping) and {"cutoff", "why", "rows"} <= report.keys() else {}


@dataclass(frozen=True, kw_only=True, eq=False)
class Prepared:
    """A prepared Dataset, the preparation with numbers in place of "auto", and its price as plain JSON.

    `report`: the settings; "why" for what was chosen; "rows" and "sample_rate" [Hz] before and after; per joint
    "acceleration_noise" before and after the filter [rad/s^2 or m/s^2] (None where the log shows no noise floor) and
    "power_removed", the share of the variance of q, v, a and u that the filter took.
    """

    dataset: Dataset
    report: dict[str, Any]
    preparation: Preparation


def _resolve(given: Preparation, dataset: Dataset) -> tuple[Preparation, dict[str, Any]]:
    reasons: dict[str, Any] = {}
    for name in LATE:
        value = getattr(given, name)
        if isinstance(value, tuple) and len(value) != (count := actuators(dataset)):
            of = "joints" if torques_of_joints(dataset) else "actuators"
            raise InvalidInput(f"{name} has {len(value)} numbers; the dataset has {count} {of}.")
    chosen = given
    if given.cutoff == "auto":
        spectrum = motion_spectrum(dataset, given.differentiate)
        each, decisive = spectrum.cutoff, _decisive(spectrum.cutoff, dataset)
        cutoff = float(f"{np.nanmax(decisive):.3g}") if np.isfinite(decisive).any() else None
        reasons["cutoff"] = _why(cutoff, decisive, spectrum, dataset)
        model = dataset.model
        if cutoff is not None and model is not None and not model.contacts and torques_of_joints(dataset):
            with contextlib.suppress(DatasetError):  # too short, or sampled too slowly: the spectrum has to do
                best, tried = held_out_cutoff(dataset, model.robot, cutoff, given.differentiate, given.order)
                shares = ", ".join(f"{100.0 * share:.2g} % at {frequency:g} Hz" for frequency, share in tried.items())
                reasons["cutoff"] += f"; of held-out torques stay unexplained {shares}"
                cutoff = best
        chosen = replace(given, cutoff=cutoff)
        reasons["cutoff_per_joint"] = plain(each)
    for name in LATE:
        if getattr(given, name) != "auto":
            continue
        if name == "lag" and thruster_columns(dataset.model):
            seconds, std = estimate_thruster_lag(_filtered(replace(chosen, lag=0.0), dataset))
            pushing = thruster_columns(dataset.model)  # joints beside them do not follow so
            each = tuple(seconds * (column in pushing) for column in range(actuators(dataset)))
            chosen = replace(chosen, lag=seconds if all(each) else each)
            reasons[name] = f"{1e3 * seconds:.1f} ms ± {1e3 * std:.1f} ms"
            continue
        found = estimate_delay(_filtered(replace(chosen, **{name: 0.0}), dataset), kind=name)
        chosen = replace(chosen, **{name: found.significant})
        reasons[name] = found.reason
        reasons[f"{name}_common"], reasons[f"{name}_common_std"] = plain(np.array([found.common, found.common_std]))
        reasons[f"{name}_per_joint"], reasons[f"{name}_per_joint_std"] = plain(found.seconds), plain(found.std)
    return chosen, reasons


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
        dataset = low_pass(dataset, float(chosen.cutoff), order=chosen.order, signals=signals)
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


def _report(
    chosen: Preparation, reasons: dict[str, Any], raw: Dataset, filtered: Dataset, prepared: Dataset
) -> dict[str, Any]:
    per_joint = {name: _per_actuator(getattr(chosen, name), raw) for name in LATE}
    report: dict[str, Any] = {
        "cutoff": chosen.cutoff,
        "order": chosen.order,
        **per_joint,
        "every": chosen.every,
        "trim": chosen.trim,
        "differentiate": chosen.differentiate if chosen.cutoff is not None else None,
        "why": reasons,
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
        after = spectrum.acceleration_noise(lambda f: low_pass_gain(f, rate, float(chosen.cutoff or 0.0), chosen.order))
    report["acceleration_noise"] = {"before": plain(before), "after": plain(after)}
    unshifted = _filtered(replace(chosen, delay=0.0, lag=0.0), raw) if any(map(any, per_joint.values())) else filtered
    report["power_removed"] = {name: _power_removed(raw, unshifted, name) for name in ("q", "v", "a", "u")}
    return report


def _power_removed(before: Dataset, after: Dataset, name: str) -> list[float | None]:
    """Share of the variance of each column that is gone: the variance of the difference over that before."""
    old, new = getattr(before, name), getattr(after, name)
    change, space = old - new, space_of(before)
    if name == "q" and not space.is_vector_space:
        old, change = as_vectors(before), space.difference(*(torch.tensor(x) for x in (new, old))).numpy()
    with np.errstate(invalid="ignore", divide="ignore"):
        return plain(np.minimum(np.var(change, axis=0) / np.var(old, axis=0), 1.0))


def _finite(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and bool(np.isfinite(value))
