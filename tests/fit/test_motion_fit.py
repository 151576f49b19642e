"""Models refined on recorded positions: derivatives, what is recovered, what is stored, what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.posterior.arm import arm_data, arm_model

from forcegp import Dataset, JointFriction, Model, Robot, load_posterior, save_posterior
from forcegp.data.views import all_motions, recorded_motions
from forcegp.errors import DataWarning, InvalidInput, NumericalError
from forcegp.evidence import Motions, Torques
from forcegp.fit import fit as fit_model
from forcegp.fit.motion_fit import MotionFit, Unknowns
from forcegp.forces import Actuation, Coulomb, Normal, RigidBodies, Rotor, Viscous
from forcegp.noise import Noise

URDF = """<robot name="slide"><link name="base"/><link name="cart"><inertial><mass value="5"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="x" type="prismatic">
<parent link="base"/><child link="cart"/><axis xyz="1 0 0"/><limit lower="-5" upper="5" effort="99" velocity="9"/>
</joint></robot>"""
DT, QUIET = 0.01, Noise(0.5)


def slide(viscous: float, coulomb: float) -> Model:
    friction = Viscous(viscous), Coulomb(coulomb, 0.02)
    return Model(Robot.from_urdf_text(URDF), (), (Actuation(), RigidBodies(), *friction))


def line(v: float) -> float:
    return 3.0 * v + 4.0 * np.tanh(v / 0.02)


def bump(v: float) -> float:
    """The same with a force at speeds near .3 m/s that no law has."""
    return line(v) + 5.0 * np.exp(-(((v - 0.3) / 0.12) ** 2))


def recording(friction, seed: int, seconds: float = 12.0) -> Dataset:
    """The cart of 5 kg under forces that excite it and hold the middle; positions of .01 mm, bad accelerations."""
    generator, rows = np.random.default_rng(seed), int(seconds / DT)
    time, phase = DT * np.arange(rows), generator.uniform(0.0, 6.0, 3)
    force = sum(9.0 * np.sin(w * time + p) for w, p in zip((1.3, 2.9, 5.1), phase, strict=True))
    q, v, u = np.zeros((3, rows, 1))
    for k in range(rows):
        u[k] = force[k] - 12.0 * q[k]
        if k + 1 < rows:
            q[k + 1], v[k + 1] = pushed(friction, float(q[k, 0]), float(v[k, 0]), float(u[k, 0]))
    a = np.gradient(v, DT, axis=0) + 0.5 * generator.standard_normal((rows, 1))
    q = q + 1e-5 * generator.standard_normal((rows, 1))
    return Dataset(q=q, v=v, u=u, a=a, time=time, model=slide(1.0, 1.0), noise_std=np.array([0.5]))


def pushed(friction, q: float, v: float, u: float, parts: int = 20) -> tuple[float, float]:
    """The state a row later, by Heun's method of `parts` steps."""
    h = DT / parts
    for _ in range(parts):
        first = (u - friction(v)) / 5.0
        second = (u - friction(v + h * first)) / 5.0
        q, v = q + h * v + 0.5 * h * h * first, v + 0.5 * h * (first + second)
    return q, v


@pytest.fixture(scope="module")
def along_the_law() -> Dataset:
    return recording(line, 1)


def analytical(data: Dataset):
    return fit_model(slide(1.0, 1.0).with_forces(noise=QUIET), data, points=50, restarts=1)


def refined(posterior, data: Dataset, seconds: float = 0.5, bodies: bool = True):
    return fit_model(posterior.model, data, Motions(seconds, bodies), start=posterior)


def motion_error(posterior, data: Dataset, seconds: float = 1.0) -> float:
    """Root mean square of q after so long, from recorded states."""
    recorded = recorded_motions(data, 10, seconds)
    made = posterior.predictor(covariance="none", compile=False).rollouts(
        recorded.q[:, 0], recorded.v[:, 0], recorded.u, recorded.dt, integrator="implicit-midpoint"
    )
    return float(np.sqrt(np.mean((made.q[:, -1].numpy() - recorded.q[:, -1]) ** 2)))


def test_friction_is_recovered_from_positions(along_the_law):
    before = analytical(along_the_law)
    after = refined(before, along_the_law, 1.0, bodies=False)
    found = after.parameters
    for name, truth in (("viscous.x", 3.0), ("coulomb.level.x", 4.0)):
        error = found[name].std
        assert found[name].value == pytest.approx(truth, abs=max(4.0 * error, 0.02 * truth))
        assert 0.0 < error < 0.1 * truth
    assert motion_error(after, along_the_law) < 1e-3 < 0.05 * motion_error(before, along_the_law)
    assert float({type(force): force for force in after.model.forces}[Viscous].damping) == found["viscous.x"].value
    assert after.model.robot.link("cart").mass == 5.0
    assert float(before.model.forces[2].damping) == 1.0  # the one that was given stays as it is


def test_a_number_that_a_prior_knows_stays(along_the_law):
    """Both evidence in one fit: a standard deviation of 0 holds a number in all of it."""
    model = slide(1.0, 1.0).with_forces(Viscous(Normal(2.0, 0.0)), Coulomb())
    found = fit_model(model, along_the_law, (Torques(), Motions(1.0, bodies=False)))
    assert float({type(force): force for force in found.model.forces}[Viscous].values["damping"]) == 2.0
    assert "viscous.x" not in found.parameters
    assert found.parameters["coulomb.level.x"].value > 4.0


