"""Predictions as values: of accelerations, of forces, also given accelerations, and of the u that makes them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, NumericalError
from forcegp.evidence.likelihood import FAR_FROM_SURFACE, observed
from forcegp.forces import Actuation
from forcegp.integration.integrators import find_roots, rows_jacobian
from forcegp.mechanics import AffineMap, ConstrainedDynamics
from forcegp.model import Model
from forcegp.posterior.fitted import DEVIATIONS
from forcegp.robots.arguments import broadcast_batch, real_tensor, require_finite
from forcegp.summary import Summary, listed

ROWS_PER_BLOCK = 4096  # states that are predicted at once; bounds the memory of long recordings
Rows = Float[Tensor, "rows nv"]
"""One number per state and joint."""
Positions = Float[Tensor, "rows nq"]
"""One state per row; more numbers than joints where some have a quaternion, or cos and sin."""
Inputs = Float[Tensor, "rows nu"]
"""One number per state and input of the system."""
Array = Tensor | np.ndarray | Sequence[Any]


@dataclass(frozen=True, eq=False, repr=False)
class Gaussian(Summary):
    """A normal distribution per state; `covariance` is None where only the mean was asked for."""

    mean: Float[Tensor, "*batch k"]
    covariance: Float[Tensor, "*batch k k"] | None

    @property
    def variance(self) -> Float[Tensor, "*batch k"]:
        """Diagonal of the covariance (..., k)."""
        if self.covariance is None:
            raise InvalidInput("only the mean was predicted; call predict(..., covariance=True)")
        return self.covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0.0)

    @property
    def std(self) -> Float[Tensor, "*batch k"]:
        """Standard deviation of each entry (..., k)."""
        return self.variance.sqrt()

    def through(
        self, matrix: Float[Tensor, "*batch m k"], offset: Float[Tensor, "*batch m"] | None = None
    ) -> "Gaussian":
        """The distribution of offset + matrix x, whose covariance is symmetric, also where rounding is not."""
        mean, covariance = (matrix @ self.mean[..., None])[..., 0], None
        if self.covariance is not None:
            covariance = matrix @ self.covariance @ matrix.mT
            covariance = 0.5 * (covariance + covariance.mT)
        return Gaussian(mean if offset is None else offset + mean, covariance)

    def entries(self, which: slice) -> "Gaussian":
        """The distribution of some entries."""
        return Gaussian(self.mean[..., which], None if self.covariance is None else self.covariance[..., which, which])

    @override
    def facts(self) -> dict[str, object]:
        """Shape, and the largest mean and standard deviation."""
        facts: dict[str, object] = {"batch": tuple(self.mean.shape[:-1]), "entries": self.mean.shape[-1]}
        if self.mean.numel() and not self.mean.is_meta:
            facts["largest mean"] = f"{float(self.mean.detach().abs().amax()):.3g}"
            if self.covariance is not None:
                facts["largest std"] = f"{float(self.std.detach().amax()):.3g}"
        return facts | ({"covariance": "only the mean was predicted"} if self.covariance is None else {})


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Gaussian):
    """The acceleration (`mean` in rad/s^2 or m/s^2, `covariance`), without measurement noise, and the forces behind it.

    `multiplier` is lambda (..., m); `contact_force` the world force on the robot at each contact in turn (..., 3 m) in
    N; `unknown_force` Q_U (..., nv) in Nm or N, without a mean with Q_K in it; None where a model predicts no forces.
    Along contact normals accelerations show nothing: where no force sensor was learned from all three rest on the prior
    alone there. Forces of contacts hold the noise of joint forces. `noise_covariance` (...,
    nv, nv) is that of a measurement, at the root-mean-square level where that differed between rows.
    """

    multiplier: Gaussian | None
    contact_force: Gaussian | None
    unknown_force: Gaussian | None
    noise_covariance: Float[Tensor, "*batch nv nv"]
    frames: tuple[str, ...] = ()
    """Where each contact is."""
    off: Float[Tensor, "*batch m"] | None = None
    """How far the point of each contact is off its surface [m], where the model holds it; 0 where a switch lets go."""
    unseen: Float[Tensor, "*batch m"] | None = None
    """Share of the variance of each multiplier that is a prior on what the log did not show, 0 to 1."""

    def force_at(self, frame: str) -> Gaussian:
        """The world force on the robot at the contacts of a frame together (..., 3) in N."""
        if self.contact_force is None or frame not in self.frames:
            there = ", ".join(dict.fromkeys(self.frames)) or "none"
            raise InvalidInput(f"there is no contact at {frame!r} whose force is predicted; there is {there}.")
        own = torch.tensor([[float(each == frame) for each in self.frames]])
        return self.contact_force.through(torch.kron(own, torch.eye(3)).to(self.mean))

    @override
    def facts(self) -> dict[str, object]:
        """Of the acceleration, and which forces there are."""
        forces = [name for name in ("multiplier", "contact_force", "unknown_force") if getattr(self, name) is not None]
        facts = {**super().facts(), "forces": listed(forces)}
        if self.off is not None and not self.off.is_meta and bool((self.off.abs() > FAR_FROM_SURFACE).any()):
            facts["off a surface"] = f"by up to {float(self.off.abs().max()):.3g} m"
        if self.unseen is not None and not self.unseen.is_meta and bool(self.unseen.any()):
            facts["variance of contact forces not seen by the log"] = f"{float(self.unseen.mean()):.0%}"
        return facts

    @property
    def acceleration(self) -> Gaussian:
        """`mean` and `covariance` under their full name."""
        return Gaussian(self.mean, self.covariance)

    @property
    def measurement(self) -> Gaussian:
        """The acceleration as a sensor with the model's noise would report it."""
        return Gaussian(self.mean, None if self.covariance is None else self.covariance + self.noise_covariance)


