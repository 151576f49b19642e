"""Arguments of the public functions: values of another type, shape or size where one or two right ones were."""

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st
from tests.fuzz.made import INPUTS, QUICK
from tests.fuzz.oracle import DefectError, Target, allowed
from tests.fuzz.values import words
from tests.posterior.arm import URDF, arm_model
from tests.robots.mjcf_models import OPEN_BARS

import forcegp
import forcegp.control
import forcegp.data
import forcegp.errors
import forcegp.forces
import forcegp.inference
import forcegp.mechanics
import forcegp.recordings
import forcegp.scores
import forcegp.simulation
from forcegp import KukaSurfaceConfig, forces, mechanics
from forcegp.evidence import parse_evidence
from forcegp.fit import fit
from forcegp.forces import JointForces

STATE = tuple(torch.full((3,), number, dtype=torch.float64) for number in (0.3, 0.1, 0.5))
POSE = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0, 0.6, 0.8]).double()
STILL = torch.zeros(6).double()
TEXTS = ("", "\ud800", "a\nb", "joint +", *words("x abc 10 nan joint auto none base hand pan body floating planar"))
TENSORS = (
    lambda: torch.ones(3, dtype=torch.float64, requires_grad=True), lambda: torch.ones(3, dtype=torch.complex128),
    lambda: torch.ones(3, dtype=torch.bool), lambda: torch.ones(3, device="meta"), lambda: torch.zeros(0),
    lambda: torch.tensor(float("nan")), lambda: torch.ones(2, 3).to_sparse(),
)  # fmt: skip
VALUES = (None, True, False, Ellipsis, NotImplemented, 0, -1, 1, 2, 3, 7, 2**63, 10**30, -0.0, 0.5, 1.5, 1e308, -1e308)
VALUES += (1e-320, float("nan"), float("inf"), float("-inf"), 1j, b"x", *TEXTS, (), (1,), (1, 2, 3), (0.0, 0.0, 0.0))
VALUES += (("pan",), (None,), (float("nan"),) * 3)
MADE: dict[str, Callable[[], Any]] = {
    **{repr(value): functools.partial(lambda value: value, value) for value in VALUES}, "[]": list, "{}": dict,
    "[[1, 2], [3]]": lambda: [[1, 2], [3]], "['a', 'b', 'c']": lambda: ["a", "b", "c"], "{'a': 1}": lambda: {"a": 1},
    "an object": object, "a generator": lambda: (k for k in range(3)), "a slice": lambda: slice(0, 2),
    "a path with NUL": lambda: "a\x00b", **{f"tensor {k}": make for k, make in enumerate(TENSORS)},
    "array of dates": lambda: np.full(3, np.datetime64("2026-01-01")),
    "array of objects": lambda: np.array([{}, [], None], object),
    "array of records": lambda: np.zeros(3, [("a", "f8")]), "array of nothing": lambda: np.zeros((0, 3)),
    "array (3, 3)": lambda: np.ones((3, 3)), "array (14, 3)": lambda: np.ones((14, 3)),
    "array (14, 3) of NaN": lambda: np.full((14, 3), np.nan), "array (1, 1, 1, 3)": lambda: np.ones((1, 1, 1, 3)),
    "a Dataset": lambda: INPUTS.data, "a Dataset of a row": lambda: INPUTS.data.rows([0]),
    "a Dataset of other joints": lambda: INPUTS.other, "a posterior": lambda: INPUTS.posterior,
    "a Dataset of a drone": lambda: INPUTS.moving, "array (7,)": lambda: np.ones(7),
    "array (6, 2)": lambda: np.ones((6, 2)), "a robot": lambda: INPUTS.data.model.robot,
    "a model": lambda: INPUTS.data.model, "a free model": lambda: arm_model(0),
    "a contact": lambda: INPUTS.data.model.contacts[0],
}  # fmt: skip
"""Made anew for every case: some can be used once only, and none may be changed by the one before."""


