"""Parts of gear friction by evidence: what is there is found, what is not is left out, few reversals show nothing."""

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
import torch
from tests.checks.clean_logs import between_postures
from tests.forces.test_presliding import JOINTS, log_of, lugre_log, motion  # noqa: F401  # a fixture
from tests.posterior.arm import arm_model

from forcegp import Torques, fit, score
from forcegp.data import Dataset
from forcegp.evidence import motion_residuals
from forcegp.fit.friction_choice import WIDTHS, _precision, _Regression, choose_friction
from forcegp.fit.friction_in_words import friction_in_words
from forcegp.fit.transmission_choice import SHARE, _clearly
from forcegp.forces import Actuation, Coulomb, DirectionalFriction, GearFriction, JointFriction, Offset, Rotor, Viscous
from forcegp.inference import OptimizerOptions
from forcegp.noise import Noise
from forcegp.summary import within

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
    posterior, found = parts_of(log := log_with(friction))
    assert expected != {"breakaway"} or "near rest" in friction_in_words(posterior, log, "Nm")[0]
    assert found["few_reversals"] == []
    names = [set(parts) for parts in found["parts"].values()]
    assert all("memory" not in each for each in names)
    assert sum(each >= expected for each in names) >= 2, found  # one joint may show too little of it
    if not expected:  # one joint in three may have a little of something, since widths are tried on a grid
        assert sum(map(bool, names)) <= 1


def test_all_points_are_all_rows_whose_past_is_known():
    """Rows in which a joint has not moved yet are left out, also where all of the log were asked for."""
    time, q, v, a = motion(200, 0)
    for x, still in ((q, q[0]), (v, 0.0), (a, 0.0)):
        x[:4] = still
    u = arm_model(0).robot.inverse_dynamics(*map(torch.tensor, (q, v, a))).numpy() + LEVEL * sign(v)
    log = log_of(q, v, a, u, time)
    forces = Coulomb(LEVEL, sigma=3000.0, memory=True), JointFriction()
    options, model = OptimizerOptions(iterations=3), arm_model(0).with_forces(*forces, noise=Noise(0.1))
    assert 150 < len(fit(model, log, points=len(log), restarts=1, options=options).training) < len(log)


def test_what_is_told_of_a_curve_is_the_line_nearest_to_it():
    log = log_with(lambda v, rigid: LEVEL * (1.0 + np.sqrt(np.abs(v))) * sign(v))
    words, slopes = friction_in_words(parts_of(log)[0], log, "Nm")
    told = map(float, words.split(" Nm")[0].split(", "))
    for dry, (slope, half), v, level in zip(told, slopes.values(), abs(log.v.T), LEVEL, strict=True):
        v = v[v > 0.1 * np.sqrt(np.square(v).mean())]
        true = np.polyfit(v, level * (1.0 + np.sqrt(v)), 1)
        assert (slope, dry) == pytest.approx(true, rel=0.03)
        assert abs(slope - true[0]) < half < 0.1 * slope
    assert "near rest" not in words


def test_wide_intervals_of_what_is_told_stand_beside_it():
    """Of a line they are those of level and viscous friction themselves; and of a tenth of the number and more."""
    log = log_with(lambda v, rigid: LEVEL * sign(v) + 0.2 * v, rows=400)
    noise = [0.01, 0.3, 0.3] * np.random.default_rng(1).standard_normal(log.u.shape)
    posterior = fit(arm_model(0).with_forces(Viscous(), Coulomb()), replace(log, u=log.u + noise), Torques())
    words, slopes = friction_in_words(posterior, log, "Nm")
    found = [[posterior.estimates[f"{law}.{name}"] for name in slopes] for law in ("coulomb.level", "viscous")]
    for (slope, half), each in zip(slopes.values(), found[1], strict=True):
        assert (slope, half) == pytest.approx((each.value, each.value - each.interval[0]), rel=1e-3)
    halves = [each.value - each.interval[0] for each in found[0]]
    narrow = [half < 0.1 * each.value for half, each in zip(halves, found[0], strict=True)]
    assert narrow == [True, False, False]
    expected = zip(found[0], halves, narrow, strict=True)
    assert words == ", ".join(f"{x.value:.3g}" + f" ± {half:.1g}" * (not few) for x, half, few in expected) + " Nm"
    assert [within(1.0, 0.099), within(-1.0, 0.15), within(0.0, 0.0)] == ["1", "-1 ± 0.1", "0"]


def test_friction_that_differs_by_direction_is_told():
    log = log_with(lambda v, rigid: LEVEL * (sign(v) - [0.0, 0.075, -0.025]))
    log = replace(log, u=log.u + 0.2 * np.random.default_rng(0).standard_normal(log.u.shape))
    words = friction_in_words(parts_of(log, Offset())[0], log, "Nm")[0].partition("; ")[2]
    assert words == "lift 0.072 Nm more backwards, or its torque has another zero"


