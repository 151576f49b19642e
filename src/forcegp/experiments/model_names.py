"""The models that the experiments compare, by name, all behind one protocol: fit -> posterior -> predict."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from forcegp.mechanics import MechanicalSystem, ViscousJointFriction
from forcegp.models import Coefficients, IndependentGP, NetworkEnsemble, NeuralNetwork, Noise, StructuredGP
from forcegp.priors import JointAccelerations, NoForces
from forcegp.simulation.kuka_description import TOOL_LINK

START_FRICTION = 0.1
"""Where the estimation of the joints' viscous friction begins [Nms/rad]."""


def _nothing(system: MechanicalSystem) -> Mapping[str, Any]:
    return {}


@dataclass(frozen=True)
class ModelKind:
    """A model's label in the paper's figures, how it is made for a system, and further arguments of its fit."""

    label: str
    make: Callable[[MechanicalSystem], Any]
    fit_arguments: Callable[[MechanicalSystem], Mapping[str, Any]] = field(default=_nothing)


def _analytical(system: MechanicalSystem) -> StructuredGP:
    return StructuredGP(system, NoForces(), noise=Noise(0.1, learn=True))


def _analytical_with_friction(system: MechanicalSystem) -> StructuredGP:
    return _analytical(replace(system, known_forces=(*system.known_forces, ViscousJointFriction(START_FRICTION))))


def _physical_parameters(system: MechanicalSystem) -> Mapping[str, Any]:
    tool = system.robot.link(TOOL_LINK).inertial("mass", "com")
    return {"learn": [tool, Coefficients("viscous-joint-friction")]}


MODELS = {
    "gp": ModelKind("GP", IndependentGP),
    "s-gp-38": ModelKind("S-GP [38]", lambda system: StructuredGP(system, JointAccelerations(), "zero")),
    "s-gp": ModelKind("S-GP", lambda system: StructuredGP(system, mean="zero")),
    "s-gp-mean": ModelKind("S-GP + analytical mean", StructuredGP),
    "analytical": ModelKind("analytical model", _analytical),
    "analytical-fitted": ModelKind("analytical model, fitted", _analytical_with_friction, _physical_parameters),
    "neural-network": ModelKind("neural network 21-80-7", NeuralNetwork),
    "ensemble": ModelKind("network ensemble", NetworkEnsemble),
}
"""The analytical model has the true parameters; fitted, its tool's mass and centre of mass and a viscous friction of
every joint are estimated by maximum likelihood. The level of the noise is learned by both.
"""

GAUSSIAN_PROCESSES = ("gp", "s-gp-38", "s-gp", "s-gp-mean")
NETWORKS = ("neural-network", "ensemble")
ANALYTICAL = ("analytical", "analytical-fitted")
