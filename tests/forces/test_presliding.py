"""Friction that remembers: its state against Dahl's equation, its strokes, its stiffness from logs of another law."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from tests.posterior.arm import arm_model

from forcegp import Accelerations, Dataset, Torques, fit, score
from forcegp.control import ComputedTorque, ContactMonitor
from forcegp.control.tracking import Past
from forcegp.data import with_memory
from forcegp.data.strokes import strokes
from forcegp.errors import DataWarning, InvalidInput
from forcegp.evidence import motion_residuals
from forcegp.forces import Coulomb, GearFriction, LoadFriction, Stribeck, Viscous
from forcegp.forces.presliding import after_step, after_strokes
from forcegp.noise import Noise

DT, SIGMA = 0.002, torch.tensor([300.0, 900.0, 2000.0], dtype=torch.float64)
JOINTS = ("pan", "lift", "bend")


def motion(rows: int, seed: int, slow: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time, and q, v, a of sines with many reversals."""
    rng, time = np.random.default_rng(seed), DT * np.arange(rows)
    w, phase, size = rng.uniform(1.0, 5.0, (3, 3)), rng.uniform(0.0, 6.0, (3, 3)), rng.uniform(0.05, 0.3, (3, 3))
    at, w = slow * w * time[:, None, None] + phase, slow * w
    return time, (size * np.sin(at)).sum(1), (size * w * np.cos(at)).sum(1), -(size * w * w * np.sin(at)).sum(1)


def dahl(time: np.ndarray, q: np.ndarray, v: np.ndarray, sigma: float) -> np.ndarray:
    """dz/dt = sigma (v - z |v|) by an ordinary solver."""

    def rate(t, z):
        speed = np.interp(t, time, v)
        return sigma * (speed - z * abs(speed))

    return solve_ivp(rate, time[[0, -1]], [0.0], t_eval=time, method="LSODA", rtol=1e-9, atol=1e-10, max_step=DT).y[0]


def log_of(q, v, a, u, time) -> Dataset:
    return Dataset(q=q, v=v, u=u, a=a, time=time, model=arm_model(0))


def lugre(time: np.ndarray, v: np.ndarray, stiffness: float, level: float, breakaway: float) -> np.ndarray:
    """Friction of the LuGre model (Canudas de Wit et al. 1995), with viscous bristles and a Stribeck curve."""
    damping, z, out = 0.5 * np.sqrt(stiffness), 0.0, np.zeros_like(v)
    for k, speed in enumerate(v):
        for _ in range(20):
            rate = speed - stiffness * abs(speed) / (level + breakaway * np.exp(-((speed / 0.05) ** 2))) * z
            z += DT / 20 * rate
        out[k] = stiffness * z + damping * rate * 1e-2
    return out


@pytest.fixture(scope="module")
def lugre_log() -> Dataset:
    """A log whose friction is not of the form that is fitted."""
    time, q, v, a = motion(6000, 0)
    friction = np.stack([lugre(time, v[:, j], (800.0, 500.0, 300.0)[j], (0.8, 0.5, 0.3)[j], 0.1) for j in range(3)], 1)
    u = arm_model(0).robot.inverse_dynamics(*map(torch.tensor, (q, v, a))).numpy() + friction
    return log_of(q, v, a, u + 0.01 * np.random.default_rng(1).standard_normal(u.shape), time)


def test_it_is_the_solution_of_dahls_equation():
    time, q, v, a = motion(1500, 3)
    past = torch.tensor(strokes(log_of(q, v, a, a, time)))
    for j in range(3):
        expected, found = dahl(time, q[:, j], v[:, j], float(SIGMA[j])), after_strokes(past[:, j], SIGMA[j]).numpy()
        np.testing.assert_allclose(found, expected, atol=0.01)  # the reversal lies between two rows
        by_steps, z = np.zeros(len(q)), torch.zeros(1, dtype=torch.float64)
        for k in range(1, len(q)):
            z = after_step(z, torch.tensor(q[k : k + 1, j] - q[k - 1 : k, j]), SIGMA[j])
            by_steps[k] = float(z)
        np.testing.assert_allclose(found, by_steps, atol=1e-12)


def test_it_is_smooth_in_sigma_and_bounded():
    past = torch.tensor(np.random.default_rng(0).normal(0.0, 1e-3, (4, 3, 6)))
    assert torch.autograd.gradcheck(lambda s: after_strokes(past, s), SIGMA.clone().requires_grad_())
    assert float(after_strokes(past, SIGMA).abs().max()) < 1.0
    between = after_strokes(past, SIGMA, 1.0) - after_strokes(past, SIGMA, -1.0)
    torch.testing.assert_close(between, 2.0 * torch.exp(-SIGMA * past.abs().sum(-1)))  # what a start leaves