COUPLED = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 1.0]])
WRIST = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0], [0.0, -1.0, 1.0]])


@pytest.mark.parametrize("T", [np.eye(3), COUPLED, WRIST], ids=["joints", "motors", "differential"])
def test_motors_that_turn_with_two_joints_are_found(T):
    log = log_with(lambda v, rigid: (LEVEL * sign(v @ T.T) + 0.2 * (v @ T.T)) @ T)
    posterior, found = parts_of(log, Rotor())
    coupled = np.count_nonzero(T) - 3
    assert found.get("transmission") == (T.tolist() if coupled else None)
    laws = {type(law): law for law in posterior.model.laws}
    for kind in (Viscous, GearFriction, Rotor):
        given = laws[kind].transmission
        np.testing.assert_array_equal(np.eye(3) if given is None else given, T)
    np.testing.assert_allclose(laws[GearFriction].values["level"], LEVEL, rtol=0.1)
    np.testing.assert_allclose(laws[Viscous].values["damping"], 0.2, rtol=0.2)
    words, slopes = friction_in_words(posterior, log, "Nm")
    assert [slope for slope, _ in slopes.values()] == pytest.approx(3 * [0.2], rel=0.2)
    assert ("the motor of bend turns with -1 lift +1 bend" in words) == bool(coupled)
    assert words.count("the motor of") == coupled
    [first, *_] = friction_in_words(posterior, log, "Nm", log.joint_names[1:2])[0].split(" Nm")
    assert first.split(", ")[1] == "–" != first.split(", ")[0]


def test_models_of_such_motors_are_scored_on_rows_that_are_held_out():
    """Rows of a split, and points among them, know the strokes of motors that the fit has found."""
    log = log_with(lambda v, rigid: (LEVEL * sign(v @ COUPLED.T) + 0.2 * (v @ COUPLED.T)) @ COUPLED, rows=1500)
    how = {"split": "blocks:5:3", "identification": "viscous+gear+rotor@torques", "horizons": (), "points": 30}
    found = score(["identified"], log, seeds=1, **how)
    assert not found.failures
    assert found.value("share", "torque", "identified") < 0.5


def test_a_transmission_that_is_stated_or_that_of_the_actuators_is_taken():
    third = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.5, 1.0]])
    log = log_with(lambda v, rigid: (LEVEL * sign(v @ third.T)) @ third, rows=1500)
    stated = arm_model(0).with_forces(Viscous(), GearFriction(transmission="bend+0.5*lift"))
    assert fit(stated, log, Torques(), rows=500).settings["gear_friction"]["transmission"] == third.tolist()
    motors = Actuation((2.0 * third).T.tolist(), names=("one", "two", "three"))
    driven = arm_model(0).with_forces(motors, Viscous(), GearFriction())
    rows = replace(log, u=log.u @ np.linalg.inv(2.0 * third), model=replace(driven, forces=driven.laws[:2]))
    assert fit(driven, rows, Torques(), rows=500).settings["gear_friction"]["transmission"] == third.tolist()


@pytest.mark.parametrize(("share", "errors", "expected"), [(0.3, 4.0, True), (0.15, 9.0, False), (0.3, 2.0, False)])
def test_a_transmission_needs_more_evidence_than_parts(share, errors, expected):
    without, best = (each[:, None] * [1.0, 0.0, 1.0] for each in gains(share, errors))
    assert _clearly(without, best, [0, 2]) is expected
    assert _clearly(without, best, [0, 1]) is (expected or share < SHARE)  # relative to the joints that change


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


@pytest.mark.parametrize(
    ("part", "friction", "found"),
    [
        ("factor", lambda v, rigid: 0.7 * np.abs(rigid) * sign(v), False),  # most of the load
        ("root", lambda v, rigid: LEVEL * (1.0 - 2.5 * np.sqrt(np.abs(v))) * sign(v) + 2.0 * v, False),  # it drives
        (
            "root",
            lambda v, rigid: LEVEL * (1.0 - 1.1 * np.sqrt(np.abs(v))) * sign(v) + 2.0 * v,
            True,
        ),  # by three quarters
    ],
)
def test_a_part_that_makes_no_friction_is_none(part, friction, found):
    assert [part in parts for parts in parts_of(log_with(friction))[1]["parts"].values()] == [found] * 3


@pytest.mark.parametrize(("rows", "enough"), [(250, False), (400, True), (3000, True)])
def test_few_reversals_show_no_memory(rows, enough, lugre_log):  # noqa: F811  # the fixture
    log = lugre_log.rows(slice(0, rows))
    choice = choose_friction(arm_model(0).with_forces(Viscous(0.0)), replace(log, strokes=None))
    assert (len(choice.few_reversals) == 0) == enough
    assert all("memory" not in choice.parts[JOINTS.index(name)] for name in choice.few_reversals)


