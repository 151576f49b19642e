"""Predictions, motions and programs of friction that remembers."""

import subprocess

import numpy as np
import pytest
import torch
from tests.forces.test_presliding import DT, lugre_log  # noqa: F401  # a fixture
from tests.posterior.arm import arm_model

from forcegp import Torques, export_c, fit
from forcegp.data import with_memory
from forcegp.data.views import recorded_motions
from forcegp.errors import DataWarning
from forcegp.fit import calibrated
from forcegp.forces import Coulomb, Viscous
from forcegp.noise import Noise
from forcegp.posterior import casadi_function


@pytest.mark.parametrize(
    ("integrator", "transmission"),
    [
        ("rk4", "bend+lift"),
        *(pytest.param(k, None, marks=pytest.mark.nightly) for k in ("symplectic-euler", "rk4", "implicit-midpoint")),
    ],
)
def test_compiled_motions_carry_the_state_along(integrator, transmission, lugre_log):  # noqa: F811  # the fixture
    law = Coulomb([0.8, 0.5, 0.3], 0.1, sigma=300.0, memory=("pan", "bend"), transmission=transmission)
    posterior = fit(arm_model(0).with_forces(law, noise=Noise(0.1)), lugre_log.rows(slice(0, 200)))
    u = np.zeros((4, 60, 5))
    u[..., :3] = lugre_log.u[None, :60] * np.array([1.0, 0.5, -0.5, 0.2])[:, None, None]
    u[:, 0, 3:] = np.random.default_rng(0).uniform(-0.9, 0.9, (4, 2))
    given = lugre_log.q[0], 0.1 * lugre_log.v[0], u, DT
    both = [posterior.predictor(compile=how) for how in (True, False)]
    compiled, by_torch = (each.rollouts(*given, integrator=integrator) for each in both)
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
def test_programs_carry_the_state_along(transmission, lugre_log, tmp_path):  # noqa: F811  # the fixture
    casadi = pytest.importorskip("casadi", reason="CasADi is not installed: pip install 'forcegp[casadi]'")
    law = Coulomb([0.8, 0.5, 0.3], 0.1, sigma=300.0, memory=("pan", "bend"), transmission=transmission)
    model = arm_model(0).with_forces(law, noise=Noise(0.1))
    posterior, q, v = fit(model, lugre_log.rows(slice(0, 200))), lugre_log.q[0], 0.3 * lugre_log.v[0]
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


def test_a_past_that_is_not_known_is_in_the_interval(lugre_log):  # noqa: F811  # the fixture
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
    spread, added = torch.stack(draws).var(0), unknown.variance - posterior.predict(seen.q, seen.v, seen.u).variance
    assert float((added.sqrt() / spread.sqrt()).median()) == pytest.approx(1.0, abs=0.15)


def test_intervals_of_motions_under_gears_hold(lugre_log):  # noqa: F811  # the fixture
    posterior = fit(arm_model(0).with_forces(Viscous(), Coulomb(memory=True)), lugre_log, Torques(), rows=1500)
    found = calibrated(posterior, lugre_log, (0.05, 0.2))
    motions = recorded_motions(with_memory(lugre_log, found.model), 30, 0.2)
    moved = found.rollout(motions.q[:, 0], motions.v[:, 0], motions.u, motions.dt, integrator="rk4")
    low, high = (end.numpy() for end in moved.interval("q"))
    inside = (low <= motions.q) & (motions.q <= high)
    assert min(inside[:, round(horizon / motions.dt)].mean() for horizon in (0.05, 0.2)) >= 0.85