@pytest.mark.parametrize("evidence", [Torques(), Accelerations()], ids=str)
def test_a_gear_with_bristles_is_explained_better_and_its_numbers_are_near(lugre_log, evidence):
    train, test, left = lugre_log.rows(slice(0, 4000)), lugre_log.rows(slice(4000, 6000)), {}
    for law in (Stribeck(), Coulomb(), Coulomb(memory=True)):
        found = fit(arm_model(0).with_forces(Viscous(), law), train, evidence, rows=1500)
        force, _ = motion_residuals(with_memory(test, found.model), found.model)
        left[bool(law.memory), type(law).__name__] = float(np.sqrt((force**2).mean()))
    assert left[True, "Coulomb"] < 0.5 * min(left[False, "Coulomb"], left[False, "Stribeck"])
    values = {name: each.value for name, each in found.parameters.items()}
    np.testing.assert_allclose([values[f"coulomb.level.{joint}"] for joint in JOINTS], [0.8, 0.5, 0.3], rtol=0.1)
    expected = np.array([800.0, 500.0, 300.0]) / [0.8, 0.5, 0.3]  # over level: the slope at a reversal, halved
    np.testing.assert_allclose([values[f"coulomb.sigma.{joint}"] for joint in JOINTS], expected, rtol=0.5)


def test_memory_is_a_matter_of_joints(lugre_log):
    model = arm_model(0).with_forces(Coulomb(memory=("lift",)))
    assert model.inputs == (*JOINTS, "presliding of lift")
    found = fit(model, lugre_log, Torques(), rows=1000)
    names = set(found.parameters)
    assert names == {f"coulomb.level.{joint}" for joint in JOINTS} | {
        "coulomb.sigma.lift", "coulomb.velocity_scale.pan", "coulomb.velocity_scale.bend"
    }  # fmt: skip
    law, seen = found.model.laws[-1], with_memory(lugre_log, found.model)
    state = found.model.state(*(torch.tensor(np.array(x[:50])) for x in (seen.q, seen.v, seen.u)))
    expected = torch.tanh(state.v / law.values["velocity_scale"])
    expected[:, 1] = state.u[:, 3]
    torch.testing.assert_close(law.force(state), -law.values["level"] * expected)


@pytest.mark.parametrize("law", [LoadFriction, GearFriction])
def test_load_and_speed_change_its_level(law, lugre_log):
    given = {"level": [0.3, 0.2, 0.1], "factor": [0.1, 0.05, 0.2], "sigma": SIGMA.tolist(), "memory": True}
    if law is GearFriction:
        given["root"] = [0.2, -0.05, 0.1]
    model = arm_model(0).with_forces(law(**given))
    z, rigid = torch.tensor(with_memory(lugre_log, model).u[:, 3:]), torch.tensor(lugre_log.u[:, :3])
    torch_of = partial(torch.tensor, dtype=torch.float64)
    level = torch_of(given["level"]) + torch_of(given.get("root", 0.0)) * torch.tensor(lugre_log.v).abs().sqrt()
    u = rigid + level * z  # solve u = rigid + (level + mu |u|) z
    u = u / (1.0 - torch_of(given["factor"]) * z * u.sign())
    q, v = (torch.tensor(np.array(x)) for x in (lugre_log.q, lugre_log.v))
    a = model.robot.forward_dynamics(q, v, rigid)
    loaded = replace(lugre_log, u=u.numpy(), a=a.numpy())
    expected = model.dynamics(q, v, torch.tensor(with_memory(loaded, model).u)).acceleration_map().offset
    torch.testing.assert_close(expected, a, rtol=1e-8, atol=1e-8)
    found = fit(arm_model(0).with_forces(law(memory=True)), loaded, Torques(), rows=1000)
    for name in ("level", "factor"):
        np.testing.assert_allclose(found.model.laws[-1].values[name], given[name], atol=0.01)


def test_joints_that_are_not_there_are_refused():
    with pytest.raises(InvalidInput, match=r"Coulomb memory names \['wrist'\]; "):
        arm_model(0).with_forces(Coulomb(memory=("wrist",)))


def test_scores_and_motions_know_the_past(lugre_log):
    few = lugre_log.rows(slice(0, 6000, 2))
    scores = score(
        ["viscous+coulomb", "viscous+coulomb:memory"], few, split="blocks:4:2", horizons=(0.1,), starts=5, seeds=1,
        identification="viscous+coulomb",
    )  # fmt: skip
    without, remembering = (scores.runs[name][0]["table"] for name in list(scores.runs)[1:])
    for quantity, most in (("acceleration", 0.5), ("position after 0.1 s", 0.8)):
        assert (np.array(remembering[quantity]["rmse"]) / without[quantity]["rmse"]).max() < most, quantity


