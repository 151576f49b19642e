"""`Identification`: what a fit learned of the system itself, with standard errors and what is not identified."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import NumericalError, NumericalWarning
from forcegp.inference import OptimizationResult
from forcegp.mechanics import MechanicalSystem
from forcegp.models.identification.curvature import Curvature, Report, curvature_about
from forcegp.models.identification.physical_parameters import PHYSICAL, PhysicalParameters
from forcegp.models.search import Objective, blas_threads
from forcegp.summary import Summary, listed

WEAK = 0.3
"""Standard deviation beyond which a direction counts as not identified: 30 % of a mass or of a coefficient, or 0.3 of
a link's radius of gyration.
"""

NO_INFORMATION = 1e-4
"""Information below which it is infinite: a standard deviation of 100 times the value."""

NAMED_SHARE = 0.1
"""Smallest share of a direction with which a parameter is named in it."""

NORMAL_95 = 1.959963984540054


@dataclass(frozen=True)
class WeakDirection:
    """A combination of scaled parameters that the data do not identify, and its standard deviation (may be infinite).

    `weights` has unit length; its names are those of `PhysicalParameters.scaled_names`.
    """

    weights: dict[str, float]
    std: float

    def __str__(self) -> str:
        main = sorted(self.weights.items(), key=lambda entry: -abs(entry[1]))
        main = [(name, weight) for name, weight in main if weight**2 >= NAMED_SHARE] or main[:1]
        sign = 1.0 if main[0][1] > 0 else -1.0
        terms = " ".join(f"{'-' if sign * weight < 0 else '+'} {abs(weight):.2f} {name}" for name, weight in main)
        return f"{terms.removeprefix('+ ')} (standard deviation {self.std:.2g})"


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Summary):
    """Physical parameters before and after a fit, in SI units, centres of mass in link frames.

    `history` holds their values at the start and after every iteration of the search that won. Standard errors, their
    covariance and the weak directions are computed when first asked for, which takes one evaluation of the
    objective for each free parameter and two for each physical one; `progress(done, of)` is called after every one.
    """

    physical: PhysicalParameters
    objective: Objective
    parameters: dict[str, Tensor]
    history: tuple[dict[str, float], ...]
    covariance_rows: int
    progress: Report | None = None

    @classmethod
    def of(
        cls, physical: PhysicalParameters, objective: Objective, result: OptimizationResult, covariance_rows: int
    ) -> Identification:
        """From the result of a search that kept its iterates; `covariance_rows` is the size of what it factorised."""
        history = tuple(physical.named(point[PHYSICAL]) for point in result.iterates)
        return cls(physical, objective, result.parameters, history, covariance_rows)

    @override
    def facts(self) -> dict[str, object]:
        """The first estimates; standard errors, which take time, are not among them."""
        units, start = self.units, self.start
        values = [f"{name} {value:.4g} (from {start[name]:.4g}) {units[name]}" for name, value in self.values.items()]
        return {"iterations": len(self.history), "values": listed(values, most=6)}

    @property
    def start(self) -> dict[str, float]:
        """Values of the system that was given."""
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

    @cached_property
    def curvature(self) -> Curvature:
        """Curvature of the objective where the search ended, in z; warns NumericalWarning where that is no minimum."""
        try:
            with blas_threads(self.covariance_rows):
                return curvature_about(PHYSICAL, self.objective, self.parameters, self.progress)
        except NumericalError as error:  # estimates that ran to the limit of what is allowed
            warnings.warn(
                f"the curvature cannot be computed where the search ended ({error}), so nothing counts as identified: "
                "fix a parameter that the data do not inform, or give a prior",
                NumericalWarning,
                stacklevel=2,
            )
            return Curvature.unknown(self.physical.zero)

    @property
    def decrement(self) -> float:
        """Standard errors by which a Newton step would still move the estimates; 0 at an optimum."""
        return self.curvature.decrement

    @property
    def at_optimum(self) -> bool:
        """Whether the search ended at a minimum: `decrement` below 0.1 and no negative curvature."""
        return not self.curvature.doubts

    @cached_property
    def information(self) -> Float[Tensor, "k k"]:
        """Curvature of the objective in the scaled parameters s, after all others have followed."""
        inverse = torch.linalg.inv(self.physical.transform)  # z = T^-1 s
        return inverse.mT @ self.curvature.information @ inverse

    @cached_property
    def _directions(self) -> tuple[Tensor, Tensor]:
        """Variances, infinite where there is no information, and directions in s as columns."""
        values, vectors = torch.linalg.eigh(self.information)
        return torch.where(values > NO_INFORMATION, 1.0 / values, torch.full_like(values, torch.inf)), vectors

    @cached_property
    def covariance(self) -> Float[Tensor, "k k"]:
        """Of the estimates, in SI units, by the delta method; directions without any information are left out."""
        variances, vectors = self._directions
        known = torch.isfinite(variances)
        spread = self._jacobian @ (vectors[:, known] * variances[known].sqrt())
        return spread @ spread.mT

    @property
    def _jacobian(self) -> Tensor:
        """Derivatives of the physical values with respect to s."""
        z = self.parameters[PHYSICAL].detach()
        in_z = torch.autograd.functional.jacobian(self.physical.values, z)
        return torch.as_tensor(in_z) @ torch.linalg.inv(self.physical.transform)

    @cached_property
    def standard_errors(self) -> dict[str, float]:
        """By name, in SI units; infinite for a parameter that the data do not inform."""
        variances, vectors = self._directions
        lost = vectors[:, ~torch.isfinite(variances)]
        moved = (self._jacobian @ lost).abs().amax(1) if lost.shape[1] else torch.zeros(len(vectors)).double()
        reach = self._jacobian.abs().amax(1)
        errors = torch.where(moved > 1e-3 * reach, torch.inf, self.covariance.diagonal().sqrt())
        return dict(zip(self.physical.names, errors.tolist(), strict=True))

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals by name: estimate -+ 1.96 standard errors."""
        values, errors = self.values, self.standard_errors
        return {n: (values[n] - NORMAL_95 * errors[n], values[n] + NORMAL_95 * errors[n]) for n in values}

    @cached_property
    def weak_directions(self) -> tuple[WeakDirection, ...]:
        """What the data do not identify: orthogonal directions in s of a standard deviation above `WEAK`, worst first.

        A parameter of its own may be as unsure because it takes part in one of them.
        """
        variances, vectors = self._directions
        names = self.physical.scaled_names
        return tuple(
            WeakDirection(dict(zip(names, vector.tolist(), strict=True)), float(variance) ** 0.5)
            for variance, vector in zip(variances, vectors.mT, strict=True)
            if float(variance) > WEAK**2
        )

    @property
    def verdict(self) -> str:
        """What the data do not identify, as a sentence, after what the search did not reach."""
        if not self.at_optimum:
            doubts = "; ".join(self.curvature.doubts)
            return f"The search has not ended at a minimum ({doubts}): let it go on. {self._identified}"
        return self._identified

    @property
    def _identified(self) -> str:
        if not self.weak_directions:
            return "The data identify every parameter that was learned."
        listed = "; ".join(map(str, self.weak_directions))
        count = len(self.weak_directions)
        noun = "combination" if count == 1 else f"{count} combinations"
        return (
            f"The data do not identify the {noun} {listed}, where logarithms stand for factors and r for the link's "
            f"radius of gyration: fix one of its parameters, give a prior, or move the robot in other ways."
        )

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain JSON values; what is infinite is null."""

        def plain(number: float) -> float | None:
            return number if abs(number) < float("inf") else None

        start, values, errors, intervals = self.start, self.values, self.standard_errors, self.intervals
        return {
            "parameters": {
                name: {
                    "unit": unit,
                    "start": start[name],
                    "identified": values[name],
                    "standard_error": plain(errors[name]),
                    "interval_95": [plain(end) for end in intervals[name]],
                }
                for name, unit in self.units.items()
            },
            "weak_directions": [{"weights": d.weights, "std": plain(d.std)} for d in self.weak_directions],
            "verdict": self.verdict,
            "at_optimum": self.at_optimum,
            "decrement": plain(self.decrement),
            "history": list(self.history),
        }
