"""A posterior as a CasADi function: `predict`, its derivatives, and what CasADi makes of it."""

import sys

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from tests.posterior.arm import arm_data, arm_model, quick_fit
from tests.posterior.exported_program import IMPLICIT, RK4

from forcegp.codegen.library import compile_library
from forcegp.errors import InvalidInput, MissingExtra, NumericalError
from forcegp.forces import ContactFriction, JointForces, JointFriction
from forcegp.posterior import Posterior, casadi_function, export_casadi

casadi = pytest.importorskip("casadi", reason="CasADi is not installed: pip install 'forcegp[casadi]'")

PRIORS = {
    "joint": JointForces(),
    "friction under load": (JointFriction(), ContactFriction(load=True, expected=0.2)),
    "matern": (JointFriction(kernel="matern-5/2"), JointForces(kernel="matern-3/2 + linear", inputs=("q",))),
    "none": (),
}


@pytest.fixture(scope="module", params=PRIORS)
def posterior(request) -> Posterior:
    return quick_fit(arm_model().with_forces(PRIORS[request.param]))


@pytest.fixture(scope="module")
def friction() -> Posterior:
    return quick_fit(arm_model().with_forces(JointFriction()), arm_data(12, 0), 1)


def test_it_is_predict_with_the_derivatives_of_a_predictor(posterior, states):
    function = casadi_function(posterior)
    slopes, expected = function.jacobian(), posterior.predict(*states, covariance=False).mean.numpy()
    linear = posterior.predictor(covariance="none").linearize(*states)
    jacobians = torch.cat([linear.da_dq, linear.da_dv, linear.da_du], dim=-1).numpy()
    for k, state in enumerate(zip(*(x.numpy() for x in states), strict=True)):
        assert_allclose(np.array(function(*state)).ravel(), expected[k], rtol=0, atol=1e-12 * abs(expected).max())
        found = np.hstack([np.array(part) for part in slopes(*state, 0)])
        assert_allclose(found, jacobians[k], rtol=0, atol=1e-12 * abs(jacobians).max())


@pytest.mark.usefixtures("unchecked")  # explicit steps add and scale CasADi's expressions as they do tensors
@pytest.mark.parametrize("integrator", ["symplectic-euler", RK4, IMPLICIT])
def test_steps_are_those_of_a_predictor(posterior, states, integrator):
    function = casadi_function(posterior, steps=0.01, integrator=integrator)
    expected = posterior.predictor(covariance="none").step(*states, 0.01, integrator)
    for k in range(len(states[0])):
        found = function(*(x[k].numpy() for x in states))
        for ours, theirs in zip(found, expected, strict=True):
            assert_allclose(np.array(ours).ravel(), theirs[k], rtol=1e-9, atol=1e-9)
    for wrong, message in (({"steps": 0.0}, "dt is 0.0"), ({"steps": 0.1, "integrator": "leap"}, "'leap'")):
        with pytest.raises(InvalidInput, match=message):
            casadi_function(posterior, **wrong)


def test_its_own_code_compiles_to_the_same(posterior, states, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    function = casadi_function(posterior, name="arm")
    function.generate("arm.c", {"with_header": False})
    source, library = (tmp_path / "arm.c").read_text(encoding="utf-8"), tmp_path / "arm.so"
    compile_library(source, ("-O1", "-fPIC", "-shared"), library, "arm")
    external, state = casadi.external("arm", str(library)), [x[2].numpy() for x in states]
    assert_allclose(np.array(external(*state)), np.array(function(*state)), rtol=1e-12)


def test_a_kernel_that_is_the_same_for_all_centres(states):
    model = quick_fit(arm_model().with_forces(JointForces(kernel="constant", inputs=("q",))), arm_data(12, 0), 1)
    expected = model.predict(*states).mean[0].numpy()
    found = np.array(casadi_function(model)(*(x[0].numpy() for x in states))).ravel()
    assert_allclose(found, expected, rtol=0, atol=1e-9 * abs(expected).max())  # weights that cancel


def test_a_step_that_newtons_method_does_not_find_is_one_line(friction, tmp_path, monkeypatch):
    def never(*given):
        return rootfinder(*given, {"max_iter": 1})

    rootfinder = casadi.rootfinder
    monkeypatch.setattr(casadi, "rootfinder", never)
    message = r"^CasADi finds no step of 0\.05 s by implicit-midpoint .*; give shorter steps, or .*$"
    with pytest.raises(NumericalError, match=message):
        export_casadi(friction, tmp_path, steps=0.05, integrator="implicit-midpoint")
    assert list(tmp_path.iterdir()) == []


def test_without_casadi(friction, monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(MissingExtra, match=r"pip install 'forcegp\[casadi\]'"):
        casadi_function(friction)