def _dataset() -> dict[str, Any]:
    data = INPUTS.data
    names = ("q", "v", "u", "a", "time", "episode", "model", "noise_std", "truth", "metadata")
    return {name: getattr(data, name) for name in names}


def _states() -> dict[str, Any]:
    return dict(zip("qvu", STATE, strict=True))


def _robot() -> Any:
    return INPUTS.data.model.robot


def _prior(kind: Any, **arguments: Any) -> Any:
    """A prior shows what is wrong with it where it meets a robot."""
    dynamics, made = INPUTS.data.model.dynamics(*(x[None] for x in STATE)), kind(**arguments)
    made.direction(dynamics), made.features(dynamics)
    made.latent_names(_robot())
    return made


def _forces(kind: Any, **arguments: Any) -> None:
    """No numbers are returned: what a coefficient of 1e308 overflows to is refused by `predict`."""
    made, model = kind(**arguments), INPUTS.data.model.with_contacts(())
    forcegp.Model(model.robot, (), (*model.forces, made)).dynamics(*STATE).acceleration_map()


def _surface(kind: Any, **arguments: Any) -> Any:
    return arm_model(0).with_contacts((forcegp.Contact("hand", (0.0, 0.0, 0.2), kind(**arguments)),)).dynamics(*STATE).A


def _drone() -> Any:
    return INPUTS.moving.model.robot


def _link_force(kind: Any, **arguments: Any) -> Any:
    made = kind(**arguments)
    known = (made,) if kind is forcegp.forces.Actuation else (forcegp.forces.Actuation(), made)
    model = forcegp.Model(_drone(), (), (*known, forcegp.RigidBodies()))
    forcegp.Model.from_json(model.to_json())
    return model.dynamics(POSE, STILL, torch.ones(len(model.inputs)).double()).M


def _options(kind: Any, **arguments: Any) -> Any:
    made = kind(**arguments)
    if isinstance(made.iterations, int) and made.iterations > 50:
        return None
    return fit(INPUTS.data.model.with_forces(JointForces()), INPUTS.data, points=6, restarts=1, options=made)


TRACKING = {"stiffness": 10.0, "damping": None, "torque_limits": 50.0}
FIT = {"points": 6, "restarts": 1, "seed": 0, "options": QUICK}
SURFACES = {"normal": (0.0, 0.0, 1.0), "offset": 0.1}


def _call(
    of: Callable[..., Any], use: Callable[..., Any] | None = None, names: str = "", given: Callable[..., Any] = dict
) -> tuple[Callable[..., Any], Callable[[], dict[str, Any]]]:
    """What is called, directly or by `use`; and its arguments: those `given`, and the defaults of these names."""

    def arguments() -> dict[str, Any]:
        parameters = inspect.signature(of).parameters
        return {**given(), **{name: parameters[name].default for name in names.split()}}

    return (of if use is None else functools.partial(use, of)), arguments


def _of_posterior(name: str, then: Callable[[Any], Any] = lambda made: made, **more: Any) -> Callable[..., Any]:
    return lambda _, **k: then(getattr(INPUTS.posterior, name)(**{**k, **more}))


def _of_drone(name: str) -> Callable[..., Any]:
    return lambda _, **k: getattr(_drone(), name)(**k)


def _shown(kind: Any, **arguments: Any) -> str:
    return str(kind(**arguments))


def _held(kind: Any, **arguments: Any) -> Any:
    model = INPUTS.moving.model.with_contacts(kind(**arguments))
    return model.dynamics(POSE, STILL, torch.ones(len(model.inputs)).double()).A


def _flying(kind: Any, **arguments: Any) -> None:
    made, dynamics = kind(**arguments), INPUTS.moving.model.dynamics(POSE[None], STILL[None], torch.ones(1, 4).double())
    made.direction(dynamics), made.features(dynamics)
    made.latent_names(_drone())


