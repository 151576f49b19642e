"""Systems whose inertial parameters and friction were identified from training rows: a mean for other models."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import torch

from forcegp.data import Dataset
from forcegp.mechanics import Armature, CoulombJointFriction, KnownForce, MechanicalSystem, ViscousJointFriction
from forcegp.models import Coefficients, Noise, StructuredGP
from forcegp.priors import NoForces

START_NOISE = 0.1
"""Where a learned noise begins, as a part of the standard deviation of the measured acceleration of each joint."""

PRIOR_STRENGTH = 1.0
"""Of the prior on inertias when they are identified by likelihood: a mass 30 % off costs 0.2 nats."""

SMOOTHING = 0.05
"""Velocity scale of Coulomb friction, as a part of the standard deviation of each joint's velocity."""


def learned_noise(rows: Dataset, force: float | None = None) -> Noise:
    """The noise that every model of a comparison learns, from the same start.

    It begins at what the dataset states, else at a tenth of the scatter of each joint's acceleration among `rows`.
    """
    if rows.noise_std is not None:
        return Noise(None, force, learn=True)
    scatter = rows.a.std(axis=0)
    largest = float(scatter.max())
    start = START_NOISE * np.where(scatter > 0.0, scatter, largest if largest > 0.0 else 1.0)
    return Noise(tuple(float(level) for level in start), force, learn=True)


def identified_by_likelihood(system: MechanicalSystem, rows: Dataset) -> MechanicalSystem:
    """All inertias, viscous and Coulomb friction and armature by maximum likelihood of the accelerations.

    Physically consistent by construction. Friction and armature that the system does not list are added.
    """
    robot, listed = system.robot, {type(force) for force in system.known_forces}
    scale = torch.tensor(np.maximum(SMOOTHING * rows.v.std(axis=0), 1e-3))
    M = system.mass_matrix(robot.kinematics(torch.tensor(rows.q)))
    rotor = 0.01 * M.diagonal(dim1=-2, dim2=-1).mean(0)
    start = torch.tensor(np.maximum(0.01 * np.abs(rows.u).mean(axis=0), 1e-4))
    added: list[KnownForce] = []
    if ViscousJointFriction not in listed:
        added.append(ViscousJointFriction(start))
    if CoulombJointFriction not in listed:
        added.append(CoulombJointFriction(start, scale))
    if Armature not in listed:
        added.append(Armature(rotor))
    widened = replace(system, known_forces=(*system.known_forces, *added))
    links = [robot.link(joint.child) for joint in robot.joints]
    learn = [link.inertial("mass", "com", "inertia") for link in links if link.mass > 0.0]
    names = ("viscous-joint-friction", "coulomb-joint-friction", "armature")
    model = StructuredGP(widened, NoForces(), "analytical", learned_noise(rows))
    posterior = model.fit(
        rows, restarts=1, learn=[*learn, *(Coefficients(name) for name in names)], prior_strength=PRIOR_STRENGTH
    )
    return posterior.system


Identify = Callable[[MechanicalSystem, Dataset], MechanicalSystem]

IDENTIFICATIONS: Mapping[str, Identify] = {"likelihood": identified_by_likelihood}
"""How a system is identified, by name: (given system, training rows) -> identified system."""
