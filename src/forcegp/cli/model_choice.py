"""`forcegp fit`: options of the commands that write a model, which model they name, and what they are by default."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from tyro.conf import arg

import forcegp
import forcegp.data
import forcegp.models
import forcegp.priors
from forcegp.atomic_files import write_json
from forcegp.cli.command import FIELDS, listed, numbers_of, unless_given
from forcegp.cli.learning_options import LearningOptions
from forcegp.errors import InvalidInput

ModelName = Literal["structured", "unconstrained", "analytical", "independent-gp"]

LearnFrom = Literal["accelerations", "weak-form"]

POINTS = 200
POINTS_HINT = f"{POINTS}; all for functions of one or two inputs, as friction of the joints"
PREFERRED = "joint-friction, in contact tool-friction, in flight aerodynamic, unless left-out rows prefer another"
PRIORS = "NAME[:FIELD=VALUE,...],..."
WINDOW = 0.1
"""Length of a window where none is given, in s."""
ITERATIONS = 200


@dataclass(frozen=True, kw_only=True)
class FitOptions(LearningOptions):
    """What every command asks that writes one fitted model."""

    out: Annotated[Path, arg(metavar="FOLDER")]
    """The folder to write."""

    def _write(self, posterior: forcegp.models.Posterior, identification: Mapping[str, Any] | None = None) -> None:
        """The model and how it was made; of an identification also its numbers and the URDF of its robot."""
        content = {**self._given(), "resolved": dict(posterior.settings)}
        with self.folder(self.out, content) as folder:
            forcegp.save_posterior(posterior, folder)
            if identification is not None:
                write_json(folder / "identification.json", identification)
                posterior.system.to_urdf(folder / "identified.urdf")


@dataclass(frozen=True, kw_only=True)
class ModelOptions(FitOptions):
    """Which model `forcegp fit` fits, to what, and by which search."""

    model: ModelName = "structured"
    """structured: Gaussian processes on the unknown forces, inside the dynamics and contacts that are known.
    unconstrained: on the acceleration that the robot would have without contacts. analytical: known physics alone.
    independent-gp: one Gaussian process per joint, without physics."""
    points: Annotated[int | None, unless_given("N", POINTS_HINT, int)] = None
    """Train on N rows that lie farthest apart (all rows if there are fewer). Time grows with the cube of N as far as
    --engine is exact."""
    engine: Literal["auto", "exact", "inducing"] = "auto"
    """How the posterior is computed. exact: from the covariance of all points. inducing: through fewer points.
    auto: by the number of points, the
    features and the free memory, and reports why. See docs/how-to/large-data.md."""
    learning_points: Annotated[int | None, unless_given("N", "all points up to 1500, else 600", int)] = None
    """Find the hyper-parameters on N of the points; the posterior is that of all points."""
    mean: Annotated[Literal["analytical", "zero"] | None, unless_given("analytical|zero", "analytical")] = None
    """analytical: the processes learn what the known forces lack. zero: they learn the known forces, too."""
    prior: Annotated[tuple[str, ...], listed(PRIORS, PREFERRED, goes_on=FIELDS)] = ()
    """What the unknown forces may be: one or several priors, which add up. joint: a force at every joint, on (q, v, u).
    joint-friction: on its own velocity. tool-friction: tangential forces at the contact, on its velocity.
    contact-friction: isotropic. load-friction: the same, proportional to the normal force. Further joint-ripple,
    tool-forces, payload:frame=LINK. See docs/how-to/forces.md."""
    learn_from: LearnFrom = "accelerations"
    """accelerations: of the dataset. weak-form: from raw positions over short windows, of
    which --points are taken; nothing is differentiated. See docs/how-to/without-accelerations.md."""
    window: Annotated[float | None, unless_given("S", f"{WINDOW}", float)] = None
    """Length of the windows of weak-form."""
    motions: Annotated[float | None, unless_given("S", "none", float)] = None
    """After the fit, refine friction, inertias and unknown forces on the recorded positions, over windows of S seconds.
    See docs/how-to/motions.md."""
    iterations: Annotated[int, arg(metavar="N")] = ITERATIONS
    """Most L-BFGS iterations of each start."""
    device: Annotated[str, arg(metavar="cpu|cuda|cuda:K")] = "cpu"
    """Where to compute; see docs/how-to/gpu.md. The folder that is written can be used on any machine."""
    measured_torque: bool = False
    """u comes from sensors as noisy as --force-noise, and predictions account for it. Not for commanded torques."""


SEARCHED = ("structured", "unconstrained", "independent-gp")
"""Models with kernels, whose parameters are searched for from several starts."""

MEANT_FOR: Mapping[str, tuple[str, ...]] = {
    "mean": ("structured",),
    "prior": ("structured",),
    "force_noise": ("structured", "unconstrained", "analytical"),
    "measured_torque": ("structured", "unconstrained", "analytical"),
    "restarts": SEARCHED,
    "jobs": SEARCHED,
    "engine": ("structured", "unconstrained"),
    "learning_points": ("structured", "unconstrained"),
    "learn_from": ("structured", "unconstrained", "analytical"),
    "motions": ("structured", "analytical"),
    "backend": SEARCHED,
    "hyperprior": (*SEARCHED, "analytical"),
}
"""Options that mean nothing to some models -> those to which they do."""

Options = TypeVar("Options", bound=ModelOptions)


def resolved(command: Options) -> Options:
    """The command with the defaults of its model. Raises InvalidInput for options that mean nothing to it."""
    for name, models in MEANT_FOR.items():
        if command.model not in models and (given := command.words(name)):
            raise InvalidInput(
                f"{given[0].partition('=')[0]} means nothing to --model {command.model}; leave it out, or choose "
                f"{' or '.join(models)}."
            )
    if command.window is not None and command.learn_from == "accelerations":
        raise InvalidInput("--window means nothing to accelerations; add --learn-from weak-form, or leave it out.")
    changes: dict[str, Any] = {}
    if command.points is None and command.model != "structured":  # there the prior decides
        changes["points"] = POINTS
    if command.model == "structured":
        changes["mean"] = command.mean or "analytical"
    return replace(command, **changes)


def make_model(command: ModelOptions, system: forcegp.MechanicalSystem) -> forcegp.models.Model:
    """The model of a resolved command."""
    # no dataset states the noise of windows: it is learned unless it is a number
    learned = command.noise == "dataset" and command.learn_from != "accelerations"
    noise = resolved_noise("learned" if learned else command.noise, command.force_noise)
    if command.measured_torque:
        if noise is None or noise.force is None:
            raise InvalidInput("--measured-torque needs the noise of the torque sensors; add --force-noise SIGMA.")
        noise = replace(noise, measured_torque=True)
    if command.model == "independent-gp":
        return forcegp.IndependentGP(system, noise=noise)
    if command.model == "unconstrained":
        return forcegp.StructuredGP(system, forcegp.JointAccelerations(), "zero", noise)
    if command.model == "analytical":
        return forcegp.StructuredGP(system, forcegp.NoForces(), "analytical", noise)
    assert command.mean is not None, "a resolved command has a mean"
    prior = forcegp.priors.named_prior(" + ".join(command.prior), system)
    return forcegp.StructuredGP(system, prior, command.mean, noise)


def search_arguments(command: ModelOptions, points: int) -> dict[str, Any]:
    """What `fit` of the model of a resolved command takes besides the data and so many points."""
    observe = window_observation(command.learn_from, command.window)
    rows: dict[str, Any] = {}
    if observe is not None:
        if command.engine not in ("auto", "exact") or command.learning_points is not None:
            raise InvalidInput(
                f"--engine and --learning-points mean nothing to --learn-from {command.learn_from}: windows are "
                "conditioned on exactly, and all are learned from; leave both out, and give fewer --points if it takes "
                "too long."
            )
        rows = {"observe": observe}
    elif command.model in MEANT_FOR["engine"]:
        rows = {"engine": command.engine, "learning_points": command.learning_points}
    options = forcegp.models.default_options(points)
    return {
        "seed": command.seed,
        **rows,
        "restarts": 1 if command.model == "analytical" else command.restarts,  # its starts are all the same
        "backend": command._backend(),
        "hyperprior": command.hyperprior,
        "options": replace(options, iterations=command.iterations),
    }


def window_observation(learn_from: LearnFrom, seconds: float | None) -> forcegp.data.WeakForm | None:
    """What to observe of windows of that length; None for accelerations. Raises InvalidInput for no length."""
    if learn_from == "accelerations":
        return None
    return forcegp.WeakForm(WINDOW if seconds is None else seconds)


def resolved_noise(given: str, force: float | None = None) -> forcegp.Noise | None:
    """The model's noise for `learned`, `dataset` or a number, and for the noise of forces.

    Raises InvalidInput for anything else.
    """
    if given == "learned":
        return forcegp.Noise(None, force, learn=True)
    if given == "dataset":
        return None if force is None else forcegp.Noise(None, force)
    complaint = f"--noise is {given!r}; give learned, dataset or a number such as 0.1."
    return forcegp.Noise(numbers_of(given, complaint, one=True)[0], force)
