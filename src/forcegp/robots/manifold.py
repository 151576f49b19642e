"""A base that moves freely, and positions that are points of a manifold instead of vectors.

q of a floating joint is the position of the child link (m) and the quaternion x, y, z, w; v its linear and angular
velocity in its own axes, as in Pinocchio (Sola, Deray & Atchuthan 2018; Hairer, Lubich & Wanner 2006, III.4, IV.4).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput

LARGEST_NORM_ERROR = 1e-4  # by so much the length of a quaternion may differ from 1: logs are rounded
QUATERNION = ("qx", "qy", "qz", "qw")
POSITIONS = ("x", "y", "z", *QUATERNION)
VELOCITIES = ("x", "y", "z", "rx", "ry", "rz")
TURN = slice(3, 7)
NEUTRAL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
_BERNOULLI = (1 / 2, 1 / 12, 0.0, -1 / 720, 0.0, 1 / 30240, 0.0, -1 / 1209600, 0.0, 1 / 47900160)
"""Of x / (1 - exp(-x)), from the first power on."""


@dataclass(frozen=True)
class Group:
    """A floating joint: its first entries of v and of q, and the first of its six bodies, the last with the links."""

    name: str
    row: int
    place: int
    body: int

    @property
    def rows(self) -> slice:
        """Its entries of v."""
        return slice(self.row, self.row + 6)

    @property
    def places(self) -> slice:
        """Its entries of q."""
        return slice(self.place, self.place + 7)

    @property
    def bodies(self) -> slice:
        """Its bodies."""
        return slice(self.body, self.body + 6)


@dataclass(frozen=True)
class ConfigurationSpace:
    """What positions q a robot with `nv` degrees of freedom can have, and how velocities v change them."""

    nv: int
    groups: tuple[Group, ...] = ()

    @property
    def nq(self) -> int:
        """Size of q."""
        return self.nv + len(self.groups)

    @property
    def single_rows(self) -> list[int]:
        """Entries of v of the joints of one degree of freedom."""
        grouped = {row for group in self.groups for row in range(*group.rows.indices(self.nv))}
        return [row for row in range(self.nv) if row not in grouped]

    @property
    def is_vector_space(self) -> bool:
        """Whether positions add up: q has the size of v, and q' = v."""
        return not self.groups

    def integrate(self, q: Tensor, step: Tensor) -> Tensor:
        """q (..., nq) after the constant velocity `step` (..., nv) has acted for one second; batches broadcast."""
        if not self.groups:
            return q + step
        q, step = self._broadcast(q, step)
        return self._joined(
            lambda rows, places: q[..., places] + step[..., rows],
            lambda group: integrated(q[..., group.places], step[..., group.rows]),
        )

    def difference(self, start: Tensor, end: Tensor) -> Tensor:
        """The velocity (..., nv) that leads from `start` to `end` in one second, by the shorter turn."""
        if not self.groups:
            return end - start
        start, end = self._broadcast(start, end)
        return self._joined(
            lambda _, places: end[..., places] - start[..., places],
            lambda group: difference(start[..., group.places], end[..., group.places]),
        )

    def tangent(self, q: Tensor) -> Tensor:
        """dq/dt = tangent v (..., nq, nv): the derivative of `integrate` at the step 0, for turns of any length."""
        unit = torch.eye(self.nv, dtype=q.dtype, device=q.device).expand(*q.shape[:-1], -1, -1)

        def moved(group: Group) -> Tensor:
            own, (linear, angular) = q[..., None, group.places], unit[..., group.rows].split(3, -1)
            rate = torch.cat([0.5 * angular, torch.zeros_like(angular[..., :1])], -1)
            turned = quaternion_product(own[..., TURN].expand(rate.shape), rate)
            return torch.cat([(pose(own)[0] @ linear[..., None])[..., 0], turned], -1)

        return self._joined(lambda rows, _: unit[..., rows], moved).mT

    def cotangent(self, q: Tensor, slope: Tensor) -> Tensor:
        """The gradient (..., nq) in q of what does not depend on lengths of turns, from its `slope` (..., nv)."""
        tangent = self.tangent(q)  # whose columns are orthogonal
        return (tangent @ (slope / (tangent * tangent).sum(-2))[..., None])[..., 0]

    def chart_velocity(self, step: Tensor, v: Tensor) -> Tensor:
        """Rate (..., nv) of the `step` from a fixed position where the robot there moves with velocity `v`."""
        if not self.groups:
            return v
        return self._joined(
            lambda rows, _: v[..., rows], lambda group: chart_velocity(step[..., group.rows], v[..., group.rows])
        )

    def chart_matrix(self, step: Tensor) -> Tensor:
        """The matrix (..., nv, nv) of `chart_velocity`: the derivative of a step in one more step from its end."""
        axes = torch.eye(self.nv, dtype=step.dtype, device=step.device).expand(*step.shape, -1)
        return self.chart_velocity(step[..., None, :].expand_as(axes), axes).mT

    def neutral(self) -> Float[Tensor, "nq"]:
        """q at 0 for every joint, bases upright at the origin."""
        return self._joined(
            lambda rows, _: torch.zeros(rows.stop - rows.start, dtype=torch.float64),
            lambda group: torch.tensor(NEUTRAL, dtype=torch.float64),
        )

    def normalized(self, q: Float[Tensor, "*batch nq"]) -> Float[Tensor, "*batch nq"]:
        """q with quaternions of length 1."""

        def unit(group: Group) -> Tensor:
            own = q[..., group.places]
            return torch.cat([own[..., :3], _unit(own[..., TURN])], -1)

        return self._joined(lambda _, places: q[..., places], unit)

    def check(self, q: Float[Tensor, "*batch nq"]) -> None:
        """Raise InvalidInput for a turn far from length 1, except inside `vmap` and where code is written."""
        for group in self.groups:
            length = torch.linalg.vector_norm(q.detach()[..., group.places][..., TURN], dim=-1).flatten()
            try:
                worst = float((length - 1.0).abs().max()) if len(length) else 0.0
            except (RuntimeError, InvalidInput):
                return
            if not worst <= LARGEST_NORM_ERROR:
                names = ", ".join(f"{group.name}.{name}" for name in POSITIONS[TURN])
                seen = f"q has ({names}) of length {float(length[(length - 1.0).abs().argmax()]):.4g}"
                advice = "check the order of the columns, or divide by the length with robot.normalized(q)."
                raise InvalidInput(f"{seen}; a turn has length 1: {advice}")

    def singles(self, q: Float[Tensor, "*batch nq"]) -> Float[Tensor, "*batch singles"]:
        """The positions of all joints of one degree of freedom."""
        return self._joined(lambda _, places: q[..., places], lambda group: q[..., :0])

    def _broadcast(self, *tensors: Tensor) -> list[Tensor]:
        batch = torch.broadcast_shapes(*(tensor.shape[:-1] for tensor in tensors))
        return [tensor.expand(*batch, -1) for tensor in tensors]

    def _joined(self, singles: Callable[[slice, slice], Tensor], of_group: Callable[[Group], Tensor]) -> Tensor:
        """Parts of all joints in order: `singles` of entries of v and q between the groups, and each group."""
        parts, row, place = [], 0, 0
        for group in self.groups:
            parts += [singles(slice(row, group.row), slice(place, group.place)), of_group(group)]
            row, place = group.rows.stop, group.places.stop
        return torch.cat([*parts, singles(slice(row, self.nv), slice(place, self.nq))], -1)


