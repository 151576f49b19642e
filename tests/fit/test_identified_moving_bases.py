"""Regression on torques where the base moves: Pinocchio's regressor, dense algebra, and parameters found again."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import torch
from benchmarks import quadruped
from numpy.testing import assert_allclose
from scipy.linalg import eigh, null_space
from tests.forces.test_thrusters import DRONE
from tests.robots.random_positions import random_positions
from tests.robots.test_moving_bases import LIMBS, ROOTS, Pair

from forcegp import Accelerations
from forcegp.data import Dataset, Preparation
from forcegp.errors import DataWarning, InvalidInput
from forcegp.evidence import NoiseLevels, Torques, base_parameters, body_names, standard_parameters, torque_regressor
from forcegp.evidence.bodies import body_pseudo_inertias, carrying, with_bodies
from forcegp.evidence.least_squares import weighted_least_squares, without
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.evidence.recorded_rows import RecordedRows
from forcegp.fit import fit
from forcegp.forces import Actuation, Body, Coulomb, Payload, RigidBodies, Rotor, Thrusters, Viscous
from forcegp.mechanics import fixed_point
from forcegp.model import Model
from forcegp.robots import Robot

FEET = (*fixed_point("a_foot", switch="a_stands"), *fixed_point("b_foot", (0.0, 0.0, 0.1), "b_stands"))
FRICTION = Viscous(0.3), Coulomb(0.5, 0.2)
OPEN = Viscous(), Coulomb()
EVIDENCE = {"torque": Torques(), "acceleration": Accelerations(), "both": Torques("both")}


def identified(log, model=None, laws=(), evidence=None, strength=1.0, **options):
    """All bodies and these laws, from a log."""
    model = model or log.model
    links = [name.split(" ")[0] for name in body_names(model.robot)]
    bodies = RigidBodies({link: Body(strength) for link in links})
    return fit(model.with_forces(bodies, *laws), log, evidence, **options)


def parameters_of(posterior):
    return standard_parameters(posterior.model.robot).numpy()


@pytest.fixture(scope="module")
def walker():
    return Model(Robot.from_urdf_text(LIMBS, base="floating"), FEET)


def rows_of(model, count, seed=0, switches=2):
    """Random states; feet stand and swing at random."""
    generator, robot = torch.Generator().manual_seed(seed), model.robot
    v, u = (torch.randn(count, n, dtype=torch.float64, generator=generator) for n in model.sizes[1:])
    u[:, u.shape[1] - switches :] = torch.randint(0, 2, (count, switches), generator=generator).double()
    return random_positions(robot, generator, count), v, u


def scaled(robot, factors):
    """The robot whose bodies are heavier throughout by these factors."""
    own = body_pseudo_inertias(robot).numpy()
    return with_bodies(robot, {k: f * P for k, f, P in zip(carrying(robot), factors, own, strict=True)})


def recorded(model, count, noise=0.0, seed=0, switches=2):
    q, v, u = rows_of(model, count, seed, switches)
    a = model.dynamics(q, v, 5.0 * u if not switches else u).acceleration_map().offset
    a = a + noise * torch.randn(a.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed + 1))
    time = torch.arange(count, dtype=torch.float64) / 100
    u = 5.0 * u if not switches else u
    return Dataset(**{name: x.numpy() for name, x in zip("qvua", (q, v, u, a), strict=True)}, time=time.numpy(),
                   model=model)  # fmt: skip


@pytest.mark.parametrize("base", [base for base in ROOTS if base != "fixed"])
def test_columns_and_their_rank_are_those_of_pinocchio(base):
    pair = Pair(base)
    robot = pair.robot
    ours = torque_regressor(robot, pair.q, pair.v, pair.a).unflatten(-1, (-1, 10)).numpy()
    ids = [pair.model.frames[pair.model.getFrameId(link)].parentJoint - 1 for link in body_names(robot)]
    for k, q, v, a, _ in pair.states():
        theirs = pin.computeJointTorqueRegressor(pair.model, pair.data, q, v, a).reshape(robot.nv, -1, 10)
        assert_allclose(ours[k], theirs[pair.to_v][:, ids], atol=1e-10 * np.abs(theirs).max())
    again = torque_regressor(robot, pair.q, pair.v, pair.a) @ standard_parameters(robot)
    torch.testing.assert_close(again, robot.inverse_dynamics(pair.q, pair.v, pair.a), atol=1e-10, rtol=1e-10)
    rng = np.random.default_rng(0)
    stacked = [
        pin.computeJointTorqueRegressor(pair.model, pair.data, pin.randomConfiguration(pair.model, *limits), v, a)
        for limits in [(-np.ones(pair.model.nq), np.ones(pair.model.nq))]
        for v, a in rng.normal(size=(60, 2, robot.nv))
    ]
    assert len(base_parameters(robot)) == np.linalg.matrix_rank(np.concatenate(stacked), tol=1e-8)


@pytest.mark.parametrize("likelihood", ["torque", "acceleration"])
def test_residuals_and_their_jacobians(walker, likelihood):
    """At the start they are those of the system's own dynamics; elsewhere slopes are differences of the residual."""
    model = replace(walker, forces=(*walker.forces, *FRICTION, Rotor(0.05)))
    q, v, u = (x.numpy() for x in rows_of(model, 5))
    a = np.random.default_rng(1).normal(size=v.shape)
    opened = model.with_forces(RigidBodies("all"), *(law.open() for law in model.laws if law.coefficients))
    space = ParameterSpace(opened, dict.fromkeys(("force", "position", "velocity", "inertia"), np.ones(v.shape[1])))
    rows = RecordedRows(space, q, v, u)

    def residual(x):
        if likelihood == "torque":
            r, in_parameters, in_laws, _ = rows.in_torque(x, rows.moving(a))
        else:
            r, in_parameters, in_laws = rows.in_acceleration(x, a)
        jacobian = np.concatenate([space.bodies.chained(x[: space.bodies.size], in_parameters), in_laws], -1)
        free = rows.open.swapaxes(1, 2) if likelihood == "torque" else None
        return without(r, free), without(jacobian, free)

    start, dynamics = space.start, model.dynamics(*(torch.tensor(s) for s in (q, v, u)))
    if likelihood == "torque":  # H takes out the same directions, along A^T
        wrong = (dynamics.M @ torch.tensor(a)[..., None])[..., 0] - dynamics.Q_K
        seen, ours = (dynamics.H.numpy() @ each[..., None] for each in (wrong.numpy(), residual(start)[0]))
        assert_allclose(seen, ours, atol=1e-8)
        assert np.abs(dynamics.A.numpy() @ residual(start)[0][..., None]).max() < 1e-9
    else:
        assert_allclose(residual(start)[0], a - dynamics.acceleration_map().offset.numpy(), atol=1e-8)
    x = start + np.random.default_rng(2).uniform(0.05, 0.2, len(start))
    direction = np.random.default_rng(3).normal(size=len(x))
    numeric = (residual(x + 1e-6 * direction)[0] - residual(x - 1e-6 * direction)[0]) / 2e-6
    assert_allclose(residual(x)[1] @ direction, numeric, rtol=1e-5, atol=1e-5 * np.abs(numeric).max())


