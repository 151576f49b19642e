"""Pinocchio with forcegp's joint order and one coordinate per joint: the independent answer to compare with."""

import numpy as np
import pinocchio as pin

from forcegp.robots import Robot

WORLD_ALIGNED = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


class Oracle:
    """Dynamics of a URDF text, in the joint order of ``robot``, for single states given as NumPy arrays (nv,)."""

    def __init__(self, text: str, robot: Robot):
        self.model = pin.buildModelFromXML(text)
        if robot.locked:
            self.model = self._reduced(robot.locked)
        self.model.gravity.linear = robot.gravity.numpy()
        self.ids = [self.model.getJointId(name) for name in robot.joint_names]
        self.columns = np.array([self.model.joints[i].idx_v for i in self.ids])
        self.model.armature = self._theirs(robot.armature.numpy())
        self.data = self.model.createData()

    def _reduced(self, locked):
        q = pin.neutral(self.model)
        for name, position in locked.items():
            self._place(q, self.model.joints[self.model.getJointId(name)], position)
        return pin.buildReducedModel(self.model, [self.model.getJointId(name) for name in locked], q)

    def _theirs(self, values: np.ndarray) -> np.ndarray:
        out = np.zeros(self.model.nv)
        out[self.columns] = values
        return out

    @staticmethod
    def _place(q: np.ndarray, joint, position: float) -> None:
        # a continuous joint is a point on the unit circle there
        q[joint.idx_q : joint.idx_q + joint.nq] = position if joint.nq == 1 else [np.cos(position), np.sin(position)]

    def configuration(self, q: np.ndarray) -> np.ndarray:
        out = pin.neutral(self.model)
        for index, position in zip(self.ids, q, strict=True):
            self._place(out, self.model.joints[index], position)
        return out

    def mass_matrix(self, q):
        upper = np.triu(pin.crba(self.model, self.data, self.configuration(q)))
        return (upper + np.triu(upper, 1).T)[np.ix_(self.columns, self.columns)]

    def bias_forces(self, q, v):
        return pin.nonLinearEffects(self.model, self.data, self.configuration(q), self._theirs(v))[self.columns]

    def gravity_forces(self, q):
        return pin.computeGeneralizedGravity(self.model, self.data, self.configuration(q))[self.columns]

    def inverse_dynamics(self, q, v, a):
        return pin.rnea(self.model, self.data, self.configuration(q), self._theirs(v), self._theirs(a))[self.columns]

    def forward_dynamics(self, q, v, tau):
        args = self.configuration(q), self._theirs(v), self._theirs(tau)
        return pin.aba(self.model, self.data, *args)[self.columns]

    def forward_dynamics_derivatives(self, q, v, tau):
        """Jacobians (nv, nv) of the acceleration with respect to q, v and tau."""
        args = self.configuration(q), self._theirs(v), self._theirs(tau)
        pin.computeABADerivatives(self.model, self.data, *args)
        square, inverse = np.ix_(self.columns, self.columns), np.triu(self.data.Minv)
        inverse = inverse + np.triu(inverse, 1).T
        return self.data.ddq_dq[square], self.data.ddq_dv[square], inverse[square]

    def torque_regressor(self, q, v, a):
        """Columns per body (nv, bodies, 10) of tau in [m, m c, Ixx, Ixy, Iyy, Ixz, Iyz, Izz] at the joint's origin."""
        args = self.configuration(q), self._theirs(v), self._theirs(a)
        regressor = pin.computeJointTorqueRegressor(self.model, self.data, *args)
        return regressor.reshape(self.model.nv, -1, 10)[self.columns]

    def carrier(self, link: str):
        """Index of the joint that carries a link (0: the world), and the link's placement (4, 4) in its frame."""
        frame = self.model.frames[self.model.getFrameId(link, pin.FrameType.BODY)]
        return frame.parentJoint, frame.placement.homogeneous

    def with_point(self, link: str, point: np.ndarray) -> int:
        """A new frame of the axes of ``link`` at ``point`` in it."""
        frame = self.model.frames[self.model.getFrameId(link, pin.FrameType.BODY)]
        placement = frame.placement * pin.SE3(np.eye(3), np.asarray(point, dtype=float))
        added = pin.Frame(f"point {self.model.nframes}", frame.parentJoint, placement, pin.FrameType.OP_FRAME)
        index = self.model.addFrame(added, False)
        self.data = self.model.createData()
        return index

    def frame(self, q, v, index: int):
        """Pose (4, 4), Jacobian (6, nv) and classical acceleration (6,) at zero joint acceleration."""
        q, v = self.configuration(q), self._theirs(v)
        jacobian = pin.computeFrameJacobian(self.model, self.data, q, index, WORLD_ALIGNED)[:, self.columns]
        pin.forwardKinematics(self.model, self.data, q, v, np.zeros(self.model.nv))
        pose = pin.updateFramePlacement(self.model, self.data, index).homogeneous
        return pose, jacobian, pin.getFrameClassicalAcceleration(self.model, self.data, index, WORLD_ALIGNED).vector
