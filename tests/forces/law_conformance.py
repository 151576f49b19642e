"""What every law must do. A new law is tested by one subclass whose name begins with `Test`:

class TestHardeningSpring(LawConformance):
    law = HardeningSpring([1.0, 2.0, 0.5], [3.0, 1.0, 2.0])
"""

import json
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from tests.posterior.arm import arm_data, arm_model

from forcegp import Accelerations, Payload, RigidBodies, Torques, fit, load_posterior, save_posterior
from forcegp.data import Dataset
from forcegp.evidence import motion_residuals
from forcegp.forces import JointFriction, JointLaw, Law, Viscous, force_from_dict, force_to_dict, parse_forces
from forcegp.forces.joint_law import PerJointLaw
from forcegp.forces.registry import force_name
from forcegp.inference import OptimizerOptions
from forcegp.model import Model
from forcegp.noise import Noise

STILL = Noise(1e-3)


def log_of(model: Model, rows: int = 200, seed: int = 0) -> Dataset:
    """Random states of the arm in the air, and the accelerations that this model has there."""
    data = arm_data(rows, seed, model)
    a = model.dynamics(*(torch.tensor(np.array(x)) for x in (data.q, data.v, data.u))).acceleration_map().offset
    return replace(data, a=a.numpy(), truth={}, noise_std=None)