def test_forces_that_are_left_out_are_those_of_least_squares_with_them_as_unknowns():
    rng = np.random.default_rng(0)
    rows, nv, k = 40, 4, 3
    J, noise, truth = rng.normal(size=(rows, nv, k)), np.array([0.1, 1.0, 0.3, 0.5]), np.array([1.0, -2.0, 0.5])
    held = rng.normal(size=(rows, 2, nv)) * (rng.integers(0, 3, (rows, 1)) > np.arange(2))[..., None]
    pushed = (held.swapaxes(1, 2) @ (100.0 * rng.normal(size=(rows, 2, 1))))[..., 0]
    y = J @ truth + noise * rng.normal(size=(rows, nv)) + pushed

    def prior(x):
        return 1e-3 * x, 1e-3 * np.eye(k)

    bounds = np.full(k, -np.inf), np.full(k, np.inf)
    fit = weighted_least_squares(lambda x: (J @ x - y, J), prior, np.zeros(k), bounds, held=held)
    lambdas = np.zeros((rows * nv, 2 * rows))
    for row in range(rows):
        lambdas[nv * row : nv * row + nv, 2 * row : 2 * row + 2] = -(held[row] / fit.noise).T
    dense = np.concatenate([(J / fit.noise[:, None]).reshape(-1, k), lambdas], 1)
    assert_allclose(fit.x, np.linalg.lstsq(dense, (y / fit.noise).ravel(), rcond=1e-10)[0][:k], atol=1e-3)
    hidden = np.linalg.qr(lambdas[:, lambdas.any(0)])[0]
    left = dense[:, :k] - hidden @ (hidden.T @ dense[:, :k])
    assert_allclose(fit.information, left.T @ left, rtol=1e-8)
    assert_allclose(fit.noise, noise, rtol=0.5)


