"""From accelerations to motion: integrators, the projection onto constraints, and trajectories that may diverge."""

from forcegp.integration.constraint_manifold import ConstraintManifold, ProjectedPosition
from forcegp.integration.integrators import (
    INTEGRATORS,
    Acceleration,
    Integrator,
    Projected,
    RungeKutta4,
    Step,
    SymplecticEuler,
    integrator_named,
)
from forcegp.integration.trajectory import SPEED_LIMIT, Feedback, Trajectory, integrate

__all__ = [
    "INTEGRATORS",
    "SPEED_LIMIT",
    "Acceleration",
    "ConstraintManifold",
    "Feedback",
    "Integrator",
    "Projected",
    "ProjectedPosition",
    "RungeKutta4",
    "Step",
    "SymplecticEuler",
    "Trajectory",
    "integrate",
    "integrator_named",
]