@pytest.mark.parametrize("seed", [0, 1])
def test_joints_that_hardly_turn_have_the_memory_of_the_others(seed):
    log = between_postures(arm_model(0).robot, seed, 6.0, 0.7)
    choice = choose_friction(arm_model(0).with_forces(Viscous(0.0)), log)
    assert choice.few_reversals
    assert choice.has("memory").all()


def test_long_logs_are_thinned(monkeypatch):
    """To 10,000 rows, and to 2,000 for the first fit and for transmissions."""
    rows, module = [], import_module("forcegp.fit.friction_choice")
    log = log_with(lambda v, rigid: LEVEL * sign(v), rows=12_000)

    def seen(name, place):
        given = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *args: rows.append(len(args[place])) or given(*args))

    seen("_Regression", 0)
    seen("choose_transmission", 2)
    _, found = parts_of(log)
    assert rows == [2000, 10_000]
    assert set(found["parts"]) == set(JOINTS)


def test_stated_numbers_are_left_as_they_are():
    model = arm_model(0).with_forces(GearFriction(memory=False))
    posterior = fit(model, log_with(lambda v, rigid: LEVEL * sign(v)), Torques(), rows=500)
    assert "gear_friction" not in posterior.settings
    assert {name.split(".")[1] for name in posterior.parameters} >= {"level", "factor", "root", "breakaway"}


@pytest.mark.parametrize("noise", [None, Noise((0.3, 0.2, 0.5), (0.05, 0.1, 0.02))], ids=["forces", "both"])
def test_normal_equations_are_those_of_weighted_least_squares(noise):
    log = log_with(lambda v, rigid: LEVEL * (1.0 + np.sqrt(np.abs(v))) * sign(v)).rows(slice(None, None, 5))
    model = arm_model(0).with_forces(Viscous(0.0), Coulomb(0.0))
    P, torque = _precision(model, log, noise), motion_residuals(log, model)[0]
    state = model.state(*(torch.tensor(np.array(x)) for x in (log.q, log.v, log.u)))
    regression = _Regression(P, Coulomb(), log, state, torque)
    regression.beside, regression.across = regression._beside(0), {}
    at, parts = (-WIDTHS[3], 5), ("root", "direction")
    L, columns = np.linalg.cholesky(P).swapaxes(1, 2), [np.linalg.solve(P, regression.bodies)]
    for j in range(3):
        chosen, sign_of = (parts, at[0]) if j == 0 else ((), regression.at[j])
        s = np.tanh(log.v[:, j] / (-sign_of * regression.speed[j]))
        more = [np.sqrt(np.abs(log.v[:, j])) * s, np.abs(log.v[:, j])] if chosen else []
        columns.append(np.stack([log.v[:, j], s, np.ones(600), *more], axis=-1)[:, None] * np.eye(3)[j][:, None])
    X, y = L @ np.concatenate(columns, axis=-1), L @ torque[..., None]
    rows, left = np.arange(600) * 10 // 600, {}
    for k in range(-1, 10):  # all rows, then without a stretch
        kept = rows != k
        x = np.linalg.lstsq(X[kept].reshape(-1, X.shape[-1]), y[kept].ravel(), rcond=None)[0]
        left[k] = (y[..., 0] - X @ x) ** 2
    joints = slice(None) if noise else 0
    for held_out in (False, True):
        every = [left[-1][:, joints].sum()]
        expected = [left[k][rows == k][:, joints].sum() for k in range(10)] if held_out else every
        np.testing.assert_allclose(regression._residuals(0, parts, at, held_out), expected, rtol=1e-3)


def gains(share: float, errors: float) -> tuple[np.ndarray, np.ndarray]:
    """Squared residuals of ten stretches without and with a part that explains a share of them, so clearly."""
    way = np.array([1.0, -1.0] * 5)
    return np.ones(10), 1.0 - share - (10.0 * share / (errors * np.sqrt(10.0) * way.std(ddof=1))) * way


@pytest.mark.parametrize(
    ("share", "errors", "memory", "expected"),
    [
        (0.06, 2.0, False, True), (0.06, 1.0, False, False), (0.04, 9.0, False, False), (0.01, 0.7, True, True),
        (0.01, 0.3, True, False), (0.005, 9.0, True, False),
    ],
)  # fmt: skip
def test_memory_needs_less_evidence_than_other_parts(share, errors, memory, expected):
    regression = object.__new__(_Regression)
    regression.count, regression.coupled = 10, False
    without, best = gains(share, errors)
    gain = without - best
    assert gain.sum() / without.sum() == pytest.approx(share)
    assert gain.sum() / (np.sqrt(10.0) * gain.std(ddof=1)) == pytest.approx(errors)
    assert regression._clearly(without, best, memory) is expected
