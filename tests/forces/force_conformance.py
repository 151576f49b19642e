"""What every unknown force must do. A new one is tested by one subclass whose name begins with `Test`:

class TestAirDrag(UnknownConformance):
    prior = AirDrag("hand")
    acts_at = ("hand", (0.0, 0.0, 0.0))
"""

import json
import pickle
import warnings
from functools import cache
from typing import Any, ClassVar, get_args

import pytest
import torch
from tests.mechanics.systems import assert_close
from tests.posterior.arm import URDF, arm_data, arm_model

from forcegp.data import Dataset
from forcegp.errors import NumericalWarning
from forcegp.fit import fit
from forcegp.forces import JointPositionForces, Scaling, Unknown, UnknownForces, force_from_dict, force_to_dict
from forcegp.inference import OptimizerOptions
from forcegp.model import Model
from forcegp.posterior import load_posterior, save_posterior
from forcegp.robots import Robot

BATCHES, STEP = [(), (4,), (2, 4)], 1e-5


@cache
def bent_arm() -> Model:
    """The arm on its plane, crooked, so that every force moves a joint, and with a last joint that slides."""
    changes = {
        '<joint name="bend" type="revolute">': '<joint name="bend" type="prismatic">',
        '<origin xyz="0 0 0.3" rpy="0 0 0"/><parent link="upper"/>': (
            '<origin xyz="0 0 0.3" rpy="0.3 0.2 0"/><parent link="upper"/>'
        ),
        '<origin xyz="0 0 0.25" rpy="0 0 0"/>': '<origin xyz="0 0 0.25" rpy="0.2 0.1 0.4"/>',
    }
    text = URDF
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    return arm_model().with_robot(Robot.from_urdf_text(text))


@cache
def some_data(model: Model, rows: int, seed: int) -> Dataset:
    return arm_data(rows, seed, model)


def some_states(*batch: int) -> list[torch.Tensor]:
    generators = (torch.Generator().manual_seed(seed) for seed in (1, 2, 3))
    return [torch.randn(*batch, 3, dtype=torch.float64, generator=generator) for generator in generators]


