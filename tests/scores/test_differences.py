"""Differences against Student's paired test of scipy and against simulated recordings, and the one rule of verdicts."""

import numpy as np
import pytest
from scipy.stats import t as student
from scipy.stats import ttest_rel

from forcegp.errors import FitError, InvalidInput
from forcegp.scores import Scores
from forcegp.scores.scores import CRITERIA, paired_difference


@pytest.mark.parametrize("axis", [0, 2], ids=["seeds", "stretches"])
def test_intervals_of_densities_are_those_of_the_paired_difference(axis):
    generator = np.random.default_rng(1)
    other = generator.uniform(1.0, 2.0, 6)
    one = other * generator.uniform(0.7, 1.05, 6)
    shape = [1, 1, 1]
    shape[axis] = 6
    found = paired_difference("density", "a", "b", one.reshape(shape), other.reshape(shape))
    interval = ttest_rel(one, other).confidence_interval(0.95)
    assert np.allclose(found.interval, [interval.low, interval.high])
    assert found.value == pytest.approx(np.mean(one - other))
    assert (found.runs, found.stretches) == ((6, 1) if axis == 0 else (1, 6))
    assert (found.wins, found.ahead)[axis // 2] == int((one < other).sum())


def test_chance_of_seeds_and_of_stretches_adds_up():
    difference = np.random.default_rng(2).normal(size=(4, 1, 7))
    found = paired_difference("density", "a", "b", difference, np.zeros_like(difference))
    seeds, stretches = (difference.mean(axis=axis).ravel() for axis in (2, 0))
    parts = [each.var(ddof=1) / len(each) for each in (seeds, stretches)]
    freedom = sum(parts) ** 2 / (parts[0] ** 2 / 3 + parts[1] ** 2 / 6)
    assert np.ptp(found.interval) / 2 == pytest.approx(student.ppf(0.975, freedom) * np.sqrt(sum(parts)))


def test_the_interval_of_a_ratio_holds_the_true_one():
    """Two models of expected squared errors 1 and .81, over few stretches and seeds, both with effects of their own."""
    generator = np.random.default_rng(3)
    held = []
    for _ in range(200):
        level = generator.gamma(4.0, 0.25, size=(1, 1, 12))  # stretches that are hard for both
        own = generator.gamma(20.0, 0.05, size=(2, 1, 1, 12)) * generator.gamma(20.0, 0.05, size=(2, 4, 1, 1))
        found = paired_difference("motion", "a", "b", 0.81 * level * own[0], level * own[1])
        held.append(found.interval[0] < 0.9 < found.interval[1])
    assert 0.88 < np.mean(held) < 0.995


def errors(*values: float) -> np.ndarray:
    return np.square(np.array(values))[None, None]


def test_the_verdict_needs_an_interval_on_one_side_and_a_margin():
    better = paired_difference("acceleration", "a", "b", errors(0.5, 0.52, 0.48), errors(1.0, 1.0, 1.0))
    assert better.outcome == "better"
    assert better.sentence.startswith("**Better**: a / b = 0.5")
    assert "better in 1 of 1 runs and in 3 of 3 held-out stretches of time" in better.sentence
    assert (
        paired_difference("acceleration", "a", "b", errors(1.0, 1.0, 1.0), errors(0.5, 0.52, 0.48)).outcome == "worse"
    )
    assert (
        paired_difference("acceleration", "a", "b", errors(0.3, 2.0, 1.0), errors(1.0, 1.0, 1.0)).outcome
        == "no difference"
    )
    certain = paired_difference("motion", "a", "b", errors(0.99, 0.991, 0.99), errors(1.0, 1.0, 1.0))
    assert certain.interval[1] < 1.0
    assert certain.outcome == "no difference"  # for one percent matters to nobody
    assert paired_difference("motion", "a", "b", errors(0.97, 0.971), errors(1.0, 1.0)).outcome == "better"
    one = paired_difference("acceleration", "a", "b", errors(0.1), errors(1.0))
    assert (one.outcome, one.interval) == ("no difference", None)
    assert "one stretch and one seed, so no interval" in one.sentence
    assert paired_difference("acceleration", "a", "b", errors(), errors()) is None
    assert paired_difference("acceleration", "a", "b", errors(0.0), errors(1.0)) is None


def cell(seed: int, force: float | None, diverged: int = 0, motion: float = 0.1) -> dict:
    run = {"split": "s", "seed": seed, "error": "failed", "warnings": []}
    if force is None:
        return run
    squared = [[motion**2] * 3, [None] * diverged + [4.0 * motion**2] * (3 - diverged)]
    stretches = {name: [force**2, 0.25 * force**2] for name in ("acceleration", "force")}
    stretches["density"] = [-1.0 / force, 3.0 - 1.0 / force]  # one that is hard for all
    return {**run, "error": None, "stretches": stretches, "motions": {"squared": squared}, "table": {}}


KINDS = {"urdf": "given", "ls": "identified", "ls2": "identified", "gp": "force prior", "net": "black box"}


def scores(runs: dict[str, list[dict]], kinds: dict[str, str] = KINDS) -> Scores:
    models = {name: {"kind": kinds[name], "summary": ""} for name in runs}
    return Scores(models=models, runs=runs, joint_names=("j",), units={})


def test_models_are_compared_over_the_runs_that_both_finished():
    found = scores(
        {
            "urdf": [cell(k, 4.0 + 0.1 * k) for k in range(3)],
            "ls": [cell(k, 1.0 + 0.01 * k) for k in range(3)],
            "ls2": [cell(0, 0.01), cell(1, None), cell(2, 0.01)],  # better, but failed once
            "gp": [cell(k, 0.5 + 0.01 * k, diverged=k) for k in range(3)],
            "net": [cell(k, None) for k in range(3)],
        }
    )
    assert found.best_of(("identified",), "force") == "ls"
    assert found.best_of(("black box",), "force") is None
    against = {name: found.difference(name, "gp", "ls") for name in CRITERIA}
    assert {name: each.outcome for name, each in against.items()} == {
        "acceleration": "better", "force": "better", "density": "better", "motion": "no difference"
    }  # fmt: skip
    gp, urdf, seldom = (found.difference("force", name, "ls") for name in ("gp", "urdf", "ls2"))
    assert seldom.runs == 2
    assert (urdf.outcome, gp.wins, gp.ahead, urdf.ahead, gp.stretches) == ("worse", 3, 2, 0, 2)
    assert [line.split(" (")[0] for line in found.failures] == [
        "ls2 failed in 1 of 3 runs",
        "net failed in 3 of 3 runs",
    ]


def test_the_model_to_take_is_parametric_unless_another_is_shown_to_be_better():
    cells = {
        "urdf": [cell(k, 2.0, motion=0.4) for k in range(3)],
        "ls": [cell(k, 1.0, motion=0.1) for k in range(3)],
        "gp": [cell(k, 0.5 + 0.01 * k, motion=0.0999) for k in range(3)],
        "net": [cell(k, 0.6 + 0.01 * k, motion=0.3) for k in range(3)],
    }
    found = scores(cells)
    assert {name: each.model for name, each in found.winners.items()} == {
        "motion": "ls", "force": "gp", "acceleration": "gp", "density": "gp"
    }  # fmt: skip
    assert found.recommended == "ls", "motions decide before forces and accelerations"
    assert "No difference" in found.winners["motion"].sentence
    assert found.winners["acceleration"].sentence.startswith("**Better**")
    alone = scores({"net": cells["net"]})
    assert {each.model for each in alone.winners.values()} == {alone.recommended} == {"net"}
    nothing = scores({"net": [cell(0, None)]})
    assert (nothing.winners, nothing.recommended) == ({}, None)
    with pytest.raises(FitError, match="no model was fitted: net failed in 1 of 1 runs"):
        nothing.fitted_on_all_rows()


@pytest.mark.parametrize(
    ("squared", "taken"),
    [
        ([0.01, 0.4, 0.09], True),  # .41 of the error, better everywhere: three stretches cannot show it
        ([0.7, 0.9, 0.8], False),  # .89 of it, which is not much
        ([0.001, 0.002, 1.3], False),  # lower by .66, but not mostly
    ],
)
def test_too_little_time_to_show_a_large_difference_decides_for_it(squared, taken):
    found = paired_difference("acceleration", "gp", "ls", np.array([[squared]]), np.ones((1, 1, 3)))
    assert found.outcome == "no difference"
    assert found.favours_challenger == taken
    nats = paired_difference("density", "gp", "ls", np.array([[[-4.0, 0.9, 0.9]]]), np.ones((1, 1, 3)))
    assert (nats.outcome, nats.ahead, nats.favours_challenger) == ("no difference", 3, False)


def test_a_model_whose_motions_diverge_is_not_the_best():
    kinds = {"a": "force prior", "b": "force prior"}
    cells = {"a": [cell(0, 1.0, diverged=2, motion=0.01)], "b": [cell(0, 1.0, diverged=0, motion=0.5)]}
    assert scores(cells, kinds).best_of(("force prior",), "motion") == "b"


def test_a_model_that_is_not_there_is_named():
    with pytest.raises(InvalidInput, match="name one of urdf, gp"):
        scores({"urdf": [cell(0, 1.0)], "gp": [cell(0, 0.5)]}).value("mae")
    with pytest.raises(InvalidInput, match=r"no model 'gpp'.*did you mean 'gp'"):
        scores({"urdf": [cell(0, 1.0)], "gp": [cell(0, 0.5)]}).value("mae", model="gpp")
