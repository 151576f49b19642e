"""Parts of gear friction by evidence: what is there is found, what is not is left out, few reversals show nothing."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.forces.test_presliding import JOINTS, log_of, lugre_log, motion  # noqa: F401  # a fixture
from tests.posterior.arm import arm_model

from forcegp import Torques, fit
from forcegp.data import Dataset
from forcegp.fit.friction_choice import _Regression, choose_friction
from forcegp.forces import DirectionalFriction, GearFriction, Viscous

LEVEL = np.array([0.8, 0.5, 0.3])


def log_with(friction, rows: int = 3000, seed: int = 0, slow: float = 1.0) -> Dataset:
    """Torques of an arm whose joints have this friction of (v, rigid torque), and noise."""
    time, q, v, a = motion(rows, seed, slow)
    rigid = arm_model(0).robot.inverse_dynamics(*map(torch.tensor, (q, v, a))).numpy()
    u = rigid + friction(v, rigid) + 0.01 * np.random.default_rng(seed).standard_normal(rigid.shape)
    return log_of(q, v, a, u, time)


def sign(v):
    return np.tanh(v / 0.02)


def parts_of(log, *laws):
    posterior = fit(arm_model(0).with_forces(Viscous(), GearFriction(), *laws), log, Torques(), rows=1500)
    return posterior, posterior.settings["gear_friction"]


@pytest.mark.parametrize(
    ("friction", "expected"),
    [
        (lambda v, rigid: LEVEL * sign(v), set()),
        (lambda v, rigid: (LEVEL + 0.1 * np.abs(rigid)) * sign(v), {"factor"}),
        (lambda v, rigid: LEVEL * (1.0 + np.sqrt(np.abs(v))) * sign(v), {"root"}),
        (lambda v, rigid: LEVEL * (1.0 + np.exp(-((v / 0.15) ** 2))) * sign(v), {"breakaway"}),
    ],
    ids=["none", "load", "speed", "breakaway"],
)
def test_what_is_there_is_found_and_memory_is_not(friction, expected):
    _, found = parts_of(log_with(friction))
    assert found["few_reversals"] == []
    names = [set(parts) for parts in found["parts"].values()]
    assert all("memory" not in each for each in names)
    assert sum(each >= expected for each in names) >= 2, found  # one joint may show too little of it
    if not expected:  # one joint in three may have a little of something, since widths are tried on a grid
        assert sum(map(bool, names)) <= 1


def test_bristles_are_memory_in_every_joint(lugre_log):  # noqa: F811  # the fixture
    posterior, found = parts_of(lugre_log)
    assert all("memory" in parts for parts in found["parts"].values())
    assert max(found["left"]) < 0.5
    law = next(law for law in posterior.model.laws if isinstance(law, GearFriction))
    assert posterior.model.memory.names == tuple(f"presliding of {joint}" for joint in JOINTS)
    assert bool((law.values["sigma"] > 100.0).all())


def test_a_direction_is_chosen_where_it_is_listed():
    log = log_with(lambda v, rigid: LEVEL * sign(v) + 0.2 * np.abs(v))
    _, found = parts_of(log, DirectionalFriction())
    assert all("direction" in parts for parts in found["parts"].values())
    posterior, found = parts_of(log)
    assert not any("direction" in parts for parts in found["parts"].values())
    assert not any(name.startswith("direction") for name in posterior.parameters)


def test_friction_that_takes_most_of_the_load_is_none():
    assert not any(
        "factor" in parts
        for parts in parts_of(log_with(lambda v, rigid: 0.7 * np.abs(rigid) * sign(v)))[1]["parts"].values()
    )


@pytest.mark.parametrize(("rows", "enough"), [(700, False), (3000, True)])
def test_few_reversals_show_no_memory(rows, enough, lugre_log):  # noqa: F811  # the fixture
    log = lugre_log.rows(slice(0, rows))
    choice = choose_friction(arm_model(0).with_forces(Viscous(0.0)), replace(log, strokes=None))
    assert (len(choice.few_reversals) == 0) == enough
    assert all("memory" not in choice.parts[JOINTS.index(name)] for name in choice.few_reversals)


def test_stated_numbers_are_left_as_they_are():
    model = arm_model(0).with_forces(GearFriction(memory=False))
    posterior = fit(model, log_with(lambda v, rigid: LEVEL * sign(v)), Torques(), rows=500)
    assert "gear_friction" not in posterior.settings
    assert {name.split(".")[1] for name in posterior.parameters} >= {"level", "factor", "root", "breakaway"}


def gains(share: float, errors: float) -> tuple[np.ndarray, np.ndarray]:
    """Squared residuals of ten stretches without and with a part that explains a share of them, so clearly."""
    way = np.array([1.0, -1.0] * 5)
    spread = 10.0 * share / (errors * np.sqrt(10.0) * way.std(ddof=1))
    return np.ones(10), 1.0 - share - spread * way


@pytest.mark.parametrize(
    ("share", "errors", "memory", "expected"),
    [
        (0.06, 2.0, False, True),
        (0.06, 1.0, False, False),
        (0.04, 9.0, False, False),
        (0.01, 0.7, True, True),
        (0.01, 0.3, True, False),
        (0.005, 9.0, True, False),
    ],
)
def test_memory_needs_less_evidence_than_other_parts(share, errors, memory, expected):
    regression = object.__new__(_Regression)
    regression.count = 10
    without, best = gains(share, errors)
    gain = without - best
    assert gain.sum() / without.sum() == pytest.approx(share)
    assert gain.sum() / (np.sqrt(10.0) * gain.std(ddof=1)) == pytest.approx(errors)
    assert regression._clearly(without, best, memory) is expected
