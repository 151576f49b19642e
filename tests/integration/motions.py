"""Motions with known answers: the small arm of `tests.models.arm` on all surfaces, and damped oscillators."""

import torch
from tests.models.arm import arm_system, unknown_force

from forcegp.integration import ConstraintManifold
from forcegp.mechanics import Contact, Cylinder, MechanicalSystem, Plane, Sphere

TOOL = (0.0, 0.0, 0.2)
PLANE = Contact("hand", TOOL, Plane((0.2, 0.0, 1.0), 0.4))
CONTACTS = {
    "plane": (PLANE,),
    "plane twice": (PLANE, PLANE),
    "sphere": (Contact("hand", TOOL, Sphere((0.0, 0.1, 0.4), 0.45)),),
    "cylinder": (Contact("hand", TOOL, Cylinder((0.3, 0.0, 0.3), (0.0, 1.0, 0.2), 0.2)),),
}


def free_system(contacts: str) -> MechanicalSystem:
    """The arm with these contacts and no stabilisation."""
    return arm_system(baumgarte=None).with_contacts(CONTACTS[contacts])


def start(system: MechanicalSystem, speed: float = 0.6) -> tuple[torch.Tensor, torch.Tensor]:
    """Two states that meet the constraint."""
    q = torch.tensor([[0.3, 0.7, 0.8], [-0.5, 0.9, 0.6]], dtype=torch.float64)
    v = speed * torch.tensor([[0.8, -0.5, 0.9], [0.7, 0.6, -0.4]], dtype=torch.float64)
    return ConstraintManifold(system).project(q, v)


def physics(system: MechanicalSystem):
    """a(q, v, u) of the arm with a little friction and with gravity compensated, so that u = 0 keeps it in reach."""

    def acceleration(q, v, u):
        dynamics = system.dynamics(q, v, u)
        return dynamics.acceleration(0.03 * unknown_force(v) + system.robot.gravity_forces(q))

    return acceleration
