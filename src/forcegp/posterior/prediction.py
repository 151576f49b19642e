"""Predictions as frozen values."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, UnknownRow
from forcegp.model import Model
from forcegp.robots.arguments import broadcast_batch, real_tensor, require_finite
from forcegp.summary import Summary, listed

ROWS_PER_BLOCK = 4096
"""States that are predicted at once; bounds the memory of long recordings."""
Rows = Float[Tensor, "rows nv"]
"""One number per state and joint."""
Positions = Float[Tensor, "rows nq"]
"""One state per row; more numbers than joints where some have a quaternion, or cos and sin."""
Inputs = Float[Tensor, "rows nu"]
"""One number per state and input of the system."""
Array = Tensor | np.ndarray | Sequence[Any]
AnyGaussian = TypeVar("AnyGaussian", bound="Gaussian")  # beartype cannot check Self where a module is hooked


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

    def __getitem__(self: AnyGaussian, index: Any) -> AnyGaussian:
        """The same for some of the states: `prediction[i]`, `prediction[:10]`, `prediction[mask]`.

        `index` is for the batch dimensions. Raises UnknownRow for states that are not there.
        """
        batch = self.mean.shape[:-1]
        try:
            rows = torch.arange(batch.numel(), device=self.mean.device).reshape(batch)[index]
        except (IndexError, TypeError) as error:
            raise UnknownRow(f"no states {index!r} in a batch of shape {tuple(batch)}: {error}") from None

        def chosen(part: Any) -> Any:
            if isinstance(part, Tensor):
                return part.flatten(0, len(batch) - 1)[rows] if batch else part[None][rows]
            return part[index] if isinstance(part, Gaussian) else part

        return type(self)(**{item.name: chosen(getattr(self, item.name)) for item in fields(self)})

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
    N; `unknown_force` Q_U (..., nv) in Nm or N: what the Gaussian processes carry, which without an analytical mean
    includes Q_K. Accelerations show nothing of a force along the contact normals: that part of `unknown_force`, and
    through it `multiplier` and `contact_force`, rests on the prior alone, and is no surer than the prior is right.
    The three are None where a model predicts no forces.
    `noise_covariance` (..., nv, nv) is that of a measurement: add it to `covariance` to compare with noisy data. Where
    the noise differed between training rows, it is that of their root-mean-square level.
    """

    multiplier: Gaussian | None
    contact_force: Gaussian | None
    unknown_force: Gaussian | None
    noise_covariance: Float[Tensor, "*batch nv nv"]

    @override
    def facts(self) -> dict[str, object]:
        """Of the acceleration, and which forces there are."""
        forces = [name for name in ("multiplier", "contact_force", "unknown_force") if getattr(self, name) is not None]
        return {**super().facts(), "forces": listed(forces)}

    @property
    def acceleration(self) -> Gaussian:
        """`mean` and `covariance` under their full name."""
        return Gaussian(self.mean, self.covariance)

    @property
    def measurement(self) -> Gaussian:
        """The acceleration as a sensor with the model's noise would report it."""
        return Gaussian(self.mean, None if self.covariance is None else self.covariance + self.noise_covariance)


def join_predictions(blocks: Sequence[Prediction], batch: torch.Size) -> Prediction:
    """One prediction from blocks of rows, with these batch dimensions."""

    def joined(parts: Sequence[Any]) -> Any:
        first = parts[0]
        if isinstance(first, Tensor):
            rows = torch.cat(list(parts))
            return rows.reshape(*batch, *rows.shape[1:])
        if first is None:
            return None
        return type(first)(*(joined([getattr(part, item.name) for part in parts]) for item in fields(first)))

    return joined(blocks)


class Linearization(NamedTuple):
    """a(q, v, u) and its derivatives at a state (nv,) or states (n, nv): da_dq[..., i, j] = d a_i / d q_j."""

    a: Tensor
    da_dq: Tensor
    da_dv: Tensor
    da_du: Tensor


class JointForces(NamedTuple):
    """Q_K + Q_U (..., nv) at states under their u, dQ/du and M (..., nv, nv), A (..., m, nv) and b (..., m)."""

    Q: Tensor
    dQ_du: Tensor
    M: Tensor
    A: Tensor
    b: Tensor


def state_rows(model: Model, q: Array, v: Array, u: Array) -> tuple[list[Tensor], torch.Size]:
    """What `Posterior.checked_states` documents."""
    named = zip("qvu", (q, v, u), model.sizes, strict=True)
    given = [state_tensor(name, values, size, model.robot.device) for name, values, size in named]
    batch = broadcast_batch(dict(zip("qvu", (x.shape[:-1] for x in given), strict=True)))
    return [x.expand(*batch, -1).reshape(batch.numel(), x.shape[-1]) for x in given], batch


def state_tensor(name: str, values: Array, size: int, device: torch.device) -> Tensor:
    """Finite float64 numbers (..., size). Raises InvalidInput."""
    tensor = real_tensor(name, values, device)
    if tensor.dim() == 0 or tensor.shape[-1] != size:
        raise InvalidInput(
            f"{name} has shape {tuple(tensor.shape)}; its last dimension must be {size}, one value per joint."
        )
    require_finite(name, tensor)
    return tensor
