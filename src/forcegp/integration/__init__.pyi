from .integrators import (
    INTEGRATORS as INTEGRATORS, SPEED_LIMIT as SPEED_LIMIT, Feedback as Feedback, ImplicitMidpoint as ImplicitMidpoint,
    Integrator as Integrator, RungeKutta4 as RungeKutta4, Step as Step, SymplecticEuler as SymplecticEuler,
    Trajectory as Trajectory, integrate as integrate, integrator_named as integrator_named,
    onto_contacts as onto_contacts, violation as violation,
)
