"""Cut-offs that held-out torques choose; delays beside friction."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from tests.checks.clean_logs import between_postures
from tests.fit.test_payload import ROBOT, TEXT, log
from tests.posterior.arm import arm_model

from forcegp import Model, Rotor, Stribeck, Torques, Viscous, fit
from forcegp.data import Preparation
from forcegp.data.spectrum import FACTORS, held_out_cutoff, motion_spectrum
from forcegp.errors import DatasetError
from forcegp.evidence import motion_residuals
from forcegp.forces import RigidBodies

STEP = 0.004


def raw(seed, noise, late=0.0, seconds=10.0):
    """The motion at 250 Hz with noise of the positions, and torques that are logged late."""
    rows = log(TEXT, seed, seconds=seconds)
    time, rng = np.arange(rows.time[0], rows.time[-1], STEP), np.random.default_rng(seed)
    from scipy.interpolate import CubicSpline

    q = CubicSpline(rows.time, rows.q)(time) + noise * rng.standard_normal((len(time), 6))
    u = CubicSpline(rows.time, rows.u)(np.clip(time - late, rows.time[0], rows.time[-1]))
    u += 0.05 * rng.standard_normal(u.shape)
    v = np.gradient(q, STEP, axis=0)
    return replace(rows, q=q, v=v, u=u, a=np.gradient(v, STEP, axis=0), time=time, episode=np.zeros(len(time), int))


def test_a_spectrum_that_shows_too_low_a_cutoff_is_overruled():
    """From a tenth of the right cut-off the search comes to where friction is not smeared."""
    rows, low = raw(2, 1e-5, seconds=30.0), 1.2
    best, shares = held_out_cutoff(rows, low)
    assert best > 1.9 * low
    assert shares[min(shares)] > 2.0 * shares[best] == 2.0 * min(shares.values())
    assert len(shares) >= len(FACTORS)

    def error(cutoff):
        """Rms of what the identified robot misses of the torques of another motion, without noise."""
        prepared = Preparation(cutoff=cutoff, trim=1.0, every=15).apply(rows)
        found = fit(Model(ROBOT).with_forces(RigidBodies("all"), Viscous(), Stribeck(), Rotor()), prepared, Torques())
        return np.sqrt(np.square(motion_residuals(log(TEXT, 9), found.model)[0]).mean())

    assert error(best) < 0.6 * error(low)


def test_where_joints_rest_a_filter_lets_no_gear_creep():
    """Shares of what is left are those of noise behind every filter, though rests last longer than moves."""
    rows = between_postures(arm_model(0).robot, 1, 30.0, 0.4)
    rows = replace(rows, q=rows.q + 2e-5 * np.random.default_rng(1).standard_normal(rows.q.shape))
    best, shares = held_out_cutoff(rows, 15.0)
    assert 15.0 < best < 45.0  # moves of .8 s
    assert max(shares.values()) < 2e-3  # of filtered positions, .8


def test_a_passive_robot_keeps_the_cutoff_of_its_spectrum():
    """Where no torque acts, every cut-off explains all of it."""
    rows = raw(3, 1e-4)
    still = replace(rows, u=0.0 * rows.u)
    spectrum = motion_spectrum(still, "q").cutoff
    assert Preparation(cutoff="auto").resolved(still).cutoff == float(f"{np.nanmax(spectrum):.3g}")
    with pytest.raises(DatasetError, match="no torque acts"):
        held_out_cutoff(still, 6.0)
    one = replace(rows, u=rows.u * (np.arange(6) == 1))  # the others are no part of the mean
    assert min(held_out_cutoff(one, 6.0)[1].values()) > 1e-4


def test_short_logs_are_refused():
    with pytest.raises(DatasetError, match="too few to choose a cut-off"):
        held_out_cutoff(raw(1, 1e-4).rows(slice(0, 300)), 6.0)


@pytest.mark.parametrize(("lag", "delay"), [(0.04, 0.0), (0.0, 0.02)])
def test_a_torque_behind_a_filter_of_the_robot_is_told_from_one_that_is_late(lag, delay):
    rows = between_postures(arm_model(0).robot, 1, 16.0, 0.4)
    rows = replace(rows, q=rows.q + 2e-5 * np.random.default_rng(1).standard_normal(rows.q.shape))
    keep = np.exp(-0.005 / lag) if lag else 0.0  # the filter's exact steps
    u = rows.u[0] + lfilter([1.0 - keep], [1.0, -keep], rows.u - rows.u[0], axis=0)
    u = np.stack([np.interp(rows.time - delay, rows.time, each) for each in u.T], axis=1)
    late, plain = replace(rows, u=u), Preparation(cutoff=15.0, trim=0.3)
    found = replace(plain, delay="auto").resolved(late)
    assert (found.lag, found.delay) == (pytest.approx(-lag, rel=0.1), pytest.approx(delay, abs=0.006))
    undone, left, true = found.rows(late), plain.rows(late), plain.rows(rows)
    off = [np.abs(each.u - true.u[np.isin(true.time, each.time)]).mean() for each in (undone, left)]
    assert off[0] < 0.5 * off[1]
    assert ("behind a low-pass of first order at" in found.why["delay"]) == bool(lag)
