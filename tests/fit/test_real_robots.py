"""Published and required numbers on recordings of real robots (see tests/evidence/realdata.py)."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.evidence.realdata import dfki, dfki_system, emps, multiarm, multiarm_system, panda, panda_system

from forcegp.evidence import Accelerations, Motions, base_parameters, motion_residuals
from forcegp.fit import calibrated, fit
from forcegp.forces import Coulomb, DirectionalFriction, LoadFriction, Offset, RigidBodies, Rotor, Viscous
from forcegp.mechanics import Contact, Sphere
from forcegp.scores.held_out import held_out_motions, motion_scores


def test_published_numbers_of_a_pendulum_predict_its_motion(shared):
    """nRMSE .0085 and .0094 of the absolute angles' accelerations, from URDF and friction objects alone."""
    folder, model = shared("realdata"), multiarm_system(Viscous([2.37142783e-4, 1.00000019e-5]))
    data = multiarm(folder, model)
    _, residual = motion_residuals(data, model)
    absolute = [x.cumsum(axis=1) for x in (residual, data.a)]
    nrmse = np.sqrt((absolute[0] ** 2).mean(0)) / absolute[1].std(0)
    np.testing.assert_allclose(nrmse, [0.0085, 0.0094], rtol=0.03)


def test_eleven_parameters_of_a_driven_pendulum_from_accelerations(shared):
    """At least as good on other runs as eleven analytical parameters of the pendulum: nRMSE .156 and .111."""
    folder = shared("realdata")
    model = dfki_system(folder)
    train, test = dfki(folder, model, 143524, 143601, 143704, 144115), dfki(folder, model, 143339, 143747)
    laws = RigidBodies("all"), Viscous(), Coulomb(), open_rotors(model)
    _, residual = motion_residuals(test, fit(model.with_forces(*laws), train, Accelerations(), rows=2000).model)
    assert (np.sqrt((residual**2).mean(0)) / test.a.std(0) < [0.157, 0.112]).all()


def test_least_squares_of_a_manipulator_on_held_out_blocks(shared):
    """Held-out torque residuals of base parameters and friction [Nm], from the manufacturer's URDF."""
    folder = shared("realdata")
    model = panda_system(folder)
    train, test = panda(folder, model)
    laws = RigidBodies("all"), Viscous(), Coulomb(), Offset(), Rotor()
    found = fit(model.with_forces(*laws), train)
    assert len(base_parameters(model.robot)) == 43
    force, _ = motion_residuals(test, found.model)
    assert (np.sqrt((force**2).mean(0)) < [0.16, 0.25, 0.22, 0.22, 0.09, 0.06, 0.06]).all()


def test_an_elbow_that_stuck_is_a_holonomic_constraint(shared):
    """Its second link is as far from the first joint as it was: a point of it stays on a sphere around that joint."""
    # With the constraint the error of the first joint falls to about 0.6 of what it is without
    folder = shared("realdata")
    model = dfki_system(folder)
    train, stuck = dfki(folder, model, 143524, 143601, 143704, 144115), dfki(folder, model, 143906)
    laws = RigidBodies("all"), Viscous(), LoadFriction(), open_rotors(model)
    found, offset, length = fit(model.with_forces(*laws), train, Accelerations(), rows=1000).model, 0.1, 0.2
    sphere = Sphere((0.0, 0.0, 0.0), float(np.hypot(offset, length)))
    held = found.with_contacts([Contact("link2", (offset, 0.0, 0.0), sphere)])
    free_error, held_error = (
        np.sqrt(((each.dynamics(*states(stuck)).acceleration_map().offset.numpy() - stuck.a) ** 2).mean(0))
        for each in (found, held)
    )
    assert held_error[0] < 0.7 * free_error[0]
    assert held_error[0] < 0.6 * stuck.a[:, 0].std()
    assert held_error[1] < 0.1 * free_error[1]


def open_rotors(model):
    """The coupled rotors that the model lists, to be estimated."""
    (rotors,) = (law for law in model.laws if isinstance(law, Rotor))
    return rotors.open()


def states(rows):
    return tuple(torch.tensor(x) for x in (rows.q, rows.v, rows.u))


@pytest.mark.nightly
def test_an_axis_with_more_friction_is_followed(shared):
    """EMPS: half of the record, and the other half as if its friction were 2.9 % higher, as it is in another record."""
    # Errors of q [m] after 1 and 4 s, and 95 % intervals after .1, .25, .5 and 1 s, before 6 s are seen and after
    train, test = emps(shared("realdata"))
    laws = RigidBodies("all"), Viscous(), Coulomb(), Offset(), DirectionalFriction()
    found = fit(train.model.with_forces(*laws), train.rows(slice(None, None, 5)), Accelerations())
    found = calibrated(fit(found.model, train, Motions(1.0), start=found), train)
    numbers = {each: found.parameters[f"{each}.x"].value for each in ("viscous", "coulomb.level", "direction")}
    parts = test.v, np.tanh(test.v / 0.0015), abs(test.v)
    more = 0.029 * sum(number * part for number, part in zip(numbers.values(), parts, strict=True))
    other = replace(test, u=test.u + more, time=test.time - test.time[0])
    rest, first, errors = other.rows(other.time >= 6.0), other.rows(other.time < 6.0), {}
    for name, posterior in (("fit", found), ("seen", found.update(first))):
        whole, errors[name] = np.ones(len(rest), dtype=bool), []
        for horizons in ((0.1, 0.25, 0.5, 1.0), (4.0,)):
            table, _ = motion_scores(posterior, held_out_motions(rest, whole, horizons, 50), "implicit-midpoint")
            errors[name].append(table[f"position after {horizons[-1]:g} s"]["rmse"][0])
            inside = [table[f"position after {h:g} s"]["coverage_95"][0] for h in horizons]
            assert min(inside) >= 0.88, (name, inside)
    assert errors["seen"][0] < min(1.1e-3, 0.5 * errors["fit"][0])
    assert errors["seen"][1] < min(4.4e-3, 0.8 * errors["fit"][1])
