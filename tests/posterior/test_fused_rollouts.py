"""Motions by the compiled loop are those of `integrate`, whose results they may take the place of."""

import warnings

import pytest
import torch
from tests.posterior.arm import arm_data, arm_model, quick_fit
from tests.posterior.exported_program import IMPLICIT

from forcegp.errors import NumericalWarning
from forcegp.forces import JointForces, JointFriction
from forcegp.posterior import Posterior, Predictor, rollout

DT, STEPS = 0.01, 12
INTEGRATORS = ["symplectic-euler", "rk4", IMPLICIT]


@pytest.fixture(scope="module")
def friction() -> Posterior:
    return quick_fit(arm_model().with_forces(JointFriction()))


@pytest.fixture(scope="module")
def predictor(friction) -> Predictor:
    return friction.predictor(covariance="none")


@pytest.fixture(scope="module")
def starts() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """11 motions, more than the lanes of a vector hold."""
    data, wave = arm_data(11, 1), torch.linspace(0.0, 3.0, STEPS, dtype=torch.float64).sin()
    q, v, u = (torch.tensor(x) for x in (data.q, data.v, data.u))
    return q, v, u[:, None] * (1.0 + 0.1 * wave[:, None])


def rolled_out(posterior, starts, **how):
    with warnings.catch_warnings(action="ignore", category=NumericalWarning):
        return posterior.rollout(*starts, DT, baumgarte=posterior.model.baumgarte, **how)


def close(found, expected, tolerance=1e-8):
    for name in ("q", "v", "a"):
        ours, theirs = getattr(found, name), getattr(expected, name)
        scale = float(theirs.nan_to_num().abs().max())
        torch.testing.assert_close(ours, theirs, rtol=0.0, atol=tolerance * scale, equal_nan=True)
    assert torch.equal(found.diverged_at, expected.diverged_at)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("prior", ["sums over centres", "pieces"])
def test_every_integrator_is_that_of_torch(friction, starts, integrator, prior):
    posterior = friction if prior == "pieces" else quick_fit(arm_model().with_forces(JointForces(inputs=("q", "v"))))
    found = posterior.predictor(covariance="none").rollouts(*starts, DT, integrator=integrator)
    close(found, rolled_out(posterior, starts, integrator=integrator))


def test_drawn_functions_are_those_of_a_rollout(friction, predictor, starts):
    found = predictor.rollouts(*starts, DT, functions=3, seed=5)
    assert found.q.shape == (3, 11, STEPS + 1, 3)
    close(found, rolled_out(friction, starts, samples=3, seed=5).samples, 1e-7)
    assert not torch.equal(found.q, predictor.rollouts(*starts, DT, functions=3, seed=6).q)


def test_motions_that_become_too_fast_end_as_they_do_in_torch(friction, predictor, starts):
    q, v, u = starts
    pushed = u.clone()
    pushed[3:5] += 3e3
    with pytest.warns(NumericalWarning, match=r"2 of 11 motions diverged, the first at step"):
        found = predictor.rollouts(q, v, pushed, DT)
    expected = rolled_out(friction, (q, v, pushed))
    assert int((expected.diverged_at >= 0).sum()) == 2
    close(found, expected)


def test_batches_broadcast_and_threads_change_nothing(predictor, starts):
    q, v, u = starts
    found = predictor.rollouts(q[0], v[0], u[:6].reshape(2, 3, STEPS, 3), DT, threads=2)
    assert found.q.shape == (2, 3, STEPS + 1, 3)
    assert torch.equal(found.a[1, 2], predictor.rollouts(q[0], v[0], u[5], DT).a)
    many = [x.repeat(9, *[1] * (x.dim() - 1)) for x in starts]
    one, two = (predictor.rollouts(*many, DT, threads=threads) for threads in (1, 2))
    assert torch.equal(one.q, two.q)


def test_without_a_compiler_torch_does_the_same(friction, predictor, starts):
    close(friction.predictor(covariance="none", compile=False).rollouts(*starts, DT), predictor.rollouts(*starts, DT))


def test_rollouts_of_a_posterior_are_compiled_where_they_are_long(friction, starts, monkeypatch):
    expected = rolled_out(friction, starts, samples=2)
    monkeypatch.setattr(rollout, "STEPS_TO_COMPILE", 1)
    called = []

    def moved(*given, **how):
        called.append(given[1])
        return rollout.moved(*given, **how)

    monkeypatch.setattr("forcegp.posterior.posterior.moved", moved)
    found = rolled_out(friction, starts, samples=2)
    assert [len(loops) for loops in called] == [1, 2]
    close(found, expected)
    close(found.samples, expected.samples, 1e-7)
    monkeypatch.setenv("CC", "no-such-compiler")
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/nowhere")
    with pytest.warns(NumericalWarning, match="computed by torch, some 50 times slower: .*"):
        close(friction.rollout(*starts, DT, baumgarte=friction.model.baumgarte), expected, 1e-12)
