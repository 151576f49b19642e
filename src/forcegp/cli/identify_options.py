"""Options of `forcegp identify`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import UseAppendAction, arg

from forcegp.cli.command import DATASET, unless_given
from forcegp.cli.fit_options import FitOptions


@dataclass(frozen=True, kw_only=True)
class IdentifyOptions(FitOptions):
    """What to identify, by which model, and from how many rows."""

    learn: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="LINK:PARTS|FORCE", help_behavior_hint="")] = ()
    """What to estimate (repeatable): LINK:PARTS with parts out of mass, com (centre of mass) and inertia, or
    viscous-joint-friction, coulomb-joint-friction, armature: of all joints, or of FORCE:JOINT,JOINT; from the URDF's
    coefficients, or from FORCE=START. The next two models estimate all of it instead."""
    model: Literal["structured", "analytical", "least-squares", "consistent"] = "structured"
    """structured: Gaussian processes model the unknown forces. analytical: there are none but noise.
    least-squares: regression of joint forces on every inertia. consistent: the same with inertias that bodies can have.
    """
    friction: Annotated[str, arg(metavar="NAME,NAME")] = "viscous,coulomb"
    """With the last two models: viscous, coulomb or stribeck or load (grows with |u|), offset; none for no friction."""
    rotors: Literal["armature", "rotor", "none"] = "armature"
    """With the last two models: armature: one rotor inertia per joint. rotor: those of the system's coupled rotors."""
    likelihood: Literal["torque", "acceleration"] = "torque"
    """With the last two models: torque: residuals of inverse dynamics, where torque sensors are good. acceleration: of
    forward dynamics, where arms are light."""
    robust: Annotated[bool, arg(help_behavior_hint="")] = False
    """With the last two models: count outliers by their absolute value."""
    test: Annotated[Path | None, DATASET, unless_given("TEST.h5", "none", Path)] = None
    """With the last two models: score on this recording, too."""
    prior_strength: Annotated[float | None, unless_given("W", "0; 1 for the last two models", float)] = None
    """Weight that holds inertias near the URDF's, w/2 times their squared distance in the geometric metric."""
    points: Annotated[int, arg(metavar="N")] = 200
    """Train on N rows that lie farthest apart (all rows if there are fewer). Time grows with the cube of N."""
    learning_points: Annotated[int | None, unless_given("N", "all points", int)] = None
    """Find the estimates and all other parameters on N of the points; standard errors are those of N points."""
    mean: Literal["analytical", "zero"] = "analytical"
    """analytical: the processes learn what the known forces lack. zero: they learn the known forces, too."""
    iterations: Annotated[int, arg(metavar="N")] = 200
    """Most L-BFGS iterations of each start."""
    restarts: Annotated[int, arg(metavar="R")] = 1
    """Starts of the search; the best is kept. They differ in the kernels only: the physical values begin the same."""
