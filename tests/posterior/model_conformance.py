"""What every model has to pass, whatever it is: inherit `ModelConformance` and say how the model is made."""

import dataclasses
import pickle
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from tests.data import samples
from tests.posterior.arm import arm_data

from forcegp import score
from forcegp.errors import InvalidInput
from forcegp.fit import fit
from forcegp.model import Model
from forcegp.posterior import load_posterior, save_posterior
from forcegp.posterior.posterior import Posterior

BATCHES = [(), (1,), (4,), (2, 3), (2, 0, 3)]
FORCES = ("multiplier", "contact_force", "unknown_force")


class ModelConformance:
    """Shapes, batches, calibrable covariance, gradients, seeds, storage, errors and scores of one kind of model."""

    quick: ClassVar[dict[str, Any]] = {}
    """Keywords that make a fit fast."""
    points = 30

    @classmethod
    def make(cls, model: Model) -> Model:
        raise NotImplementedError

    @pytest.fixture(scope="class")
    @classmethod
    def data(cls):
        return arm_data(60, seed=1)

    @pytest.fixture(scope="class")
    @classmethod
    def test(cls):
        return arm_data(40, seed=2)

    @pytest.fixture(scope="class")
    @classmethod
    def fitted(cls, data) -> Posterior:
        return fit(cls.make(data.model), data, points=cls.points, seed=3, **cls.quick)

    def test_it_is_a_model_and_a_posterior_that_tell_what_they_are(self, fitted, data):
        assert isinstance(fitted, Posterior)
        assert isinstance(fitted.model, Model)
        assert fitted.model is fitted.model
        assert fitted.joint_names == tuple(data.joint_names)
        assert fitted.description
        assert fitted.noise_std.shape == (3,)
        assert bool((fitted.noise_std > 0).all())
        assert fitted.settings["points"] == len(fitted.training.q) == self.points
        assert fitted.settings["seed"] == 3
        assert fitted.settings["data"]["episodes"] == [0]
        assert len(fitted.result.history) > 0
        assert np.isfinite(fitted.negative_log_likelihood)

    @pytest.mark.parametrize("batch", BATCHES, ids=str)
    def test_shapes_types_and_positive_covariance(self, fitted, batch):
        generator = torch.Generator().manual_seed(0)
        states = [0.5 * torch.randn(*batch, 3, generator=generator, dtype=torch.float64) for _ in range(3)]
        prediction = fitted.predict(*states)
        assert prediction.mean.shape == (*batch, 3)
        assert prediction.covariance.shape == prediction.noise_covariance.shape == (*batch, 3, 3)
        for values in (prediction.mean, prediction.covariance, prediction.noise_covariance):
            assert values.dtype == torch.float64
            assert bool(torch.isfinite(values).all())
        torch.testing.assert_close(prediction.covariance, prediction.covariance.mT, rtol=0.0, atol=0.0)
        if prediction.mean.numel():
            assert float(torch.linalg.eigvalsh(prediction.covariance).min()) > -1e-9
            assert float(torch.linalg.eigvalsh(prediction.noise_covariance).min()) > 0.0
        for name in FORCES:
            force = getattr(prediction, name)
            assert force is None or force.mean.shape[:-1] == batch
        only_mean = fitted.predict(*states, covariance=False)
        assert only_mean.covariance is None
        torch.testing.assert_close(only_mean.mean, prediction.mean, rtol=1e-10, atol=1e-10)

    def test_rows_are_predicted_each_for_itself(self, fitted, test, monkeypatch):
        flat = fitted.predict(test.q[:6], test.v[:6], test.u[:6])
        batched = fitted.predict(*(x[:6].reshape(2, 3, 3) for x in (test.q, test.v, test.u)))
        torch.testing.assert_close(batched.mean.reshape(6, 3), flat.mean, rtol=1e-10, atol=1e-10)
        single = fitted.predict(test.q[4], test.v[4], test.u[4])
        torch.testing.assert_close(single.mean, flat.mean[4], rtol=1e-10, atol=1e-10)
        std = flat.variance.sqrt()  # the unit: entries beside variances of 5e5 are rounded by 1e-10
        unit = std[:, :, None] * std[:, None]
        torch.testing.assert_close(single.covariance / unit[4], flat.covariance[4] / unit[4], rtol=1e-8, atol=1e-12)
        monkeypatch.setattr("forcegp.posterior.posterior.ROWS_PER_BLOCK", 4)
        blocks = fitted.predict(test.q[:6], test.v[:6], test.u[:6])
        torch.testing.assert_close(blocks.covariance / unit, flat.covariance / unit, rtol=1e-8, atol=1e-12)

    def test_the_mean_is_differentiable(self, fitted, test):
        def mean_of(q, v, u):
            return fitted.predict(q, v, u, covariance=False).mean

        point = tuple(torch.tensor(x[0]).requires_grad_() for x in (test.q, test.v, test.u))
        assert torch.autograd.gradcheck(mean_of, point, atol=1e-6)
        gradients = torch.autograd.grad(mean_of(*point).sum(), point)
        assert float(max(gradient.abs().max() for gradient in gradients)) > 0.0

    def test_equal_seeds_give_equal_models_and_no_global_state_is_used(self, fitted, data, test):
        torch.manual_seed(99)
        before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
        again = fit(self.make(data.model), data, points=self.points, seed=3, **self.quick)
        assert torch.equal(torch.get_rng_state(), before)
        np.testing.assert_array_equal(np.random.get_state()[1], numpy_before)  # noqa: NPY002
        states = test.q, test.v, test.u
        torch.testing.assert_close(again.predict(*states).mean, fitted.predict(*states).mean, rtol=1e-10, atol=1e-10)

    def test_it_comes_back_from_a_folder_and_from_another_process(self, fitted, test, tmp_path):
        save_posterior(fitted, tmp_path / "run")
        states = test.q, test.v, test.u
        for again in (load_posterior(tmp_path / "run"), pickle.loads(pickle.dumps(fitted))):
            assert type(again) is type(fitted)
            mine, theirs = fitted.predict(*states), again.predict(*states)
            assert torch.equal(mine.mean, theirs.mean)
            assert torch.equal(mine.covariance, theirs.covariance)
            assert torch.equal(mine.noise_covariance, theirs.noise_covariance)
            assert again.description == fitted.description
            assert again.result.history == fitted.result.history
            assert again.settings["points"] == self.points

    def test_it_can_be_scored(self, fitted, test):
        found, errors = score(fitted, test, horizons=()), fitted.predict(test.q, test.v, test.u).mean.numpy() - test.a
        np.testing.assert_allclose(found.columns("mae"), np.abs(errors).mean(0), rtol=1e-9)
        assert np.isfinite(found.value("nlpd", "all joints"))
        assert not any("of the data" in warning or "training rows" in warning for warning in found.warnings)
        speaks = not fitted.is_black_box
        assert ("unknown force" in found.quantities()) == speaks
        assert ("contact force" in found.quantities()) == speaks
        bare = dataclasses.replace(test, truth={}, noise_std=None)
        assert score(fitted, bare, horizons=()).value("mae") == found.value("mae")

    def test_wrong_data_and_numbers_are_refused(self, fitted, data, test):
        model = self.make(data.model)
        with pytest.raises(InvalidInput, match="dataset are shoulder, elbow, those of the robot pan, lift, bend"):
            fit(model, samples.dataset())
        with pytest.raises(InvalidInput, match="points=61` must be an integer from 2 to 60"):
            fit(model, data, points=61)
        with pytest.raises(InvalidInput, match="seed=-1"):
            fit(model, data, seed=-1)
        with pytest.raises(InvalidInput, match="last dimension must be 3"):
            fitted.predict(test.q[:, :2], test.v, test.u)
        with pytest.raises(InvalidInput, match="not finite"):
            fitted.predict(np.full(3, np.nan), np.zeros(3), np.zeros(3))
        with pytest.raises(InvalidInput, match="do not broadcast"):
            fitted.predict(test.q[:2], test.v[:3], test.u[:3])
        with pytest.raises(InvalidInput, match="give a Model"):
            fit(data.model.robot, data)