@pytest.mark.parametrize("likelihood", ["torque", "acceleration", "both"])
def test_a_walker_is_found_again(walker, likelihood):
    """Feet stand row by row, forces on them unknown: total mass, base parameters and friction come from the rest."""
    heavier = body_pseudo_inertias(walker.robot).numpy() * np.array([1.5, 1.2, 0.9, 1.1])[:, None, None]
    truth = replace(
        walker,
        robot=with_bodies(walker.robot, dict(zip(carrying(walker.robot), heavier, strict=True))),
        forces=(*walker.forces, *FRICTION),
    )
    found = identified(recorded(truth, 300, noise=1e-3), walker, OPEN, EVIDENCE[likelihood], strength=1e-3)
    mass, error = found.parameters.total_mass
    assert abs(mass - heavier[:, 3, 3].sum()) < 5 * error + 1e-2
    for name, value in {"viscous": 0.3, "coulomb.level": 0.5}.items():
        for joint in walker.robot.single_joint_names:
            assert abs(found.parameters[f"{name}.{joint}"].value - value) < 0.03
    assert not any(name.startswith(("viscous.base", "coulomb.level.base")) for name in found.parameters)
    test = recorded(truth, 50, seed=9)
    Y = torque_regressor(walker.robot, *(torch.tensor(x) for x in (test.q, test.v, test.a))).flatten(0, 1).numpy()
    wanted = Y @ standard_parameters(truth.robot).numpy()
    assert_allclose(Y @ parameters_of(found), wanted, atol=0.02 * np.abs(wanted).max())
    assert_allclose(found.predict(test.q, test.v, test.u).mean, test.a, atol=0.05 * np.abs(test.a).max())
    assert_allclose(found.model.sizes, walker.sizes)


