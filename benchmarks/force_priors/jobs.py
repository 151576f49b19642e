"""Jobs of the experiments on force priors: simulate one trajectory, fit one model, score it on several."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.paper.data import farthest, simulated
from benchmarks.paper.fits import MODEL, search_report
from benchmarks.plants import JointFrictionLaw, PlantConfig
from benchmarks.scores import scores_of
from forcegp.data import Dataset
from forcegp.errors import InvalidInput
from forcegp.evidence import Accelerations
from forcegp.fit import fit as fit_model
from forcegp.forces import ContactFriction, Coulomb, JointFriction, Viscous, parse_forces
from forcegp.inference import OptimizerOptions
from forcegp.jobs import JobStore
from forcegp.posterior import save_posterior
from forcegp.posterior.prediction import Curve
from forcegp.robots import Robot
from forcegp.simulation import KukaSurfaceConfig
from forcegp.simulation.kuka_surface import DryFriction, ViscousFriction, tool_friction_of

Law = Callable[[np.ndarray], np.ndarray]
TRAIN_X, TEST_X = 0.0, 0.1  # training rows have their tool at x below the first, test rows above the second [m]


def _tool_x(dataset: Dataset) -> np.ndarray:
    assert dataset.model is not None
    kinematics = dataset.model.robot.kinematics(torch.tensor(dataset.q), torch.tensor(dataset.v))
    return dataset.model.contacts[0].position(kinematics)[:, 0].numpy()


def true_curves(posterior: Any) -> dict[str, Law]:
    """Latent -> true resisting force over its velocity; latents without a true law of their own are left out.

    Those are priors that differ from the simulation, for example a friction that does not grow with the load.
    """
    if posterior.is_black_box:
        return {}
    model = posterior.model
    given: Mapping[str, Any] = posterior.settings["data"]["metadata"]["config"]
    values: Any = {name: tuple(x) if isinstance(x, list | tuple) else x for name, x in given.items()}
    config = PlantConfig(**values)
    out: dict[str, Law] = {}
    names = posterior.latent_names
    for _, term, which in model.unknown.named(model.robot):
        if isinstance(term, JointFriction):
            for joint, name in zip(term.latent_names(model.robot), names[which], strict=True):
                law = _joint_law(config, model.robot, model.robot.joint_names.index(joint))
                out |= {} if law is None else {name: law}
        elif isinstance(term, ContactFriction) and term.axes == "isotropic" and term.inputs == ("velocity",):
            law = _tool_law(config, term.load)
            if law is not None:
                out[names[which][0]] = (lambda speed, law=law: law(speed) / speed) if term.viscous else law
    return out


def _joint_law(config: KukaSurfaceConfig, robot: Robot, joint: int) -> Law | None:
    if config.joint_friction == "none":
        return np.zeros_like
    law = JointFrictionLaw(config, robot)
    if not law.of_velocity:
        return None
    return lambda v: law.curve(np.asarray(v)[:, None] * np.ones(len(law.coulomb)))[:, joint]


def _tool_law(config: KukaSurfaceConfig, load: bool) -> Law | None:
    law = tool_friction_of(config)
    if isinstance(law, DryFriction) and load:
        return law.coefficient
    if isinstance(law, ViscousFriction) and not load:
        return lambda speed: law.coefficient * np.asarray(speed)
    return None


ROUNDING = 1e-9  # relative
FILE = "data.h5"
BLACK_BOX, KNOWN_PHYSICS, LAWS = "independent-gp", "none", "joint-laws"
"""Models of the trials that are no prior expressions: a Gaussian process per joint, no unknown force at all, and
Coulomb's and viscous friction of every joint by maximum likelihood, with the smooth sign of the scenario."""


