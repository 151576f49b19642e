"""Searches, levels of noise, coordinates, residuals of rows and start values, as they were."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.evidence.test_contact_forces import held, measured, on_plane, with_imu
from tests.evidence.test_least_squares import FREE, TRUTH, no_prior, problem
from tests.evidence.test_noise_levels import ACCELERATION, FORCE, drawn
from tests.goldens.compare import assert_unchanged
from tests.posterior.arm import arm_data, arm_model

from forcegp import forces as f
from forcegp.data.dataset import TORQUE
from forcegp.evidence.least_squares import NoiseLevels, correlation_time, weighted_least_squares
from forcegp.evidence.likelihood import MarginalLikelihood, TrainingData, problem_size
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.evidence.recorded_rows import RecordedRows, motion_residuals, share_of
from forcegp.fit.physical import typical_sizes
from forcegp.noise import Noise

HELD = np.random.default_rng(5).normal(size=(60, 1, 2))
SEARCHES = {
    "free": {}, "bounds": {"bounds": (np.array([-9.0, -0.49, 0.0]), np.full(3, 9.0))}, "held": {"held": HELD},
    "known": {"known": np.array([0.02, 0.4])}, "sizes": {"sizes": np.array([1.0, 3.0])},
    "roughly": {"roughly": True}, "short": {"longest": 0.3, "evaluations": 9},
    "turned": {"moved": lambda x, step: x + step + 0.1 * step**2},
}  # fmt: skip


@pytest.mark.parametrize("start", [0.0, 4.0, -6.0])
def test_every_step_of_a_search(start):
    found = {}
    for name, how in SEARCHES.items():
        seen, told, residual = [], [], problem(60)
        fit = weighted_least_squares(
            lambda x, seen=seen, residual=residual: (seen.append(x), residual(x))[1],
            (lambda x: (0.1 * (x - TRUTH), 0.1 * np.eye(3))) if name == "free" else no_prior,
            np.full(3, start),
            **{"bounds": FREE, "progress": lambda *given, told=told: told.append(given)} | how,
        )
        ended = [fit.noise, fit.evaluations, fit.settled, fit.expected, fit.information, fit.white]
        found[name] = {"at": np.array(seen), "rounds": told, "ended": ended}
    assert_unchanged(f"evidence/search from {start:g}", found, rtol=1e-4)


def test_levels_of_noise_and_rows_that_resemble_each_other():
    residual, M = drawn(60, ACCELERATION, FORCE)
    H, near = np.linalg.inv(M) * [1.0, 0.0], NoiseLevels(np.array([3.0, 0.1]), np.array([1e-9, 40.0]))
    found = {"of": NoiseLevels.of(residual, M), "near": NoiseLevels.of(residual, M, H, near)}
    found |= {"many": NoiseLevels.of(*drawn(2100, ACCELERATION, FORCE)), "white": near.scaled(2.0).whitening(H)}
    waves = np.cumsum(np.random.default_rng(0).normal(size=(80, 3)), axis=0) * [1.0, 0.1, 0.01] + [0.0, 1.0, 0.0]
    found["times"] = [correlation_time(waves - waves.mean(0), np.arange(80) // rows) for rows in (80, 7, 2)]
    assert_unchanged("evidence/noise", found)


def in_air(*forces):
    return arm_model(0).with_forces(*forces)


LAWS = {
    in_air: (f.RigidBodies("all"), f.Viscous(f.Normal(0.2, 0.1)), f.Stribeck(), f.Rotor(f.LogNormal(0.02, 0.5))),
    held: (f.RigidBodies(("fore",)), f.LoadFriction(), f.Actuation(gain=None), f.Spring(), f.DirectionalFriction()),
    on_plane: (f.Offset(), f.Viscous(), f.Payload("hand", 0.4), f.Payload("fore")),
}


@pytest.mark.parametrize("contact", LAWS)
def test_residuals_of_rows_and_what_their_coordinates_mean(contact):
    model = contact(*LAWS[contact]).with_forces(noise=Noise(None, sensor=(9.0, 0.1, 0.2, 0.3)))
    log = replace(arm_data(12, 0, model), truth={})
    log = with_imu(measured(contact(f.Viscous(0.4)), contact(), rows=12) if model.contacts else log)
    at_link = {f"{TORQUE}bend": np.random.default_rng(2).normal(0.0, 3.0, (len(log), 1))}
    log = replace(log, measured={**log.measured, **at_link})
    space = ParameterSpace(model, typical_sizes(model, [log]))
    loaded, how = contact is not in_air, {"any_contact": True, "sensed": log.measured, "pushed": [0]}
    rows = RecordedRows(space, log.q, log.v, log.u, loaded, **how)
    x = np.clip(space.start + 0.05 * np.random.default_rng(1).standard_normal(space.size), *space.bounds)
    levels, motion = rows.rough_noise(x, log.a), rows.moving(log.a)
    likely = rows.likely(x, motion, levels)
    bounds = [np.clip(each, -1e3, 1e3) for each in (*space.bounds, space.longest_steps(x))]
    found = {
        "coordinates": [space.start, *bounds, *space.prior(x), space.moved(x, 0.1 * x), space.number_slopes(x)],
        "parameters": {f"{each.name} {each.unit}": [each.start, each.prior] for each in space.parameters},
        "noise": [levels, rows.felt_noise, rows.link_noise, share_of(log.a)], "torque": rows.in_torque(x, motion)[:3],
        "acceleration": rows.in_acceleration(x, log.a),
        "likely": [likely.offset, likely.whitening, likely.white_regressor, rows.by_body(log.a)],
        "motion": motion_residuals(log, space.model_at(x)),
    }  # fmt: skip
    assert_unchanged(f"evidence/rows {contact.__name__}", found, rtol=1e-5)


def test_rows_of_a_marginal_likelihood():
    model = replace(on_plane(f.JointForces(("q",))), noise=Noise(0.05, 0.02, learn=True, sensor=(0.3, 0.2, 0.2, 0.2)))
    log, found = with_imu(measured(on_plane(f.Viscous(0.7)), model.known, rows=12, noise=0.05)), {}
    data = TrainingData.of(log, torch.device("cpu"), log.measured)
    for name, rows in (("alone", data), ("like others", replace(data, reference=data, correlated_rows=3.0))):
        likelihood = MarginalLikelihood(model, rows)
        learned, stays = likelihood.split_noise
        parameters = {**likelihood.kernels.initial_parameters(), **learned, **stays}
        terms, value = likelihood.terms(parameters), likelihood(likelihood.kernels, parameters)
        posterior = likelihood.condition(likelihood.kernels, parameters)
        values = {**learned, "kernels": [x.detach() for x in likelihood.kernels.initial_parameters().values()]}
        found[name] = [values, float(value.detach()), posterior.weights, terms.noise, terms.residual, terms.W]
    found["size"] = [vars(problem_size(each, 70)) for each in (model, held(f.JointForces()), arm_model(0))]
    assert_unchanged("evidence/likelihood", found)
