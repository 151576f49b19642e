"""Numbers that users hand over: what is taken, what is converted, and what would have been read as something else."""

import datetime

import numpy as np
import pytest
import torch
from tests.data.samples import dataset
from tests.posterior.arm import arm_data

from forcegp.errors import DatasetError, ForceGPError, InvalidInput, NumericalError
from forcegp.fit import fit
from forcegp.forces import JointForces


@pytest.fixture(scope="module")
def data():
    return arm_data(12, 0)


@pytest.fixture(scope="module")
def posterior(data):
    return fit(data.model.with_forces(JointForces()), data, restarts=1)


@pytest.fixture(scope="module")
def state(data):
    return tuple(np.array(x[0]) for x in (data.q, data.v, data.u))


@pytest.mark.parametrize("name", ["q", "v", "u", "a", "noise_std", "truth"])
def test_masked_entries_of_a_dataset_are_refused(name):
    masked = np.ma.masked_equal(np.where(np.arange(80).reshape(40, 2) == 7, -9999.0, 1.0), -9999.0)
    given = {"truth": {"a": masked}} if name == "truth" else {name: masked}
    with pytest.raises(DatasetError, match=r"has 1 masked values, the first at \(3, 1\); .* drop these rows"):
        dataset(**given)


WRONG = [
    (np.ma.masked_array([1.0, 2.0, -9999.0], [False, False, True]), "u has 1 masked values"),
    (np.array(["2026-01-01"] * 3, "datetime64[D]"), "u must be an array of real numbers; given: datetime64"),
    ([datetime.date(2026, 1, 1)] * 3, "u must be an array of real numbers; given: object"),
    ([True, False, True], "u must be an array of real numbers; given: bool"),
    (np.full(3, 1.0 + 2.0j), "u must be an array of real numbers; given: complex128"),
    (torch.tensor([True, False, True]), "u must be a tensor of real numbers; given: torch.bool"),
    (torch.full((3,), 1.0 + 2.0j), "u must be a tensor of real numbers; given: torch.complex64"),
    ("123", "u must be an array of real numbers; given: <U3"),
]


@pytest.mark.parametrize(("given", "message"), WRONG)
def test_predict_rollout_and_predictor_refuse_what_is_no_real_number(posterior, state, given, message):
    q, v, _ = state
    predictor = posterior.predictor(compile=False)
    steps = [given] if isinstance(given, str | list) else given[None]
    for call in (
        lambda: posterior.predict(q, v, given),
        lambda: posterior.components(q, v, given),
        lambda: posterior.rollout(q, v, steps, 0.01),
        lambda: predictor(q, v, given),
    ):
        with pytest.raises(InvalidInput, match=message):
            call()


def test_a_prediction_that_is_not_finite_is_an_error(posterior, state):
    q, v, u = state
    with pytest.raises(NumericalError, match="prediction of row 1 is not finite: q, v or u is too large"):
        posterior.predict(np.stack([q, q]), np.stack([v, 1e308 * np.ones(3)]), np.stack([u, u]))
    with pytest.raises(ForceGPError):
        posterior.predict(q + 1e308, v, u)


def test_inside_vmap_the_remedy_is_stated(posterior, data):
    rows = [torch.tensor(np.array(x[:3])) for x in (data.q, data.v, data.u)]
    predictor = posterior.predictor(compile=False)
    for call in (
        lambda q, v, u: posterior.predict(q, v, u).mean,
        lambda q, v, u: posterior.rollout(q, v, u[None], 0.01).q,
        lambda q, v, u: predictor.mean(q, v, u),
    ):
        with pytest.raises(InvalidInput, match=r"torch.func.vmap.*batch dimensions lead.*\(n, nv\)"):
            torch.func.vmap(call)(*rows)
