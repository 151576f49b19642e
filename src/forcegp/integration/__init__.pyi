from .integrators import (
    INTEGRATORS as INTEGRATORS, SPEED_LIMIT as SPEED_LIMIT, Feedback as Feedback, Integrator as Integrator,
    Step as Step, Trajectory as Trajectory, integrate as integrate, integrator_named as integrator_named,
)
