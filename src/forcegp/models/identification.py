"""`Identification`: what a fit learned of the system itself, how sure it is, and what the data cannot tell."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from forcegp.inference import OptimizationResult
from forcegp.mechanics import MechanicalSystem
from forcegp.models.physical_parameters import PHYSICAL, PhysicalParameters

Objective = Callable[[Mapping[str, Tensor]], Tensor]


@dataclass(frozen=True, eq=False)
class Identification:
    """Physical parameters before and after a fit, in SI units, centres of mass in link frames.

    `history` holds their values at the start and after every iteration of the search that won.
    """

    physical: PhysicalParameters
    objective: Objective
    parameters: Mapping[str, Tensor]
    history: list[dict[str, float]]

    @classmethod
    def of(cls, physical: PhysicalParameters, objective: Objective, result: OptimizationResult) -> Identification:
        """From the result of a search that kept its iterates."""
        history = [physical.named(point[PHYSICAL]) for point in result.iterates]
        return cls(physical, objective, result.parameters, history)

    @property
    def start(self) -> dict[str, float]:
        """Values at which the search began."""
        return self.physical.named(self.physical.zero)

    @property
    def values(self) -> dict[str, float]:
        """Estimates."""
        return self.physical.named(self.parameters[PHYSICAL])

    @property
    def units(self) -> dict[str, str]:
        """SI units by name."""
        return dict(zip(self.physical.names, self.physical.units, strict=True))

    @cached_property
    def system(self) -> MechanicalSystem:
        """The system with the estimates, its robot as URDF text."""
        return self.physical.system_at(self.parameters[PHYSICAL])
