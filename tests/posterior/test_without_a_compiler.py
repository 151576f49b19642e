"""Predictors where nothing can be compiled: torch computes the same, and one warning says so."""

import warnings

import pytest
import torch
from tests.posterior.arm import arm_data, arm_model, quick_fit

from forcegp.errors import NumericalWarning
from forcegp.forces import JointForces, JointFriction


def test_everything_is_the_same_after_one_warning(states, tmp_path, monkeypatch):
    posterior = quick_fit(arm_model().with_forces(JointFriction(), JointForces()), arm_data(20, 0))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("CC", "no-such-compiler")
    slower = "predictions are computed by torch, some hundred times slower: .*no-such-compiler.*compile=False"
    with pytest.warns(NumericalWarning, match=slower) as given:
        predictor = posterior.predictor()
    assert len(given) == 1
    assert "\n" not in str(given[0].message)
    eager = posterior.predictor(compile=False)
    with warnings.catch_warnings(action="error"):
        for at in (states, [x[0] for x in states]):
            for name, more in (("mean", ()), ("__call__", ()), ("linearize", ()), ("step", (0.01,))):
                found, expected = (getattr(of, name)(*at, *more) for of in (predictor, eager))
                assert type(found) is type(expected)
                torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
        u = states[2][:, None].repeat(1, 5, 1)
        for functions in (0, 2):
            motions = [of.rollouts(*states[:2], u, 0.01, functions=functions) for of in (predictor, eager)]
            torch.testing.assert_close(motions[0], motions[1])
    torch.testing.assert_close(predictor.mean(*states), posterior.predict(*states).mean)