def pose(q: Float[Tensor, "*batch 7"]) -> tuple[Tensor, Tensor]:
    """Rotation (..., 3, 3) and translation (..., 3) of the child link. The length of a quaternion does not count."""
    x, y, z, w = _unit(q[..., TURN]).unbind(-1)
    rows = [
        *(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        *(2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
        *(2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
    ]
    return torch.stack(rows, -1).unflatten(-1, (3, 3)), q[..., :3]


def integrated(q: Float[Tensor, "*batch 7"], step: Float[Tensor, "*batch 6"]) -> Tensor:
    """q after the constant body velocity `step` has acted for one second."""
    linear, angular = step.split(3, -1)
    square = (angular * angular).sum(-1, keepdim=True)
    rotation, origin = pose(q)
    once = torch.linalg.cross(angular, linear)
    moved = linear + _versine(square) * once + _rest(square) * torch.linalg.cross(angular, once)
    quarter = 0.25 * square  # quaternions turn by half the angle
    half = torch.cat([0.5 * _sine(quarter) * angular, 1.0 - quarter * _versine(quarter)], -1)
    turned = quaternion_product(_unit(q[..., TURN]), half)
    return torch.cat([origin + (rotation @ moved[..., None])[..., 0], turned], -1)


def difference(start: Float[Tensor, "*batch 7"], end: Float[Tensor, "*batch 7"]) -> Tensor:
    """The body velocity that leads from `start` to `end` in one second, by the shorter turn."""
    (first, from_), (_, to) = pose(start), pose(end)
    conjugate = _unit(start[..., TURN]) * start.new_tensor([-1.0, -1.0, -1.0, 1.0])
    turn = quaternion_product(conjugate, _unit(end[..., TURN]))
    turn = torch.where(turn[..., 3:] < 0.0, -turn, turn)
    sines = (turn[..., :3] ** 2).sum(-1, keepdim=True)
    arc = _smooth(sines, _ARCSINE, lambda sine: torch.atan2(sine, turn[..., 3:]) / sine, small=1e-3)  # over its sine
    angular = 2.0 * arc * turn[..., :3]
    square, linear = (angular * angular).sum(-1, keepdim=True), (first.mT @ (to - from_)[..., None])[..., 0]
    once = torch.linalg.cross(angular, linear)
    return torch.cat([linear - 0.5 * once + _cotangent(square) * torch.linalg.cross(angular, once), angular], -1)


def chart_velocity(step: Float[Tensor, "*#batch 6"], v: Float[Tensor, "*#batch 6"]) -> Tensor:
    """d step / dt where `q0 integrated by step` moves with velocity v: ad / (1 - exp(-ad)) v, to the tenth power."""
    (along, turn), moved, cross = step.split(3, -1), v.split(3, -1), torch.linalg.cross
    total = torch.cat(moved, -1)
    for coefficient in _BERNOULLI:
        moved = cross(turn, moved[0]) + cross(along, moved[1]), cross(turn, moved[1])  # ad of SE(3)
        if coefficient:
            total = total + coefficient * torch.cat(moved, -1)
    return total


def quaternion_product(left: Float[Tensor, "*batch 4"], right: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Of quaternions x, y, z, w: the turn `right` in the axes that `left` has turned."""
    (a, s), (b, t) = (left[..., :3], left[..., 3:]), (right[..., :3], right[..., 3:])
    return torch.cat([s * b + t * a + torch.linalg.cross(a, b), s * t - (a * b).sum(-1, keepdim=True)], -1)


def _unit(turn: Tensor) -> Tensor:
    return turn / torch.linalg.vector_norm(turn, dim=-1, keepdim=True)


SMALL = 0.05
"""Squares of angles below which series are summed: there the closed forms cancel, and their gradients end at 0."""
_SINE = (1.0, -1 / 6, 1 / 120, -1 / 5040, 1 / 362880, -1 / 39916800)
_VERSINE = (1 / 2, -1 / 24, 1 / 720, -1 / 40320, 1 / 3628800, -1 / 479001600)
_REST = (1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800, -1 / 6227020800)
_COTANGENT = (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000)
_ARCSINE = (1.0, 1 / 6, 3 / 40, 15 / 336, 105 / 3456, 945 / 42240, 10395 / 599040)


def _smooth(square: Tensor, series: Sequence[float], exact: Callable[[Tensor], Tensor], small: float = SMALL) -> Tensor:
    """A function of t^2 that is smooth at 0: `exact` of t, or below `small` the power series in t^2."""
    large, total = square > small, torch.full_like(square, series[-1])
    for coefficient in reversed(series[:-1]):
        total = total * square + coefficient
    # the branch that is not taken has a finite gradient, too
    return torch.where(large, exact(torch.where(large, square, 1.0).sqrt()), total)


_sine = partial(_smooth, series=_SINE, exact=lambda t: t.sin() / t)
"""sin t / t."""
_versine = partial(_smooth, series=_VERSINE, exact=lambda t: 2.0 * ((0.5 * t).sin() / t) ** 2)
"""(1 - cos t) / t^2."""
_rest = partial(_smooth, series=_REST, exact=lambda t: (t - t.sin()) / t**3)
"""(t - sin t) / t^3."""
_cotangent = partial(_smooth, series=_COTANGENT, exact=lambda t: (1.0 - 0.5 * t / (0.5 * t).tan()) / t**2)
"""(1 - t/2 cot(t/2)) / t^2."""