def without_past(
    posterior: Any, q: Positions, v: Rows, u: Inputs, covariance: bool, a: Rows | None = None
) -> Prediction:
    """The prediction for one block of rows whose u lacks what laws remember, which then counts as unknown.

    Its mean and variance are those of the training rows that moved the same way; a force is linear in it.
    """
    model, training = posterior.model, posterior.training
    memory, first = model.memory, model.memory_column
    mean, variance = memory.likely(v, training.u[:, first : first + len(memory.names)], training.v)

    def at(z: Float[Tensor, "rows m"], covariance: bool) -> Prediction:
        return posterior.predict_rows(q, v, torch.cat([u[:, :first], z, u[:, first:]], dim=1), covariance, a)

    found = at(mean, covariance)
    if not covariance:
        return found
    moved = [at(mean + unit, False) for unit in torch.eye(len(memory.names)).to(mean)]

    def wider(name: str) -> Gaussian | None:
        here: Gaussian | None = getattr(found, name)
        if here is None or here.covariance is None:
            return here
        slopes = torch.stack([getattr(each, name).mean - here.mean for each in moved], dim=-1)
        return Gaussian(here.mean, here.covariance + (slopes * variance[:, None]) @ slopes.mT)

    wide = {name: wider(name) for name in ("multiplier", "contact_force", "unknown_force")}
    acceleration = wider("acceleration")
    assert acceleration is not None, "every model predicts it"
    made = replace(found, mean=acceleration.mean, covariance=acceleration.covariance, **wide)
    if made.unseen is None or found.multiplier is None or made.multiplier is None:
        return made
    return replace(made, unseen=made.unseen * found.multiplier.variance / made.multiplier.variance.clamp_min(1e-300))


def join_predictions(blocks: Sequence[Prediction], batch: torch.Size) -> Prediction:
    """One prediction from blocks of rows, with these batch dimensions."""

    def joined(parts: Sequence[Any]) -> Any:
        first = parts[0]
        if isinstance(first, Tensor):
            rows = torch.cat(list(parts))
            return rows.reshape(*batch, *rows.shape[1:])
        if first is None or isinstance(first, tuple):
            return first
        return type(first)(*(joined([getattr(part, item.name) for part in parts]) for item in fields(first)))

    return joined(blocks)


class Linearization(NamedTuple):
    """a(q, v, u) and its derivatives at a state (nv,) or states (n, nv): da_dq[..., i, j] = d a_i / d q_j."""

    a: Tensor
    da_dq: Tensor
    da_dv: Tensor
    da_du: Tensor


class JointForces(NamedTuple):
    """Q_K + Q_U (..., nv) at states under their u, dQ/du and M (..., nv, nv), A (..., m, nv), b and `off` (..., m).

    `off` is how far the points of the contacts are off their surfaces, in m.
    """

    Q: Tensor
    dQ_du: Tensor
    M: Tensor
    A: Tensor
    b: Tensor
    off: Tensor


def state_rows(model: Model, q: Array, v: Array, u: Array, past: bool = True) -> tuple[list[Tensor], torch.Size]:
    """States as float64 rows, and their batch; without `past` u lacks what laws remember. Raises InvalidInput."""
    nq, nv, nu = model.sizes
    named = zip("qvu", (q, v, u), (nq, nv, nu if past else nu - len(model.memory.names)), strict=True)
    given = [state_tensor(name, values, size, model.robot.device) for name, values, size in named]
    batch = broadcast_batch(dict(zip("qvu", (x.shape[:-1] for x in given), strict=True)))
    return [x.expand(*batch, -1).reshape(batch.numel(), x.shape[-1]) for x in given], batch


