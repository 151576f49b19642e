"""Probabilistic forward dynamics of robots: Gaussian processes on the forces that nobody modelled.

This page is the whole public API. Each name is imported from its room at first use, so `import forcegp` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from forcegp.analytical import AnalyticalIdentification, identify_analytical
    from forcegp.checks import CheckReport, check
    from forcegp.data import Dataset, Preparation, VelocityIncrements, WeakForm
    from forcegp.evaluation import Evaluation, PriorComparison, compare_priors, evaluate
    from forcegp.inference import Exact, Inducing, Iterative, Stochastic
    from forcegp.mechanics import (
        Actuation,
        Armature,
        Baumgarte,
        ConstantJointForce,
        Contact,
        CoulombJointFriction,
        Cylinder,
        ImplicitSurface,
        LoadJointFriction,
        MechanicalSystem,
        Plane,
        RigidBodyBias,
        RotorInertia,
        Sphere,
        StribeckJointFriction,
        ViscousJointFriction,
    )
    from forcegp.models import (
        Coefficients,
        IndependentGP,
        NetworkEnsemble,
        NeuralNetwork,
        Noise,
        StructuredGP,
        load_posterior,
        save_posterior,
    )
    from forcegp.parallel import Joblib, Ray, Serial
    from forcegp.priors import (
        ContactFriction,
        JointAccelerations,
        JointForces,
        JointFriction,
        NoForces,
        Payload,
        PeriodicJointForces,
        ToolForces,
    )
    from forcegp.recordings import ColumnMapping, ImportOptions, import_recordings
    from forcegp.robots import Robot
    from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface
    from forcegp.validation import Comparison, Validation, split_named, validate

    __version__: str

__all__ = [
    # the robot
    "Robot",
    # what is known about it: contacts and forces
    "MechanicalSystem",
    "Contact",
    "Plane",
    "Sphere",
    "Cylinder",
    "ImplicitSurface",
    "Baumgarte",
    "Actuation",
    "RigidBodyBias",
    "ViscousJointFriction",
    "CoulombJointFriction",
    "StribeckJointFriction",
    "LoadJointFriction",
    "ConstantJointForce",
    "Armature",
    "RotorInertia",
    # what was measured
    "Dataset",
    "check",
    "CheckReport",
    "Preparation",
    "import_recordings",
    "ColumnMapping",
    "ImportOptions",
    "WeakForm",
    "VelocityIncrements",
    "KukaSurfaceConfig",
    "simulate_kuka_surface",
    # what is unknown, and the model that learns it
    "JointForces",
    "JointFriction",
    "PeriodicJointForces",
    "ToolForces",
    "ContactFriction",
    "Payload",
    "JointAccelerations",
    "NoForces",
    "Noise",
    "Coefficients",
    "StructuredGP",
    "IndependentGP",
    "NeuralNetwork",
    "NetworkEnsemble",
    "save_posterior",
    "load_posterior",
    # the same without Gaussian processes
    "identify_analytical",
    "AnalyticalIdentification",
    # how and where it is computed
    "Exact",
    "Iterative",
    "Inducing",
    "Stochastic",
    "Serial",
    "Joblib",
    "Ray",
    # how good it is
    "evaluate",
    "Evaluation",
    "compare_priors",
    "PriorComparison",
    "validate",
    "Comparison",
    "Validation",
    "split_named",
]

_ROOMS = {
    "robots": {"Robot"},
    "mechanics": {"MechanicalSystem", "Contact", "Plane", "Sphere", "Cylinder", "ImplicitSurface", "Baumgarte"}
    | {"Actuation", "RigidBodyBias", "ViscousJointFriction", "CoulombJointFriction", "Armature"}
    | {"StribeckJointFriction", "LoadJointFriction", "ConstantJointForce", "RotorInertia"},
    "checks": {"CheckReport", "check"},
    "data": {"Dataset", "Preparation", "VelocityIncrements", "WeakForm"},
    "recordings": {"ColumnMapping", "ImportOptions", "import_recordings"},
    "analytical": {"AnalyticalIdentification", "identify_analytical"},
    "priors": {"JointForces", "JointFriction", "PeriodicJointForces", "ToolForces", "ContactFriction", "Payload"}
    | {"JointAccelerations", "NoForces"},
    "inference": {"Exact", "Iterative", "Inducing", "Stochastic"},
    "models": {"IndependentGP", "NeuralNetwork", "NetworkEnsemble"}
    | {"StructuredGP", "Noise", "Coefficients", "save_posterior", "load_posterior"},
    "parallel": {"Serial", "Joblib", "Ray"},
    "simulation": {"KukaSurfaceConfig", "simulate_kuka_surface"},
    "validation": {"Comparison", "Validation", "split_named", "validate"},
    "evaluation": {"Evaluation", "evaluate", "PriorComparison", "compare_priors"},
}


def __getattr__(name: str) -> object:
    """Import a public name at its first use (PEP 562)."""
    if name == "__version__":
        from importlib import metadata

        value = metadata.version("forcegp")
    else:
        room = next((room for room, names in _ROOMS.items() if name in names), None)
        if room is None:
            raise AttributeError(f"module 'forcegp' has no attribute {name!r}; it has {', '.join(__all__)}")
        value = getattr(import_module(f"forcegp.{room}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