def test_controllers_and_monitors_see_the_past(lugre_log):
    train, test, left = lugre_log.rows(slice(0, 4000)), lugre_log.rows(slice(4000, 6000)), {}
    for law in (Coulomb(), Coulomb(memory=True)):
        posterior = fit(arm_model(0).with_forces(Viscous(), law, noise=Noise(0.1)), train, Torques(), rows=1500)
        monitor = ContactMonitor(posterior.predictor(), dt=DT)
        left[law.memory] = float(monitor._residuals(test.q, test.v, test.u)[0].square().mean().sqrt())
    assert left[True] < 0.6 * left[False]
    predictor, z = posterior.predictor(), [0.5, -0.2, 0.7]
    q, v, a = test.q[0], test.v[0], test.a[0]
    u = predictor.inverse_dynamics(q, v, a, memory=z).mean
    torch.testing.assert_close(posterior.predict(q, v, np.append(u, z)).mean, torch.tensor(a), rtol=1e-7, atol=1e-7)
    with pytest.raises(InvalidInput, match=r"this model remembers: give memory=\(presliding of pan"):
        predictor.inverse_dynamics(q, v, a)
    assert ComputedTorque(predictor, stiffness=100.0, position_noise=1e-3).past.least == 1e-3
    controller, seen = ComputedTorque(predictor, stiffness=100.0), with_memory(test, posterior.model)
    for k in range(300):
        asked = controller(test.q[k], test.v[k], test.q[k], test.v[k], test.a[k])
    np.testing.assert_allclose(controller.past.z, seen.u[299, 3:], atol=1e-9)
    needed = predictor.inverse_dynamics(test.q[299], test.v[299], test.a[299], memory=controller.past.z).mean
    torch.testing.assert_close(asked, needed, rtol=1e-7, atol=1e-7)
    more = posterior.update(test.rows(slice(0, 200)))
    assert len(more.training) == len(more.training.strokes) == len(posterior.training) + 200


def test_noise_of_an_encoder_does_not_wear_the_state_down():
    model, chance = arm_model(0).with_forces(Coulomb(1.0, sigma=1000.0, memory=True)), np.random.default_rng(0)
    quiet, every = Past(model, least=5e-5), Past(model)
    for past in (quiet, every):
        past.see(torch.zeros(3, dtype=torch.float64))
        past.see(torch.full((3,), 0.01, dtype=torch.float64))
        for _ in range(500):
            past.see(torch.tensor(0.01 + 1e-5 * chance.standard_normal(3)))
    assert bool((quiet.z > 0.99).all())
    assert bool((every.z < 0.5).all())


def test_rows_at_once_are_rows_one_by_one():
    model = arm_model(0).with_forces(Coulomb(1.0, sigma=10.0, memory=["pan", "bend"]))
    q, single, together = torch.randn(50, 3, dtype=torch.float64).cumsum(0) / 20.0, Past(model), Past(model)
    wanted = [torch.stack(each) for each in zip(*((single.see(row), single.open) for row in q), strict=True)]
    found = map(torch.cat, zip(together.over(q[:20]), together.over(q[20:]), strict=True))
    torch.testing.assert_close([*found], wanted, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("kind", ["short", "coarse", "sharp"])
def test_what_a_log_does_not_tell_of_memory_is_said(kind, lugre_log):  # the fixture
    log, few = lugre_log.rows(slice(0, 3000)), 1000
    if kind == "short":
        log = replace(log, episode=np.arange(3000) // 10)
        said = r"until a joint has moved .* \d\d% of the rows come before that"
    elif kind == "coarse":
        log, said = replace(log, q=np.round(log.q / 2e-3) * 2e-3), r"larger than the ways .*: pan \(2\), lift \(2\)"
    else:
        u = arm_model(0).robot.inverse_dynamics(*map(torch.tensor, (log.q, log.v, log.a))).numpy()
        log = replace(log, u=u + 0.5 * np.sign(log.v))
        said = "friction of pan, lift, bend turns sooner after a reversal than the log can tell"
    with pytest.warns(DataWarning, match=said):
        fit(arm_model(0).with_forces(Viscous(), Coulomb(memory=True)), log, Torques(), rows=few)


def test_joints_that_stand_and_pauses_and_gaps_are_no_harm(lugre_log):  # the fixture
    q, v, a = (np.array(x) for x in (lugre_log.q, lugre_log.v, lugre_log.a))
    model = arm_model(0).with_forces(Viscous(), Coulomb(memory=True))
    whole = {name: each.value for name, each in fit(model, lugre_log, Torques(), rows=1500).parameters.items()}
    at = np.r_[0:3000, np.full(1000, 3000), 3000:6000]  # all joints wait for 2 s
    moves = np.repeat([1.0, 0.0, 1.0], [3000, 1000, 3000])[:, None]
    paused = log_of(q[at], moves * v[at], moves * a[at], lugre_log.u[at], DT * np.arange(7000))
    gaps = lugre_log.rows(np.r_[0:1000, 1600:3000, 3700:6000])
    for log in (paused, gaps):
        found = fit(model, log, Torques(), rows=1500).parameters
        for name, value in whole.items():
            if not name.startswith("viscous"):
                assert found[name].value == pytest.approx(value, rel=0.1), name
    q[:, 1], v[:, 1], a[:, 1] = q[0, 1], 0.0, 0.0
    found = fit(model, log_of(q, v, a, lugre_log.u, lugre_log.time), Torques(), rows=1000).parameters
    for name in ("coulomb.level.lift", "coulomb.sigma.lift"):
        assert (found[name].decided_by, found[name].why) == ("prior", "no row shows it")
