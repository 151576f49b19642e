"""Learned forces as passive forces of MuJoCo, as one C function: no Python in its loop, any number of threads."""

import ctypes
import json
from pathlib import Path
from typing import Any

import mujoco as untyped
import numpy as np
import torch

from forcegp.codegen.c_writer import c_text, filled
from forcegp.codegen.library import load_library
from forcegp.errors import InvalidInput, NumericalError, require_type
from forcegp.posterior.prediction import require_actuated
from forcegp.posterior.predictor import Predictor

mujoco: Any = untyped
STATES = 5  # random ones, at which robots are compared
ALIKE = 1e-6  # relative difference of mass matrices and bias forces: MuJoCo diagonalises the inertias of a URDF


class MujocoForces:
    """What was learned of a robot's forces, as MuJoCo's passive force: `with MujocoForces(predictor, model): ...`.

    Within the context every `mj_step`, `mj_forward` and `mujoco.rollout` of this process adds them, on any number of
    threads; one at a time. `qacc` then is what `posterior.predict` returns.

    * predictor: without contacts, since those are MuJoCo's; its forces may depend on q and v.
    * model: an `MjModel` with the joints of the robot, its inertias and gravity, and no damping or friction of its own.

    Raises InvalidInput for models that do not fit, CompilerError without a C compiler; leaving the context
    NumericalError where a force was not finite meanwhile.
    """

    def __init__(self, predictor: Predictor, model: Any) -> None:
        require_type("predictor", predictor, Predictor, " : posterior.predictor()")
        require_type("model", model, mujoco.MjModel)
        predictor.posterior.model.robot.require_vectors("forces in MuJoCo")
        require_actuated(predictor.posterior)
        self.predictor, own = predictor, predictor.posterior.model
        if own.contacts:
            raise InvalidInput("MuJoCo has contacts of its own, and this model has one; posterior.with_contacts([]).")
        if predictor.code is None:
            raise InvalidInput("the predictor was made with compile=False; MuJoCo needs the C program.")
        places = _joints(model, own.robot.joint_names)
        _require_alike(predictor, model, places)
        code, nv = predictor.code, predictor.nv
        program = code.program("passive")
        if set(program.graph.inputs[2 * nv :]) & set(program.graph.needed(program.nodes)):
            raise InvalidInput("forces depend on u, which MuJoCo computes after passive ones; learn forces of q and v.")
        positions, velocities = (", ".join(map(str, numbers)) for numbers in zip(*places, strict=True))
        words = {"JOINTS": nv, "POSITIONS": positions, "VELOCITIES": velocities}
        source = code.c_source("passive", 1, filled(c_text(__name__, "passive_force.c"), words))
        include = f"-I{Path(mujoco.__file__).parent / 'include'}"
        key = json.dumps([source, mujoco.mj_versionString()])
        self._library = load_library("mujoco", key, lambda _: source, (include,))
        self._held = code.tables()
        self._tables = (ctypes.c_void_p * max(1, len(self._held)))(*(x.data_ptr() for x in self._held))

    def __enter__(self) -> "MujocoForces":
        if mujoco.get_mjcb_passive() is not None:
            raise InvalidInput("MuJoCo has a passive callback already; leave its context, or set_mjcb_passive(None).")
        self._library.evaluate(self._tables)
        kind = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
        mujoco.set_mjcb_passive(ctypes.cast(self._library.passive, kind))
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        mujoco.set_mjcb_passive(None)
        if self._library.evaluate(self._tables) and kind is None:
            raise NumericalError("a learned force was not finite: a state left what its tables hold, or diverged.")


def _joints(model: Any, names: tuple[str, ...]) -> list[tuple[int, int]]:
    places = []
    for name in names:
        number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
        scalar = [int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)]
        if number < 0 or int(model.jnt_type[number]) not in scalar:
            found = [model.joint(k).name for k in range(model.njnt)]
            raise InvalidInput(f"the MjModel has no hinge or slide {name!r}; its joints are {', '.join(found)}.")
        at = int(model.jnt_dofadr[number])
        stated = {"damping": model.dof_damping[at], "frictionloss": model.dof_frictionloss[at]}
        for what, value in (stated | {"stiffness": model.jnt_stiffness[number]}).items():
            if np.any(value):
                seen = f"joint {name} has {what} in the MjModel, which would act beside the learned forces"
                numbers = "model.dof_damping, dof_frictionloss, jnt_stiffness"
                raise InvalidInput(f"{seen}; set it to 0 ({numbers}), or learn with it as a known force.")
        places.append((int(model.jnt_qposadr[number]), at))
    return places


def _require_alike(predictor: Predictor, model: Any, places: list[tuple[int, int]]) -> None:
    """Raise InvalidInput where masses, inertias or gravity are not those of the robot."""
    data, known, generator = mujoco.MjData(model), predictor.posterior.model, np.random.default_rng(0)
    at_q, at_v = (list(each) for each in zip(*places, strict=True))
    for _ in range(STATES):
        data.qpos[at_q], data.qvel[at_v] = generator.uniform(-1.0, 1.0, (2, len(places)))
        mujoco.mj_forward(model, data)
        whole = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, whole)
        q, v = (torch.from_numpy(np.array(x)) for x in (data.qpos[at_q], data.qvel[at_v]))
        kinematics = known.robot.kinematics(q, v)
        M, h = known.mass_matrix_at(kinematics).numpy(), kinematics.bias_forces().numpy()
        pairs = ("mass matrix", M, whole[np.ix_(at_v, at_v)]), ("gravity or bias force", h, data.qfrc_bias[at_v])
        for what, own, other in pairs:
            apart = float(np.abs(own - other).max() / np.abs(own).max())
            if not apart <= ALIKE:
                seen = f"the {what} of the MjModel differs by {apart:.2g} (relative) from that of {known.robot.name}"
                raise InvalidInput(f"{seen}; load the same URDF, with the same gravity and armature (dof_armature).")