def simulate(results: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """One trajectory of a scenario: its `rows` that lie farthest apart, or every `every`-th."""
    everything = simulated(spec["seed"], spec["seconds"], **spec["scenario"])
    if spec["rows"] is None:
        kept = everything.rows(slice(None, None, spec["every"]))
    else:
        kept = farthest(everything, spec["rows"], spec["seconds"])
    kept.save(folder / FILE)
    return {"rows_available": len(everything), "rows": len(kept)}


def load(results: JobStore, name: str) -> Dataset:
    """The rows of a data job."""
    return Dataset.load(results.place(name) / FILE)


def fit(results: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Fit to the first `points` training rows and score on every test trajectory, under the contacts of its own."""
    train = load(results, spec["train"])
    if spec["region"]:
        train = train.rows(_tool_x(train) < TRAIN_X)
    if spec["points"] > len(train):
        raise InvalidInput(f"{spec['points']} training points are asked for, but there are {len(train)}.")
    posterior = fitted(spec, train.rows(slice(spec["points"])))
    save_posterior(posterior, folder / MODEL)
    tests = {}
    for label, name in spec["tests"].items():
        test = load(results, name)
        if spec["region"]:
            test = test.rows(_tool_x(test) > TEST_X)
        tests[label] = scores(posterior, test)
    return {"tests": tests, "curves": curve_scores(posterior), "search": search_report(posterior)}


def fitted(spec: Mapping[str, Any], train: Dataset) -> Any:
    """The model of `spec` fitted to these rows."""
    model = train.model
    assert model is not None, "simulated data carry their model"
    options = OptimizerOptions(iterations=spec["iterations"], tolerance=spec["tolerance"])
    how = {"seed": spec["seed"], "restarts": spec["restarts"], "options": options}
    if spec["prior"] == BLACK_BOX:
        return fit_model(model.black_box(), train, **how)
    if spec["prior"] == LAWS:
        smoothing = train.metadata["config"]["joint_smoothing"]
        return fit_model(model.with_forces(Viscous(), Coulomb(None, smoothing)), train, Accelerations())
    known = () if spec["prior"] == KNOWN_PHYSICS else parse_forces(spec["prior"])
    whole = model.with_forces(known)
    return fit_model(whole if spec["mean"] == "analytical" else whole.without_mean(), train, **how)


def scores(posterior: Any, test: Dataset) -> dict[str, Any]:
    """Errors of the acceleration and, where the model has them, of the forces; plain JSON values."""
    assert test.model is not None, "simulated data carry their model"
    if not posterior.is_black_box:
        posterior = posterior.with_contacts(test.model.contacts)  # what was identified stays
    out = scores_of(posterior, test)
    names = ("mae", "mae_noise_free", "nlpd", "coverage_95", "coverage_95_noise_free", "known_physics_mae")
    kept = {name: out[name] for name in names}
    if "a" in test.truth:  # what nothing can be better than on these rows
        kept["mae_of_truth"] = float(np.abs(test.truth["a"] - test.a).mean())
    if posterior.is_black_box:
        return kept
    kept |= {name: value for name, value in out.items() if name.startswith(("force_mae.", "normal_force"))}
    found = posterior.components(test.q, test.v, test.u, covariance=False)
    if found:  # how far they are from their sum
        total = sum(part.joint_force.mean for part in found.values())
        kept["component_sum_error"] = float((total - found.total.mean).abs().max())
    return kept


def curve_coverage(curve: Curve, law: Callable[[np.ndarray], np.ndarray]) -> float:
    """Share of the curve's points (n,) within the visited range whose 95 % interval contains the true `law`."""
    at = curve.features[:, 0].cpu().numpy()
    low, high = curve.visited[:, 0].cpu().numpy()
    inside = (at >= low - ROUNDING * abs(low)) & (at <= high + ROUNDING * abs(high))
    truth = law(at)
    lower, upper = (end.cpu().numpy() for end in curve.interval())
    slack = ROUNDING * float(np.abs(truth).max())  # friction at rest is exactly zero, and so is its interval's width
    return float(((truth >= lower - slack) & (truth <= upper + slack))[inside].mean())


def curve_scores(posterior: Any) -> dict[str, Any]:
    """Share of the visited range where the 95 % band of a friction curve holds the true law, per curve."""
    out = {}
    for latent, law in true_curves(posterior).items():
        curve = posterior.curve(latent)
        truth = torch.tensor(law(curve.features[:, 0].numpy()))
        size = float(truth.square().mean().sqrt())
        out[latent] = {
            "coverage": curve_coverage(curve, law),
            "relative_error": float((curve.mean - truth).square().mean().sqrt()) / size if size else None,
        }
    return out
