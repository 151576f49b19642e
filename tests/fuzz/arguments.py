"""Arguments of the public functions: values of another type, shape or size where one or two right ones were."""

from __future__ import annotations

import datetime
import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st
from tests.fuzz.made import INPUTS, QUICK
from tests.fuzz.oracle import DefectError, Target, allowed
from tests.posterior.arm import URDF, arm_model
from tests.robots.mjcf_models import FOUR_BAR

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
from forcegp import forces, mechanics
from forcegp.evidence import parse_evidence
from forcegp.fit import fit
from forcegp.forces import JointForces

STATE = (np.full(3, 0.3), np.full(3, 0.1), np.full(3, 0.5))
POSE = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.6, 0.8])
TEXTS = (
    "",
    "x",
    "abc",
    "10",
    "nan",
    "joint",
    "\ud800",
    "a\nb",
    "auto",
    "joint +",
    "none",
    "base",
    "hand",
    "pan",
    "body",
    "floating",
    "planar",
)
TENSORS = (
    lambda: torch.ones(3, dtype=torch.float64, requires_grad=True),
    lambda: torch.ones(3, dtype=torch.complex128),
    lambda: torch.ones(3, dtype=torch.bool),
    lambda: torch.ones(3, device="meta"),
    lambda: torch.zeros(0),
    lambda: torch.tensor(float("nan")),
    lambda: torch.ones(2, 3).to_sparse(),
)
MADE: dict[str, Callable[[], Any]] = {
    **{
        repr(value): functools.partial(lambda value: value, value)
        for value in (None, True, False, Ellipsis, NotImplemented)
    },
    **{
        repr(v): functools.partial(lambda v: v, v)
        for v in (0, -1, 1, 2, 3, 7, 2**63, 10**30, -0.0, 0.5, 1.5, 1e308, -1e308, 1e-320)
    },
    **{
        repr(v): functools.partial(lambda v: v, v)
        for v in (float("nan"), float("inf"), float("-inf"), 1j, b"x", *TEXTS)
    },
    **{
        repr(v): functools.partial(lambda v: v, v)
        for v in ((), (1,), (1, 2, 3), (0.0, 0.0, 0.0), ("pan",), (None,), (float("nan"),) * 3)
    },
    "[]": list,
    "{}": dict,
    "[[1, 2], [3]]": lambda: [[1, 2], [3]],
    "['a', 'b', 'c']": lambda: ["a", "b", "c"],
    "{'a': 1}": lambda: {"a": 1},
    "{1: None}": lambda: {1: None},
    "{'pan': 'x'}": lambda: {"pan": "x"},
    "a set": lambda: {1, 2},
    "an object": object,
    "a type": lambda: int,
    "a function": lambda: len,
    "a generator": lambda: (k for k in range(3)),
    "a range": lambda: range(3),
    "a slice": lambda: slice(0, 2),
    "a path": lambda: Path("nowhere"),
    "a path with NUL": lambda: "a\x00b",
    "a date": lambda: datetime.date(2026, 1, 1),
    "an error": ValueError,
    **{f"tensor {k}": make for k, make in enumerate(TENSORS)},
    "array of dates": lambda: np.full(3, np.datetime64("2026-01-01")),
    "array of texts": lambda: np.array(["a", "b", "c"]),
    "array of objects": lambda: np.array([{}, [], None], object),
    "array of records": lambda: np.zeros(3, [("a", "f8")]),
    "masked": lambda: np.ma.masked_array(np.ones(3), [True, False, False]),
    "array of nothing": lambda: np.zeros((0, 3)),
    "array without columns": lambda: np.zeros((3, 0)),
    "array (3, 3)": lambda: np.ones((3, 3)),
    "array (14, 3)": lambda: np.ones((14, 3)),
    "array (14, 3) of NaN": lambda: np.full((14, 3), np.nan),
    "array (14, 3) huge": lambda: np.full((14, 3), 1e307),
    "array (14,)": lambda: np.arange(14.0),
    "array (1, 1, 1, 3)": lambda: np.ones((1, 1, 1, 3)),
    "scalar of NumPy": lambda: np.float64(0.5),
    "complex array": lambda: np.ones(3) * 1j,
    "a Dataset": lambda: INPUTS.data,
    "a Dataset of a row": lambda: INPUTS.data.rows([0]),
    "a Dataset of other joints": lambda: INPUTS.other,
    "a posterior": lambda: INPUTS.posterior,
    "a Dataset of a drone": lambda: INPUTS.moving,
    "array (7,)": lambda: np.ones(7),
    "array (6,)": lambda: np.ones(6),
    "array (2, 3)": lambda: np.ones((2, 3)),
    "array (6, 2)": lambda: np.ones((6, 2)),
    "a robot": lambda: INPUTS.data.model.robot,
    "a model": lambda: INPUTS.data.model,
    "a free model": lambda: arm_model(0),
    "a contact": lambda: INPUTS.data.model.contacts[0],
    "a noise": lambda: forcegp.Noise(0.1),
    "a plane": lambda: forcegp.Plane((0.0, 0.0, 1.0), 0.0),
}
"""Made anew for every case: some can be used once only, and none may be changed by the one before."""


