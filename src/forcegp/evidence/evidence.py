"""What a fit learns from: measured accelerations, torques, windows of raw signals, motions.

Everything that can be measured on a robot is affine in its forces, so each kind of evidence gives the same rows: a
residual that is the effect of forces, how it depends on them, and the noise (docs/explanation/model.md). A new kind is
one class, and an entry in `EVIDENCE`.
"""

from abc import ABC
from dataclasses import dataclass, fields
from typing import ClassVar, Literal

from forcegp.data import Dataset
from forcegp.errors import InvalidInput, require_type, usable_arguments


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