def _fit_of(model: Callable[[], Any]) -> Callable[..., Any]:
    return lambda _, **k: fit(model(), **k)


Posterior, Robot = forcegp.Posterior, forcegp.Robot
POINT = (0.0, 0.0, 0.1)
CALLS: dict[str, tuple[Callable[..., Any], Callable[[], dict[str, Any]]]] = {
    "Dataset": _call(forcegp.Dataset, given=_dataset),
    "Dataset.rows": (lambda index: INPUTS.data.rows(index), lambda: {"index": [0, 1]}),
    "Dataset.load": _call(forcegp.Dataset.load, given=lambda: {"path": INPUTS.folder / "train.h5"}),
    "predict": _call(Posterior.predict, _of_posterior("predict"), "covariance", _states),
    "components": _call(Posterior.components, _of_posterior("components"), "covariance", _states),
    "rollout": _call(
        Posterior.rollout,
        _of_posterior("rollout", str),  # NaN from where a motion diverges
        "integrator samples seed baumgarte",
        lambda: {"q0": STATE[0], "v0": STATE[1], "u": torch.zeros(2, 3).double(), "dt": 0.001},
    ),
    "update": _call(
        Posterior.update,
        _of_posterior("update", lambda made: made.predict(*STATE)),
        given=lambda: {"rows": INPUTS.data.rows([9])},
    ),
    "curve": _call(Posterior.curve, _of_posterior("curve"), "features", lambda: {"latent": "pan", "points": 5}),
    "with_model": _call(Posterior.with_model, _of_posterior("with_model"), given=lambda: {"model": INPUTS.data.model}),
    "predictor": _call(
        Posterior.predictor, _of_posterior("predictor", lambda made: made(*STATE), compile=False), "covariance"
    ),
    "predictor()": (lambda **k: INPUTS.predictor(**k), _states),
    "Noise": _call(
        forcegp.Noise,
        lambda kind, **k: fit(INPUTS.data.model.with_forces(JointForces(), noise=kind(**k)), INPUTS.data, **FIT),
        "acceleration learn",
        lambda: {"force": 0.1},
    ),
    "fit": _call(
        fit,
        _fit_of(lambda: INPUTS.data.model.with_forces(JointForces())),
        "evidence start engine learning_points",
        lambda: {"dataset": INPUTS.data, **FIT},
    ),
    "fit (laws)": _call(
        fit,
        _fit_of(lambda: INPUTS.free.model.with_forces(forcegp.Viscous())),
        "baseline",
        lambda: {"dataset": INPUTS.free, "evidence": forcegp.Torques(), "rows": 50},
    ),
    "IndependentAccelerations": _call(
        forces.IndependentAccelerations,
        lambda kind, **k: fit(INPUTS.data.model.without_mean().with_forces(kind(**k)), INPUTS.data, **FIT),
        "inputs",
    ),
    "OptimizerOptions": _call(forcegp.inference.OptimizerOptions, _options, "tolerance", lambda: {"iterations": 2}),
    "Inducing": _call(
        forcegp.inference.Inducing,
        lambda kind, **k: fit(INPUTS.data.model.with_forces(JointForces()), INPUTS.data, **FIT, engine=kind(**k)),
        "tolerance",
        lambda: {"points": 5},
    ),
    "Robot.from_urdf_text": _call(
        Robot.from_urdf_text,
        lambda of, **k: of(**k).forward_dynamics(*STATE),
        "gravity armature locked inertias base",
        lambda: {"text": URDF},
    ),
    "Robot.from_mjcf_text": _call(
        Robot.from_mjcf_text,
        _shown,
        given=lambda: {
            "text": OPEN_BARS,
            **dict.fromkeys(("gravity", "armature", "locked", "base")),
            "inertias": "strict",
        },
    ),
    "Robot.from_urdf": _call(Robot.from_urdf, given=lambda: {"path": INPUTS.folder / "arm.urdf"}),
    "Model.from_file": _call(
        forcegp.Model.from_file, _shown, given=lambda: {"path": INPUTS.folder / "drone.xml", "base": None}
    ),
    "integrate": _call(Robot.integrate, _of_drone("integrate"), given=lambda: {"q": POSE, "step": STILL + 0.1}),
    "normalized": _call(Robot.normalized, _of_drone("normalized"), given=lambda: {"q": POSE}),
    "with_armature": (lambda armature: _robot().with_armature(armature), lambda: {"armature": (0.1, 0.1, 0.1)}),
    "Thrusters": _call(
        forces.Thrusters,
        _link_force,
        "torque axes power names",
        lambda: {"frame": "body", "places": [[0.1, 0.0, 0.0], [0.0, 0.1, 0.0]], "thrust": 1.0},
    ),
    "ObservedWrench": _call(forces.ObservedWrench, _link_force, "names", lambda: {"frame": "body"}),
    "Actuation": _call(
        forces.Actuation, _link_force, given=lambda: {"matrix": np.ones((6, 2)), "names": ("one", "two")}
    ),
    "fixed_point": _call(mechanics.fixed_point, _held, given=lambda: {"frame": "body", "point": POINT, "switch": "x"}),
    "AerodynamicForce": _call(forcegp.AerodynamicForce, _flying, "frame inputs kernel observe"),
    "QuadrotorConfig": _call(forcegp.simulation.QuadrotorConfig, names="seconds seed noise episodes wind lag"),
    "KukaSurfaceConfig": _call(KukaSurfaceConfig, names="seconds seed noise surface friction tool_mass"),
    "Model": _call(forcegp.Model, names="contacts forces noise baumgarte", given=lambda: {"robot": _robot()}),
    "dynamics": (lambda **k: INPUTS.data.model.dynamics(**k).A, _states),
    "Contact": (
        lambda **k: arm_model(0).with_contacts((forcegp.Contact(**k),)).dynamics(*STATE).A,
        lambda: {"frame": "hand", "point": POINT, "surface": forcegp.Plane(**SURFACES)},
    ),
    "Plane": _call(forcegp.Plane, _surface, given=lambda: dict(SURFACES)),
    "Baumgarte": (
        lambda **k: arm_model(baumgarte=forcegp.mechanics.Baumgarte(**k)).dynamics(*STATE).b,
        lambda: {"omega": 5.0, "zeta": 1.0},
    ),
    "viscous": _call(forcegp.Viscous, _forces, given=lambda: {"damping": 0.1}),
    "stribeck": _call(
        forcegp.Stribeck, _forces, given=lambda: {"level": 0.1, "breakaway": 0.1, "stribeck_velocity": 0.1}
    ),
    "Payload": _call(
        forcegp.Payload, _forces, "inertia", lambda: {"link": "hand", "mass": 1.0, "center_of_mass": POINT}
    ),
    "Normal": _call(
        forcegp.Normal,
        lambda kind, **k: _forces(forcegp.Viscous, damping=kind(**k)),
        given=lambda: {"mean": 0.1, "std": 0.1},
    ),
    "RigidBodies": _call(
        forcegp.RigidBodies,
        lambda kind, **k: INPUTS.data.model.with_forces(kind(**k)).dynamics(*STATE).A,
        given=lambda: {"learn": ("hand",)},
    ),
    "with_forces": (
        lambda forces, noise: INPUTS.data.model.with_forces(forces, noise=noise),
        lambda: {"forces": forcegp.Viscous(), "noise": 0.1},
    ),
    "parse_forces": _call(forces.parse_forces, given=lambda: {"expression": "gp:joint"}),
    "parse_evidence": _call(parse_evidence, given=lambda: {"words": "torques:mean=.4"}),
    "JointFriction": _call(forcegp.JointFriction, _prior, "joints kernel"),
    "ToolForces": _call(forcegp.ToolForces, _prior, "inputs contact kernel"),
    "ContactFriction": _call(forcegp.ContactFriction, _prior, "contact load kernel"),
    "Preparation": _call(
        forcegp.data.Preparation,
        lambda kind, **k: kind(**k).apply(INPUTS.free),
        "delay lag every trim differentiate",
        lambda: {"cutoff": 20.0},
    ),
    "ComputedTorque": _call(
        forcegp.ComputedTorque, lambda kind, **k: kind(arm_model(0), **k)(*STATE[:2], *STATE), "", lambda: TRACKING
    ),
    "ContactMonitor": _call(
        forcegp.ContactMonitor,
        lambda kind, **k: kind(arm_model(0), **k).run(INPUTS.free.q, INPUTS.free.v, INPUTS.free.u),
        "bandwidth",
        lambda: {"dt": 0.01},
    ),
    "MPPI": _call(
        forcegp.MPPI,
        lambda kind, **k: kind(INPUTS.predictor, lambda q, v, u: q.square().sum((-1, -2)), **k)(*STATE[:2]),
        "noise seed",
        lambda: {"dt": 0.01, "steps": 2, "torque_limits": 5.0, "samples": 3, "integrator": "rk4"},
    ),
    "excitation": _call(
        forcegp.excitation,
        None,
        "start surfaces clearance task seed",
        lambda: {
            **{"model": INPUTS.posterior.with_contacts(()), "seconds": 1.0, "limits": {"velocity": 1.0}, "rows": 5},
            "motions": 2,
        },
    ),
    "score": _call(
        forcegp.score,
        _shown,
        given=lambda: {"models": INPUTS.posterior, "log": INPUTS.data, "horizons": (0.01,), "starts": 1},
    ),
    "check": _call(forcegp.check, None, "model", lambda: {"dataset": INPUTS.free}),
    "Torques": _call(forcegp.Torques, names="noisy mean"),
    "Motions": _call(forcegp.Motions, names="seconds bodies"),
    "split_named": (forcegp.scores.split_named, lambda: {"dataset": INPUTS.free, "text": "blocks:5:3", "guard": 0.01}),
    "ColumnMapping": _call(forcegp.recordings.ColumnMapping, names="time q u joints unit sign step headerless"),
    "ImportOptions": _call(forcegp.recordings.ImportOptions, names="gap rate start end"),
    "load_posterior": _call(forcegp.load_posterior, given=lambda: {"path": INPUTS.folder / "carried"}),
}


