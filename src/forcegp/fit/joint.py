"""Numbers of laws and bodies beside unknown functions: Gauss-Newton on rows whose covariance contains the functions.

With kernels and noise given, the rows y = m(x) + W f + e have the covariance S = R + W K W^T, and

    1/2 r^T S^-1 r + 1/2 |prior(x)|^2,    r = y - m(x),    J = -dm/dx

is least squares (generalised least squares; Rasmussen & Williams 2006, section 2.7). Whitened and deflated as in
`forcegp.inference.likelihood`, r^T S^-1 r = |(1 - U U^T) y~|^2 + |L^-1 U^T y~|^2 with T = L L^T, so it costs one factor
of T and a solution for each number. That the directions W change with x as well is left out of the derivative.
Information about x does not depend on that about kernels: a mean and a covariance (Kay 1993, eq. 3.31).
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.evidence.least_squares import Fit, weighted_least_squares
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.evidence.recorded_rows import RecordedRows
from forcegp.inference.cholesky import factorize
from forcegp.inference.likelihood import deflate, deflated_covariance, whiten
from forcegp.posterior import StructuredPosterior
from forcegp.posterior.estimates import Estimates

MOST_ROUNDS = 6
"""Searches for kernels and for numbers in turn."""
CHANGE = 0.1
"""They end where numbers change by fewer of their standard deviations."""


class JointRows:
    """The learning rows of a posterior, and the directions in which its functions act, whitened."""

    def __init__(self, posterior: StructuredPosterior, space: ParameterSpace) -> None:
        likelihood, training = posterior.likelihood, posterior.likelihood.training
        self.space = space
        q, v, u = (x.cpu().numpy() for x in (training.q, training.v, training.u))
        self.rows = RecordedRows(space, q, v, u, any_contact=True)
        self.a = training.a.cpu().numpy()  # of windows, their mean, which weights of sum 1 leave as it is
        features, W, _, noise = likelihood.terms(posterior.hyperparameters)
        kernels, self.weights = posterior.kernels, training.weights
        matrices = kernels.matrices(posterior.hyperparameters, features)
        self.noise, self.like = noise.expand(len(W), *noise.shape[1:]), W
        self.U: Tensor | None = None
        if self.weights is not None:
            self.factor = factorize(self._of_windows(W, matrices).clone)
            return
        nothing = torch.zeros_like(training.a)
        white, *_ = whiten(W, nothing, self.noise)
        found = deflate(white, nothing)
        self.U = found.U
        self.factor = factorize(deflated_covariance(found.C, matrices).clone) if found.rank else None

    def _of_windows(self, W: Tensor, matrices: list[Tensor]) -> Float[Tensor, "n n"]:
        """S of all windows, dense: sums over their nodes."""
        assert self.weights is not None, "there are windows"
        windows, nodes = self.weights.shape
        nv = W.shape[1]
        S = W.new_zeros(windows * nv, windows * nv)
        for c, K in enumerate(matrices):
            own = self.weights.reshape(-1, 1) * W[..., c]  # (N, nv)
            for k in range(nv):
                part = (own[:, k, None] * K).unflatten(0, (windows, nodes)).sum(1)
                both = torch.einsum("wn,nj->wnj", part, own).unflatten(1, (windows, nodes)).sum(2)
                S[k::nv] += both.flatten(1)
        R = self.noise.unflatten(0, (windows, nodes))
        first = torch.diag_embed(R[:, 0]) if R.dim() == 3 else (self.weights[..., None, None].square() * R).sum(1)
        return S + torch.block_diag(*first)

    def white(self, values: Float[np.ndarray, "N nv k"]) -> Float[Tensor, "rows k"]:
        """Columns of residuals over their covariance."""
        given = torch.as_tensor(values, device=self.like.device)
        if self.U is None:
            assert self.weights is not None, "there are windows"
            assert self.factor is not None, "there are windows"
            summed = (self.weights[..., None, None] * given.unflatten(0, self.weights.shape)).sum(1)
            return self.factor.solve_lower(summed.flatten(0, 1))
        columns, *_ = whiten(given, torch.zeros_like(given[..., 0]), self.noise)
        along = self.U.mT @ columns
        across = (columns - self.U @ along).flatten(0, 1)
        return across if self.factor is None else torch.cat([across, self.factor.solve_lower(along.flatten(0, 1))])

    def residual(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `weighted_least_squares` takes it: one whitened equation in a row."""
        r, Y, in_terms = self.rows.in_acceleration(x, self.a)
        of_bodies = self.space.bodies.chained(x[: self.space.bodies.size], Y)
        both = np.concatenate([r[..., None], of_bodies, in_terms], axis=-1)
        white = self.white(both).cpu().numpy()
        return white[:, :1], white[:, None, 1:]


def numbers_beside(
    posterior: StructuredPosterior, space: ParameterSpace, x: Float[np.ndarray, " k"]
) -> tuple[np.ndarray, Fit, float]:
    """Coordinates at fixed kernels, the search, and by how many standard deviations the farthest moved."""
    with torch.no_grad():
        rows = JointRows(posterior, space)
        fit = weighted_least_squares(
            rows.residual,
            space.prior,
            x,
            space.bounds,
            longest=space.longest_steps,
            moved=space.moved,
            known=np.ones(1),
            evaluations=30,
        )
    spread = np.sqrt(np.linalg.inv(fit.information + fit.prior_information).diagonal())
    return fit.x, fit, float((abs(fit.x - x) / spread).max(initial=0.0))


def estimates_beside(space: ParameterSpace, fit: Fit, count: int) -> Estimates:
    """The numbers at the end, whose covariance is that of Laplace's approximation: functions count as unknown."""
    white = np.concatenate([fit.jacobian[:, 0], fit.residual], axis=-1)
    found = Estimates.of_search(
        space.parameters, space.numbers(fit.x), space.number_slopes(fit.x), white, (), space.prior(fit.x)[1],
        evidence="accelerations, beside unknown forces", rows=count, evaluations=fit.evaluations, settled=fit.settled,
    )  # fmt: skip
    return found
