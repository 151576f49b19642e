"""Options of the commands that write one fitted model, and those of `forcegp fit` that choose the model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import UseAppendAction, arg

import forcegp
import forcegp.models
from forcegp.cli.command import unless_given
from forcegp.cli.learning_options import LearningOptions
from forcegp.cli.output_folders import output_folder

ModelName = Literal["structured", "unconstrained", "analytical", "independent-gp", "neural-network", "ensemble"]

LearnFrom = Literal["accelerations", "increments", "weak-form"]

POINTS, NETWORK_POINTS = 200, 10_000
POINTS_HINT = f"{POINTS}; networks {NETWORK_POINTS}"
WINDOW = 0.1
"""Length of a window where none is given, in s."""
ITERATIONS = 200
ITERATIONS_HINT = f"{ITERATIONS}; networks 5000, ensembles 3000"


@dataclass(frozen=True, kw_only=True)
class FitOptions(LearningOptions):
    """What every command asks that writes one fitted model."""

    out: Annotated[Path, arg(metavar="RUN")] = field()
    """The folder to write."""

    def _write(self, posterior: forcegp.models.Posterior, kind: str, more: Mapping[str, str] | None = None) -> None:
        """The model, `more` files by name with their text, and how it was made."""
        content = {**self._given(), "resolved": dict(posterior.settings)}
        with output_folder(self.out, kind, content, overwrite=self.overwrite) as folder:
            forcegp.save_posterior(posterior, folder)
            for name, text in (more or {}).items():
                (folder / name).write_bytes(text.encode("utf-8"))  # as text, line ends would change


@dataclass(frozen=True, kw_only=True)
class ModelOptions(FitOptions):
    """Which model `forcegp fit` fits, to what, and by which search."""

    model: ModelName = "structured"
    """structured: Gaussian processes on the unknown forces, inside the dynamics and contacts that are known.
    unconstrained: on the acceleration that the robot would have without contacts. analytical: known physics alone.
    independent-gp: one Gaussian process per joint, without physics. neural-network: one small network.
    ensemble: several networks with variances."""
    points: Annotated[int | None, unless_given("N", POINTS_HINT, int)] = None
    """Train on N rows that lie farthest apart (all rows if there are fewer). Time grows with the cube of N as far as
    --engine is exact."""
    engine: Annotated[Literal["auto", "exact", "iterative", "inducing", "stochastic"], arg(metavar="NAME")] = "auto"
    """How the posterior is computed. exact: from the covariance of all points. iterative: by conjugate gradients.
    inducing: through fewer points, for friction curves and the like. stochastic: the same, on mini-batches. auto: by
    the number of points, the features and the free memory, and reports why. See docs/large-data.md."""
    learning_points: Annotated[int | None, unless_given("N", "all points up to 1500, else 600", int)] = None
    """Find the hyper-parameters on N of the points; the posterior is that of all points."""
    mean: Annotated[Literal["analytical", "zero"] | None, unless_given("analytical|zero", "analytical")] = None
    """analytical: the processes learn what the known forces lack. zero: they learn the known forces, too."""
    prior: Annotated[
        UseAppendAction[tuple[str, ...]],
        arg(metavar="NAME[:FIELD=VALUE,...]", help_behavior_hint="(repeatable, they add up; default: joint)"),
    ] = ()
    """What the unknown forces may be. joint: a force at every joint, on (q, v, u). joint-friction: on its own velocity.
    tool-friction: tangential forces at the contact, on its velocity. contact-friction: isotropic; load-friction:
    the same, proportional to the normal force. joint-ripple, tool-forces, payload:frame=LINK. See docs/forces.md."""
    learn_from: Annotated[LearnFrom, arg(metavar="accelerations|increments|weak-form")] = "accelerations"
    """accelerations: of the dataset. increments, weak-form: from raw velocities or positions over short windows, of
    which --points are taken; nothing is differentiated. See docs/without-accelerations.md."""
    window: Annotated[float | None, unless_given("SECONDS", f"{WINDOW}", float)] = None
    """Length of the windows."""
    iterations: Annotated[int | None, unless_given("N", ITERATIONS_HINT, int)] = None
    """Most L-BFGS iterations of each start, or training steps of a network."""
    device: Annotated[str, arg(metavar="cpu|cuda|cuda:K")] = "cpu"
    """Where to compute; see docs/gpu.md. The folder that is written can be used on any machine."""
    measured_torque: bool = False
    """u comes from sensors as noisy as --force-noise, and predictions account for it. Not for commanded torques."""
