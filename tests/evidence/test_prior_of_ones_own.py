"""A prior that is not registered fits and predicts; one that gives the wrong things is refused before the search."""

from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from gpytorch.kernels import RBFKernel
from tests.forces.third_party_unknown import AirDrag
from tests.posterior.arm import arm_data

from forcegp.errors import InvalidInput
from forcegp.fit import fit
from forcegp.fit.search import Search
from forcegp.forces import JointForces, Unknown, kernel_of
from forcegp.inference import OptimizerOptions
from forcegp.posterior import save_posterior

QUICK: dict[str, Any] = {"restarts": 1, "options": OptimizerOptions(iterations=2)}


@dataclass(frozen=True)
class OnOneJoint(Unknown):
    """A force at the first joint, on its velocity; `wrong` replaces what methods give."""

    wrong: dict[str, Any] = field(default_factory=dict)

    def _or(self, name, right, *given):
        return self.wrong[name](right, *given) if name in self.wrong else right

    def latent_names(self, robot):
        return self._or("latent_names", ("push",))

    def direction(self, dynamics):
        unit = torch.zeros(*dynamics.state.q.shape, 1, dtype=torch.float64)
        unit[..., 0, :] = 1.0
        return self._or("direction", unit)

    def features(self, dynamics):
        return self._or("features", (dynamics.state.v[..., :1],))

    def scalings(self, robot):
        return self._or("scalings", ("scale",))

    def kernels(self, robot, dimensions, variances):
        made = tuple(kernel_of("squared-exponential", d, s) for d, s in zip(dimensions, variances, strict=True))
        return self._or("kernels", made)

    def to_dict(self):
        raise AssertionError("nobody stores this")


@pytest.fixture(scope="module")
def data():
    return arm_data(15, 0)


def test_a_prior_that_is_not_registered_fits_and_is_refused_only_by_save(data, tmp_path):
    for prior in (OnOneJoint(), (OnOneJoint(), JointForces())):
        posterior = fit(data.model.with_forces(prior), data, **QUICK)
        assert torch.isfinite(posterior.predict(data.q, data.v, data.u).std).all()
        with pytest.raises(InvalidInput, match="OnOneJoint cannot be stored: register it first"):
            save_posterior(posterior, tmp_path / "run")
        assert not (tmp_path / "run").exists()


def learned(right):
    return torch.nn.Parameter(right if isinstance(right, torch.Tensor) else right[0])


WRONG = [
    ("features", lambda z: (z[0][..., 0],), r"features of 'push' is .* of shape \(15,\).*z\[..., None\]"),
    ("features", lambda z: z[0], "features gives a Tensor; it must give a tuple with one for each of"),
    ("features", lambda z: (*z, *z), "features gives 2 entries"),
    ("features", lambda z: (z[0].float(),), "features of 'push' is a torch.float32 .* must be a float64 tensor"),
    ("features", lambda z: (z[0].numpy(),), "features of 'push' .* must be a float64 tensor"),
    ("features", lambda z: (z[0] / 0.0,), "features of 'push' is not finite at training row 0"),
    ("features", lambda z: (learned(z),), "features of 'push' .* without gradients"),
    ("direction", lambda B: B.mT, r"direction is .* of shape \(15, 1, 3\); .* \(15, 3, 1\)"),
    ("latent_names", lambda names: "push", "latent_names gives 'push'; it must give a tuple"),
    ("scalings", lambda ways: ("log",), "scalings of 'push' is 'log'; give one of 'standardize', 'scale', 'none'"),
    ("scalings", lambda ways: ways * 2, "scalings gives 2 entries"),
    ("kernels", lambda kernels: kernels * 2, "OnOneJoint.kernels gives 2 kernels for 1 latents"),
    ("kernels", lambda kernels: kernels[0], "kernels must give a tuple of GPyTorch kernels"),
    ("kernels", lambda kernels: (RBFKernel(),), r"float32; inference needs float64, call .double\(\)"),
]


@pytest.mark.parametrize(("method", "wrong", "message"), WRONG)
def test_what_a_prior_gives_is_checked_before_the_search(data, monkeypatch, method, wrong, message):
    monkeypatch.setattr(Search, "best", lambda *_, **__: pytest.fail("searched"))
    with pytest.raises(InvalidInput, match=message) as caught:
        fit(data.model.with_forces(OnOneJoint({method: wrong})), data, **QUICK)
    assert "\n" not in str(caught.value)


def test_a_complete_prior_passes(data):
    fit(data.model.with_forces(AirDrag("hand")), data, **QUICK)