def test_likely_accelerations_cost_least(walker):
    """The cost r^T S^-1 r is the least, over a* and forces of contacts, of both squared errors; its slope is theirs."""
    # What moves the base without an actuator is an error of a, whose covariance stays that of the last estimates
    q, v, u = (x.numpy() for x in rows_of(walker, 6))
    a, opened = np.random.default_rng(1).normal(size=v.shape), walker.with_forces(RigidBodies("all"), Viscous())
    space = ParameterSpace(opened, dict.fromkeys(("force", "position", "velocity", "inertia"), np.ones(v.shape[1])))
    rows, x = RecordedRows(space, q, v, u), space.start + np.random.default_rng(2).uniform(0.05, 0.2, space.size)
    levels, measured = NoiseLevels(np.full(9, 0.3), np.full(9, 0.2)), rows.moving(a)
    likely = rows.likely(x, measured, levels)
    of_base, of_joints = np.split(levels.force**2, [6])
    _, _, H = rows.acceleration(x)
    e_a = np.diag(levels.acceleration**2) + H[:, :, :6] * of_base @ H[:, :6]

    def cost(x):
        """By least squares with e_a and lambda as unknowns, where contacts hold and nothing drives the base."""
        total = 0.0
        r, *_ = rows.in_torque(x, measured)
        _, M, _ = rows.acceleration(x)
        for row in range(len(a)):
            held = rows.held[row].T
            missing = np.concatenate([-M[row], held], 1)  # of the forces; r is what is there already
            fixed = np.concatenate([np.concatenate([held.T, np.zeros((held.shape[1],) * 2)], 1), missing[:6]])
            wanted = np.concatenate([held.T @ a[row] - rows.right[row], -r[row, :6]])
            found, free = np.linalg.lstsq(fixed, wanted, rcond=1e-12)[0], null_space(fixed, rcond=1e-12)
            weights = np.linalg.inv(np.linalg.cholesky(e_a[row])), np.diag(of_joints**-0.5)
            left = np.concatenate([weights[0] @ found[:9], weights[1] @ (missing[6:] @ found + r[row, 6:])])
            change = np.concatenate([weights[0] @ free[:9], weights[1] @ missing[6:] @ free])
            total += ((left - change @ np.linalg.lstsq(change, left, rcond=1e-12)[0]) ** 2).sum()
            broken = held.T @ a[row] - rows.right[row]  # what contacts cost does not depend on x
            total -= broken @ np.linalg.pinv(held.T @ e_a[row] @ held, rcond=1e-12) @ broken
        return total

    r, in_parameters, in_laws, _ = rows.in_torque(x, likely.motion)
    assert_allclose((rows.held @ likely.motion.a[..., None])[..., 0], rows.right, atol=1e-8)
    white = (likely.whitening @ (r + likely.offset)[..., None])[..., 0]
    assert_allclose((white**2).sum(), cost(x), rtol=1e-7)
    in_bodies = space.bodies.chained(x[: space.bodies.size], in_parameters)
    slope = 2.0 * np.einsum("ni,nij,njk->k", white, likely.whitening, np.concatenate([in_bodies, in_laws], -1))
    direction = np.random.default_rng(3).normal(size=len(x))
    numeric = (cost(x + 1e-6 * direction) - cost(x - 1e-6 * direction)) / 2e-6
    assert slope @ direction == pytest.approx(numeric, rel=1e-5)


def test_noise_of_accelerations_takes_no_mass_away(walker):
    """Least squares of torque find a robot of some grams."""
    log = recorded(walker, 250)
    noisy = replace(log, a=log.a + 3.0 * np.random.default_rng(0).normal(size=log.a.shape))
    mass = standard_parameters(walker.robot)[::10].sum().item()
    assert identified(noisy, evidence=Torques()).parameters.total_mass[0] < 0.5 * mass
    found = identified(noisy)
    assert found.parameters.evidence == str(Torques("both"))
    assert found.parameters.total_mass[0] == pytest.approx(mass, rel=0.02)


@pytest.mark.nightly
def test_a_drone_without_joints(walker):
    """Nothing but the ten numbers of one body, from thrusts."""
    places = ((0.2, 0.0, 0.0), (0.0, 0.2, 0.0), (-0.2, 0.0, 0.0), (0.0, -0.2, 0.1))
    robot = Robot.from_urdf_text(DRONE, base="floating")
    locked = Robot.from_urdf_text(DRONE, base="floating", locked=dict.fromkeys(robot.single_joint_names, 0.0))
    rotors = Thrusters(locked.layout.moving[0], places, torque=(0.02, -0.02, 0.02, -0.02))
    model = Model(locked, (), (Actuation(), rotors, RigidBodies()))
    heavier = replace(model, robot=scaled(locked, [1.3]))
    log = recorded(heavier, 200, switches=0)
    found, carried = identified(log, model), fit(model.with_forces(Payload()), log).parameters["payload.mass"]
    assert carried.value == pytest.approx(0.3 * locked.mass, rel=0.05)
    assert_allclose(parameters_of(found), standard_parameters(heavier.robot), atol=1e-3)
    assert [type(force) for force in found.model.forces] == [type(force) for force in model.forces]
    weak = replace(rotors, thrust=(1.0, 1.0, 0.8, 1.0), torque=(0.02, -0.02, 0.016, -0.02))
    weak = replace(model, forces=(Actuation(), weak, RigidBodies()))
    q, v, u = rows_of(model, 2000, switches=0)
    q[:, 3:] = torch.nn.functional.normalize(0.1 * q[:, 3:] + torch.eye(4)[3], dim=-1)
    u, noise = 2.5 * locked.mass * (1.0 + 0.1 * u), np.random.default_rng(0).normal(0.0, 0.1, v.shape)  # it hovers
    a = weak.dynamics(q, v, u).acceleration_map().offset + torch.tensor(noise)
    values = dict(zip("qvua", map(np.asarray, (q, v, u, a)), strict=True))
    log = Dataset(**values, time=0.01 * np.arange(2000), model=model)
    with pytest.warns(DataWarning, match=r"times 0\.8 \(rotor_3\) would do as well as any payload"):
        carried = fit(model.with_forces(Payload()), log, Torques("both", mean=0.4)).parameters["payload.mass"]
    assert carried.interval[0] < 0.0


