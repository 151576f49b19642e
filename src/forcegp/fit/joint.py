"""Numbers of laws and bodies beside unknown functions: least squares on rows whose covariance contains the functions.

Generalised least squares (Rasmussen & Williams 2006, section 2.7), whitened and deflated. Kernels are sought at the
best numbers of every kernel (variable projection, Golub & Pereyra 1973): sought in turn, functions learn at first what
wrong numbers do, and are then known too well to give it back.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.evidence import TrainingData
from forcegp.evidence.least_squares import Fit, weighted_least_squares
from forcegp.evidence.likelihood import MarginalLikelihood
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.evidence.recorded_rows import RecordedRows
from forcegp.inference import LatentKernels, Terms
from forcegp.inference.likelihood import CholeskyFactor, deflated_covariance, factorize, whiten
from forcegp.posterior import Posterior
from forcegp.posterior.fitted import Estimates

MOST_ROUNDS = 10  # searches, each about the numbers of the last one
CHANGE = 0.1  # they end where numbers change by fewer of their standard deviations


@dataclass(frozen=True, eq=False)
class Whitening:
    """What columns of residuals are over their covariance, functions included."""

    terms: Terms
    U: Float[Tensor, "N D r"]
    factor: CholeskyFactor | None

    @classmethod
    def of(cls, terms: Terms, matrices: Sequence[Float[Tensor, "N N"]]) -> "Whitening":
        """That of rows. Raises NumericalError without a factorisation."""
        found = terms.deflated()
        return cls(terms, found.U, factorize(lambda: deflated_covariance(found.C, matrices)) if found.rank else None)

    def __call__(self, values: Float[Tensor, "rows D k"]) -> Float[Tensor, "n k"]:
        """Of every state."""
        columns, *_ = whiten(values, self.terms.residual, self.terms.noise)
        if self.factor is None:
            return columns.flatten(0, 1)
        along = self.U.mT @ columns
        return torch.cat([(columns - self.U @ along).flatten(0, 1), self.factor.solve_lower(along.flatten(0, 1))])


class Slopes:
    """Residuals of the learning rows as functions of the numbers."""

    def __init__(self, training: TrainingData, space: ParameterSpace) -> None:
        self.space = space
        q, v, u = (x.cpu().numpy() for x in (training.q, training.v, training.u))
        strokes = None if training.strokes is None else training.strokes.cpu().numpy()
        sensed = {name: x.cpu().numpy() for name, x in training.sensed.items()}
        self.rows = RecordedRows(space, q, v, u, any_contact=True, strokes=strokes, sensed=sensed)
        self.a = training.a.cpu().numpy()
        self.device = training.a.device

    def at(self, x: Float[np.ndarray, " k"]) -> Float[Tensor, "rows nv columns"]:
        """The residual and then its derivatives."""
        r, Y, in_terms = self.rows.in_acceleration(x, self.a)
        of_bodies = self.space.bodies.chained(x[: self.space.bodies.size], Y)
        return torch.as_tensor(np.concatenate([r[..., None], of_bodies, in_terms], axis=-1), device=self.device)


@dataclass(frozen=True, eq=False)
class FreeNumbers:
    """The marginal likelihood at the best numbers, in nats: a function of kernels and noise alone.

    `slopes` (rows, nv, k) of the residual about the numbers of the model; `prior`: the distance and its Jacobian.
    """

    likelihood: MarginalLikelihood
    slopes: Tensor
    prior: tuple[Tensor, Tensor]

    @property
    def training(self) -> TrainingData:
        """The learning rows."""
        return self.likelihood.training

    def __call__(self, kernels: LatentKernels, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """Differentiable once in every parameter."""
        terms, matrices = self.likelihood.checked_terms(kernels, parameters)
        distance, jacobian = self.prior
        with torch.no_grad():
            of_data = Whitening.of(terms, matrices)(torch.cat([terms.residual[..., None], self.slopes], -1))
            columns = torch.cat([of_data, torch.cat([distance[:, None], jacobian], -1)])
            step = torch.linalg.lstsq(columns[:, 1:], -columns[:, :1]).solution[:, 0]
        moved = terms._replace(residual=terms.residual + self.slopes @ step)
        return self.likelihood.of_terms(moved, matrices) + 0.5 * (distance + jacobian @ step).square().sum()


def with_free_numbers(likelihood: MarginalLikelihood, space: ParameterSpace, x: Float[np.ndarray, " k"]) -> FreeNumbers:
    """The likelihood of a model whose numbers are x, as they change."""
    slopes = Slopes(likelihood.training, space).at(x)[..., 1:]
    distance, jacobian = (torch.as_tensor(part, device=slopes.device) for part in space.prior(x))
    return FreeNumbers(likelihood, slopes, (distance, jacobian))


def numbers_beside(
    posterior: Posterior, space: ParameterSpace, x: Float[np.ndarray, " k"]
) -> tuple[np.ndarray, Fit, float]:
    """Coordinates at fixed kernels, the search, and by how many standard deviations the farthest moved."""
    likelihood, slopes = posterior.likelihood, Slopes(posterior.training, space)
    with torch.no_grad():
        terms = likelihood.terms(posterior.hyperparameters)
        white = Whitening.of(terms, posterior.kernels.matrices(posterior.hyperparameters, terms.features))

        def residual(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            columns = white(slopes.at(x)).cpu().numpy()  # one equation in a row
            return columns[:, :1], columns[:, None, 1:]

        stated = {"known": np.ones(1), "evaluations": 30}
        fit = weighted_least_squares(residual, space.prior, x, space.bounds, **stated, **space.steps)
    spread = np.sqrt(np.linalg.inv(fit.information + fit.prior_information).diagonal())
    return fit.x, fit, float((abs(fit.x - x) / spread).max(initial=0.0))


def estimates_beside(space: ParameterSpace, fit: Fit, count: int) -> Estimates:
    """The numbers at the end, whose covariance is that of Laplace's approximation: functions count as unknown."""
    white = np.concatenate([fit.jacobian[:, 0], fit.residual], axis=-1)
    return Estimates.of_search(
        space.parameters, space.numbers(fit.x), space.number_slopes(fit.x), white, (), space.prior(fit.x)[1],
        evidence="accelerations, beside unknown forces", rows=count, evaluations=fit.evaluations, settled=fit.settled,
    )  # fmt: skip