def _dataset() -> dict[str, Any]:
    data = INPUTS.data
    names = ("q", "v", "u", "a", "time", "joint_names", "units", "episode", "model", "noise_std", "truth", "metadata")
    return {name: getattr(data, name) for name in names}


def _states() -> dict[str, Any]:
    return dict(zip("qvu", STATE, strict=True))


def _robot() -> Any:
    return INPUTS.data.model.robot


def _prior(kind: Any, **arguments: Any) -> Any:
    """A prior shows what is wrong with it where it meets a robot."""
    dynamics = INPUTS.data.model.dynamics(*(torch.tensor(x)[None] for x in STATE))
    made = kind(**arguments)
    made.direction(dynamics), made.features(dynamics)
    made.latent_names(_robot())
    return made


def _forces(kind: Any, **arguments: Any) -> None:
    """No numbers are returned: what a coefficient of 1e308 overflows to is refused by `predict`."""
    made = kind(**arguments)
    model = INPUTS.data.model.with_contacts(())
    known = (*model.forces, made)
    forcegp.Model(model.robot, (), known).dynamics(*(torch.tensor(x) for x in STATE)).acceleration_map()


def _with(force: Any) -> Any:
    return INPUTS.data.model.with_forces(force).dynamics(*(torch.tensor(x) for x in STATE)).A


def _surface(kind: Any, **arguments: Any) -> Any:
    model = arm_model(0).with_contacts((forcegp.Contact("hand", (0.0, 0.0, 0.2), kind(**arguments)),))
    return model.dynamics(*(torch.tensor(x) for x in STATE)).A


def _contact(**arguments: Any) -> Any:
    return arm_model(0).with_contacts((forcegp.Contact(**arguments),)).dynamics(*(torch.tensor(x) for x in STATE)).A


def _baumgarte(**arguments: Any) -> Any:
    return arm_model(baumgarte=forcegp.mechanics.Baumgarte(**arguments)).dynamics(*(torch.tensor(x) for x in STATE)).b


def _robot_from(**arguments: Any) -> Any:
    return forcegp.Robot.from_urdf_text(**arguments).forward_dynamics(*(torch.tensor(x) for x in STATE))


def _drone() -> Any:
    return INPUTS.moving.model.robot


def _link_force(kind: Any, **arguments: Any) -> Any:
    made = kind(**arguments)
    known = (made,) if kind is forcegp.forces.Actuation else (forcegp.forces.Actuation(), made)
    model = forcegp.Model(_drone(), (), (*known, forcegp.RigidBodies()))
    forcegp.Model.from_json(model.to_json())
    return model.dynamics(POSE, np.zeros(6), np.ones(len(model.inputs))).M


def _held(contacts: Any) -> Any:
    model = INPUTS.moving.model.with_contacts(contacts)
    return model.dynamics(POSE, np.zeros(6), np.ones(len(model.inputs))).A


def _flying(made: Any) -> None:
    dynamics = INPUTS.moving.model.dynamics(POSE[None], np.zeros((1, 6)), np.ones((1, 4)))
    made.direction(dynamics), made.features(dynamics)
    made.latent_names(_drone())


def _fitted(noise: Any) -> Any:
    return fit(INPUTS.data.model.with_forces(JointForces(), noise=noise), INPUTS.data, restarts=1, options=QUICK)


def _options(**arguments: Any) -> Any:
    from forcegp.inference import OptimizerOptions

    made = OptimizerOptions(**arguments)
    if isinstance(made.iterations, int) and made.iterations > 50:
        return None
    return fit(INPUTS.data.model.with_forces(JointForces()), INPUTS.data, points=6, restarts=1, options=made)