class UnknownConformance:
    """Shapes, names, derivatives, kernels, storage, sums and a fit of `prior`, on an arm with one contact."""

    prior: ClassVar[Unknown]
    acts_at: ClassVar[tuple[str, tuple[float, float, float]] | None] = None
    """Link and point (m) at which `point_force` acts; None for priors of joint forces."""

    @pytest.fixture(scope="class")
    @classmethod
    def model(cls) -> Model:
        """Override for a prior that needs another robot."""
        return bent_arm()

    @pytest.fixture(scope="class")
    @classmethod
    def data(cls, model):
        return some_data(model, 14, 1)

    @pytest.fixture(scope="class")
    @classmethod
    def fitted(cls, data):
        model = data.model.with_forces(cls.prior)
        with warnings.catch_warnings(action="ignore", category=NumericalWarning):  # so few iterations settle nothing
            return fit(model, data, restarts=1, options=OptimizerOptions(iterations=3))

    def values(self, model, *states) -> torch.Tensor:
        """Mixing and features of each state as one vector."""
        dynamics = model.dynamics(*states)
        return torch.cat([self.prior.direction(dynamics).flatten(-2), *self.prior.features(dynamics)], dim=-1)

    @pytest.mark.parametrize("batch", BATCHES, ids=str)
    def test_shapes_names_and_units_agree(self, model, batch):
        robot, dynamics = model.robot, model.dynamics(*some_states(*batch))
        names = self.prior.latent_names(robot)
        B, features = self.prior.direction(dynamics), self.prior.features(dynamics)
        point_force = self.prior.point_force(dynamics)
        assert len(set(names)) == len(names)
        assert B.shape == (*batch, robot.nv, len(names))
        assert all(z.shape[:-1] == batch and z.dim() == len(batch) + 1 for z in features)
        assert point_force is None or point_force.shape == (*batch, 3, len(names))
        assert all(value.dtype == torch.float64 for value in (B, *features))
        assert all(bool(torch.isfinite(value).all()) for value in (B, *features))
        scalings, labels = self.prior.scalings(robot), self.prior.feature_names(robot)
        units = self.prior.latent_units(robot)
        assert len(features) == len(scalings) == len(units) == len(names)
        assert all(isinstance(text, str) for text in (*names, *units))
        for scaling, z in zip(scalings, features, strict=True):
            ways = (scaling,) * z.shape[-1] if isinstance(scaling, str) else scaling
            assert len(ways) == z.shape[-1]
            assert all(way in get_args(Scaling) for way in ways)
        if labels is not None:
            assert [len(label) for label in labels] == [z.shape[-1] for z in features]
            assert all(len(set(label)) == len(label) for label in labels)

    def test_it_fits_the_system_and_has_a_title(self, model):
        self.prior.check(model.robot, model.contacts)
        assert self.prior.title

    def test_the_same_states_give_the_same_answer_and_stay_as_they_are(self, model):
        states = some_states(4)
        once, again = (model.dynamics(*states) for _ in range(2))
        assert torch.equal(self.prior.direction(once), self.prior.direction(again))
        assert torch.equal(self.prior.direction(once), self.prior.direction(once))
        assert all(map(torch.equal, self.prior.features(once), self.prior.features(again)))
        assert all(map(torch.equal, states, some_states(4)))

    def test_every_state_stands_for_itself_under_vmap_too(self, model):
        states = some_states(4)
        single = torch.stack([self.values(model, *(x[row] for x in states)) for row in range(4)])
        assert_close(self.values(model, *states), single, 1e-12)
        assert_close(torch.func.vmap(lambda *given: self.values(model, *given))(*states), single, 1e-12)

    def test_derivatives_in_the_state(self, model):
        states = some_states()
        jacobians = torch.func.jacrev(lambda *given: self.values(model, *given), (0, 1, 2))(*states)
        steps = STEP * torch.eye(9, dtype=torch.float64)
        places = ((torch.cat(states) + sign * steps).split(3, dim=-1) for sign in (1.0, -1.0))
        ahead, behind = (self.values(model, *at) for at in places)
        assert_close(torch.cat(jacobians, dim=-1), (ahead - behind).mT / (2.0 * STEP), 1e-6)

    def test_values_and_derivatives_are_finite_at_rest(self, model):
        q, v, u = some_states()
        assert bool(torch.isfinite(self.values(model, q, 0.0 * v, u)).all())
        jacobians = torch.func.jacrev(lambda *given: self.values(model, *given), (0, 1, 2))(q, 0.0 * v, u)
        assert all(bool(torch.isfinite(jacobian).all()) for jacobian in jacobians)

    def test_kernels_take_the_features_and_start_with_the_variances(self, model):
        features = self.prior.features(model.dynamics(*some_states(5)))
        dimensions = tuple(z.shape[-1] for z in features)
        variances = torch.arange(1.0, 1.0 + len(features), dtype=torch.float64)
        kernels, wider = (self.prior.kernels(model.robot, dimensions, scale * variances) for scale in (1.0, 4.0))
        assert len(kernels) == len(wider) == len(features)
        assert not {id(kernel) for kernel in kernels} & {id(kernel) for kernel in wider}
        for kernel, wide, z in zip(kernels, wider, features, strict=True):
            assert all(value.dtype == torch.float64 for value in kernel.parameters())
            with torch.no_grad():
                K, larger = kernel(z).to_dense(), wide(z).to_dense()
            assert K.shape == (5, 5)
            assert_close(larger, 4.0 * K, 1e-9)
            assert float(torch.linalg.eigvalsh(K)[0]) > -1e-9 * float(K.abs().max())

    def test_it_survives_a_file_and_another_process(self):
        again = force_from_dict(json.loads(json.dumps(force_to_dict(self.prior))))
        assert again == self.prior
        assert type(again) is type(self.prior)
        assert force_to_dict(again) == force_to_dict(self.prior)
        assert pickle.loads(pickle.dumps(self.prior)) == self.prior

    def test_the_point_force_makes_the_joint_force(self, model):
        dynamics = model.dynamics(*some_states(4))
        force = self.prior.point_force(dynamics)
        assert (force is None) == (self.acts_at is None)
        if force is None:
            return
        J = dynamics.state.kinematics.frame_jacobian(*self.acts_at)[..., :3, :]
        pushes = force.abs().amax((0, 1)) > 0.0  # the others are torques
        assert bool(pushes.any())
        assert_close(J.mT @ force[..., pushes], self.prior.direction(dynamics)[..., pushes], 1e-12)

    def test_sums_with_another_prior(self, model):
        other = JointPositionForces(kernel="matern-1/2")
        total, dynamics = UnknownForces((self.prior, other)), model.dynamics(*some_states(4))
        parts = (self.prior, other)
        assert torch.equal(total.direction(dynamics), torch.cat([part.direction(dynamics) for part in parts], -1))
        given = [z for part in parts for z in part.features(dynamics)]
        assert all(map(torch.equal, total.features(dynamics), given))
        count = len(self.prior.latent_names(model.robot))
        assert total.slices(model.robot)[-1] == slice(count, count + 3)
        ends = [[which.start, which.stop] for which in total.slices(model.robot)]
        assert [start for start, _ in ends[1:]] == [stop for _, stop in ends[:-1]]
        names = total.latent_names(model.robot)
        assert len(set(names)) == len(names) == count + 3
        assert names[count].startswith("joint-position-forces")
        assert names[count].endswith(" pan")
        assert len(set(total.term_names)) == len(total.terms)
        assert total.latent_units(model.robot)[:count] == self.prior.latent_units(model.robot)
        assert total.scalings(model.robot) == self.prior.scalings(model.robot) + other.scalings(model.robot)
        kernels = total.kernels(model.robot, tuple(z.shape[-1] for z in given), torch.ones(count + 3).double())
        assert len(kernels) == count + 3
        assert total.named(model.robot)[-1][1] is other

    def test_a_fit_predicts_and_comes_back_from_a_folder(self, fitted, data, tmp_path):
        test = some_data(data.model, 6, 2)
        states = test.q, test.v, test.u
        prediction, dynamics = fitted.predict(*states), data.model.dynamics(*map(torch.tensor, states))
        violation = (dynamics.A @ prediction.mean[..., None])[..., 0] - dynamics.b
        assert float(violation.abs().max()) < 1e-8
        for gaussian in (prediction, prediction.unknown_force):
            smallest = torch.linalg.eigvalsh(gaussian.covariance)[..., 0]
            assert bool((smallest > -1e-9 * (1.0 + gaussian.covariance.abs().amax((-2, -1)))).all())
        save_posterior(fitted, tmp_path / "run")
        again = load_posterior(tmp_path / "run")
        assert again.model.unknown_forces == fitted.model.unknown_forces
        theirs = again.predict(*states)
        assert torch.equal(theirs.mean, prediction.mean)
        assert torch.equal(theirs.covariance, prediction.covariance)

    def test_the_components_add_up(self, fitted, data):
        test = some_data(data.model, 6, 2)
        states = test.q, test.v, test.u
        components, prediction = fitted.components(*states), fitted.predict(*states)
        parts: Any = list(components.values())
        assert tuple(components) == (self.prior.title,)
        assert [name for part in parts for name in part.latent_names] == [*self.prior.latent_names(data.model.robot)]
        assert_close(sum(part.joint_force.mean for part in parts), prediction.unknown_force.mean, 1e-10)
        offset = data.model.dynamics(*map(torch.tensor, states)).acceleration_map().offset
        assert_close(offset + sum(part.acceleration.mean for part in parts), prediction.mean, 1e-10)
        for part in parts:
            assert_close(part.joint_force.covariance, part.joint_force.covariance.mT, 0.0)
            if part.point_force is not None:
                assert part.point_force.mean.shape == (6, 3)
