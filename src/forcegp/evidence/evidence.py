"""What a fit learns from: accelerations, torques, motions, sensors. A new kind is a class, an entry in `EVIDENCE`."""

from abc import ABC
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import ClassVar, Literal

from forcegp.data.dataset import FORCE, IMU, TORQUE, Dataset
from forcegp.errors import LARGEST, InvalidInput, require_known, require_number, usable_arguments
from forcegp.forces.registry import called


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
            raise InvalidInput(f"{self.name} need rows in order of time, not a sample; give the whole recording.")

    def __str__(self) -> str:
        given = [f"{f.name} {getattr(self, f.name)}" for f in fields(self) if getattr(self, f.name) != f.default]  # type: ignore[arg-type]  # every evidence is a dataclass
        return ", ".join([self.name, *given])


@dataclass(frozen=True)
class Accelerations(Evidence):
    """Accelerations of single rows, with noise of accelerations and of forces: right where arms are light."""

    name: ClassVar[str] = "accelerations"
    of_torque: ClassVar[bool] = False
    noisy_in_both: ClassVar[bool] = False


@dataclass(frozen=True)
class Torques(Evidence):
    """Torques of single rows: what inverse dynamics needs less what was measured; right where torque sensors are good.

    noisy: "u", or "both" for accelerations, too (errors in variables), which a base that moves needs.
    mean: average the equations over windows of so many s: it takes noise of accelerations and leaves friction sharp.
    """

    name: ClassVar[str] = "torques"
    noisy: Literal["u", "both"] = "u"
    mean: float | None = None
    of_torque: ClassVar[bool] = True

    @usable_arguments("Torques")
    def __post_init__(self) -> None:
        if self.noisy not in ("u", "both"):
            raise InvalidInput(f"Torques noisy is {self.noisy!r}; give 'u' or 'both'.")
        if self.mean is not None and not 0.0 < self.mean < float("inf"):
            raise InvalidInput(f"Torques mean is {self.mean!r}; give the length of a window in s, or None.")

    @property
    def noisy_in_both(self) -> bool:
        """Whether accelerations are noisy as well."""
        return self.noisy == "both"


@dataclass(frozen=True)
class Motions(Evidence):
    """Recorded positions over windows of so many `seconds`, which refine what other evidence found.

    Laws, and the bodies of the robot with `bodies`, from q and u of each row, and v where windows begin.
    """

    name: ClassVar[str] = "motions"
    columns: ClassVar[tuple[str, ...]] = ("q", "v", "u")
    in_order: ClassVar[bool] = True
    seconds: float = 1.0
    bodies: bool = True

    @usable_arguments("Motions")
    def __post_init__(self) -> None:
        require_number("Motions seconds", self.seconds, "give the length of windows in s, above 0", below=LARGEST)

    @staticmethod
    def refuse(unknown_forces: Sequence[object]) -> None:
        """Raise InvalidInput where there are unknown forces: these learn from accelerations."""
        if unknown_forces:
            why = "the model has unknown forces, which learn from accelerations"
            advice = "refine the laws first, and learn the forces beside them without motions."
            raise InvalidInput(f"motions refine numbers of laws and bodies, and {why}; {advice}")


@dataclass(frozen=True)
class Sensor(Evidence):
    """A sensor at `frame` ("": all), whose names in `Dataset.measured` begin with `kind`; `noise` is in their units.

    The frame of a torque sensor is the name of its joint.
    """

    kind: ClassVar[str]
    frame: str = ""
    noise: float | None = None

    @usable_arguments("Sensor")
    def __post_init__(self) -> None:
        if self.noise is not None:
            require_number(f"noise of {self.name}", self.noise, "give a standard deviation in SI units, or None")

    def names(self, dataset: Dataset) -> list[str]:
        """Of these sensors in `Dataset.measured`."""
        own = {name: name.removeprefix(self.kind) for name in dataset.measured if name.startswith(self.kind)}
        return [name for name, place in own.items() if self.frame in ("", place, place.partition("@")[0])]

    def check(self, dataset: Dataset) -> None:
        """Raise InvalidInput where the log has no such sensor."""
        if not self.names(dataset):
            seen = f"{self.name} need the sensor {self.kind}{self.frame or 'FRAME'}; the log has {[*dataset.measured]}"
            advice = "name its columns, as in `forcegp import --force foot=fx,fy,fz,imu:hand=ax,ay,az`."
            raise InvalidInput(f"{seen}: {advice}")


@dataclass(frozen=True)
class ContactForces(Sensor):
    """What a force sensor measured, beside accelerations or torques: the force on the robot at `frame` ("": at all).

    Where the model has a contact there, its multipliers are seen; elsewhere, beside torques, it is a force that is
    known. `noise` is the standard deviation of the sensor [N]; None: 2 % of what it measured.
    """

    name: ClassVar[str] = "contact-forces"
    kind: ClassVar[str] = FORCE


@dataclass(frozen=True)
class FrameAcceleration(Sensor):
    """What an IMU on the link of `frame` measured ("": all): R^T (J a + Jdot v - g), beside accelerations or torques.

    Torques are then `Torques(noisy="both")`, whose accelerations it makes better. `noise` [m/s^2]; None: 2 % of what it
    measured, which holds offset and scale. If it may be `turned` a little, that is found first.
    """

    name: ClassVar[str] = "frame-acceleration"
    kind: ClassVar[str] = IMU
    turned: bool = False


@dataclass(frozen=True)
class JointTorques(Sensor):
    """What torque sensors between gears and links measured ("": in all joints), beside torques of the motors.

    A sensor there sees bodies, payloads, contacts and springs, but no friction, rotor or gain of its gear, so both
    together tell these apart. The noise is found as that of torques is; beside `Torques(noisy="both")` it is `noise`
    [Nm or N]; None: 2 % of what it measured.
    """

    name: ClassVar[str] = "joint-torques"
    kind: ClassVar[str] = TORQUE


KINDS = (Accelerations, Torques, Motions, ContactForces, FrameAcceleration, JointTorques)
EVIDENCE: dict[str, type[Evidence]] = {kind.name: kind for kind in KINDS}
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