def test_a_payload_on_the_trunk_of_a_walker(walker):
    heavier, link = body_pseudo_inertias(walker.robot).numpy().copy(), body_names(walker.robot)[0]
    heavier[0] += np.diag([2e-3, 2e-3, 2e-3, 0.0])
    heavier[0] += 0.8 * np.outer([0.05, 0.0, 0.1, 1.0], [0.05, 0.0, 0.1, 1.0])
    truth = replace(walker, robot=with_bodies(walker.robot, dict(zip(carrying(walker.robot), heavier, strict=True))))
    log = recorded(truth, 2000, noise=0.3)
    found = fit(walker.with_forces(Viscous(), Payload(link)), log, Torques("both", mean=0.4)).parameters
    mass = found["payload.mass"]
    assert mass.value == pytest.approx(0.8, abs=3.0 * mass.std)
    assert mass.std < 0.2
    assert_allclose([found[f"payload.center_of_mass.{axis}"].value for axis in "xyz"], [0.05, 0.0, 0.1], atol=0.1)


def test_noise_under_constraints_is_that_of_the_rows(walker):
    q, v, u = rows_of(walker, 400)
    dynamics, rng = walker.dynamics(q, v, u), np.random.default_rng(0)
    force, acceleration = np.full(9, 0.5), np.full(9, 0.2)
    moved = (dynamics.H.numpy() @ (force * rng.normal(size=(400, 9)))[..., None])[..., 0]
    residual = moved + acceleration * rng.normal(size=(400, 9))
    H, truth = dynamics.H.numpy(), NoiseLevels(acceleration, force)
    found, white = NoiseLevels.of(residual, dynamics.M.numpy(), H), (truth.whitening(H) @ residual[..., None])[..., 0]
    assert_allclose(white.T @ white / len(white), np.eye(9), atol=0.25)

    def cost(levels):
        lower = levels.whitening(H)
        return 0.5 * ((lower @ residual[..., None]) ** 2).sum() - np.linalg.slogdet(lower)[1].sum()

    assert cost(found) < cost(truth)
    assert_allclose(found.acceleration[:6], acceleration[:6], rtol=0.2)  # a light joint hides its own


def test_a_robot_that_cannot_move_teaches_nothing(walker):
    robot, points = walker.robot, [(x, y, 0.1 * x * y) for x in (0.1, -0.1) for y in (0.1, -0.1)]
    held = tuple(c for point in points for c in fixed_point(robot.layout.moving[0], point))
    held += tuple(c for foot in ("a_foot", "b_foot") for point in points for c in fixed_point(foot, point))
    model = replace(walker, contacts=held)
    q, v, u = rows_of(walker, 20)
    still = np.zeros(v.shape)
    rows = Dataset(q=q.numpy(), v=still, u=u[:, :3].numpy(), a=still, time=np.arange(20.0), model=model)
    with pytest.raises(InvalidInput, match="no equation is left"):
        identified(rows, evidence=Torques())


