"""Flags of contacts that the motion does not support, and bases that nobody measured."""

from dataclasses import replace

import numpy as np
import pytest

from forcegp import check
from forcegp.checks import quick_check
from forcegp.simulation import QuadrupedConfig, simulate_quadruped


@pytest.fixture(scope="module")
def log():
    return simulate_quadruped(QuadrupedConfig(seconds=6.0, seed=5, noise=0.05))


def of(dataset, subject="contact flag"):
    return [each for each in quick_check(dataset) if each.about == subject]


def flagged(log, foot, change):
    u, place = log.u.copy(), log.model.inputs.index(foot)
    u[:, place] = change(u[:, place])
    return replace(log, u=u, truth={})


def test_flags_that_the_motion_supports_are_in_order(log):
    assert not of(log)
    assert {each.level for each in check(log).doubts if each.about == "contact flag"} == {"ok"}


def test_a_foot_that_moves_while_it_stands_is_named(log):
    feet = log.model.inputs[12:]
    lifted = next(foot for foot in feet if (log.u[:, log.model.inputs.index(foot)] == 0.0).any())
    (doubt,) = of(flagged(log, lifted, np.ones_like))
    assert doubt.level == "wrong"
    assert repr(lifted) in doubt.what
    assert repr(lifted.replace("_stands", "_foot")) in doubt.what
    rows = np.flatnonzero(log.u[:, log.model.inputs.index(lifted)] == 0.0)
    assert int(doubt.what.split("row ")[1].split(" ")[0]) in rows
    assert "Set the flag to 0" in doubt.advice


def test_flags_that_are_no_flags_are_named(log):
    (doubt,) = of(flagged(log, log.model.inputs[13], lambda flags: 0.9 * flags))
    assert "neither 0 nor 1" in doubt.what
    assert doubt.numbers["rows"] == int((log.u[:, 13] != 0.0).sum())


def test_a_base_that_nobody_measured_is_named(log):
    q, v = log.q.copy(), log.v.copy()
    q[:, :7], v[:, :6] = q[0, :7], 0.0
    doubts = of(replace(log, q=q, v=v, truth={}), "base")
    assert doubts[0].level == "wrong"
    assert "not measured" in doubts[0].what
    assert "motion capture" in doubts[0].advice
    assert "base='fixed'" in doubts[0].advice
