"""Friction that remembers: its state against Dahl's equation, its strokes, its stiffness from logs of another law."""

import subprocess
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from tests.posterior.arm import arm_model

from forcegp import Accelerations, Dataset, Torques, export_c, fit, score
from forcegp.control import ComputedTorque, ContactMonitor
from forcegp.control.tracking import Past
from forcegp.data import Preparation, estimate_delay, with_memory, with_strokes
from forcegp.data.strokes import encoder_step, strokes, turning_points, white_noise
from forcegp.data.views import FORGOTTEN, past_known, recorded_motions
from forcegp.errors import DataWarning, InvalidInput
from forcegp.evidence import motion_residuals
from forcegp.fit import calibrated
from forcegp.fit.doubts import doubts_of_past
from forcegp.forces import Coulomb, GearFriction, LoadFriction, Stribeck, Viscous
from forcegp.forces.presliding import after_step, after_strokes
from forcegp.noise import Noise
from forcegp.posterior import casadi_function

DT, SIGMA = 0.002, torch.tensor([300.0, 900.0, 2000.0], dtype=torch.float64)
JOINTS = ("pan", "lift", "bend")


def motion(rows: int, seed: int, slow: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time, and q, v, a of sines with many reversals."""
    rng, time = np.random.default_rng(seed), DT * np.arange(rows)
    w, phase, size = rng.uniform(1.0, 5.0, (3, 3)), rng.uniform(0.0, 6.0, (3, 3)), rng.uniform(0.05, 0.3, (3, 3))
    at = slow * w * time[:, None, None] + phase
    w = slow * w
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
    damping = 0.5 * np.sqrt(stiffness)
    z, out = 0.0, np.zeros_like(v)
    for k, speed in enumerate(v):
        for _ in range(20):
            g = level + breakaway * np.exp(-((speed / 0.05) ** 2))
            rate = speed - stiffness * abs(speed) / g * z
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
        expected = dahl(time, q[:, j], v[:, j], float(SIGMA[j]))
        found = after_strokes(past[:, j], SIGMA[j]).numpy()
        np.testing.assert_allclose(found, expected, atol=0.01)  # the reversal lies between two rows
        by_steps, z = np.zeros(len(q)), torch.zeros(1, dtype=torch.float64)
        for k in range(1, len(q)):
            z = after_step(z, torch.tensor(q[k : k + 1, j] - q[k - 1 : k, j]), SIGMA[j])
            by_steps[k] = float(z)
        np.testing.assert_allclose(found, by_steps, atol=1e-12)


def test_it_is_smooth_in_sigma_and_bounded():
    past = torch.tensor(np.random.default_rng(0).normal(0.0, 1e-3, (4, 3, 6)))
    sigma = SIGMA.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda s: after_strokes(past, s), sigma)
    assert float(after_strokes(past, SIGMA).abs().max()) < 1.0
    between = after_strokes(past, SIGMA, 1.0) - after_strokes(past, SIGMA, -1.0)
    torch.testing.assert_close(between, 2.0 * torch.exp(-SIGMA * past.abs().sum(-1)))  # what a start leaves


def test_a_thinned_log_has_the_same_past():
    time, q, v, a = motion(3000, 4)
    log = log_of(q, v, a, a, time)
    model = log.model.with_forces(Coulomb(1.0, sigma=SIGMA.tolist(), memory=True))
    whole = with_memory(log, model)
    some = np.sort(np.random.default_rng(0).choice(3000, 300, replace=False))
    np.testing.assert_array_equal(with_memory(whole.rows(some), model).u, whole.rows(some).u)
    shuffled = whole.rows(np.random.default_rng(1).permutation(some))
    np.testing.assert_array_equal(with_memory(shuffled, model).u, shuffled.u)
    gaps = with_memory(log.rows(some), model).u[:, 3:]  # steps of 20 ms: only the rows about reversals differ
    assert np.median(abs(gaps - whole.u[some, 3:])) < 1e-6
    with pytest.raises(InvalidInput, match="remembers, and the rows are not in order of time"):
        with_memory(log.rows(some[::-1]), model)


def test_motors_that_turn_with_two_joints_have_strokes_of_their_own():
    time, q, v, a = motion(1500, 3)
    law = Coulomb(1.0, sigma=SIGMA.tolist(), memory=True, transmission="bend+lift/pan-0.5*bend")
    T = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, 0.0], [0.0, 1.0, 1.0]])
    np.testing.assert_array_equal(law.bound_to(arm_model(0).robot).transmission, T)
    log, model = log_of(q, v, a, a, time), arm_model(0).with_forces(law)
    whole = with_memory(log, model)
    expected = np.stack([dahl(time, q @ T[j], v @ T[j], float(SIGMA[j])) for j in range(3)], axis=1)
    np.testing.assert_allclose(whole.u[:, 3:], expected, atol=0.01)
    force = whole.model.laws[-1].force(whole.model.state(*(torch.tensor(x) for x in (whole.q, whole.v, whole.u))))
    np.testing.assert_allclose(force, -whole.u[:, 3:] @ T, atol=1e-12)
    some = whole.rows(np.random.default_rng(1).permutation(1500)[:300])
    np.testing.assert_array_equal(with_memory(some, model).u, some.u)
    with pytest.raises(InvalidInput, match="not in order of time"):
        with_memory(with_strokes(log).rows(slice(None, None, -1)), model)
    step = 1e-3
    coarse = log_of(np.round(q / step) * step, v, a, a, time)
    z = after_strokes(torch.tensor(strokes(coarse, transmission=T)), torch.tensor(0.1 / step))
    smooth = after_strokes(torch.tensor(strokes(log, transmission=T)), torch.tensor(0.1 / step))
    assert float((z - smooth).abs().mean()) < 0.05


def test_steps_of_an_encoder_are_no_reversals():
    time, q, v, a = motion(3000, 5, slow=0.3)
    step = 2e-4
    noise = 0.25 * step * np.random.default_rng(0).standard_normal(q.shape)
    coarse = log_of(np.round((q + noise) / step) * step, v, a, a, time)
    assert encoder_step(coarse, coarse.q[:, 0]) == pytest.approx(step)
    assert encoder_step(log_of(q, v, a, a, time), q[:, 0]) == 0.0
    smooth = strokes(log_of(q, v, a, a, time))
    sigma = torch.tensor(0.1 / step)
    apart = after_strokes(torch.tensor(strokes(coarse)), sigma) - after_strokes(torch.tensor(smooth), sigma)
    assert float(apart.abs().mean()) < 0.05
    jitter = np.array([0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 2.0, 3.0, 2.0, 3.0, 9.0, 2.0])
    assert turning_points(jitter, 2.0).tolist() == [0, 10]
    assert turning_points(jitter, 0.5).tolist() == [0, 1, 2, 3, 4, 7, 8, 10]


@pytest.mark.parametrize("evidence", [Torques(), Accelerations()], ids=str)
def test_a_gear_with_bristles_is_explained_better_and_its_numbers_are_near(lugre_log, evidence):
    train, test = lugre_log.rows(slice(0, 4000)), lugre_log.rows(slice(4000, 6000))
    left = {}
    for law in (Stribeck(), Coulomb(), Coulomb(memory=True)):
        found = fit(arm_model(0).with_forces(Viscous(), law), train, evidence, rows=1500)
        force, _ = motion_residuals(with_memory(test, found.model), found.model)
        left[bool(law.memory), type(law).__name__] = float(np.sqrt((force**2).mean()))
    assert left[True, "Coulomb"] < 0.5 * min(left[False, "Coulomb"], left[False, "Stribeck"])
    values = {name: each.value for name, each in found.parameters.items()}
    np.testing.assert_allclose([values[f"coulomb.level.{joint}"] for joint in JOINTS], [0.8, 0.5, 0.3], rtol=0.1)
    expected = np.array([800.0, 500.0, 300.0]) / [
        0.8,
        0.5,
        0.3,
    ]  # stiffness over level: the slope at a reversal, halved
    np.testing.assert_allclose([values[f"coulomb.sigma.{joint}"] for joint in JOINTS], expected, rtol=0.5)


def test_memory_is_a_matter_of_joints(lugre_log):
    model = arm_model(0).with_forces(Coulomb(memory=("lift",)))
    assert model.inputs == (*JOINTS, "presliding of lift")
    found = fit(model, lugre_log, Torques(), rows=1000)
    names = set(found.parameters)
    assert names == {f"coulomb.level.{joint}" for joint in JOINTS} | {
        "coulomb.sigma.lift", "coulomb.velocity_scale.pan", "coulomb.velocity_scale.bend"
    }  # fmt: skip
    law = found.model.laws[-1]
    seen = with_memory(lugre_log, found.model)
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
    z = torch.tensor(with_memory(lugre_log, model).u[:, 3:])
    rigid = torch.tensor(lugre_log.u[:, :3])
    torch_of = partial(torch.tensor, dtype=torch.float64)
    level = torch_of(given["level"]) + torch_of(given.get("root", 0.0)) * torch.tensor(lugre_log.v).abs().sqrt()
    u = rigid + level * z  # solve u = rigid + (level + mu |u|) z
    u = u / (1.0 - torch_of(given["factor"]) * z * u.sign())
    q, v = (torch.tensor(np.array(x)) for x in (lugre_log.q, lugre_log.v))
    a = model.robot.forward_dynamics(q, v, rigid)
    loaded = replace(lugre_log, u=u.numpy(), a=a.numpy())
    seen = with_memory(loaded, model)
    expected = model.dynamics(q, v, torch.tensor(seen.u)).acceleration_map().offset
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
        ratio = np.array(remembering[quantity]["rmse"]) / without[quantity]["rmse"]
        assert ratio.max() < most, quantity


@pytest.mark.parametrize(
    ("integrator", "transmission"),
    [("symplectic-euler", None), ("rk4", None), ("implicit-midpoint", None), ("rk4", "bend+lift")],
)
def test_compiled_motions_carry_the_state_along(integrator, transmission, lugre_log):
    law = Coulomb([0.8, 0.5, 0.3], 0.1, sigma=300.0, memory=("pan", "bend"), transmission=transmission)
    model = arm_model(0).with_forces(law, noise=Noise(0.1))
    posterior = fit(model, lugre_log.rows(slice(0, 200)))
    u = np.zeros((4, 60, 5))
    u[..., :3] = lugre_log.u[None, :60] * np.array([1.0, 0.5, -0.5, 0.2])[:, None, None]
    u[:, 0, 3:] = np.random.default_rng(0).uniform(-0.9, 0.9, (4, 2))
    given = lugre_log.q[0], 0.1 * lugre_log.v[0], u, DT
    compiled, by_torch = (
        posterior.predictor(compile=how).rollouts(*given, integrator=integrator) for how in (True, False)
    )
    torch.testing.assert_close(compiled.q, by_torch.q, rtol=1e-9, atol=1e-11)
    again = posterior.rollout(*given, integrator=integrator)
    torch.testing.assert_close(again.q, by_torch.q, rtol=1e-9, atol=1e-11)
    other = u.copy()
    other[:, 0, 3:] = 0.0
    assert float((posterior.rollout(*given[:2], other, DT).q - again.q).abs().max()) > 1e-5
    other[:, 0], other[:, 1:, 3:] = u[:, 0], 0.7  # only the first row holds a state
    torch.testing.assert_close(posterior.rollout(*given[:2], other, DT, integrator=integrator).q, again.q)


@pytest.mark.usefixtures("unchecked")  # explicit steps add and scale CasADi's expressions as they do tensors
@pytest.mark.parametrize("transmission", [None, "bend-0.5*lift"])
def test_programs_carry_the_state_along(transmission, lugre_log, tmp_path):
    casadi = pytest.importorskip("casadi", reason="CasADi is not installed: pip install 'forcegp[casadi]'")
    law = Coulomb([0.8, 0.5, 0.3], 0.1, sigma=300.0, memory=("pan", "bend"), transmission=transmission)
    model = arm_model(0).with_forces(law, noise=Noise(0.1))
    posterior = fit(model, lugre_log.rows(slice(0, 200)))
    q, v = lugre_log.q[0], 0.3 * lugre_log.v[0]
    u = np.concatenate([lugre_log.u[0], [0.4, -0.7]])
    there = posterior.rollout(q, v, u[None], DT)
    z = model.laws[-1].remember(torch.tensor(u[3:]), there.q[1] - torch.tensor(q), DT).numpy()
    step = casadi_function(posterior, steps=DT)
    np.testing.assert_allclose(np.array(step(q, v, u)[2]).ravel(), z, rtol=1e-9)
    assert isinstance(step, casadi.Function)
    export_c(posterior, tmp_path / "made", name="arm", steps=DT)
    (tmp_path / "main.c").write_text(
        '#include "arm.h"\n#include <stdio.h>\n'
        f"int main(void) {{ const double q[3] = {{{', '.join(map(repr, q.tolist()))}}}, z[2] = {{0.4, -0.7}};\n"
        f"const double to[3] = {{{', '.join(map(repr, there.q[1].tolist()))}}}; double out[2];\n"
        f'if (arm_remember(z, q, to, {DT}, out)) return 1;\n printf("%.17g %.17g", out[0], out[1]); return 0; }}\n'
    )
    words = ["cc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-I", str(tmp_path / "made")]
    words += [str(tmp_path / "main.c"), str(tmp_path / "made" / "arm.c"), "-lm", "-o", str(tmp_path / "main")]
    subprocess.run(words, check=True)
    printed = subprocess.run([str(tmp_path / "main")], check=True, capture_output=True, text=True).stdout
    np.testing.assert_allclose([float(x) for x in printed.split()], z, rtol=1e-12)


def test_a_past_that_is_not_known_is_in_the_interval(lugre_log):
    model = arm_model(0).with_forces(Coulomb(memory=True), Viscous(), noise=Noise(0.1))
    posterior = fit(model, lugre_log.rows(slice(0, 4000)), Torques(), rows=1500)
    test = lugre_log.rows(slice(4000, 6000, 10))
    seen = with_memory(lugre_log, posterior.model).rows(slice(4000, 6000, 10))
    known = posterior.predict(seen.q, seen.v, seen.u)
    with pytest.warns(DataWarning, match="the past of friction counts as unknown"):
        unknown = posterior.predict(test.q, test.v, test.u)
    error = (unknown.mean - torch.tensor(test.a)).square().mean().sqrt()
    assert float(error) > 2.0 * float((known.mean - torch.tensor(test.a)).square().mean().sqrt())
    inside = (unknown.mean - torch.tensor(test.a)).abs() <= 1.96 * unknown.measurement.variance.sqrt()
    assert float(inside.double().mean()) >= 0.9
    # friction is linear in its state: the spread is that of predictions at states drawn from what was seen
    z = posterior.training.u[:, 3:] * posterior.training.v.sign()
    draws, chance = [], torch.Generator().manual_seed(0)
    for _ in range(100):
        drawn = z[torch.randint(len(z), (200,), generator=chance)].numpy() * np.sign(test.v)
        draws.append(posterior.predict(test.q, test.v, np.concatenate([test.u, drawn], 1)).mean)
    # joints are drawn together here, and apart in the prediction: variances of the diagonal agree
    spread = torch.stack(draws).var(0)
    added = unknown.variance - posterior.predict(seen.q, seen.v, seen.u).variance
    assert float((added.sqrt() / spread.sqrt()).median()) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("delay", [0.0, 0.012])
def test_hysteresis_is_no_delay(delay, lugre_log):
    """With friction of velocity alone the same logs show 20 ms more."""
    few = lugre_log.rows(slice(0, 6000, 2))
    late = replace(few, u=CubicSpline(few.time, few.u)(few.time - delay))
    found = estimate_delay(late)
    assert abs(found.significant - delay) < 0.004
    alone = estimate_delay(replace(late, time_ordered=True, strokes=np.zeros((len(late), 3, 1))))  # nothing remembered
    assert alone.significant > delay + 0.01


def test_controllers_and_monitors_see_the_past(lugre_log):
    train, test = lugre_log.rows(slice(0, 4000)), lugre_log.rows(slice(4000, 6000))
    left = {}
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
    noisy = ComputedTorque(predictor, stiffness=100.0, position_noise=1e-3)
    assert noisy.past.least == 1e-3
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


def test_noise_of_positions_is_no_reversal():
    """Its size is found at any rate, and motion is not taken for it."""
    time, rng = DT * np.arange(8000), np.random.default_rng(0)
    q = np.stack([0.4 * np.sin((1.0 + 0.3 * j) * time) for j in range(3)], 1)
    v, a = np.gradient(q, time, axis=0), np.zeros_like(q)
    smooth, noisy = log_of(q, v, a, a, time), log_of(q + 1e-4 * rng.standard_normal(q.shape), v, a, a, time)
    assert [white_noise(noisy, each) for each in noisy.q.T] == pytest.approx(3 * [1e-4], rel=0.1)
    assert [white_noise(each, each.q[:, 0]) for each in (smooth, smooth.rows(slice(None, None, 200)))] == [0.0, 0.0]
    reversals = [(np.diff(np.sign(strokes(log)[:, :, 0]), axis=0) != 0).sum() for log in (smooth, noisy)]
    assert abs(reversals[1] - reversals[0]) <= 3  # of three joints, at the first rows
    fast = replace(smooth, q=0.1 * np.sin(2.0 * np.pi * 0.195 * np.arange(8000))[:, None] * np.ones(3))
    assert white_noise(fast, fast.q[:, 0]) == 0.0  # a fifth of the rate: orders differ by a factor of 1.7
    way = np.interp(time, [0.0, 4.0, 5.0, 16.0], [0.0, 0.2, 0.1995, 0.5])[:, None] + np.zeros(3)
    back = log_of(way + 1e-4 * rng.standard_normal(q.shape), a, a, a, time)
    assert (strokes(back)[:, :, 1] != 0.0)[-1].all()  # five deviations back, and as many of noise, are a reversal
    still = log_of(1e-4 * rng.standard_normal(q.shape), a, a, a, time)
    assert np.abs(strokes(still)[:, :, 1]).max() < 1e-3  # at rest there is no past, but for rare peaks


def test_a_filter_does_not_round_the_reversals_that_friction_remembers():
    """Of a log of postures, strokes are those before the filter."""
    time = DT * np.arange(6000)
    steps = np.cumsum(np.where(np.arange(6000) % 1500 < 300, 2e-3, 0.0) * np.sign(np.sin(0.001 * np.arange(6000))))
    q = np.stack([steps, 0.5 * steps, -0.3 * steps], 1)
    v = np.gradient(q, time, axis=0)
    raw = log_of(q, v, np.gradient(v, time, axis=0), v, time)
    filtered = Preparation(cutoff=2.0, every=3).apply(raw)
    assert np.array_equal(np.asarray(filtered.strokes), strokes(raw)[::3])
    assert not np.allclose(filtered.strokes, strokes(replace(filtered, strokes=None)), atol=1e-4)
    moving = replace(raw, q=q + 0.5 * np.sin(time)[:, None])
    assert Preparation(cutoff=2.0).apply(moving).strokes is None, "without rests, positions fit the filtered torques"


def test_rows_before_a_joint_has_moved_are_left_out():
    _, q, v, a = motion(6000, 2)
    rest = 1e-9 * np.random.default_rng(0).standard_normal((15, 3))
    q, v, a = np.vstack([q[0] + rest, q]), np.vstack([rest, v]), np.vstack([rest, a])
    log = with_strokes(log_of(q, v, a, a, DT * np.arange(len(q))))
    model = arm_model(0).with_forces(Coulomb(sigma=500.0, memory=("lift",)))
    known = past_known(log, model)
    first = int(np.argmax(known))
    assert known[first:].all()
    assert first >= 15
    for share, said in ((0.09, False), (0.11, True)):
        many = np.arange(1000) >= 1000 * share
        assert bool(list(doubts_of_past(model, log, many))) is said
    for rows, left_out in ((60 * first, True), (30 * first, False)):
        found = fit(model, log.rows(slice(0, rows)), Torques(), rows=500)
        assert ("rows_before_a_past" in found.settings) is left_out
    way = np.abs(np.diff(q[: first + 1, 1])).sum()
    assert FORGOTTEN / 500.0 - 0.005 < way < FORGOTTEN / 500.0 + 0.005
    q[:, 1] = q[0, 1]  # a joint that never moves keeps its rows
    assert past_known(with_strokes(log_of(q, v, a, a, log.time)), model).all()
    assert past_known(log, arm_model(0)).all()


@pytest.mark.parametrize("kind", ["short", "coarse", "sharp"])
def test_what_a_log_does_not_tell_of_memory_is_said(kind, lugre_log):  # the fixture
    log, few = lugre_log.rows(slice(0, 3000)), 1000
    if kind == "short":
        log, said = (
            replace(log, episode=np.arange(3000) // 10),
            r"counts as 0 before the first row .* in \d\d% of the rows",
        )
    elif kind == "coarse":
        log, said = replace(log, q=np.round(log.q / 2e-3) * 2e-3), r"larger than the ways .*: pan \(2\), lift \(2\)"
    else:
        u = arm_model(0).robot.inverse_dynamics(*map(torch.tensor, (log.q, log.v, log.a))).numpy()
        log, said = (
            replace(log, u=u + 0.5 * np.sign(log.v)),
            "sigma of pan, lift, bend is at its bound: it turns sooner",
        )
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
    still = log_of(q, v, a, lugre_log.u, lugre_log.time)
    found = fit(model, still, Torques(), rows=1000).parameters
    for name in ("coulomb.level.lift", "coulomb.sigma.lift"):
        assert (found[name].decided_by, found[name].why) == ("prior", "no row shows it")


def test_intervals_of_motions_under_gears_hold(lugre_log):
    posterior = fit(arm_model(0).with_forces(Viscous(), Coulomb(memory=True)), lugre_log, Torques(), rows=1500)
    found = calibrated(posterior, lugre_log, (0.05, 0.2))
    motions = recorded_motions(with_memory(lugre_log, found.model), 30, 0.2)
    moved = found.rollout(motions.q[:, 0], motions.v[:, 0], motions.u, motions.dt, integrator="rk4")
    low, high = (end.numpy() for end in moved.interval("q"))
    inside = (low <= motions.q) & (motions.q <= high)
    assert min(inside[:, round(horizon / motions.dt)].mean() for horizon in (0.05, 0.2)) >= 0.85
