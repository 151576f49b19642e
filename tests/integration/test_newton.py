"""Newton's method on friction that is steep, kinked and falls with speed: it finds all roots, and their derivatives."""

import pytest
import torch

from forcegp.errors import InvalidInput
from forcegp.integration.integrators import find_roots


def implicit_step(friction, joints: int, states: int):
    """The equation of an implicit step of 40 ms with coupled masses from .003 to 3 kg m^2, and where it begins."""
    generator = torch.Generator().manual_seed(0)
    like = {"dtype": torch.float64, "generator": generator}
    Q, _ = torch.linalg.qr(torch.randn(states, joints, joints, **like))
    M = (Q * torch.logspace(-2.5, 0.5, joints, dtype=torch.float64)) @ Q.mT
    v, u = torch.randn(2, states, joints, **like).unbind()
    return lambda w: w - v - 0.02 * torch.linalg.solve(M, 2.0 * u - friction(w)), v


def stribeck(v):
    return (2.0 + 2.0 * torch.exp(-((v / 0.1) ** 2))) * torch.tanh(v / 0.01) + 0.01 * v


def sawtooth(v):
    """A mean of Matern-1/2 friction: a kink at each of 100 training velocities."""
    generator = torch.Generator().manual_seed(1)
    at = torch.asinh(torch.randn(v.shape[-1], 100, generator=generator, dtype=torch.float64) * 40.0)
    weights = 0.2 * torch.randn(v.shape[-1], 100, generator=generator, dtype=torch.float64)
    bumps = (torch.exp(-(torch.asinh(v / 0.05)[..., None] - at).abs() / 0.3) * weights).sum(-1)
    return torch.tanh(v / 0.05) * (0.1 + bumps) + 0.01 * v


@pytest.mark.parametrize("friction", [stribeck, sawtooth])
@pytest.mark.parametrize("joints", [2, 7])
def test_all_implicit_steps_are_found(friction, joints):
    residual, v = implicit_step(friction, joints, 40)
    w, found = find_roots(residual, v)
    assert found.all()
    assert residual(w).abs().max() <= 1e-7 * residual(v).abs().max()


def test_where_there_is_no_root_it_is_not_found():
    x = torch.tensor([[0.5], [0.5], [0.5]], dtype=torch.float64)
    shift = torch.tensor([[0.0], [1.0], [float("nan")]], dtype=torch.float64)
    _, found = find_roots(lambda x: x**2 + shift - 0.1, x)
    assert found.tolist() == [True, False, False]


def test_the_root_is_differentiable_once():
    p = torch.rand(3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()

    def root(p):
        return find_roots(lambda x: x + p * torch.tanh(x / 0.1) - p[:, :1] * x.roll(1, -1) ** 2 - 0.3, 0.0 * p)[0]

    assert torch.autograd.gradcheck(root, p)
    with pytest.raises(InvalidInput, match="differentiable once; leave out create_graph"):
        torch.autograd.grad(root(p).sum(), p, create_graph=True)


def test_a_root_is_found_where_no_eigenvalues_are(monkeypatch):
    """LAPACK can fail on ordinary matrices whose eigenvalues repeat."""

    def fails(_):
        raise torch.linalg.LinAlgError("the algorithm failed to converge")

    monkeypatch.setattr(torch.linalg, "eigvals", fails)
    x, found = find_roots(lambda x: x + 0.5 * torch.tanh(x.roll(1, -1)) - 1.0, torch.zeros(2, 3).double())
    assert found.all()
    torch.testing.assert_close(x + 0.5 * torch.tanh(x.roll(1, -1)), torch.ones(2, 3).double())


def test_without_eigenvalues_the_bound_is_theirs_where_the_jacobian_is_symmetric(monkeypatch):
    """A smallest slope of .05 is raised to .1, so the error halves with every step, either way."""
    A = torch.tensor([[0.525, 0.475], [0.475, 0.525]], dtype=torch.float64)  # of eigenvalues .05 and 1
    calls = []

    def residual(x):
        calls[-1] += 1
        return x @ A - torch.tensor([0.05, -0.05], dtype=torch.float64)

    def fails(_):
        raise torch.linalg.LinAlgError("the algorithm failed to converge")

    for eigenvalues in (torch.linalg.eigvals, fails):
        monkeypatch.setattr(torch.linalg, "eigvals", eigenvalues)
        calls.append(0)
        x, found = find_roots(residual, torch.zeros(1, 2).double())
        assert found.all()
        torch.testing.assert_close(x, torch.tensor([[1.0, -1.0]]).double())
    assert calls[0] == calls[1] > 20