def test_inertias_are_found_as_well(along_the_law):
    light = slide(3.0, 4.0)
    light = light.with_robot(Robot.from_urdf_text(URDF.replace('mass value="5"', 'mass value="4"')))
    posterior = fit_model(light.with_forces(noise=QUIET), along_the_law, points=50, restarts=1)
    assert refined(posterior, along_the_law, 1.0).model.robot.link("cart").mass == pytest.approx(5.0, rel=0.01)


def test_what_is_stored_predicts_the_same(along_the_law, tmp_path):
    better = refined(analytical(along_the_law), along_the_law, 0.5)
    save_posterior(better, tmp_path / "run")
    again = load_posterior(tmp_path / "run")
    rows = along_the_law.q[:50], along_the_law.v[:50], along_the_law.u[:50]
    here, there = better.predict(*rows), again.predict(*rows)
    torch.testing.assert_close(there.mean, here.mean, rtol=1e-10, atol=1e-10)
    assert again.settings["motions"] == better.settings["motions"]
    torch.testing.assert_close(better.predictor(compile=False).mean(*rows), here.mean, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("contacts", [0, 1])
def test_derivatives_in_every_unknown(contacts):
    friction = Viscous(0.3), Coulomb(0.2, 0.3), Rotor(0.01)
    model = arm_model(contacts, forces=(Actuation(), RigidBodies(), *friction))
    data = arm_data(24, 5, model)
    posterior = fit_model(model, data, points=24, restarts=1)
    data = replace(data, v=0.2 * data.v, u=0.3 * data.u, truth={})
    unknowns = Unknowns.of(posterior, data, True)
    recorded, stride = all_motions(replace(data, q=data.q[:1].repeat(24, 0)), 0.05, 0.01)
    fit, generator = MotionFit(recorded, stride, unknowns), torch.Generator().manual_seed(0)
    x = torch.as_tensor(unknowns.space.start) + 0.05 * torch.rand(
        unknowns.space.size, generator=generator, dtype=torch.float64
    )
    one, small = torch.ones(3, dtype=torch.float64), 1e-5
    here = fit.at(x, fit.start, one, one, None)
    assert bool(here.motions.found.all())
    scale = float(here.motions.in_parameters.abs().max())
    for _ in range(2):  # a direction shows a fault in any of its entries
        step = torch.randn(len(x), generator=generator, dtype=torch.float64)
        ends = [fit.at(x + sign * small * step, fit.start, one, one, here.motions).motions.q for sign in (1.0, -1.0)]
        expected = (ends[0] - ends[1]) / (2.0 * small)
        torch.testing.assert_close(here.motions.in_parameters @ step, expected, rtol=1e-4, atol=1e-6 * scale)


def test_what_cannot_be_refined_is_refused(along_the_law):
    posterior, short = analytical(along_the_law), along_the_law.rows(slice(40))
    for seconds in (0.0, -1.0, np.inf, True, "1"):
        with pytest.raises(InvalidInput, match=r"seconds is .*; give"):
            refined(posterior, along_the_law, seconds)
    with pytest.raises(InvalidInput, match=r"no stretch of 1 s has equal steps"):
        refined(posterior, short, 1.0)
    uneven = replace(along_the_law, time=along_the_law.time + 4e-3 * np.sin(np.arange(len(along_the_law))))
    with pytest.raises(InvalidInput, match="resample the recording"):
        refined(posterior, uneven, 1.0)
    for model in (posterior.model.with_forces(JointFriction()), posterior.model.black_box()):
        with pytest.raises(InvalidInput, match="refine the laws first, and learn the forces beside them"):
            fit_model(model, short, Motions(0.1))
        learned = fit_model(model, short, points=20, restarts=1)
        with pytest.raises(InvalidInput, match="unknown forces, which learn from accelerations"):
            refined(learned, along_the_law)


def test_a_model_without_motions_near_the_recorded_ones_is_refused(along_the_law):
    class Wild(Viscous):
        def amplitude(self, features, parameters):
            return 1e6 * features[0] * features[0].abs()

    model = Model(Robot.from_urdf_text(URDF), (), (Actuation(), RigidBodies(), Wild(1.0)))
    posterior = fit_model(model.with_forces(noise=QUIET), along_the_law, points=20, restarts=1)
    with pytest.raises(NumericalError, match="give fewer seconds"):
        refined(posterior, along_the_law, 1.0)


def test_a_recording_that_is_there_twice_counts_once():
    log = recording(line, 1, 2.0)
    columns = {name: np.concatenate([getattr(log, name)] * 2) for name in ("q", "v", "u", "a", "time")}
    twice = Dataset(**columns, episode=np.repeat([0, 1], len(log)), model=log.model, noise_std=log.noise_std)
    model, evidence = slide(1.0, 1.0), Motions(0.5)
    with pytest.warns(DataWarning, match="200 of 400 rows equal another one and count once"):
        found = fit_model(model, twice, evidence, restarts=1)
    alone = fit_model(model, log, evidence, restarts=1)
    assert len(found.training) == len(alone.training)
    assert [each.std for each in found.parameters.values()] == [each.std for each in alone.parameters.values()]
