"""Forces by themselves, their curves, and other contacts and robots, against dense conditioning and true forces."""

import math

import numpy as np
import pytest
import torch
from tests.posterior.arm import URDF, Weight, arm_data, arm_model, quick_fit

from forcegp.errors import InvalidInput, UnknownName
from forcegp.forces import ContactFriction, JointForces, JointFriction, UnknownForces
from forcegp.mechanics import Contact, Plane, Sphere
from forcegp.robots import Robot

PRIOR, NOISE = UnknownForces((JointFriction(), ContactFriction(), Weight())), 0.05
TIP = (0.0, 0.0, 0.2)
OTHER_CONTACTS = {
    "same": arm_model().contacts, "sphere": (Contact("hand", TIP, Sphere((0.0, 0.0, -2.0), 2.4)),), "none": (),
    "two": (*arm_model().contacts, Contact("fore", (0.1, 0.0, 0.0), Plane((1.0, 0.0, 0.0), 0.1))),
}  # fmt: skip


@pytest.fixture(scope="module")
def train():
    return arm_data(16, 1)


@pytest.fixture(scope="module")
def posterior(train):
    return quick_fit(train.model.with_forces(PRIOR.terms), train, 5)


@pytest.fixture(scope="module")
def states():
    test = arm_data(4, 2)
    return [torch.tensor(x) for x in (test.q, test.v, test.u)]


class Dense:
    """All processes of PRIOR given the training data, from one joint covariance, written plainly."""

    def __init__(self, posterior, train):
        self.kernels, self.widening = list(posterior.latent.kernels), posterior.widening
        dynamics = train.model.dynamics(*(torch.tensor(x) for x in (train.q, train.v, train.u)))
        self.scales = [z.square().mean(0).sqrt() for z in PRIOR.features(dynamics)]  # velocities keep their zero
        self.z, self.W = self.scaled(dynamics), dynamics.H @ PRIOR.direction(dynamics)
        N, D, _ = self.W.shape
        S = NOISE**2 * torch.eye(N * D).double()
        for c, kernel in enumerate(self.kernels):
            w = self.W[..., c]
            S += torch.einsum("id,ij,je->idje", w, self.k(kernel, self.z[c], self.z[c]), w).reshape(N * D, N * D)
        self.S = S
        self.residual = (torch.tensor(train.a) - dynamics.acceleration_map().offset).reshape(-1)

    def scaled(self, dynamics):
        return [z / s for z, s in zip(PRIOR.features(dynamics), self.scales, strict=True)]

    @staticmethod
    def k(kernel, one, other):
        with torch.no_grad():
            pairs = [[float(kernel(a[None], b[None], diag=True)) for b in other] for a in one]
        return torch.tensor(pairs, dtype=torch.float64)

    def latents(self, z):
        """Means (n, C) and covariances (n, C, C) at scaled features."""
        cross, own = [], []
        for c, kernel in enumerate(self.kernels):
            cross.append(torch.einsum("nj,jd->njd", self.k(kernel, z[c], self.z[c]), self.W[..., c]).flatten(1))
            own.append(self.k(kernel, z[c], z[c]).diagonal())
        cross = torch.stack(cross, dim=1)
        mean = cross @ torch.linalg.solve(self.S, self.residual)
        covariance = torch.diag_embed(torch.stack(own, -1)) - cross @ torch.linalg.solve(self.S, cross.mT)
        return mean, self.widening**2 * covariance


@pytest.fixture(scope="module")
def dense(posterior, train):
    return Dense(posterior, train)


