"""`Identification`: what a fit learned of the system itself, with standard errors and what is not identified.

With the Hessian in blocks of physical (p) and all other free parameters (k), the information about the physical ones is
the Schur complement H_pp - H_pk H_kk^-1 H_kp: the curvature after the others have followed, and the inverse of their
block of H^-1 (Laplace's approximation; Rasmussen & Williams 2006, section 3.4). It means that only at an optimum. How
far that is, is the Newton decrement (Boyd & Vandenberghe 2004, section 9.5.1),

    sqrt(g^T S^-1 g),    g = g_p - H_pk H_kk^-1 g_k,    S = H_pp - H_pk H_kk^-1 H_kp,

the length in standard errors of the step that Newton's method would still make in the physical parameters.

Curvatures of H_kk below `FLAT` are raised to it, which is a prior of standard deviation 32 on logarithms: left out,
they would count as known, and standard errors would be too small.
"""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import NumericalError, NumericalWarning
from forcegp.mechanics import MechanicalSystem
from forcegp.models.identification.physical_parameters import PHYSICAL, PhysicalParameters
from forcegp.models.motion_models import DEVIATIONS
from forcegp.models.search import Objective, blas_threads
from forcegp.summary import Summary, listed

CENTRAL_STEP = 1e-3
"""For the parameters asked about: of the size of a thousandth of a standard deviation, where units are whitened."""

FORWARD_STEP = 1e-3
"""For all others, logarithms: one evaluation each, since a relative error of a thousandth of H_kk changes nothing."""

FLAT = 1e-3
"""Least curvature that any direction of the other parameters counts with, in nats per squared unit."""

SADDLE = -0.1
"""Curvature in the other parameters below which the search has not ended at a minimum; above it may be rounding."""

NEGATIVE = -0.01
"""The same for the physical ones, as a fraction of the largest curvature (at least 1) before others follow."""

NO_INFORMATION = 1e-4
"""Curvature, or information, below which a physical direction is not known: its standard deviation, 100 times the value
or more, counts as infinite, and in the decrement it has this curvature."""

LARGEST_DECREMENT = 0.1
"""Standard errors that estimates may be away from the optimum before a warning."""

Report = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Curvature:
    """Information S (k, k) about the physical parameters, and whether it was taken at an optimum.

    `decrement` is in standard errors; `lowest` and `lowest_other` are the smallest curvatures in the physical
    parameters (after the others have followed) and in the others, `tolerated` what rounding may make of zero in the
    first.
    """

    information: Float[Tensor, "k k"]
    decrement: float
    lowest: float
    lowest_other: float
    tolerated: float

    @property
    def doubts(self) -> tuple[str, ...]:
        """Why this is not the curvature at a minimum; empty where it is."""
        out = []
        if self.decrement > LARGEST_DECREMENT:
            out.append(f"a Newton step would still move the estimates by {self.decrement:.2g} standard errors")
        if self.lowest < self.tolerated:
            out.append(f"the curvature in the physical parameters falls to {self.lowest:.2g}")
        if self.lowest_other < SADDLE:
            out.append(f"the curvature in the kernel and noise parameters falls to {self.lowest_other:.2g}")
        return tuple(out)


