"""The jobs of figure 2c: estimate the tool's mass and centre of mass from a wrong start."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.paper.data import scored_rows, training_rows
from forcegp import score
from forcegp.evidence import Accelerations
from forcegp.fit import fit
from forcegp.forces import Body, JointForces, RigidBodies, ToolForces
from forcegp.inference import OptimizerOptions
from forcegp.jobs import JobStore
from forcegp.model import Model
from forcegp.robots.urdf_file import replace_inertial
from forcegp.simulation.kuka_surface import TOOL_LINK

MODELS = {"s-gp": "S-GP + analytical mean", "s-gp-tool": "the same, tool friction"}
MASS_BOUND, CENTER_BOUND = 0.02, 1e-3  # errors that count as found [kg, m]
MASS_OFFSET, CENTER_OFFSET = 0.5, (0.05, 0.05, -0.03)  # how wrong the start is [kg, m]
NAMES = ("mass", "center_of_mass.x", "center_of_mass.y", "center_of_mass.z")
LEARNED = RigidBodies({TOOL_LINK: Body(0.01)})
FORCES = {"s-gp": (LEARNED, JointForces()), "s-gp-tool": (LEARNED, ToolForces())}


def estimate(results: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Errors and standard deviations of mass [kg] and centre [m], what decides them, and the MAE."""
    train = training_rows(results, spec["data"], spec["points"])
    assert train.model is not None
    link = train.model.robot.link(TOOL_LINK)
    true = dict(zip(NAMES, (link.mass, *link.center_of_mass), strict=True))
    options = OptimizerOptions(iterations=spec["iterations"], tolerance=spec["tolerance"])
    posterior = fit(
        wrong_model(train.model).with_forces(FORCES[spec["model"]]), train, Accelerations(), restarts=1, options=options
    )
    found = {name: posterior.parameters[f"{TOOL_LINK}.{name}"] for name in NAMES}
    error = {name: found[name].value - true[name] for name in NAMES}
    return {
        "error": error,
        "std": {name: found[name].std for name in NAMES},
        "decided_by": {name: found[name].decided_by for name in NAMES},
        "center_error": math.hypot(*(error[name] for name in NAMES[1:])),
        "inside": {name: bool(found[name].interval[0] <= true[name] <= found[name].interval[1]) for name in NAMES},
        "mae": score(posterior, scored_rows(results, spec["data"])).value("mae"),
    }


def wrong_model(model: Model) -> Model:
    """The same with a tool that is too heavy and has its centre of mass elsewhere; its inertia stays."""
    link = model.robot.link(TOOL_LINK)
    moved = np.array(link.center_of_mass) + np.array(CENTER_OFFSET)
    text = replace_inertial(
        model.robot.urdf_text, TOOL_LINK, link.mass + MASS_OFFSET, moved, link.inertia, source=model.robot.source
    )
    return model.with_robot(model.robot.with_text(text))
