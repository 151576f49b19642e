"""MuJoCo's numbers in our coordinates: quaternions x, y, z, w, and free bodies that move in their own axes."""

import mujoco as untyped
import numpy as np
import torch
from tests.robots.random_positions import random_positions

mujoco = untyped


class MujocoOracle:
    """A model, and the joints of its coordinates: `followers` maps joints to (driver, multiplier, offset)."""

    def __init__(self, model, followers=None):
        self.model, self.data = model, mujoco.MjData(model)
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        model.dof_damping[:], model.jnt_stiffness[:] = 0.0, 0.0
        self.followers = {model.joint(name).id: (model.joint(x[0]).id, *x[1:]) for name, x in (followers or {}).items()}
        kept = [k for k in range(model.nv) if model.dof_jntid[k] not in self.followers]
        self.G = np.zeros((model.nv, len(kept)))
        for column, dof in enumerate(kept):
            self.G[dof, column] = 1.0
        for joint, (driver, ratio, _) in self.followers.items():
            self.G[model.jnt_dofadr[joint], kept.index(model.jnt_dofadr[driver])] = ratio

    def at(self, q, v):
        """Set the state (nq,), (nv,) of forcegp."""
        model, qpos, k = self.model, np.zeros(self.model.nq), 0
        for joint in range(model.njnt):
            place = model.jnt_qposadr[joint]
            if joint in self.followers:
                continue
            if model.jnt_type[joint] == 0:
                qpos[place : place + 7] = q[[k, k + 1, k + 2, k + 6, k + 3, k + 4, k + 5]]
                k += 7
            elif model.jnt_type[joint] == 1:
                qpos[place : place + 4] = q[[k + 3, k, k + 1, k + 2]]
                k += 4
            else:
                qpos[place] = q[k]
                k += 1
        for joint, (driver, ratio, offset) in self.followers.items():
            qpos[model.jnt_qposadr[joint]] = ratio * qpos[model.jnt_qposadr[driver]] + offset
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(model, self.data)
        self.T, self.drift = self.G.copy(), np.zeros(model.nv)
        for joint in np.flatnonzero(model.jnt_type == 0):
            rows = slice(model.jnt_dofadr[joint], model.jnt_dofadr[joint] + 3)
            R = self.data.xmat[model.jnt_bodyid[joint]].reshape(3, 3)
            self.T[rows] = R @ self.T[rows]
            own = self.G @ v
            self.drift[rows] = R @ np.cross(own[rows.stop : rows.stop + 3], own[rows])
        self.data.qvel[:] = self.T @ v
        mujoco.mj_forward(model, self.data)

    def mass_matrix(self):
        M = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self.data, M)
        return self.T.T @ M @ self.T

    def inverse_dynamics(self, a):
        """Joint forces of forcegp that give its acceleration a."""
        self.data.qacc[:] = self.T @ a + self.drift
        mujoco.mj_inverse(self.model, self.data)
        return self.T.T @ self.data.qfrc_inverse


def compiled(text):
    """The model of MJCF text without the meshes that are not there."""
    spec = mujoco.MjSpec.from_string(text)
    for geom in spec.geoms:
        if geom.meshname:
            geom.type, geom.meshname, geom.size, geom.mass = mujoco.mjtGeom.mjGEOM_SPHERE, "", [0.1, 0, 0], 0.0
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    return spec.compile()


def states(robot, rows=4, seed=0):
    generator = torch.Generator().manual_seed(seed)
    v, a = torch.randn(2, rows, robot.nv, dtype=torch.float64, generator=generator)
    return random_positions(robot, generator, rows), v, a