def curvature_about(
    name: str,
    objective: Callable[[Mapping[str, Tensor]], Tensor],
    parameters: Mapping[str, Tensor],
    progress: Report | None = None,
) -> Curvature:
    """Schur complement of the Hessian at `parameters` onto those called `name` (k,), symmetric.

    Costs 2 k + 1 evaluations, and one more for each other number. `progress(done, of)` is called after every one.
    Warns NumericalWarning where `parameters` are not a minimum.
    """
    others = {key: value.detach() for key, value in parameters.items() if key != name}
    shapes = [(key, value.shape, value.numel()) for key, value in others.items()]
    flat = torch.cat([value.reshape(-1) for value in others.values()]) if others else torch.zeros(0).double()
    asked = parameters[name].detach()
    total, done = 2 * len(asked) + 1 + len(flat), 0

    def gradients(at: Tensor, rest: Tensor, want: bool = True) -> tuple[Tensor, Tensor]:
        nonlocal done
        at, rest = at.clone().requires_grad_(want), rest.clone().requires_grad_()
        pieces = rest.split([size for *_, size in shapes]) if shapes else ()
        named = {key: piece.reshape(shape) for (key, shape, _), piece in zip(shapes, pieces, strict=True)}
        wanted = ([at] if want else []) + ([rest] if shapes else [])
        with torch.enable_grad():
            found = torch.autograd.grad(objective({**named, name: at}), wanted, allow_unused=True)
        full = [torch.zeros_like(x) if g is None else g for x, g in zip(wanted, found, strict=True)]
        done += 1
        if progress is not None:
            progress(done, total)
        return full[0], full[-1] if shapes else rest.detach()

    columns = []
    for step in CENTRAL_STEP * torch.eye(len(asked), dtype=asked.dtype, device=asked.device):
        above, below = gradients(asked + step, flat), gradients(asked - step, flat)
        columns.append([(high - low) / (2.0 * CENTRAL_STEP) for high, low in zip(above, below, strict=True)])
    H_pp = torch.stack([own for own, _ in columns])
    slope, here = gradients(asked, flat)
    information, lowest_other = 0.5 * (H_pp + H_pp.mT), float("inf")
    tolerated = NEGATIVE * max(1.0, float(information.diagonal().max()))
    if shapes:
        H_pk = torch.stack([other for _, other in columns])
        steps = FORWARD_STEP * torch.eye(len(flat), dtype=flat.dtype, device=flat.device)
        H_kk = torch.stack([(gradients(asked, flat + step, False)[1] - here) / FORWARD_STEP for step in steps])
        values, vectors = torch.linalg.eigh(0.5 * (H_kk + H_kk.mT))
        lowest_other = float(values[0])
        scaled = vectors / values.clamp_min(FLAT).sqrt()
        half = H_pk @ scaled
        information, slope = information - half @ half.mT, slope - half @ (scaled.mT @ here)
    values, vectors = torch.linalg.eigh(information)
    decrement = float(torch.linalg.vector_norm(vectors.mT @ slope / values.clamp_min(NO_INFORMATION).sqrt()))
    found = Curvature(information, decrement, float(values[0]), lowest_other, tolerated)
    if found.doubts:
        warnings.warn(
            f"the search has not ended at a minimum ({'; '.join(found.doubts)}), so estimates and standard errors are "
            "rough: search longer, by more `iterations` of the options, or keep the `hyperprior`",
            NumericalWarning,
            stacklevel=2,
        )
    return found


WEAK = 0.3
"""Standard deviation of what is not identified: 30 % of a mass or coefficient, or 0.3 radii of gyration of a link."""

NAMED_SHARE = 0.1
"""Smallest share of a direction with which a parameter is named in it."""


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

    `history` holds their values at the start and after every iteration of the search that won, whose objective
    factorised `covariance_rows`. Standard errors, their
    covariance and the weak directions are computed when first asked for, which takes one evaluation of the
    objective for each free parameter and two for each physical one; `progress(done, of)` is called after every one.
    Parameters in `confounded` have infinite ones, since an unknown force of the prior takes their place.
    """

    physical: PhysicalParameters
    objective: Objective
    parameters: dict[str, Tensor]
    history: tuple[dict[str, float], ...]
    covariance_rows: int
    confounded: tuple[str, ...] = ()
    progress: Report | None = None

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
            unknown = torch.zeros_like(self.physical.transform)
            return Curvature(unknown, float("inf"), 0.0, 0.0, 0.0)

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
        found = dict(zip(self.physical.names, errors.tolist(), strict=True))
        return found | dict.fromkeys(self.confounded, float("inf"))

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals by name: estimate -+ 1.96 standard errors."""
        values, errors = self.values, self.standard_errors
        return {n: (values[n] - DEVIATIONS * errors[n], values[n] + DEVIATIONS * errors[n]) for n in values}

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
        doubts = "; ".join(self.curvature.doubts)
        begin = f"The search has not ended at a minimum ({doubts}): let it go on. " if doubts else ""
        other = ""
        if self.confounded:
            names, other = ", ".join(self.confounded), "other "
            begin += f"The data do not identify {names}: forces of the prior do the same. "
        if not self.weak_directions:
            rest = len(self.units) > len(self.confounded)
            return f"{begin}{f'The data identify every {other}parameter that was learned.' if rest else ''}".strip()
        named, count = "; ".join(map(str, self.weak_directions)), len(self.weak_directions)
        noun = "combination" if count == 1 else f"{count} combinations"
        return (
            f"{begin}The data do not identify the {noun} {named}, where logarithms stand for factors and r for the "
            "link's radius of gyration: fix one of its parameters, give a prior, or move the robot in other ways."
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