def _engine(kind: Any, **arguments: Any) -> Any:
    return fit(
        INPUTS.data.model.with_forces(JointForces()),
        INPUTS.data,
        points=8,
        restarts=1,
        options=QUICK,
        engine=kind(**arguments),
    )


def _control(kind: Any, of: Callable[[], Any], *more: Any, **arguments: Any) -> Any:
    return kind(of(), *more, **arguments)(*STATE[:2], *(() if more else (STATE[0], STATE[1], STATE[2])))


def _cost(q: torch.Tensor, v: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    return q.square().sum((-1, -2))


TRACKING = {"stiffness": 10.0, "damping": None, "integral": 0.0, "dt": 0.01, "torque_limits": 50.0}
FIT = {"points": 6, "restarts": 1, "seed": 0, "options": QUICK}
SURFACES = {"normal": (0.0, 0.0, 1.0), "offset": 0.1}
CALLS: dict[str, tuple[Callable[..., Any], Callable[[], dict[str, Any]]]] = {
    "Dataset": (forcegp.Dataset, _dataset),
    "Dataset.rows": (lambda index: INPUTS.data.rows(index), lambda: {"index": [0, 1]}),
    "Dataset[]": (lambda index: INPUTS.data[index], lambda: {"index": "q"}),
    "predict": (lambda **k: INPUTS.posterior.predict(**k), lambda: {**_states(), "covariance": True}),
    "components": (lambda **k: INPUTS.posterior.components(**k), lambda: {**_states(), "covariance": True}),
    "rollout": (
        lambda **k: str(INPUTS.posterior.rollout(**k)),  # NaN from where a motion diverges
        lambda: {
            "q0": STATE[0],
            "v0": STATE[1],
            "u": np.zeros((2, 3)),
            "dt": 0.001,
            "integrator": "rk4",
            "samples": 0,
            "seed": 0,
            "baumgarte": None,
        },
    ),
    "update": (lambda **k: INPUTS.posterior.update(**k), lambda: {"rows": INPUTS.data.rows([9]), "budget": 8}),
    "update (horizon)": (
        lambda **k: INPUTS.posterior.update(**k).predict(*STATE),
        lambda: {"rows": INPUTS.data.rows([9]), "horizon": 60.0},
    ),
    "predictor().refreshed": (lambda **k: INPUTS.predictor.refreshed(**k), lambda: {"posterior": INPUTS.posterior}),
    "curve": (lambda **k: INPUTS.posterior.curve(**k), lambda: {"latent": "pan", "features": None, "points": 5}),
    "with_contacts": (lambda **k: INPUTS.posterior.with_contacts(**k), lambda: {"contacts": ()}),
    "with_robot": (lambda **k: INPUTS.posterior.with_robot(**k), lambda: {"robot": _robot()}),
    "with_model": (lambda **k: INPUTS.posterior.with_model(**k), lambda: {"model": INPUTS.data.model}),
    "predictor": (
        lambda **k: INPUTS.posterior.predictor(**{**k, "compile": False})(*STATE),
        lambda: {"covariance": "auto", "tolerance": 0.01, "largest_rank": 64},
    ),
    "predictor()": (lambda **k: INPUTS.predictor(**k), _states),
    "predictor().mean": (lambda **k: INPUTS.predictor.mean(**k), _states),
    "Noise": (lambda **k: _fitted(forcegp.Noise(**k)), lambda: {"acceleration": 0.1, "force": 0.1, "learn": False}),
    "noise": (_fitted, lambda: {"noise": 0.1}),
    "fit": (
        lambda **k: fit(INPUTS.data.model.with_forces(JointForces()), **k),
        lambda: {
            "dataset": INPUTS.data,
            "evidence": None,
            **FIT,
            "start": None,
            "engine": "exact",
            "learning_points": None,
        },
    ),
    "IndependentAccelerations": (
        lambda **k: fit(
            INPUTS.data.model.without_mean().with_forces(forcegp.forces.IndependentAccelerations(**k)),
            INPUTS.data,
            **FIT,
        ),
        lambda: {"inputs": ("q",)},
    ),
    "OptimizerOptions": (
        _options,
        lambda: {
            "iterations": 2,
            "tolerance": 1e-8,
            "gradient_tolerance": 1e-4,
            "memory": 5,
        },
    ),
    "Robot.from_urdf_text": (
        _robot_from,
        lambda: {
            **{"text": URDF, "gravity": (0.0, 0.0, -9.81), "armature": None, "locked": None},
            **{"inertias": "strict", "base": None, "root": None},
        },
    ),
    "Robot.from_mjcf_text": (
        lambda **k: repr(forcegp.Robot.from_mjcf_text(**k)),
        lambda: {
            **{"text": FOUR_BAR, "gravity": None, "armature": None, "locked": None, "inertias": "strict"},
            "base": None,
        },
    ),
    "Model.from_file": (
        lambda **k: repr(forcegp.Model.from_file(**k)),
        lambda: {"path": INPUTS.folder / "drone.xml", "base": None, "locked": None},
    ),
    "floating": (
        lambda **k: forcegp.Robot.from_urdf_text(URDF, **k).neutral(),
        lambda: {"base": "floating", "locked": None, "armature": None},
    ),
    "integrate": (lambda **k: _drone().integrate(**k), lambda: {"q": POSE, "step": np.full(6, 0.1)}),
    "difference": (lambda **k: _drone().difference(**k), lambda: {"q0": POSE, "q1": POSE}),
    "normalized": (lambda **k: _drone().normalized(**k), lambda: {"q": POSE}),
    "dynamics (drone)": (
        lambda **k: INPUTS.moving.model.dynamics(**k).M,
        lambda: {"q": POSE, "v": np.full(6, 0.1), "u": np.full(4, 500.0)},
    ),
    "Thrusters": (
        functools.partial(_link_force, forces.Thrusters),
        lambda: {
            **{"frame": "body", "places": [[0.1, 0.0, 0.0], [0.0, 0.1, 0.0]], "thrust": 1.0, "torque": 0.1},
            **{"axes": (0.0, 0.0, 1.0), "power": 2, "names": ("one", "two")},
        },
    ),
    "ObservedWrench": (
        functools.partial(_link_force, forces.ObservedWrench),
        lambda: {"frame": "body", "names": ("x", "y", "z")},
    ),
    "Actuation": (
        functools.partial(_link_force, forcegp.forces.Actuation),
        lambda: {"matrix": np.ones((6, 2)), "names": ("one", "two")},
    ),
    "fixed_point": (
        lambda **k: _held(mechanics.fixed_point(**k)),
        lambda: {"frame": "body", "point": (0.0, 0.0, 0.1), "switch": "stands"},
    ),
    "fixed_frame": (
        lambda **k: _held(mechanics.fixed_frame(**k)),
        lambda: {"frame": "body", "switch": "stands"},
    ),
    "loop_point": (
        lambda **k: _held(mechanics.loop_point(**k)),
        lambda: {
            **{"frame_a": "body", "point_a": (0.0, 0.0, 0.1), "frame_b": "body", "point_b": (0.0, 0.0, 0.1)},
            "switch": "stands",
        },
    ),
    "AerodynamicForce": (
        lambda **k: _flying(forcegp.AerodynamicForce(**k)),
        lambda: {"frame": "body", "inputs": ("velocity", "thrust"), "kernel": "linear", "observe": 0.5},
    ),
    "BaseWrench": (
        lambda **k: _flying(forcegp.forces.BaseWrench(**k)),
        lambda: {"frame": "body", "inputs": ("velocity",), "kernel": "linear"},
    ),
    "QuadrotorConfig": (
        forcegp.simulation.QuadrotorConfig,
        lambda: {"seconds": 1.0, "seed": 0, "noise": 0.1, "episodes": 1, "wind": 4.0, "lag": 0.06},
    ),
    "Robot.from_urdf": (forcegp.Robot.from_urdf, lambda: {"path": INPUTS.folder / "arm.urdf"}),
    "inverse_dynamics": (
        lambda **k: _robot().inverse_dynamics(**k),
        lambda: {"q": STATE[0], "v": STATE[1], "a": STATE[2]},
    ),
    "forward_dynamics": (
        lambda **k: _robot().forward_dynamics(**k),
        lambda: {"q": STATE[0], "v": STATE[1], "tau": STATE[2]},
    ),
    "mass_matrix": (lambda **k: _robot().mass_matrix(**k), lambda: {"q": STATE[0]}),
    "frame_pose": (lambda frame, q: _robot().frame_pose(frame, q), lambda: {"frame": "hand", "q": STATE[0]}),
    "with_armature": (lambda armature: _robot().with_armature(armature), lambda: {"armature": (0.1, 0.1, 0.1)}),
    "Model": (
        forcegp.Model,
        lambda: {
            "robot": _robot(),
            "contacts": (),
            "forces": (forcegp.forces.Actuation(),),
            "noise": None,
            "baumgarte": None,
        },
    ),
    "dynamics": (lambda **k: INPUTS.data.model.dynamics(**k).A, _states),
    "Contact": (_contact, lambda: {"frame": "hand", "point": (0.0, 0.0, 0.2), "surface": forcegp.Plane(**SURFACES)}),
    "Plane": (functools.partial(_surface, forcegp.Plane), lambda: dict(SURFACES)),
    "Sphere": (functools.partial(_surface, forcegp.Sphere), lambda: {"center": (0.0, 0.0, 0.1), "radius": 0.5}),
    "Baumgarte": (_baumgarte, lambda: {"omega": 5.0, "zeta": 1.0}),
    "viscous": (functools.partial(_forces, forcegp.Viscous), lambda: {"damping": 0.1}),
    "coulomb": (
        functools.partial(_forces, forcegp.Coulomb),
        lambda: {"level": 0.1, "velocity_scale": 0.01},
    ),
    "stribeck": (
        functools.partial(_forces, forcegp.Stribeck),
        lambda: {"level": 0.1, "breakaway": 0.1, "stribeck_velocity": 0.1},
    ),
    "constant": (functools.partial(_forces, forcegp.Offset), lambda: {"value": 0.1}),
    "direction": (functools.partial(_forces, forcegp.forces.DirectionalFriction), lambda: {"difference": 0.1}),
    "armature": (functools.partial(_forces, forcegp.Rotor), lambda: {"inertia": 0.1}),
    "rotor": (functools.partial(_forces, forcegp.forces.CoupledRotors), lambda: {"inertia": 0.1, "transmission": None}),
    "load": (functools.partial(_forces, forcegp.LoadFriction), lambda: {"level": 0.1, "factor": 0.1}),
    "spring": (functools.partial(_forces, forcegp.Spring), lambda: {"stiffness": 0.1, "rest": None}),
    "Normal": (
        lambda **k: _forces(forcegp.Viscous, damping=forcegp.Normal(**k)),
        lambda: {"mean": 0.1, "std": 0.1},
    ),
    "LogNormal": (
        lambda **k: _forces(forcegp.Coulomb, level=0.1, velocity_scale=forcegp.LogNormal(**k)),
        lambda: {"median": 0.1, "spread": 1.0},
    ),
    "RigidBodies": (lambda **k: _with(forcegp.RigidBodies(**k)), lambda: {"learn": ("hand",)}),
    "with_forces": (
        lambda **k: INPUTS.data.model.with_forces(k["forces"], noise=k["noise"]),
        lambda: {"forces": forcegp.Viscous(), "noise": 0.1},
    ),
    "parse_forces": (forces.parse_forces, lambda: {"expression": "gp:joint"}),
    "parse_evidence": (parse_evidence, lambda: {"words": "torques:mean=.4"}),
    "JointForces": (
        functools.partial(_prior, forcegp.JointForces),
        lambda: {"inputs": ("q",), "kernel": "linear", "angles": "plain"},
    ),
    "JointFriction": (functools.partial(_prior, forcegp.JointFriction), lambda: {"joints": None, "kernel": "friction"}),
    "PeriodicJointForces": (
        functools.partial(_prior, forcegp.forces.PeriodicJointForces),
        lambda: {"period": 6.28, "joints": None},
    ),
    "ToolForces": (
        functools.partial(_prior, forcegp.ToolForces),
        lambda: {
            "frame": "hand",
            "point": (0.0, 0.0, 0.0),
            "axes": "world",
            "inputs": ("velocity",),
            "torque": False,
            "contact": 0,
            "kernel": "linear",
        },
    ),
    "ContactFriction": (
        functools.partial(_prior, forcegp.ContactFriction),
        lambda: {
            "contact": 0,
            "axes": "isotropic",
            "load": False,
            "viscous": False,
            "inputs": ("velocity",),
            "kernel": None,
        },
    ),
    "Payload": (
        functools.partial(_forces, forcegp.Payload),
        lambda: {"link": "hand", "mass": 1.0, "center_of_mass": (0.0, 0.0, 0.1), "inertia": None},
    ),
    "Inducing": (
        functools.partial(_engine, forcegp.inference.Inducing),
        lambda: {"points": 5, "tolerance": 0.02, "refine": 0},
    ),
    "Preparation": (
        lambda **k: forcegp.data.Preparation(**k).apply(INPUTS.free),
        lambda: {"cutoff": 20.0, "delay": 0.0, "every": 1, "trim": 0.0, "differentiate": "q"},
    ),
    "ComputedTorque": (
        functools.partial(_control, forcegp.ComputedTorque, lambda: arm_model(0)),
        lambda: {**TRACKING, "on_failure": "raise"},
    ),
    "PDGravity": (
        functools.partial(_control, forcegp.control.PDGravity, _robot),
        lambda: {**TRACKING, "on_failure": "hold"},
    ),
    "ContactMonitor": (
        lambda **k: forcegp.ContactMonitor(arm_model(0), **k).run(INPUTS.free.q, INPUTS.free.v, INPUTS.free.u),
        lambda: {"dt": 0.01, "bandwidth": 5.0, "covariance": "noise"},
    ),
    "MPPI": (
        functools.partial(_control, forcegp.MPPI, lambda: INPUTS.predictor, _cost),
        lambda: {
            "dt": 0.01,
            "steps": 2,
            "torque_limits": 5.0,
            "samples": 3,
            "noise": None,
            "correlation": 0.5,
            "temperature": None,
            "functions": 0,
            "integrator": "rk4",
            "seed": 0,
            "on_failure": "raise",
        },
    ),
    "excitation": (
        forcegp.excitation,
        lambda: {
            "model": INPUTS.posterior.with_contacts(()),
            "seconds": 1.0,
            "limits": {"velocity": 1.0},
            "margin": 0.9,
            "start": None,
            "surfaces": None,
            "clearance": 0.05,
            "task": None,
            "rows": 5,
            "motions": 2,
            "seed": 0,
        },
    ),
    "score": (
        lambda **k: str(forcegp.score(**k)),
        lambda: {"models": INPUTS.posterior, "log": INPUTS.data, "horizons": (0.01,), "starts": 1},
    ),
    "check": (forcegp.check, lambda: {"dataset": INPUTS.free, "model": None, "preparation": None}),
    "fit (laws)": (
        lambda **k: fit(INPUTS.free.model.with_forces(forcegp.Viscous()), **k),
        lambda: {"dataset": INPUTS.free, "evidence": forcegp.Torques(), "rows": 50, "baseline": None},
    ),
    "Torques": (forcegp.Torques, lambda: {"noisy": "u", "robust": False, "mean": None}),
    "Motions": (forcegp.Motions, lambda: {"seconds": 1.0, "bodies": True}),
    "split_named": (forcegp.scores.split_named, lambda: {"dataset": INPUTS.free, "text": "blocks:5:3", "guard": 0.01}),
    "ColumnMapping": (
        forcegp.recordings.ColumnMapping,
        lambda: {
            "time": "t",
            "q": ("q",),
            "u": ("u",),
            "joints": ("a",),
            "unit": {},
            "sign": {},
            "step": None,
            "headerless": (),
        },
    ),
    "ImportOptions": (
        forcegp.recordings.ImportOptions,
        lambda: {"gap": None, "rate": "auto", "start": None, "end": None},
    ),
    "KukaSurfaceConfig": (
        forcegp.KukaSurfaceConfig,
        lambda: {
            "seconds": 1.0,
            "seed": 0,
            "noise": 0.1,
            "surface": "plane",
            "friction": None,
            "patch_factor": 1.0,
        },
    ),
    "Windows": (forcegp.Windows, lambda: {"seconds": 0.1, "nodes": 6, "signal": "q", "order": 2}),
    "Body": (forcegp.forces.Body, lambda: {"strength": 1.0, "parts": ("mass",)}),
    "load_posterior": (forcegp.load_posterior, lambda: {"path": INPUTS.folder / "carried", "contacts": None}),
    "Dataset.load": (forcegp.Dataset.load, lambda: {"path": INPUTS.folder / "train.h5"}),
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


TARGET = Target(CASES, check, fast=80, nightly=8000)