def close(given, expected, tolerance=1e-7):
    torch.testing.assert_close(given, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("contacts", OTHER_CONTACTS)
def test_components_are_those_of_dense_conditioning(posterior, dense, states, contacts):
    """Under the contacts of the training data, and under others."""
    moved = posterior.with_contacts(OTHER_CONTACTS[contacts])
    dynamics = moved.model.dynamics(*states)
    mean, covariance = dense.latents(dense.scaled(dynamics))
    B, components = PRIOR.direction(dynamics), moved.components(*states)
    assert tuple(components) == ("joint-friction", "contact-friction", "weight")
    for name, which in zip(components, (slice(0, 3), slice(3, 4), slice(4, 5)), strict=True):
        part, b, own = components[name], B[..., which], covariance[:, which, which]
        close(part.latents.mean, mean[:, which])
        close(part.latents.covariance, own)
        for gaussian, matrix in ((part.joint_force, b), (part.acceleration, dynamics.H @ b)):
            close(gaussian.mean, (matrix @ mean[:, which, None])[..., 0])
            close(gaussian.covariance, matrix @ own @ matrix.mT)
    force = torch.tensor([0.0, 0.0, -9.81]).double() * components["weight"].latents.mean
    close(components["weight"].point_force.mean, force, 1e-6)
    assert components["joint-friction"].point_force is None
    predicted = moved.predict(*states)
    total = predicted.unknown_force
    close(total.mean, (B @ mean[..., None])[..., 0])
    close(total.covariance, B @ covariance @ B.mT)
    alone = sum(part.joint_force.covariance for part in components.values())
    assert float((total.covariance - alone).abs().max()) > 1e-4  # the data tie the parts to each other
    learned, noise = B @ covariance @ B.mT, moved.unlearned(dynamics)
    whole = learned if noise is None else learned + noise
    for gaussian, affine, spread in (
        (predicted.multiplier, dynamics.multiplier_map(), whole),
        (predicted.contact_force, dynamics.contact_force_map(), whole),
        (predicted, dynamics.acceleration_map(), learned),
    ):
        close(gaussian.mean, affine(total.mean))
        close(gaussian.covariance, affine.matrix @ spread @ affine.matrix.mT)
    if contacts == "none":
        assert float(components["contact-friction"].joint_force.mean.abs().max()) == 0.0
    bare = moved.components(*states, covariance=False)
    close(bare["weight"].joint_force.mean, components["weight"].joint_force.mean, 1e-12)
    assert bare["weight"].joint_force.covariance is None


def test_components_of_any_batch_and_their_names(posterior, states):
    flat, folded = posterior.components(*states), posterior.components(*(x.reshape(2, 2, 3) for x in states))
    close(folded["contact-friction"].point_force.mean.reshape(4, 3), flat["contact-friction"].point_force.mean, 1e-12)
    single = posterior.components(*(x[1].tolist() for x in states))
    close(single["weight"].joint_force.covariance, flat["weight"].joint_force.covariance[1], 1e-12)
    assert flat["contact-friction"].latent_units == ("N",)
    assert flat["joint-friction"].latent_names == ("pan", "lift", "bend")
    with pytest.raises(InvalidInput, match="last dimension must be 3"):
        posterior.components([1.0], [1.0], [1.0])


def test_a_curve_is_that_of_dense_conditioning(posterior, dense, train):
    v = torch.tensor(train.v)
    for name, index in (("joint-friction lift", 1), ("contact-friction sliding", 3)):
        curve = posterior.curve(name, points=7)
        assert curve.features.shape == (7, 1)
        z = [curve.features / scale if len(scale) else curve.features[:, :0] for scale in dense.scales]
        mean, covariance = dense.latents(z)
        close(curve.mean, mean[:, index])
        close(curve.std, covariance[:, index, index].sqrt(), 1e-6)
        assert torch.equal(curve.visited, torch.stack([curve.features[0], curve.features[-1]]))
    lift = posterior.curve("joint-friction lift", points=7)
    assert (lift.name, lift.unit, lift.feature_names) == ("joint-friction lift", "Nm", ("velocity of lift [rad/s]",))
    assert torch.equal(lift.visited[:, 0], torch.stack([v[:, 1].min(), v[:, 1].max()]))
    lower, upper = lift.interval()
    close(0.5 * (upper - lower) / lift.std, 1.959963984540054 * torch.ones(7).double(), 1e-12)
    given = posterior.curve("joint-friction lift", [0.0, 3.0])
    assert float(given.mean[0]) == pytest.approx(0.0, abs=1e-12)  # friction at rest is zero
    assert torch.equal(given.features, torch.tensor([[0.0], [3.0]]).double())
    constant = posterior.curve("weight mass")
    assert (constant.unit, constant.feature_names) == ("kg", ())
    assert constant.mean.shape == constant.std.shape == (1,)
    parts = posterior.components(*(torch.tensor(x[:1]) for x in (train.q, train.v, train.u)))
    close(constant.mean, parts["weight"].latents.mean[0], 1e-10)


def test_wrong_curves_are_refused(posterior, train):
    with pytest.raises(InvalidInput, match="no latent '0' in this model"):
        posterior.curve(0)  # a number is no name
    with pytest.raises(InvalidInput, match=r"no latent 'lift' in this model.* Valid latents: "):
        posterior.curve("lift")
    with pytest.raises(InvalidInput, match=r"'joint-friction lift' .*\(3, 2\).*\(n, 1\)"):
        posterior.curve("joint-friction lift", np.zeros((3, 2)))
    with pytest.raises(InvalidInput, match="give finite numbers"):
        posterior.curve("joint-friction lift", [math.nan])
    with pytest.raises(InvalidInput, match="points=0"):
        posterior.curve("joint-friction lift", points=0)
    joint = quick_fit(train.model.with_forces(JointForces()), train, 1)
    with pytest.raises(InvalidInput, match=r"'pan' .*\(n, 9\)"):
        joint.curve("pan")
    assert joint.curve("pan", np.zeros((2, 9))).mean.shape == (2,)


def test_what_cannot_move_is_refused(posterior, train):
    heavier = Robot.from_urdf_text(URDF.replace('mass value="0.6"', 'mass value="1.4"'))
    renamed = Robot.from_urdf_text(URDF.replace('"pan"', '"yaw"'))
    with pytest.raises(InvalidInput, match=r"pan, lift, bend.*yaw, lift, bend"):
        posterior.with_model(posterior.model.with_robot(renamed))
    handless = Robot.from_urdf_text(URDF.replace('"hand"', '"claw"'))
    with pytest.raises(UnknownName, match="hand"):
        posterior.with_model(arm_model(contacts=0).with_robot(handless))
    zero = quick_fit(train.model.with_forces(JointForces()).without_mean(), train, 1)
    with pytest.raises(InvalidInput, match=r"no rigid bodies.* fit a model with RigidBodies\(\)"):
        zero.with_model(zero.model.with_robot(heavier))
    assert zero.with_contacts([]).predict(train.q, train.v, train.u).multiplier.mean.shape == (16, 0)