def state_tensor(name: str, values: Array, size: int, device: torch.device) -> Tensor:
    """Finite float64 numbers (..., size). Raises InvalidInput."""
    tensor = real_tensor(name, values, device)
    if tensor.dim() == 0 or tensor.shape[-1] != size:
        each = "input of the model (its `inputs`)" if name == "u" else "joint"
        raise InvalidInput(
            f"{name} has shape {tuple(tensor.shape)}; its last dimension must be {size}, one per {each}."
        )
    require_finite(name, tensor)
    return tensor


@dataclass(frozen=True, eq=False)
class ForceComponent:
    """One of the forces that add up to the unknown force, at a batch of states, as accelerations tell them apart.

    `joint_force` (..., nv) in Nm or N; `latents` (..., C) in `latent_units`; `point_force` (..., 3) in N, world axes,
    of forces at a point; `acceleration` (..., nv) is what it adds under the constraint, in rad/s^2 or m/s^2.
    """

    name: str
    latent_names: tuple[str, ...]
    latent_units: tuple[str, ...]
    latents: Gaussian
    joint_force: Gaussian
    acceleration: Gaussian
    point_force: Gaussian | None


@dataclass(frozen=True, eq=False)
class Curve:
    """One process over some of its features, for example a friction curve: force over velocity.

    `features` (n, d) and names with units; `mean`, `std` (n,) in `unit`; `visited` (2, d) is that of training data.
    """

    name: str
    unit: str
    feature_names: tuple[str, ...]
    features: Float[Tensor, "n d"]
    mean: Float[Tensor, " n"]
    std: Float[Tensor, " n"]
    visited: Float[Tensor, "2 d"]

    def interval(self) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Lower and upper end of the 95 % interval."""
        return self.mean - DEVIATIONS * self.std, self.mean + DEVIATIONS * self.std


def joint_force(posterior: Any, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv"]:
    """Q_K + Q_U, the mean of what acts on the joints of a Posterior beside the contacts."""
    return dynamics.Q_K + posterior.latents(dynamics, False).through(posterior.trained.unknown.direction(dynamics)).mean


def require_actuated(posterior: Any) -> None:
    """Raises InvalidInput for a Posterior of which no u can be solved for."""
    actuated = any(isinstance(force, Actuation) and force.known for force in posterior.model.laws)
    nv, nu = posterior.model.sizes[1], posterior.model.sizes[2] - len(posterior.model.memory.names)
    if nv != nu:
        seen = f"{posterior.model.robot.name} has {nv} degrees of freedom and u has {nu} entries"
        advice = "search for u with `predictor.linearize` or `predictor.rollouts`."
        raise InvalidInput(f"no u makes every acceleration: {seen}; {advice}")
    if posterior.carries_known_forces or not actuated:
        lacks = "RigidBodies()" if posterior.carries_known_forces else "Actuation()"
        seen = f"this model has no {lacks} among its laws, so no u can be solved for"
        raise InvalidInput(f"{seen}; call `predict`, or fit one that has.")


def inverse_dynamics(
    posterior: Any, states: Sequence[Tensor], normal_force: Any, covariance: bool, memory: Any = None
) -> Gaussian:
    """u (n, nv) of M a = Q_K(u) + Q_U(u) + A^T lambda of a Posterior at rows of q, v and a.

    Friction under load and processes may depend on u: Newton's method. With J = d(Q_K + Q_U)/du and the covariance S of
    the processes, that of u is to first order J^-1 B S B^T J^-T.
    """
    require_actuated(posterior)
    q, v, a = (x.detach() for x in states)
    shape = (len(q), len(posterior.model.contacts))
    wanted = q.new_zeros(shape) if normal_force is None else real_tensor("normal_force", normal_force, q.device)
    if wanted.shape not in (shape, shape[1:]):
        raise InvalidInput(f"normal_force has shape {tuple(wanted.shape)}; give {shape[1:]} or {shape}, by contact.")
    require_finite("normal_force", wanted)
    names, first = posterior.model.memory.names, posterior.model.memory_column
    if names and memory is None:
        raise InvalidInput(f"this model remembers: give memory=({', '.join(names)}), for a state without past 0.")
    z = real_tensor("memory", [] if memory is None else memory, q.device).expand(len(q), -1) if names else q[:, :0]

    def whole(u: Tensor) -> Tensor:
        return torch.cat([u[:, :first], z, u[:, first:]], dim=1) if names else u

    def surplus(u: Tensor, learned: bool = True) -> Tensor:
        """What is left over of Q_K + Q_U + A^T lambda - M a."""
        at = posterior.dynamics(q, v, whole(u))
        Q = joint_force(posterior, at) if learned else at.Q_K
        return Q + (at.A.mT @ wanted[..., None] - at.M @ a[..., None])[..., 0]

    with torch.no_grad():
        # from the u without what was learned: from u = 0 the load, and friction under it, would be those of free fall
        u, found = find_roots(surplus, -surplus(torch.zeros_like(a), learned=False))
        if not bool(found.all()):
            seen = f"no u was found that gives row {int((~found).nonzero()[0])} its acceleration"
            why = "friction takes as much as u adds, or a number is too large"
            raise NumericalError(f"{seen}: {why}; check q, v, a and normal_force of that row.")
        if not covariance:
            return Gaussian(u, None)
        at = posterior.dynamics(q, v, whole(u))
        response = torch.linalg.solve(rows_jacobian(surplus, u)[1], posterior.trained.unknown.direction(at))
        return Gaussian(u, posterior.latents(at, True).through(response).covariance)


def curve_features(latent: str, given: Any, visited: Tensor, points: int) -> Tensor:
    """Features (n, d) of a curve, checked."""
    count = visited.shape[-1]
    if given is None:
        if not count:
            return visited[:1]  # a constant has one value
        if count != 1:
            raise InvalidInput(f"{latent!r} is a function of {count} features; give features (n, {count})")
        if points < 1:
            raise InvalidInput(f"a curve of points={points} was asked for; give 1 or more")
        steps = torch.linspace(0.0, 1.0, points, dtype=torch.float64, device=visited.device)
        return visited[0] + steps[:, None] * (visited[1] - visited[0])
    z = real_tensor(f"features of {latent!r}", given, visited.device)
    z = z[:, None] if z.dim() == 1 and count == 1 else z
    if z.dim() != 2 or z.shape[-1] != count or not bool(torch.isfinite(z).all()):
        raise InvalidInput(f"features of {latent!r} have shape {tuple(z.shape)}; give finite numbers (n, {count})")
    return z


def joint_forces_given(
    latents: Gaussian,
    B: Float[Tensor, "rows nv C"],
    extra: Float[Tensor, "*rows nv nv"] | None,
    acceleration: AffineMap,
    seen: tuple[Rows, Float[Tensor, " nv"]] | None,
) -> tuple[Gaussian, Gaussian]:
    """Joint forces B f + e with e ~ N(0, `extra`), and B f alone: given accelerations that were `seen`, if any.

    a = offset + H (B f + e) + N(0, s^2) with (a, s) = `seen`: a normal distribution conditioned on a part of it
    (Rasmussen & Williams 2006, eq. A.6).
    """
    learned = latents.through(B)
    if extra is None:
        extra = torch.zeros_like(acceleration.matrix[..., :1, :1])
    whole = Gaussian(learned.mean, None if learned.covariance is None else learned.covariance + extra)
    if seen is None:
        return whole, learned
    assert whole.covariance is not None, "as above"
    a, std = seen
    H, missed = acceleration.matrix, a - acceleration(learned.mean)
    V = H @ whole.covariance @ H.mT + torch.diag_embed(std.square())

    def given(prior: Gaussian, across: Tensor) -> Gaussian:
        gain = torch.linalg.solve(V, across.mT).mT
        assert prior.covariance is not None, "as above"
        covariance = prior.covariance - gain @ across.mT
        return Gaussian(prior.mean + (gain @ missed[..., None])[..., 0], 0.5 * (covariance + covariance.mT))

    assert learned.covariance is not None, "as above"
    return given(whole, whole.covariance @ H.mT), given(learned, learned.covariance @ H.mT)


SHARP = 1e-9  # of what evidence shows of hidden torques, the variance that conditioning on it leaves: rounding


def hidden_forces(
    hidden: Float[Tensor, " nv"], dynamics: ConstrainedDynamics, sensors: Sequence[str]
) -> Float[Tensor, "rows nv nv"]:
    """The covariance of joint forces of these standard deviations that nothing showed.

    What changes accelerations, or what `sensors` measure, was seen and is not among them: N(0, h^2) given that
    H e = 0 and C e = 0, which is (A h^-2 A^T)^-1 for the multipliers of independent contacts.
    """
    prior, G = torch.diag(hidden.square()), observed(dynamics, sensors).matrix
    across = prior @ G.mT
    V = G @ across
    V = V + SHARP * V.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] * torch.eye(V.shape[-1]).to(V)
    left = prior - across @ torch.linalg.solve(V, across.mT)
    return 0.5 * (left + left.mT)
