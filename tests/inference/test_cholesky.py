import math

import pytest
import torch
from tests.inference.problems import normal

from forcegp.errors import NumericalError, NumericalWarning
from forcegp.inference import cholesky
from forcegp.inference.cholesky import factorize


@pytest.fixture(params=["LAPACK", "torch"])
def route(request, monkeypatch):
    """The way of the CPU, and the way of all other devices."""
    if request.param == "torch":
        monkeypatch.setattr(cholesky, "_is_for_lapack", lambda matrix: False)


def positive_definite(size: int, seed: int = 0) -> torch.Tensor:
    factor = normal(size, size, seed=seed)
    return factor @ factor.mT + 0.1 * torch.eye(size, dtype=torch.float64)


@pytest.mark.usefixtures("route")
@pytest.mark.parametrize("size", [0, 1, 2, 7, 150])
def test_everything_a_factor_does(size):
    matrix = positive_definite(size)
    right = normal(size, 3, seed=1)
    kept = right.clone()
    factor = factorize(matrix.clone)
    assert factor.jitter == 0.0
    torch.testing.assert_close(factor.lower.tril(), torch.linalg.cholesky(matrix))
    torch.testing.assert_close(factor.log_determinant(), torch.logdet(matrix) if size else torch.tensor(0.0).double())
    torch.testing.assert_close(factor.solve(right), torch.linalg.solve(matrix, right))
    torch.testing.assert_close(factor.solve_lower(right), torch.linalg.solve(torch.linalg.cholesky(matrix), right))
    assert torch.equal(right, kept)
    inverse = torch.linalg.inv(matrix)
    torch.testing.assert_close(factor.into_inverse().tril(), inverse.tril(), rtol=1e-9, atol=1e-9)


@pytest.mark.usefixtures("route")
def test_only_the_lower_triangle_is_read():
    matrix = positive_definite(6)
    spoiled = matrix.clone()
    spoiled[torch.ones(6, 6).triu(1).bool()] = math.nan
    factor = factorize(spoiled.clone)
    right = normal(6, 2, seed=1)
    torch.testing.assert_close(factor.solve(right), torch.linalg.solve(matrix, right))
    torch.testing.assert_close(factor.solve_lower(right), torch.linalg.solve(torch.linalg.cholesky(matrix), right))
    torch.testing.assert_close(factor.into_inverse().tril(), torch.linalg.inv(matrix).tril())


def test_factor_and_inverse_live_in_the_memory_of_the_matrix():
    """Two copies of 288 MB less at 6000 x 6000."""
    matrix = positive_definite(20)
    address = matrix.data_ptr()
    factor = factorize(lambda: matrix)
    assert factor.lower.data_ptr() == address
    assert factor.into_inverse().data_ptr() == address


@pytest.mark.usefixtures("route")
@pytest.mark.parametrize("relative", [1e-12, 1e-10, 1e-8])
def test_the_smallest_sufficient_jitter_is_added_and_reported(relative):
    """A matrix whose smallest eigenvalue is -relative / 3 of its mean diagonal."""
    basis = torch.linalg.qr(normal(5, 5)).Q
    eigenvalues = torch.tensor([1.0, 1.0, 1.0, 2.0, -relative / 3.0], dtype=torch.float64)
    matrix = (basis * eigenvalues) @ basis.mT
    matrix = 0.5 * (matrix + matrix.mT)
    with pytest.warns(NumericalWarning, match=r"5 x 5 covariance positive definite; larger noise"):
        factor = factorize(matrix.clone)
    assert factor.jitter == pytest.approx(relative * float(matrix.diagonal().mean()))
    shifted = matrix + factor.jitter * torch.eye(5, dtype=torch.float64)
    lower = factor.lower.tril()
    torch.testing.assert_close(lower @ lower.mT, shifted, rtol=0.0, atol=1e-14)


@pytest.mark.usefixtures("route")
@pytest.mark.parametrize("smallest", [-1.0, -1e-6])
def test_an_indefinite_matrix_is_refused(smallest):
    matrix = torch.diag(torch.tensor([1.0, smallest, 1.0], dtype=torch.float64))
    with pytest.raises(NumericalError, match=r"not positive definite .*noise"):
        factorize(matrix.clone)


@pytest.mark.usefixtures("route")
@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("where", [(0, 0), (3, 3), (3, 0), (2, 1)], ids=str)
def test_a_matrix_that_is_not_finite_is_refused(where, value):
    matrix = positive_definite(4)
    matrix[where] = value
    with pytest.raises(NumericalError, match="covariance matrix"):
        factorize(matrix.clone)
