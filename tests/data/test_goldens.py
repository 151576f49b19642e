"""What is found in small logs, as it was: spectra, delays, filters, strokes, rests, stance, contacts, wind, IMUs."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.checks.corruptions import clean, invented, moved, on_a_line, two_links
from tests.data.test_imu import NAME
from tests.data.test_preparation import arm_log
from tests.data.test_stance import hop, walk
from tests.data.test_wind import flight
from tests.goldens.compare import assert_unchanged

from forcegp import data
from forcegp.data.configurations import as_vectors, in_base
from forcegp.data.filters import shifted, sums_before
from forcegp.data.imu import BesideMotion, expected, imu_doubts
from forcegp.data.spectrum import held_out_cutoff
from forcegp.data.strokes import encoder_step, strokes, white_noise
from forcegp.data.views import farthest_rows, move_on


def columns(log: data.Dataset) -> dict:
    return {name: getattr(log, name) for name in ("q", "v", "u", "a", "time", "measured", "noise_std")}


@pytest.fixture(scope="module")
def arm() -> data.Dataset:
    """Two episodes with a late torque and noise on positions."""
    log = arm_log(0.012, seconds=6.0)
    q = log.q + 1e-4 * np.random.default_rng(0).standard_normal(log.q.shape)
    return replace(data.differentiated(replace(log, q=q), "q"), episode=(log.time > 2.5).astype(int))


@pytest.mark.parametrize("source", ["q", pytest.param("v", marks=pytest.mark.nightly)])
def test_spectra_and_cutoffs(arm, source):
    spectrum = data.motion_spectrum(arm, source)
    best, shares = held_out_cutoff(arm, 8.0, source)
    more = {"noise": spectrum.noise_density, "behind": spectrum.acceleration_noise(data.LowPass(15.0)), "best": best}
    chosen = data.Preparation(cutoff="auto", delay="auto", differentiate=source, every=3, trim=0.1)
    report = chosen.apply(arm).metadata["preparation"]
    report.pop("why")
    found = {"spectrum": spectrum, **more, "tried": sorted(shares), "report": report}
    assert_unchanged(f"data/spectrum of {source}", found, rtol=1e-5)


def test_delays(arm):
    found = {"arm": data.estimate_delay(data.low_pass(arm, 20.0)), "far": data.estimate_delay(arm_log(-0.08))}
    assert_unchanged("data/delay", found, rtol=1e-4)


def test_filters(arm):
    walking = walk(2, 0.02, seconds=1.0)[0]
    walking = replace(walking, measured={"imu.trunk": walking.a[:, :3]})
    made = {
        "filtered": columns(data.low_pass(walking, 12.0)), "shifted": columns(shifted(walking, 0.013, 0.03, [1, 4])),
        "differentiated": columns(data.differentiated(walking, "q")),
        "resampled": columns(data.resample(walking, 0.0031)),
        "vectors": as_vectors(walking),
        "uneven": columns(data.differentiated(arm.rows(np.delete(np.arange(400), [0, 7, 300])), "q")),
        "sums": sums_before(arm.u[:300], arm.time[:300], 0.4), "farthest": farthest_rows(arm, 40).time,
    }  # fmt: skip
    turned = [torch.tensor(x[::15]) for x in (walking.q, walking.v, walking.a)]
    gravity = walking.model.robot.gravity
    q, v, a = turned[0], turned[1][:, :6], turned[2][:, :6]
    for axes in (("world", "body"), ("imu", "world")):
        made["/".join(axes)] = in_base(q[:, :7], a, axes, v, gravity), in_base(q[:, :7], v, axes)
    assert_unchanged("data/filters", made)


def test_strokes_and_noise_of_positions(arm):
    coarse = replace(arm, q=np.round(arm.q / 2e-3) * 2e-3)
    T = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, 0.0], [0.0, 1.0, 1.0]])
    found = {"fine": strokes(arm), "coarse": strokes(coarse), "motors": strokes(coarse, 4, T)}
    found |= {"noise": [white_noise(arm, q) for q in arm.q.T], "steps": [encoder_step(coarse, q) for q in coarse.q.T]}
    assert_unchanged("data/strokes", found)
    assert move_on(arm)
    assert not move_on(arm.rows(np.random.default_rng(0).permutation(400)))


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_stance(noise):
    log, _ = walk(2, noise, seconds=4.5)
    hopping = hop("floating", 50.0, 0.14)[0]
    quiet, still = replace(hopping, v=0.05 * hopping.v), walk(3, noise, seconds=1.0, lift=False)[0]
    found = {name: data.estimate_stance(each) for name, each in (("walk", log), ("hop", quiet), ("still", still))}
    assert_unchanged(f"data/stance {noise:g}", found)


def test_contacts():
    logs = {"moved": moved(on_a_line(4), (0.02, 0.0, 0.0)), "invented": invented(clean(two_links(), 4))}
    assert_unchanged("data/contacts", {name: data.contact_doubts(log)[0].numbers for name, log in logs.items()})


def test_wind():
    log = flight([(4.0, 1.0, 0.0), (-2.0, 5.0, 0.0)], episodes=2, noise=0.3)
    law, wind = data.find_wind(log)
    assert_unchanged("data/wind", {"law": law, "wind": wind, "before": law.wind_before(log, 0.5)}, rtol=1e-4)


def test_imus(arm):
    seen = expected(arm, arm.model, NAME)
    f = 1.1 * np.roll(seen, 3, axis=0) @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    log = replace(arm, measured={NAME: f})
    doubts = {each.about: each.numbers for each in imu_doubts(log, log.model)}
    assert_unchanged("data/imu", {"beside": BesideMotion.of(log, log.model, NAME), **doubts})
