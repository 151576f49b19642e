"""Models of a robot with a closed loop: fit, prediction, motions, files and compiled programs."""

import numpy as np
import pytest
import torch
from tests.robots.mjcf_models import FOUR_BAR

from forcegp import (
    Coulomb,
    Dataset,
    JointFriction,
    Model,
    Noise,
    RigidBodies,
    fit,
)
from forcegp.data import contact_doubts, rows_in_contact
from forcegp.integration import onto_contacts
from forcegp.mechanics import loop_frame
from forcegp.scores import usual_forces

FRICTION = torch.tensor([0.4, 0.3, 0.5], dtype=torch.float64)


def forces(v):
    return -FRICTION * torch.tanh(v / 0.5)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("loop") / "four-bar.xml"
    path.write_text(FOUR_BAR)
    return Model.from_mjcf(path)


@pytest.fixture(scope="module")
def dataset(model):
    generator = torch.Generator().manual_seed(0)
    q, v, u = (torch.randn(80, 3, dtype=torch.float64, generator=generator) for _ in range(3))
    q, v = onto_contacts(model, 0.3 * q, v)
    a = model.dynamics(q, v, u).acceleration(forces(v))
    noise = 0.01 * torch.randn(80, 3, dtype=torch.float64, generator=generator)
    columns = dict(zip("qvua", (x.numpy() for x in (q, v, u, a + noise)), strict=True))
    return Dataset(**columns, time=0.01 * np.arange(80), model=model)


@pytest.fixture(scope="module")
def posterior(model, dataset):
    return fit(model.with_forces(JointFriction(), noise=Noise(0.01)), dataset, points=30, restarts=1)


def test_friction_inside_a_loop_is_learned(model, dataset, posterior):
    q, v, u, a = (torch.tensor(getattr(dataset, name)) for name in "qvua")
    found = posterior.predict(q, v, u)
    without = model.dynamics(q, v, u).acceleration(torch.zeros_like(v))
    assert (found.mean - a).abs().mean() < 0.1 * (without - a).abs().mean()
    dynamics = model.dynamics(q, v, u)
    torch.testing.assert_close((dynamics.A @ found.mean[..., None])[..., 0], dynamics.b, rtol=0.0, atol=1e-6)
    assert len(rows_in_contact(dataset)) == len(dataset)
    assert contact_doubts(dataset) == ()
    assert usual_forces(model) == "gp:joint-friction"


@pytest.mark.parametrize("kind", ["point", "frame"])
@pytest.mark.nightly
def test_compiled_predictions_are_the_same(posterior, dataset, kind):
    """With the frames of one link and the world held, six rows are more than the three joints."""
    if kind == "frame":
        posterior = posterior.with_contacts(loop_frame("coupler", "world"))
    predictor = posterior.predictor(covariance="none")
    states = [torch.tensor(getattr(dataset, name)[:4]) for name in "qvu"]
    torch.testing.assert_close(predictor.mean(*states), posterior.predict(*states).mean, rtol=1e-8, atol=1e-8)
    found = predictor.linearize(*(x[0] for x in states))
    for column in range(3):
        step = torch.zeros(1, 3, dtype=torch.float64)
        step[0, column] = 1e-6
        q, v, u = (x[:1] for x in states)
        slope = (predictor.mean(q + step, v, u) - predictor.mean(q - step, v, u)) / 2e-6
        torch.testing.assert_close(found.da_dq[:, column], slope[0], rtol=1e-5, atol=1e-4)


def test_regression_leaves_the_forces_inside_the_loop_out(model, dataset):
    """One degree of freedom: friction of single joints is open, what it does to the motion is not."""
    found = fit(model.with_forces(RigidBodies(learn="all"), Coulomb()), dataset)
    a = found.predict(dataset.q, dataset.v, dataset.u).mean.numpy()
    before = model.dynamics(*(torch.tensor(getattr(dataset, name)) for name in "qvu")).acceleration_map().offset.numpy()
    assert np.abs(a - dataset.a).mean() < 0.1 * np.abs(before - dataset.a).mean()
    rows = model.dynamics(*(torch.tensor(getattr(dataset, name)) for name in "qvu"))
    np.testing.assert_allclose((rows.A.numpy() @ a[..., None])[..., 0], rows.b, atol=1e-6)
