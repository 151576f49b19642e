from .integrators import (
    ConstraintManifold as ConstraintManifold, ProjectedPosition as ProjectedPosition, INTEGRATORS as INTEGRATORS,
    Acceleration as Acceleration, ImplicitMidpoint as ImplicitMidpoint, Integrator as Integrator,
    Projected as Projected, RungeKutta4 as RungeKutta4, Step as Step, SymplecticEuler as SymplecticEuler,
    integrator_named as integrator_named,
)
from .trajectory import (
    SPEED_LIMIT as SPEED_LIMIT, Feedback as Feedback, Trajectory as Trajectory, integrate as integrate,
)
