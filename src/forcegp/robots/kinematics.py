"""One kinematics pass over a batch of states, from which every dynamic and geometric quantity is read.

With twists S = [[w]x, v], pseudo-inertias P in the world and accelerations A_k = T''_k T_k^-1: M_ij = <S_i, S_j P_c,j>
for i above j, tau_i = <S_i, sum_k A_k P_k> (Featherstone 2008, ch. 5 and 6). Tensors over bodies are (n, rows, columns,
batch): a trailing batch is vectorised 4 to 5 times faster than `torch.bmm`. No branches on values.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput, NumericalError
from forcegp.robots.arguments import JointValues, Vector, broadcast_batch, checked_point
from forcegp.robots.inertia import pseudo_inertia_of_standard, standard_basis
from forcegp.robots.layout import WORLD
from forcegp.robots.manifold import Group, pose
from forcegp.robots.structure import Forces, MassMatrix, RobotStructure, Tree

Bodies = Float[Tensor, "n 4 4 batch"]
"""A 4x4 matrix of every body: its pose or its pseudo-inertia."""
Twists = Float[Tensor, "n 3 4 batch"]
"""A twist, or an acceleration, of every body."""
Vectors = Float[Tensor, "n 6 batch"]
"""A twist of every body as the vector [w; v]."""

NOT_POSITIVE_DEFINITE = (
    "the mass matrix is not positive definite: either q or the inertial parameters hold NaN or infinity, or "
    "all mass that a joint moves lies on its axis; check the inputs, or give that joint armature."
)


def product(
    left: Float[Tensor, "*#joints rows inner #batch"], right: Float[Tensor, "*#joints inner columns #batch"]
) -> Float[Tensor, "*joints rows columns batch"]:
    """Matrix product with the batch in the last dimension."""
    return (left.unsqueeze(-2) * right.unsqueeze(-4)).sum(-3)


def over_tree(matrix: Float[Tensor, "n n"], values: Float[Tensor, "n rows columns batch"]) -> Tensor:
    """``sum_k matrix[i, k] values[k]``."""
    return (matrix @ values.flatten(1)).view_as(values)


def of_bodies(tree: Tree, values: Float[Tensor, "nv batch"]) -> Float[Tensor, "n batch"]:
    """Velocities or accelerations of the joints of all bodies: ``G values``."""
    return tree.coupling @ values if tree.coupled else values


def of_joints(tree: Tree, values: Float[Tensor, "batch n *rest"]) -> Float[Tensor, "batch nv *rest"]:
    """Forces at the joints of all bodies as forces at those with a coordinate: ``G^T values``."""
    return (values.movedim(1, -1) @ tree.coupling).movedim(-1, 1) if tree.coupled else values


def body_poses(tree: Tree, q: Float[Tensor, "nq batch"]) -> Bodies:
    """Pose T of every body frame in the world."""
    single = of_bodies(tree, q if tree.positions is None else q[tree.positions])
    single = single + tree.shift if tree.coupled else single
    local = torch.addcmul(tree.rest, tree.sine, single.sin()[:, None, None])
    local = torch.addcmul(local, tree.cosine, single.cos()[:, None, None])
    if not tree.all_revolute:
        local = torch.addcmul(local, tree.slide, single[:, None, None])
    if tree.groups:
        local = torch.cat(_replaced(tree, local, lambda group: product(tree.rest[group.bodies], _group_pose(group, q))))
    poses: list[Tensor] = []
    for own, parent in zip(local, tree.parents, strict=True):
        poses.append(own if parent == WORLD else product(poses[parent], own))
    return torch.stack(poses)


def joint_twists(tree: Tree, poses: Bodies) -> tuple[Vectors, Twists]:
    """Twist of each body per unit velocity of its joint, as a vector [w; v] and as the matrix S = [[w]x, v]."""
    axis, point = poses[:, :3, 2], poses[:, :3, 3]
    moment = torch.linalg.cross(point, axis, dim=1)
    if not tree.all_revolute:
        moment, axis = tree.revolute * moment + (1.0 - tree.revolute) * axis, tree.revolute * axis
    vectors = torch.cat([axis, moment], dim=1)
    if tree.groups:
        vectors = torch.cat(_replaced(tree, vectors, lambda group: _group_vectors(group, poses[group.bodies.stop - 1])))
    return vectors, (tree.twist_basis @ vectors).unflatten(1, (3, 4))


def _replaced(tree: Tree, values: Tensor, of_group: Callable[[Group], Tensor]) -> list[Tensor]:
    """Values of the bodies in order, where those of groups are `of_group`."""
    parts, last = [], 0
    for group in tree.groups:
        own = of_group(group)
        parts += [values[last : group.bodies.start].expand(-1, *own.shape[1:]), own]
        last = group.bodies.stop
    return [*parts, values[last:]]


def _group_pose(group: Group, q: Float[Tensor, "nq batch"]) -> Float[Tensor, "1 4 4 batch"]:
    rotation, origin = pose(q[group.places].mT)
    upper = torch.cat([rotation, origin[..., None]], -1).movedim(0, -1)
    return torch.cat([upper, q.new_tensor([0.0, 0.0, 0.0, 1.0])[None, :, None].expand(1, 4, q.shape[-1])])[None]


def _group_vectors(group: Group, body: Float[Tensor, "4 4 batch"]) -> Float[Tensor, "rows 6 batch"]:
    """[w; v] per unit velocity of the body in its own axes."""
    rotation, origin = body[:3, :3], body[:3, 3]
    axes = rotation.movedim(1, 0)  # (3, 3, batch), one axis in the world each
    moments = torch.linalg.cross(origin.expand_as(axes), axes, dim=1)
    return torch.cat([torch.cat([torch.zeros_like(axes), axes], dim=1), torch.cat([axes, moments], dim=1)])


def body_accelerations(
    tree: Tree, twists: Twists, v: Float[Tensor, "n batch"], a: Float[Tensor, "n batch"] | None = None
) -> Twists:
    """A = A_p + (V_p + V) S v + S a of all bodies, without gravity, from their twists; ``a`` of None is 0."""
    moving = twists * v[:, None, None]
    step = product(over_tree(tree.velocity_sum, moving)[:, :, :3], moving)
    if a is not None:
        step = torch.addcmul(step, twists, a[:, None, None])
    return over_tree(tree.ancestors, step)


def world_inertias(poses: Bodies, inertias: Float[Tensor, "n 4 4 #batch"]) -> Bodies:
    """Pseudo-inertias ``T P T^T``."""
    return product(product(poses, inertias), poses.transpose(1, 2))


@dataclass(frozen=True, eq=False)
class Kinematics:
    """Poses, twists and accelerations at states (q, v), made by ``robot.kinematics(q, v)``; its fields are internal.

    Methods are differentiable, broadcast, and raise InvalidInput where they need velocities and it was made without.
    """

    robot: RobotStructure
    batch_shape: torch.Size
    poses: Tensor  # (n, 4, 4, batch), with n bodies
    vectors: Tensor  # (n, 6, batch)
    twists: Tensor  # (n, 3, 4, batch)
    v: Tensor | None  # (n, batch), of the joints of the bodies

    @classmethod
    def of(cls, robot: RobotStructure, q: Tensor, v: Tensor | None) -> "Kinematics":
        """Kinematics at checked q (*batch, nq) and v (*batch, nv)."""
        batch = q.shape[:-1]
        poses = body_poses(robot.tree, _columns(q, batch))
        vectors, twists = joint_twists(robot.tree, poses)
        v = None if v is None else of_bodies(robot.tree, _columns(v, batch))
        return cls(robot, batch, poses, vectors, twists, v)

    @cached_property
    def accelerations(self) -> Twists:
        """Of the bodies at zero joint acceleration and without gravity."""
        return self._accelerations(None)

    @cached_property
    def inertias(self) -> Bodies:
        """Pseudo-inertias of the bodies in the world."""
        return world_inertias(self.poses, self.robot.tree.inertias)

    def mass_matrix(self) -> MassMatrix:
        """Mass matrix M (..., nv, nv) in kg m^2 or kg, armature on the diagonal."""
        return self._rows(self._mass_matrix(self.inertias))

    def bias_forces(self) -> Forces:
        """Coriolis, centrifugal and gravity forces (..., nv) in Nm or N: the tau that gives zero acceleration."""
        return self._rows(self._bias_forces(self.inertias))

    def mass_matrix_and_bias(self) -> tuple[MassMatrix, Forces]:
        """:meth:`mass_matrix` and :meth:`bias_forces`."""
        return self.mass_matrix(), self.bias_forces()

    def gravity_forces(self) -> Forces:
        """Joint forces (..., nv) in Nm or N that hold the robot still."""
        tree = self.robot.tree
        first_moments = over_tree(tree.descendants, self.inertias[..., 3:, :])
        forces = -(product(self.twists, first_moments)[:, :, 0] * tree.gravity[:, None]).sum(1).mT
        return self._rows(of_joints(tree, forces))

    def inverse_dynamics(self, a: JointValues) -> Forces:
        """Joint forces (..., nv) that give the accelerations ``a`` (..., nv): ``M a + bias``."""
        tree, a = self.robot.tree, self._given("a", a)
        forces = self._joint_forces(self._accelerations(a), self.inertias)
        return self._rows(forces + tree.armature * a.mT if tree.has_armature else forces)

    def forward_dynamics(self, tau: JointValues) -> Forces:
        """Accelerations (..., nv) under the joint forces ``tau`` (..., nv): ``M^-1 (tau - bias)``."""
        net = self._given("tau", tau).mT - self._bias_forces(self.inertias)
        try:
            factor = torch.linalg.cholesky(self._mass_matrix(self.inertias))
        except torch.linalg.LinAlgError as error:
            raise NumericalError(NOT_POSITIVE_DEFINITE) from error
        return self._rows(torch.cholesky_solve(net[..., None], factor).squeeze(-1))

    def torque_regressor(self, a: Float[Tensor, "*batch nv"]) -> Float[Tensor, "... nv bodies parameters"]:
        """Joint forces per unit of the standard parameters of each body (..., nv, bodies, 10), armature left out.

        A body is what a joint moves as one; parameters are in the frame of the child link (`inertia.standard_basis`).
        """
        tree, accelerations = self.robot.tree, self._accelerations(self._given("a", a))
        frames = product(self.poses, self._child_frames()[..., None])
        basis, columns = standard_basis(self.robot.device), []
        for k in range(len(frames)):  # tau_i = tr((S_i T)^T (A_k - g) T P), P row by row
            frame = frames[k : k + 1]
            left, right = product(self.twists, frame), product(accelerations[k : k + 1] - tree.fall, frame)
            gathered = product(left.transpose(1, 2), right) * tree.descendants[:, k, None, None, None]
            columns.append((basis.mT @ gathered.flatten(1, 2)).permute(2, 0, 1))
        return self._rows(of_joints(tree, torch.stack(columns, dim=2)))

    def dynamics_of_bodies(self, parameters: Float[Tensor, "bodies 10"]) -> tuple[MassMatrix, Forces]:
        """Mass matrix and bias forces for standard parameters of the bodies, which no body need have."""
        frames = self._child_frames()
        inertias = world_inertias(self.poses, (frames @ pseudo_inertia_of_standard(parameters) @ frames.mT)[..., None])
        return self._rows(self._mass_matrix(inertias)), self._rows(self._bias_forces(inertias))

    def frame_pose(self, frame: str) -> Float[Tensor, "... 4 4"]:
        """Pose (..., 4, 4) of a link frame in the world, position in m."""
        body, offset = self.robot.frame(frame)
        if body == WORLD:
            return offset.repeat(*self.batch_shape, 1, 1)
        return self._rows(product(self.poses[body], offset[..., None]).movedim(-1, 0))

    def frame_jacobian(self, frame: str, point: Vector | None = None) -> Float[Tensor, "... 6 nv"]:
        """Jacobian (..., 6, nv) of a ``point`` (3,) fixed in ``frame`` (m), world axes, rows [linear; angular]."""
        body, position = self._world_point(frame, point)
        if body == WORLD:
            return self.twists.new_zeros(*self.batch_shape, 6, self.robot.nv)
        jacobian = torch.cat([product(self.twists, position)[:, :, 0], self.vectors[:, :3]], dim=1)
        tree = self.robot.tree
        jacobian = (jacobian * tree.descendants[:, body, None, None]).permute(2, 1, 0)
        return self._rows(jacobian @ tree.coupling if tree.coupled else jacobian.contiguous())

    def frame_bias_acceleration(self, frame: str, point: Vector | None = None) -> Float[Tensor, "... 6"]:
        """Jdot v (..., 6) of a ``point`` fixed in ``frame``: [linear; angular], m/s^2 and rad/s^2, no gravity."""
        body, position = self._world_point(frame, point)
        accelerations = self.accelerations
        if body == WORLD:
            return self.twists.new_zeros(*self.batch_shape, 6)
        linear = product(accelerations[body], position)[:, 0]
        # A = [dw/dt]x + [w]x [w]x, whose second part is symmetric: the basis reads dw/dt off the antisymmetric half
        angular = 0.5 * (self.robot.tree.twist_basis[:, :3].mT @ accelerations[body].flatten(0, 1))
        return self._rows(torch.cat([linear, angular]).mT)

    def frame_motion(self, frame: str, point: Vector) -> tuple[Tensor, Tensor, Tensor]:
        """Pose of a frame, and Jacobian and bias acceleration of a point of it."""
        return self.frame_pose(frame), self.frame_jacobian(frame, point), self.frame_bias_acceleration(frame, point)

    def _rows(self, values: Tensor) -> Tensor:
        """Give values (batch, ...) their batch dimensions back."""
        return values.reshape(*self.batch_shape, *values.shape[1:])

    def _child_frames(self) -> Tensor:
        return torch.as_tensor(self.robot.layout.child_frames, device=self.robot.device)

    def _mass_matrix(self, inertias: Bodies) -> Float[Tensor, "batch nv nv"]:
        tree = self.robot.tree
        momenta = product(self.twists, over_tree(tree.descendants, inertias))
        # <[[w]x, v], F> is the product of the vector [w; v] with these six combinations of the entries of F
        momenta = tree.twist_basis.mT @ momenta.flatten(1, 2)
        above = product(self.vectors, momenta.transpose(0, 1))
        # right where the row's joint moves the column's body; elsewhere the transpose is, or neither on other branches
        out = torch.where(tree.is_above, above, above.transpose(0, 1))
        out = out if tree.is_chain else out * tree.related
        if tree.coupled:
            out = torch.einsum("ki,klb,lj->ijb", tree.coupling, out, tree.coupling)
        if tree.has_armature:
            out = out + torch.diag(tree.armature)[..., None]
        return out.movedim(-1, 0).contiguous()

    def _bias_forces(self, inertias: Bodies) -> Float[Tensor, "batch nv"]:
        return self._joint_forces(self.accelerations, inertias)

    def _joint_forces(self, accelerations: Twists, inertias: Bodies) -> Float[Tensor, "batch nv"]:
        """Joint forces under which the bodies accelerate so against gravity (without armature)."""
        tree = self.robot.tree
        wrenches = over_tree(tree.descendants, product(accelerations - tree.fall, inertias))
        return of_joints(tree, (self.twists * wrenches).sum((1, 2)).mT)

    def _accelerations(self, a: Tensor | None) -> Twists:
        if self.v is None:
            raise InvalidInput("accelerations need velocities; make the kinematics with robot.kinematics(q, v).")
        tree = self.robot.tree
        return body_accelerations(tree, self.twists, self.v, None if a is None else of_bodies(tree, a))

    def _world_point(self, frame: str, point: Vector | None) -> tuple[int, Tensor]:
        """The body of ``frame``, and the point (4, 1, batch) of it in the world."""
        body, offset = self.robot.frame(frame)
        local = offset[:, 3:]
        if point is not None:
            local = offset[:, :3] @ checked_point(point, self.robot.device)[:, None] + local
        return body, local[..., None] if body == WORLD else product(self.poses[body], local[..., None])

    def _given(self, name: str, values: JointValues) -> Float[Tensor, "nv batch"]:
        """Values at the joints, one for each state or one for all. Raises InvalidInput for others."""
        values = self.robot.checked_input(name, values)
        if broadcast_batch({"the states": self.batch_shape, name: values.shape[:-1]}) != self.batch_shape:
            raise InvalidInput(f"{name} has shape {tuple(values.shape)} for states {tuple(self.batch_shape)}.")
        return _columns(values, self.batch_shape)


def _columns(values: Tensor, batch: torch.Size) -> Tensor:
    """(..., nv) broadcast to (*batch, nv) -> (nv, flattened batch), contiguous."""
    return values.expand(*batch, -1).reshape(batch.numel(), values.shape[-1]).mT.contiguous()