LINK = """<link name="{}"><inertial><origin xyz="0 0 {}"/><mass value="{}"/>
<inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
HINGE = """<joint name="{}" type="continuous"><parent link="{}"/><child link="{}"/><origin xyz="{}"/>
<axis xyz="{}"/></joint>"""


def test_masses_of_links_that_motions_do_not_show_stay_those_of_the_file():
    """A flying arm that carries 2 kg: mass on the axis of a joint may belong to either link, and the prior decides."""

    def flying(load):
        links = LINK.format("body", 0.01, 2.5, 0.04, 0.05, 0.07), LINK.format("upper", -0.1, 0.3, 0.002, 0.002, 0.0004)
        fore = pin.Inertia(0.2, np.array([0, 0, -0.08]), np.diag([0.001, 0.001, 0.0002]))
        fore += pin.Inertia(load, np.array([0, 0, -0.2]), load * np.diag([0.0015, 0.0015, 0.001]))
        inertia, hinges = np.diag(fore.inertia), HINGE.format("shoulder", "body", "upper", "0.05 0 -0.05", "0 1 0")
        hinges += HINGE.format("elbow", "upper", "fore", "0 0 -0.2", "1 0 0")
        last = LINK.format("fore", fore.lever[2], fore.mass, *inertia)
        robot = Robot.from_urdf_text(f'<robot name="r">{"".join(links)}{last}{hinges}</robot>', base="floating")
        return Model(robot, (), (Actuation(np.eye(8), tuple("xyzabcse")), RigidBodies()))

    found = identified(recorded(flying(2.0), 2000, noise=1e-3, switches=0), flying(0.0))
    assert found.parameters.settled
    assert_allclose([found.parameters[f"{name}.mass"].value for name in ("body", "upper")], [2.5, 0.3], atol=0.1)
    at, reference = (body_pseudo_inertias(model.robot).numpy() for model in (found.model, flying(0.0)))
    shoulder = ((0.05, 0, -0.05, 1), (0, 0, 0, 1))

    def distance(mass):  # affine-invariant, of what moves the same
        moved = at + np.stack(
            [sign * mass * np.outer(p, p) for sign, p in zip((1, -1), shoulder, strict=True)] + [0 * at[0]]
        )
        return sum((np.log(eigh(*pair, eigvals_only=True)) ** 2).sum() for pair in zip(moved, reference, strict=True))

    assert distance(0.0) < min(distance(0.02), distance(-0.02))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_noise_under_constraints_stays_within_doubles(seed):
    """H of rank 1 and hardly any noise beside it: a search without bounds meets a covariance that is singular."""
    draw = np.random.default_rng(seed)
    direction = draw.normal(size=(300, 3, 1))
    H = direction @ direction.swapaxes(1, 2)
    residual = (H @ draw.normal(size=(300, 3, 1)))[..., 0] + 1e-9 * draw.normal(size=(300, 3))
    found = NoiseLevels.of(residual, np.broadcast_to(np.diag([1e-2, 1.0, 20.0]), H.shape), H)
    assert np.isfinite([found.acceleration, found.force]).all()
    assert np.isfinite(found.whitening(H)).all()


@pytest.mark.nightly
def test_masses_of_a_noisy_trot():
    """MuJoCo's own contacts: noise of accelerations must not lower the mass, nor windows hide the rotors."""
    model = quadruped.walker()
    with pytest.warns(DataWarning, match="leave the stance open"):
        log = Preparation(cutoff="auto", stance="auto").apply(quadruped.recorded(model, 1, "trot", 5.0)[0])
    found = fit(model.with_forces(RigidBodies(["trunk"]), Viscous(), Coulomb(), Rotor()), log, rows=600).parameters
    rotors = np.array([each.value for name, each in found.items() if name.startswith("rotor")])
    assert found["trunk.mass"].value == pytest.approx(8.0, abs=0.06)
    assert np.sqrt(np.square(rotors - 0.008).mean()) < 0.004
