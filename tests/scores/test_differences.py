"""Differences against Student's paired test of scipy and against simulated recordings, and the one rule of verdicts."""

import numpy as np
import pytest
from scipy.stats import t as student
from scipy.stats import ttest_rel
from tests.goldens.compare import assert_unchanged

from forcegp.errors import FitError, InvalidInput
from forcegp.scores import Scores
from forcegp.scores.scores import paired_difference

SMALL = 1e-4


@pytest.mark.parametrize("axis", [0, 2], ids=["seeds", "stretches"])
def test_intervals_of_small_differences_are_those_of_the_paired_test(axis):
    """The logarithm of a ratio of roots near 1 is half of the difference of the squares."""
    other, one = np.ones(6), 1.0 + SMALL * np.random.default_rng(1).normal(size=6)
    shape = [1, 1, 1]
    shape[axis] = 6
    found = paired_difference("force", "a", "b", one.reshape(shape), other.reshape(shape))
    interval = ttest_rel(one, other).confidence_interval(0.95)
    assert np.allclose(2.0 * np.log(found.interval), [interval.low, interval.high], rtol=1e-3)
    assert 2.0 * np.log(found.value) == pytest.approx(np.mean(one - other), rel=1e-3)
    assert (found.runs, found.stretches) == ((6, 1) if axis == 0 else (1, 6))
    assert (found.wins, found.ahead)[axis // 2] == int((one < other).sum())


def test_chance_of_seeds_and_of_stretches_adds_up():
    difference = SMALL * np.random.default_rng(2).normal(size=(4, 1, 7))
    found = paired_difference("force", "a", "b", 1.0 + difference, np.ones_like(difference))
    seeds, stretches = (difference.mean(axis=axis).ravel() for axis in (2, 0))
    parts = [each.var(ddof=1) / len(each) for each in (seeds, stretches)]
    half = student.ppf(0.975, sum(parts) ** 2 / (parts[0] ** 2 / 3 + parts[1] ** 2 / 6)) * np.sqrt(sum(parts))
    assert np.ptp(np.log(found.interval)) == pytest.approx(half, rel=1e-3)


def test_the_interval_of_a_ratio_holds_the_true_one():
    """Two models of expected squared errors 1 and .81, over few stretches and seeds, both with effects of their own."""
    generator, held = np.random.default_rng(3), []
    for _ in range(200):
        level = generator.gamma(4.0, 0.25, size=(1, 1, 12))  # stretches that are hard for both
        own = generator.gamma(20.0, 0.05, size=(2, 1, 1, 12)) * generator.gamma(20.0, 0.05, size=(2, 4, 1, 1))
        found = paired_difference("motion", "a", "b", 0.81 * level * own[0], level * own[1])
        held.append(found.interval[0] < 0.9 < found.interval[1])
    assert 0.88 < np.mean(held) < 0.995


def errors(*values: float) -> np.ndarray:
    return np.square(np.array(values))[None, None]


def test_the_verdict_needs_an_interval_on_one_side_and_a_margin():
    better = paired_difference("force", "a", "b", errors(0.5, 0.52, 0.48), errors(1.0, 1.0, 1.0))
    assert better.outcome == "better"
    assert better.sentence.startswith("better: force-space error, a / b = 0.5")
    assert "better in 1 of 1 runs and in 3 of 3 held-out stretches of time" in better.sentence
    assert paired_difference("force", "a", "b", errors(2.0, 1.9, 2.1), errors(1.0, 1.0, 1.0)).outcome == "worse"
    assert paired_difference("force", "a", "b", errors(0.3, 2.0), errors(1.0, 1.0)).outcome == "no difference"
    certain = paired_difference("motion", "a", "b", errors(0.99, 0.991, 0.99), errors(1.0, 1.0, 1.0))
    assert certain.interval[1] < 1.0
    assert certain.outcome == "no difference"  # for one percent matters to nobody
    assert paired_difference("motion", "a", "b", errors(0.97, 0.971), errors(1.0, 1.0)).outcome == "better"
    one = paired_difference("force", "a", "b", errors(0.1), errors(1.0))
    assert (one.outcome, one.interval) == ("no difference", None)
    assert "one stretch and one seed, so no interval" in one.sentence
    assert paired_difference("force", "a", "b", errors(), errors()) is None
    assert paired_difference("force", "a", "b", errors(0.0), errors(1.0)) is None


def cell(seed: int, force: float | None, diverged: int = 0, motion: float = 0.1) -> dict:
    run = {"split": "s", "seed": seed, "error": "failed", "warnings": []}
    if force is None:
        return run
    squared = [[motion**2] * 3, [None] * diverged + [4.0 * motion**2] * (3 - diverged)]
    motions = {"horizons": [0.1, 1.0], "squared": squared}
    return {**run, "error": None, "stretches": [force**2, 0.25 * force**2], "motions": motions, "table": {}}


KINDS = {"urdf": "given", "ls": "identified", "ls2": "identified", "gp": "force prior", "net": "black box"}


def scores(runs: dict[str, list[dict]], kinds: dict[str, str] = KINDS, joints: tuple[str, ...] = ("j",)) -> Scores:
    models = {name: {"kind": kinds[name], "summary": ""} for name in runs}
    return Scores(models=models, runs=runs, joint_names=joints, units={})


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
    assert found.difference("motion", "gp", "ls").outcome == "worse", "it diverged in three motions more"
    gp, urdf, seldom = (found.difference("force", name, "ls") for name in ("gp", "urdf", "ls2"))
    assert seldom.runs == 2
    assert (gp.outcome, urdf.outcome, gp.wins, gp.ahead, urdf.ahead, gp.stretches) == ("better", "worse", 3, 2, 0, 2)
    told = [line.split(" (")[0] for line in found.failures]
    assert told == ["ls2 failed in 1 of 3 runs", "net failed in 3 of 3 runs"]


def test_a_model_whose_motions_diverge_more_often_is_worse_however_small_the_others_are():
    found = paired_difference("motion", "a", "b", np.array([[[np.nan, 0.1, 0.1]]]), np.array([[[1.0, 1.0, 1.0]]]))
    assert (found.outcome, found.favours_challenger, found.lost) == ("worse", False, 1)
    assert "diverged in 1 more" in found.sentence


def test_the_model_to_take_is_parametric_unless_another_is_shown_to_be_better():
    cells = {
        "urdf": [cell(k, 2.0, motion=0.4) for k in range(3)],
        "ls": [cell(k, 1.0, motion=0.1) for k in range(3)],
        "gp": [cell(k, 0.5 + 0.01 * k, motion=0.0999) for k in range(3)],
        "net": [cell(k, 0.6 + 0.01 * k, motion=0.3) for k in range(3)],
    }
    found = scores(cells)
    assert found.recommended == "ls", "motions decide before forces"
    assert "parametric: no difference that the data show: error of predicted motions" in found.winner.sentence
    still = scores({name: [{**each, "motions": None} for each in runs] for name, runs in cells.items()})
    assert still.recommended == "gp"
    assert still.winner.sentence.startswith("better: force-space error, gp / ls = 0.5")
    assert still.to_dict()["winner"]["difference"]["ahead"] == 2
    alone = scores({"net": cells["net"]})
    assert alone.winner == ("net", None, "no other model was scored")
    assert alone.winner.sentence == "no other model was scored"
    nothing = scores({"net": [cell(0, None)]})
    assert (nothing.winner, nothing.recommended) == (None, None)
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
    cells = {name: [{**cell(0, 1.0), "motions": None, "stretches": each}] for name, each in
             (("gp", squared), ("ls", [1.0] * 3))}  # fmt: skip
    found = scores(cells)
    assert found.difference("force", "gp", "ls").outcome == "no difference"
    assert (found.recommended == "gp", "too little time to be sure" in found.winner.sentence) == (taken, taken)


def test_a_model_whose_motions_diverge_is_not_the_best():
    kinds = {"a": "force prior", "b": "force prior"}
    cells = {"a": [cell(0, 1.0, diverged=2, motion=0.01)], "b": [cell(0, 1.0, diverged=0, motion=0.5)]}
    assert scores(cells, kinds).best_of(("force prior",), "motion") == "b"


def test_motions_are_compared_over_the_horizons_that_all_splits_last_for():
    cells = {}
    for name, error in (("ls", 0.2), ("gp", 0.1)):
        long, short = ({**cell(0, 1.0, motion=error), "split": split} for split in "st")
        long["motions"]["squared"][1] = [1.0 - error] * 3  # after 1 s, and the other way round
        short["motions"] = {"horizons": [0.1], "squared": short["motions"]["squared"][:1]}
        cells[name] = [long, short]
    assert scores(cells).difference("motion", "gp", "ls").value == pytest.approx(0.5)
    assert scores(cells).best_of(("force prior", "identified"), "motion") == "gp"


def test_a_model_that_is_usable_in_more_joints_is_taken_whatever_its_motions():
    def leaves(*shares: float | None, motion: float, quantity: str = "torque", score: str = "share") -> list[dict]:
        return [{**cell(k, 1.0, motion=motion + 0.01 * k), "table": {quantity: {score: list(shares)}}} for k in (0, 1)]

    def of(**runs: list[dict]) -> Scores:
        return scores(runs, joints=("base", "hip", "knee"))

    ls, ls2 = leaves(None, 0.3, 0.2, motion=0.4), leaves(None, 0.1, 0.51, motion=0.1)
    found = of(ls=ls, ls2=ls2)
    assert (found.recommended, found.unusable("ls2"), found.unusable("ls")) == ("ls", 1, 0), "no torque acts on a base"
    assert of(ls=ls, ls2=leaves(None, 0.1, 0.49, motion=0.1)).recommended == "ls2", "half of a torque is usable"
    learned = of(ls=ls, ls2=ls2, gp=leaves(None, 0.4, 0.6, motion=0.01))
    assert (learned.recommended, learned.winner.why) == ("ls", "usable in 1 more joint")
    assert of(ls2=ls2, gp=ls).recommended == "gp"
    light = leaves(None, 0.9, 0.1, motion=0.1, quantity="acceleration", score="nrmse")
    near = leaves(0.1, 0.2, 0.1, motion=0.1, quantity="acceleration", score="nrmse")
    both = [{**run, "table": {**leaves(None, 0.6, 0.6, motion=0.1)[0]["table"], **near[0]["table"]}} for run in near]
    assert of(ls=both, net=near).recommended == "ls", "torques of one are not compared with accelerations of another"
    net = of(ls=light, net=light)
    assert (net.left("net")[0], net.unusable("net")) == ("acceleration", 2), "what is not known is not usable"


def test_a_model_that_is_not_there_is_named():
    with pytest.raises(InvalidInput, match="name one of urdf, gp"):
        scores({"urdf": [cell(0, 1.0)], "gp": [cell(0, 0.5)]}).value("mae")
    with pytest.raises(InvalidInput, match=r"no model 'gpp'.*did you mean 'gp'"):
        scores({"urdf": [cell(0, 1.0)], "gp": [cell(0, 0.5)]}).value("mae", model="gpp")


def test_differences_and_winners_are_what_they_were():
    found, rng = {}, np.random.default_rng(5)
    for seeds, horizons, stretches in ((1, 1, 1), (1, 1, 6), (3, 1, 1), (3, 2, 5)):
        one, other = rng.gamma(8.0, 0.1, size=(2, seeds, horizons, stretches))
        for ratio in (0.3, 0.6, 0.95, 1.0, 1.03, 1.6):
            each = paired_difference("force", "a", "b", ratio * one, other)
            found[f"{one.shape} {ratio}"] = {**vars(each), "outcome": each.outcome, "to take": each.favours_challenger}
    lost = np.where(np.arange(5) < 2, np.inf, 1.0) * np.ones((3, 2, 5))
    found["lost"] = paired_difference("motion", "a", "b", lost, np.ones((3, 2, 5)))
    for share in np.linspace(0.3, 0.7, 9):
        for ratio in (0.5, 0.66, 0.69, 0.97, 0.99, 1.2):
            stretches = {"ls": rng.gamma(20.0, 0.05, size=9), "gp": ratio**2 * rng.gamma(20.0, 0.05, size=9)}
            left = {"ls": {"torque": {"share": [0.4]}}, "gp": {"torque": {"share": [share]}}}
            more = {name: {"motions": None, "stretches": each, "table": left[name]} for name, each in stretches.items()}
            winner = scores({name: [cell(0, 1.0) | each] for name, each in more.items()}).winner
            found[f"winner {share:.2g} {ratio}"] = winner.model, winner.difference and winner.difference.value
    assert_unchanged("scores/differences", found)