class LawConformance:
    """One law through everything that forcegp does with forces, on an arm of three joints."""

    law: ClassVar[Law]
    given: ClassVar[tuple[str, ...]] = ()
    """Coefficients that a log is not asked for, such as velocities at which the sign of friction is smoothed."""
    shows_at_rest: ClassVar[tuple[str, ...]] = ()
    """Coefficients that a log without motion shows, such as a constant."""

    @pytest.fixture(scope="class")
    @classmethod
    def model(cls) -> Model:
        return arm_model(0).with_forces(cls.law)

    @pytest.fixture(scope="class")
    @classmethod
    def log(cls, model) -> Dataset:
        return log_of(model)

    @pytest.fixture(scope="class")
    @classmethod
    def opened(cls) -> Law:
        """The law without its numbers, but for those `given`."""
        return type(cls.law)(**{name: getattr(cls.law, name) for name in cls.given})

    def own(self, model: Model) -> Law:
        (law,) = (law for law in model.laws if type(law) is type(self.law))
        return law

    def states(self, log: Dataset):
        return [torch.tensor(np.array(x)) for x in (log.q[:5], log.v[:5], log.u[:5])]

    def test_every_state_stands_for_itself_and_has_derivatives(self, model, log):
        q, v, u = self.states(log)
        force = self.own(model).force(model.state(q, v, u))
        alone = torch.stack([self.own(model).force(model.state(q[k], v[k], u[k])) for k in range(5)])
        torch.testing.assert_close(alone, force, rtol=1e-12, atol=1e-12)

        def of(*state):
            return self.own(model).force(model.state(*state))

        given = [x[0] for x in (q, v, u)]
        slopes = torch.func.jacrev(of, (0, 1, 2))(*given)
        for k, (x, slope) in enumerate(zip(given, slopes, strict=True)):
            step = 1e-6 * torch.eye(len(x), dtype=torch.float64)
            moved = [[of(*(x + s * d if k == j else y for j, y in enumerate(given))) for d in step] for s in (1, -1)]
            numeric = (torch.stack(moved[0], -1) - torch.stack(moved[1], -1)) / 2e-6
            torch.testing.assert_close(slope, numeric, rtol=1e-5, atol=1e-5)

    def test_it_is_part_of_the_mean(self, model, log):
        q, v, u = self.states(log)
        with_law, without = model.dynamics(q, v, u), arm_model(0).dynamics(q, v, u)
        added = self.own(model).force(model.state(q, v, u))
        torch.testing.assert_close(with_law.Q_K - without.Q_K, added, rtol=1e-12, atol=1e-12)

    @pytest.mark.parametrize("evidence", [Torques(), Torques("both"), Accelerations()], ids=str)
    def test_its_numbers_are_found(self, evidence, opened, log):
        noisy = replace(log, a=log.a + 1e-3 * np.random.default_rng(1).standard_normal(log.a.shape))
        found = fit(arm_model(0).with_forces(opened), noisy, evidence)
        estimates = found.parameters
        assert estimates.settled
        assert all(name.startswith(force_name(self.law)) for name in estimates)
        own = self.own(found.model)
        single = not isinstance(own, PerJointLaw)
        shown = {x: np.ones(1, bool) if single else own.acts_on(x, found.model.robot) for x in opened.learned}
        truth = torch.cat([self.law.values[x].expand(len(own))[own] for x, own in shown.items()])
        values, reach = (np.array([getattr(each, n) for each in estimates.values()]) for n in ("value", "std"))
        np.testing.assert_array_less(abs(values - truth.numpy()), 5.0 * reach + 0.02 * truth.numpy().__abs__() + 1e-3)
        force, _ = motion_residuals(log, found.model)
        assert np.sqrt((force**2).mean()) < 0.01 * log.u.std()

    def test_it_is_estimated_beside_a_payload_and_bodies(self, opened, log):
        carried = log_of(arm_model(0).with_forces(self.law, Payload("hand", 0.4, (0.02, 0.01, 0.1))))
        found = fit(arm_model(0).with_forces(opened, Payload("hand")), carried, Torques())
        assert found.parameters["payload.mass"].value == pytest.approx(0.4, abs=0.02)
        bodies = fit(arm_model(0).with_forces(opened, RigidBodies("all")), log, Torques())
        assert bodies.parameters.total_mass[0] == pytest.approx(3.8, abs=0.3)

    def test_it_is_known_beside_unknown_forces(self, model, log, tmp_path):
        unknown = JointFriction()
        more = log_of(arm_model(0).with_forces(self.law, Viscous(0.7) if not isinstance(self.law, Viscous) else ()))
        posterior = fit(
            model.with_forces(unknown, noise=STILL), more, points=30, restarts=1,
            options=OptimizerOptions(iterations=15),
        )  # fmt: skip
        states = [x.numpy() for x in self.states(log)]
        prediction = posterior.predict(*states)
        assert bool(torch.isfinite(prediction.covariance).all())
        mean = posterior.predictor(compile=False)(*states)[0]
        torch.testing.assert_close(mean, prediction.mean, rtol=1e-9, atol=1e-9)
        save_posterior(posterior, tmp_path / "run")
        assert torch.equal(load_posterior(tmp_path / "run").predict(*states).mean, prediction.mean)

    def test_it_survives_files_and_texts(self, model, log):
        again, states = Model.from_json(model.to_json()), self.states(log)
        torch.testing.assert_close(again.dynamics(*states).Q_K, model.dynamics(*states).Q_K, rtol=0.0, atol=0.0)
        name = force_name(self.law)
        assert type(force_from_dict(json.loads(json.dumps(force_to_dict(self.law))))) is type(self.law)
        (written,) = parse_forces(f"{name}:{self.law.frame}" if hasattr(self.law, "frame") else name)
        assert type(written) is type(self.law)
        assert written.learned

    def test_plants_have_it_and_motions_are_predicted(self, model, log):
        posterior, q, v = fit(model.with_forces(noise=STILL), log), log.q[0], 0.2 * log.v[0]
        moved = posterior.rollout(q, v, np.zeros((40, 3)), 0.005, integrator="rk4")
        at_q, at_v = torch.tensor(q), torch.tensor(v)
        for _ in range(40):  # Runge and Kutta's rule, written out
            ks = []
            for part in (0.0, 0.5, 0.5, 1.0):
                dq, dv = (0.0, 0.0) if not ks else (part * 0.005 * ks[-1][0], part * 0.005 * ks[-1][1])
                a = model.dynamics(at_q + dq, at_v + dv, torch.zeros(3).double()).acceleration_map().offset
                ks.append((at_v + dv, a))
            at_q, at_v = (
                x + 0.005 / 6.0 * (ks[0][i] + 2.0 * ks[1][i] + 2.0 * ks[2][i] + ks[3][i])
                for i, x in enumerate((at_q, at_v))
            )
        torch.testing.assert_close(moved.q[-1], at_q, rtol=1e-6, atol=1e-7)

    def test_programs_in_c_and_casadi_have_it(self, model, log, tmp_path):
        casadi = pytest.importorskip("casadi", reason="CasADi is not installed: pip install 'forcegp[casadi]'")
        from forcegp import export_c
        from forcegp.posterior import casadi_function

        posterior, states = fit(model.with_forces(noise=STILL), log), [x.numpy()[0] for x in self.states(log)]
        function, expected = casadi_function(posterior), posterior.predict(*states).mean.numpy()
        np.testing.assert_allclose(np.array(function(*states)).ravel()[:3], expected, rtol=1e-9, atol=1e-9)
        assert isinstance(function, casadi.Function)
        export_c(posterior, tmp_path / "made", name="arm")  # compiled and compared with the model where it is written
        assert (tmp_path / "made" / "arm.c").exists()

    def test_what_mujoco_has_of_it_is_written_down(self, model):
        assert "<mujoco" in model.to_mjcf()

    def test_a_log_that_does_not_show_it_is_named(self, opened, log):
        if not isinstance(self.law, JointLaw) or not set(self.law.coefficients) - set(self.shows_at_rest):
            pytest.skip("it is no law of single joints, or shows at rest")
        still, name = replace(log, q=np.zeros_like(log.q), v=np.zeros_like(log.v)), force_name(self.law)
        found = fit(arm_model(0).with_forces(opened), still, Torques()).parameters
        seen = tuple(f"{name}.{coefficient}." for coefficient in self.shows_at_rest)
        assert {each.decided_by for each in found.values() if not each.name.startswith(seen)} == {"prior"}
