"""The jobs of figure 2c: estimate the tool's mass and centre of mass from a wrong start."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.paper.data import scored_rows, training_rows
from forcegp.data import Dataset
from forcegp.inference import OptimizerOptions
from forcegp.jobs import JobStore
from forcegp.mechanics import MechanicalSystem
from forcegp.models import Identification, StructuredGP, StructuredPosterior
from forcegp.priors import JointForces, NoForces
from forcegp.robots import parameters_from_physical, physical_from_parameters
from forcegp.simulation.kuka_motion import TOOL_LINK

MODELS = {"s-gp": "S-GP", "analytical": "analytical model"}
MEANS = {"analytical": "with Q_K", "zero": "without Q_K"}
MASS_BOUND, CENTER_BOUND = 0.02, 1e-3  # errors that count as found [kg, m]
MASS_OFFSET, CENTER_OFFSET = 0.5, (0.05, 0.05, -0.03)  # how wrong the start is [kg, m]
PRIORS = {"s-gp": JointForces(), "analytical": NoForces()}
NAMES = {f"{TOOL_LINK}.{name}": name for name in ("mass", "com.x", "com.y", "com.z")}


def trace(results: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """One search, with the errors of mass and centre [kg, m] and the MAE after every iteration."""
    train = training_rows(results, spec["data"], spec["points"])
    test = scored_rows(results, spec["data"])
    true = _values(train.system)
    posterior, identification = _fitted(train, spec)
    history = [{NAMES[name]: value for name, value in point.items()} for point in identification.history]
    every = (posterior.at_iteration(k) for k in range(len(history)))
    predicted = (each.predict(test.q, test.v, test.u, covariance=False) for each in every)
    return {
        "mass_error": [point["mass"] - true["mass"] for point in history],
        "center_error": [math.dist(*([x[f"com.{axis}"] for axis in "xyz"] for x in (at, true))) for at in history],
        "mae": [float(np.abs(each.mean.numpy() - test.a).mean()) for each in predicted],
        "start_mass": MASS_OFFSET,
        "start_center": list(CENTER_OFFSET),
        "converged": posterior.result.converged,
        "status": posterior.result.status,
        **_uncertainty(identification),
    }


def estimate(results: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Errors and standard errors of S-GP + analytical mean."""
    train = training_rows(results, spec["data"], spec["points"])
    true = _values(train.system)
    posterior, identification = _fitted(train, {**spec, "model": "s-gp", "mean": "analytical"})
    error = {NAMES[name]: value - true[NAMES[name]] for name, value in identification.values.items()}
    search = {"iterations": len(posterior.result.history) - 1, "converged": posterior.result.converged}
    return {"error": error, **search, **_uncertainty(identification)}


def wrong_system(system: MechanicalSystem) -> MechanicalSystem:
    """The same with a tool that is too heavy and has its centre of mass elsewhere; its inertia stays."""
    robot = system.robot
    mass, center, inertia = physical_from_parameters(robot.inertial_parameters(TOOL_LINK)[TOOL_LINK])
    moved = center + torch.tensor(CENTER_OFFSET, dtype=center.dtype)
    return system.with_robot(
        robot.with_inertials({TOOL_LINK: parameters_from_physical(mass + MASS_OFFSET, moved, inertia)})
    )


def _fitted(train: Dataset, spec: Mapping[str, Any]) -> tuple[StructuredPosterior, Identification]:
    assert train.system is not None
    system = wrong_system(train.system)
    options = OptimizerOptions(iterations=spec["iterations"], tolerance=spec["tolerance"], keep_iterates=True)
    learn = system.robot.link(TOOL_LINK).inertial("mass", "com")
    model = StructuredGP(system, PRIORS[spec["model"]], spec["mean"])
    posterior = model.identify(train, learn, restarts=1, options=options)
    assert posterior.identification is not None, "the fit was given parameters to learn"
    return posterior, posterior.identification


def _values(system: MechanicalSystem | None) -> dict[str, float]:
    assert system is not None
    link = system.robot.link(TOOL_LINK)
    return {"mass": link.mass, **{f"com.{axis}": value for axis, value in zip("xyz", link.center_of_mass, strict=True)}}


def _uncertainty(identification: Identification) -> dict[str, Any]:
    """Standard errors by parameter (None where infinite), and a sentence about what cannot be identified."""
    errors = identification.standard_errors
    std = {NAMES[name]: value if math.isfinite(value) else None for name, value in errors.items()}
    return {"std": std, "verdict": identification.verdict.replace(f"{TOOL_LINK}.", "")}
