"""`AnalyticalIdentification`: what was estimated, how sure it is, and what it predicts."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg
import torch
from jaxtyping import Float, Int

from forcegp.analytical.bodies import BodyCoordinates, FreeBodies, with_bodies, with_joint_dynamics
from forcegp.analytical.identifiability import UNITS, BaseParameters, body_names, parameter_names
from forcegp.analytical.joint_terms import JointTerms
from forcegp.analytical.least_squares import Fit, NoiseLevels, correlation_time
from forcegp.analytical.recorded_rows import Inputs, Positions, RecordedRows, Rows, residual_scores
from forcegp.data import Dataset
from forcegp.mechanics import (
    CoulombJointFriction,
    LoadJointFriction,
    MechanicalSystem,
    StribeckJointFriction,
    ViscousJointFriction,
)
from forcegp.robots import Robot
from forcegp.summary import Summary


@dataclass(frozen=True, eq=False, repr=False)
class AnalyticalIdentification(Summary):
    """Estimates of `identify_analytical`; `given` is the system that it started from, some bodies `thickened`.

    `regressor` are equations without forces of contacts (`RecordedRows.without_contacts`).
    """

    given: MechanicalSystem
    bodies: BodyCoordinates
    terms: JointTerms
    fit: Fit
    likelihood: str
    prior_strength: float
    episode: Int[np.ndarray, " rows"]
    regressor: Float[np.ndarray, "rows nv bodies 10"]
    thickened: tuple[str, ...]
    noise: NoiseLevels | None = None
    """Of accelerations and forces, after maximum likelihood in accelerations."""

    def facts(self) -> dict[str, object]:
        """The robot, what was estimated and from what."""
        return {
            "robot": f"{self.given.robot.name!r}, {self.given.robot.nv} degrees of freedom",
            "likelihood": self.likelihood,
            "inertias": self._inertias,
            "learned from": f"{len(self.episode)} rows",
            "converged": self.fit.settled,
        }

    @property
    def parameters(self) -> Float[np.ndarray, "bodies 10"]:
        """Standard parameters of the bodies, see `forcegp.analytical.identifiability`."""
        return self.bodies.parameters(self._in_bodies)

    @cached_property
    def system(self) -> MechanicalSystem:
        """The robot and known forces that were found.

        Viscous and Coulomb friction stand in the URDF's <dynamics> as well. Raises NonPhysicalInertia where free
        inertias belong to no robot.
        """
        robot = with_bodies(self.given.robot, self.bodies.pseudo_inertias(self._in_bodies))
        return with_terms(self.given, robot, self.terms, self._in_terms)

    @property
    def names(self) -> tuple[str, ...]:
        """Of all numbers: standard parameters `LINK.m` ..., then `viscous.JOINT` and so on."""
        return (*parameter_names(self.given.robot), *self.terms.names)

    @property
    def units(self) -> dict[str, str]:
        """By name."""
        names = parameter_names(self.given.robot)
        of_bodies = dict(zip(names, UNITS * (len(names) // len(UNITS)), strict=True))
        return of_bodies | {
            f"{field.name}.{joint.name}": _unit(field.unit, joint.type == "prismatic")
            for field in self.terms.fields
            for joint in map(self.given.robot.joint, self.terms.joints)
        }

    @property
    def values(self) -> dict[str, float]:
        """By name, in SI units; rotor inertias with those that the robot had."""
        numbers = np.concatenate([self.parameters.ravel(), self.terms.totals(self._in_terms).ravel()])
        return dict(zip(self.names, numbers.tolist(), strict=True))

    @property
    def start(self) -> dict[str, float]:
        """The same numbers of the system that was given; 0 where it lists no such force."""
        zero = self.bodies.parameters(np.zeros(self.bodies.size))
        center, _ = self.terms.prior()
        return dict(zip(self.names, np.concatenate([zero.ravel(), self.terms.totals(center).ravel()]), strict=True))

    @cached_property
    def standard_errors(self) -> dict[str, float]:
        """By name: of the posterior under the prior, with residuals that resemble their neighbours accounted for.

        Without information in the data it is the prior's spread. Linearised (delta method).
        """
        return dict(zip(self.names, np.linalg.norm(self._spread, axis=1).tolist(), strict=True))

    @cached_property
    def total_mass(self) -> tuple[float, float]:
        """Of all bodies, and its standard error, in kg: a base that moves shows it better than the mass of any body."""
        masses = slice(0, self.parameters.size, len(UNITS))
        return float(self.parameters[:, 0].sum()), float(np.linalg.norm(self._spread[masses].sum(0)))

    @cached_property
    def centers_of_mass(self) -> tuple[Float[np.ndarray, "bodies 3"], Float[np.ndarray, "bodies 3"]]:
        """Of the bodies in the axes of their child links, and their standard errors (delta method), in m."""
        masses, moments = self.parameters[:, :1], self.parameters[:, 1:4]
        spread = self._spread[: self.parameters.size].reshape(*self.parameters.shape, -1)
        centers = moments / masses
        return centers, np.linalg.norm(
            (spread[:, 1:4] - centers[..., None] * spread[:, :1]) / masses[..., None], axis=-1
        )

    @cached_property
    def _spread(self) -> np.ndarray:
        """S with S S^T the covariance of all numbers, as if only one row in a correlation time were independent."""
        time = correlation_time(self.fit.white, self.episode)
        # by QR, not by normal equations, whose rounding can make a variance negative
        root = np.linalg.qr(
            np.concatenate([self.fit.weighted(time), np.linalg.cholesky(self.fit.prior_information).T]), mode="r"
        )
        slopes = np.diag(self.terms.slopes(self._in_terms).ravel())
        moved = scipy.linalg.block_diag(*self.bodies.derivatives(self._in_bodies), slopes)
        return scipy.linalg.solve_triangular(root, moved.T, trans="T").T

    @cached_property
    def base(self) -> BaseParameters:
        """Base parameters of the recorded motion, with their condition number."""
        columns = self.regressor.reshape(-1, self.regressor.shape[-2] * 10)
        return BaseParameters.of(columns, parameter_names(self.given.robot))

    @property
    def condition_number(self) -> float:
        """Of the base parameters' columns, each divided by its norm; beyond 100 is poor excitation (Gautier 1992)."""
        return self.base.condition

    @cached_property
    def weak_directions(self) -> tuple[tuple[str, float], ...]:
        """Bodies and the number of their ten directions of which the data hold less than the prior, worst first.

        The other bodies count as known: mass on the axis of a joint may still belong to either link.
        """
        out = []
        for body, name in enumerate(body_names(self.given.robot)):
            own = slice(10 * body, 10 * body + 10)
            values = np.linalg.eigvalsh(self.fit.information[own, own])
            prior = np.linalg.eigvalsh(self.fit.prior_information[own, own]).mean()
            out.append((name, float((values < prior).sum())))
        return tuple(sorted((entry for entry in out if entry[1]), key=lambda entry: -entry[1]))

    def accelerations(self, q: Positions, v: Rows, u: Inputs) -> Rows:
        """Accelerations under the forces u, also of free inertias. Raises NumericalError for a singular M."""
        return self._recorded(q, v, u).acceleration(self.parameters, self._in_terms)[0]

    def torque_residual(self, dataset: Dataset) -> Rows:
        """Measured joint forces less those under which the model moves so (Nm or N), without what contacts explain."""
        rows = self._recorded(dataset.q, dataset.v, dataset.u)
        return rows.without_contacts(
            rows.force - rows.needed_torque(self.parameters, self._in_terms, np.array(dataset.a))
        )

    def scores(self, dataset: Dataset) -> dict[str, list[float]]:
        """As `residual_scores`: rms of force and acceleration residuals of `dataset`, and nRMSE, per joint."""
        acceleration = dataset.a - self.accelerations(dataset.q, dataset.v, dataset.u)
        return residual_scores(self.torque_residual(dataset), acceleration, dataset)

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain JSON values."""
        values, start, errors, units = self.values, self.start, self.standard_errors, self.units
        return {
            "likelihood": self.likelihood,
            "inertias": self._inertias,
            "prior_strength": self.prior_strength,
            "parameters": {
                name: {"unit": units[name], "start": start[name], "identified": value, "standard_error": errors[name]}
                for name, value in values.items()
            },
            "noise_std": (self.fit.noise if self.noise is None else self.noise.acceleration).tolist(),
            "force_noise_std": None if self.noise is None else self.noise.force.tolist(),
            "total_mass": dict(zip(("identified", "standard_error"), self.total_mass, strict=True)),
            "rows": len(self.episode),
            "base_parameters": list(self.base.expressions),
            "condition_number": self.condition_number,
            "weak": dict(self.weak_directions),
            "thickened": list(self.thickened),
            "converged": self.fit.settled,
            "evaluations": self.fit.evaluations,
        }

    @property
    def _inertias(self) -> str:
        return "free" if isinstance(self.bodies, FreeBodies) else "consistent"

    @property
    def _in_bodies(self) -> np.ndarray:
        return self.fit.x[: self.bodies.size]

    @property
    def _in_terms(self) -> np.ndarray:
        return self.fit.x[self.bodies.size :]

    def _recorded(self, q: np.ndarray, v: np.ndarray, u: np.ndarray) -> RecordedRows:
        return RecordedRows(self.given, self.terms, q, v, u)


def with_terms(given: MechanicalSystem, robot: Robot, terms: JointTerms, x: np.ndarray) -> MechanicalSystem:
    """The system with this robot and the terms of these coordinates as known forces, friction in its URDF as well."""
    found = terms.known_forces(x)
    dry = [f.coefficients for f in found if type(f) is CoulombJointFriction]
    dry += [f.coulomb for f in found if isinstance(f, StribeckJointFriction | LoadJointFriction)]
    viscous = [f.coefficients for f in found if type(f) is ViscousJointFriction]
    damping, friction = (None if not x else torch.as_tensor(x[0]).numpy() for x in (viscous, dry))
    others = [force for force in given.known_forces if type(force) not in terms.kinds]
    robot = with_joint_dynamics(robot, damping, friction)
    return replace(given, robot=robot, known_forces=(*others, *found))


def _unit(kind: str, prismatic: bool) -> str:
    force, speed, inertia = ("N", "m/s", "kg") if prismatic else ("Nm", "rad/s", "kg m^2")
    return {"force": force, "force s": f"{force} s/{speed[:-2]}", "1/s": speed, "inertia": inertia, "1": "1"}[kind]