@dataclass(frozen=True)
class Call:
    """The call with the arguments number `where` replaced by these values, by name."""

    call: str
    changes: dict[int, str]
    more: str


CASES = st.builds(
    Call,
    st.sampled_from(tuple(CALLS)),
    st.dictionaries(st.integers(0, 11), st.sampled_from(tuple(MADE)), min_size=1, max_size=2),
    st.sampled_from(("",) * 20 + ("none_such",)),
)


def check(case: Call, folder: Path) -> None:
    """A ForceGPError, TypeError for an argument that is unknown, or finite numbers."""
    function, arguments = CALLS[case.call]
    given = arguments()
    names = list(given)
    for where, made in case.changes.items():
        given[names[where % len(names)]] = MADE[made]()
    if case.more:
        given[case.more] = 1
        try:
            function(**given)
        except TypeError:
            return
        except forcegp.errors.ForceGPError:
            return
        raise DefectError("an argument that nobody has was taken")
    with allowed():
        require_numbers(function(**given))


def require_numbers(result: Any) -> None:
    """Fail for results with numbers that are not finite."""
    parts = result if isinstance(result, tuple) else (result,)
    for part in parts:
        for value in (part, *(getattr(part, name, None) for name in ("mean", "covariance", "q", "v", "a"))):
            if isinstance(value, torch.Tensor) and not bool(torch.isfinite(value).all()):
                raise DefectError("numbers that are not finite")


TARGET = Target(CASES, check, fast=90, nightly=8000)
