"""A predictor is made once: later ones load it, unless something that decides it has changed."""

import dataclasses
import warnings

import pytest
import torch
from tests.posterior.arm import arm_data, arm_model
from tests.posterior.test_predictor import CONTACTS, SHORT

from forcegp.codegen.library import default_folder
from forcegp.fit import fit
from forcegp.forces import JointForces, JointFriction
from forcegp.posterior import Posterior


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def fitted(prior=None, model=None, rows: int = 20) -> Posterior:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a search of three iterations is not the subject
        model = model or arm_model().with_forces(prior or JointForces())
        return fit(model, arm_data(rows, 0), restarts=1, options=SHORT)


@pytest.fixture(scope="module")
def posterior() -> Posterior:
    return fitted()


@pytest.fixture(scope="module")
def states() -> tuple[torch.Tensor, ...]:
    data = arm_data(5, 1)
    return tuple(torch.tensor(x) for x in (data.q, data.v, data.u))


def made(posterior, **how):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return posterior.predictor(**how)


def results(predictor, states):
    motions = predictor.rollouts(*(x[:2] for x in states[:2]), states[2][:2, None].expand(2, 3, -1), 0.01)
    return [*predictor(*states), *predictor.linearize(*states), *motions]


def test_the_second_is_the_first_without_tracing(posterior, states):
    first, second = made(posterior, tolerance=0.1), made(posterior, tolerance=0.1)
    expected = results(first, states)
    assert first.code.is_traced
    for found, value in zip(results(second, states), expected, strict=True):
        assert torch.equal(found, value)
    assert not second.code.is_traced
    assert (second.rank, float(second.inflation.max())) == (first.rank, float(first.inflation.max()))
    assert not made(posterior.with_settings(note=1), tolerance=0.1).code.is_traced


def test_what_decides_it_is_in_the_key(posterior, states):
    made(posterior)
    changed = {name: value + 1e-9 for name, value in posterior.hyperparameters.items()}
    others = [
        posterior.conditioned(posterior.trained, posterior.training, changed, posterior.result, posterior.settings),
        posterior.with_settings(widening=3.0),
        posterior.with_model(dataclasses.replace(posterior.model, contacts=CONTACTS["sphere"])),
    ]
    for other in others:
        assert other.predictor(tolerance=100.0).code.is_traced
    assert posterior.predictor(tolerance=0.5).code.is_traced


def test_a_prior_whose_code_has_changed_is_traced_anew(states, monkeypatch):
    posterior = fitted(JointFriction())
    made(posterior)
    features = JointFriction.features
    monkeypatch.setattr(JointFriction, "features", lambda self, dynamics: [z + 0.1 for z in features(self, dynamics)])
    predictor = made(posterior)
    assert predictor.code.is_traced
    expected = posterior.predict(*states).mean
    assert float((predictor.mean(*states) - expected).abs().max()) <= 1e-9 * float(expected.abs().max())


def test_what_holds_code_is_not_kept(posterior):
    held = posterior.with_model(dataclasses.replace(posterior.model, contacts=CONTACTS["implicit"]))
    predictor = made(held, tolerance=100.0)
    assert predictor.code.key is None
    assert not list(default_folder().glob("*.safetensors"))


@pytest.mark.nightly
def test_a_damaged_record_is_made_again(posterior, states):
    expected = results(made(posterior, tolerance=0.1), states)
    for damage in ("cut off", "others may write", "no library"):
        for path in default_folder().glob("*.so" if damage == "no library" else "*.safetensors"):
            if damage == "cut off":
                path.write_bytes(path.read_bytes()[:-9])
            elif damage == "others may write":
                path.chmod(0o666)
            else:
                path.unlink()
        predictor = made(posterior, tolerance=0.1)
        for found, value in zip(results(predictor, states), expected, strict=True):
            assert torch.equal(found, value)
        assert predictor.code.is_traced, damage


def test_the_oldest_records_go(posterior, monkeypatch):
    monkeypatch.setattr("forcegp.posterior.programs.LARGEST", 60_000)
    for tolerance in (0.1, 0.2, 0.3, 0.4):
        made(posterior, tolerance=tolerance)
    sizes = [path.stat().st_size for path in default_folder().glob("*.safetensors")]
    assert 0 < sum(sizes) <= 60_000
    assert made(posterior, tolerance=0.1).code is not None
