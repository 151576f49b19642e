"""What the experiments on force priors make of their jobs: medians over seeds, rows of CSV, tables and figures."""

import io

import pytest
from benchmarks.force_priors.experiments import Transfer
from benchmarks.force_priors.trials import (
    TEST_SEED,
    ForceExperiment,
    Trial,
    dots_figure,
    only_test,
    score_table,
    trial_name,
)
from benchmarks.paper.experiment import DataSettings
from benchmarks.paper.fits import FitSettings
from tests.benchmarks.stored_jobs import keep

from forcegp.jobs import JobStore
from forcegp.scores.tables import median_and_range

DATA = DataSettings(train_seconds=3.0, rows=50, test_seconds=2.0, every=5)
SEARCH = FitSettings(restarts={"0": 2}, iterations=7, tolerance={"0": 1e-4})


def experiment(kind):
    return kind(data=DATA, points=(10,), seeds=(7, 8, 9), settings=SEARCH)


class OneTrial(ForceExperiment):
    name, title = "one", "One"
    trial = Trial("mine", "tilted", "gp:tool-friction", 10, {"plane": "viscous", "ball": "sphere"}, region=True)

    def trials(self):
        return [self.trial]

    def section(self, summary):
        return ""


@pytest.fixture
def results(tmp_path):
    return JobStore.open(tmp_path / "out", "a test", {})


def store(results, trial, seed, tests, curves=(), **more):
    found = {"tests": tests, "curves": {str(k): {"coverage": c} for k, c in enumerate(curves)}}
    found |= {"search": {"cpu_seconds": 2.0}} | more
    keep(results, trial_name(trial, seed), {}, found)


def test_a_job_is_told_all_that_its_trial_says():
    jobs = {job.name: job for job in experiment(OneTrial).jobs()}
    fit = jobs["force-fits/tilted-extrapolation/tool-friction-analytical-on-sphere-viscous/n10/seed8"]
    assert fit.spec == {
        "train": "force-data/tilted/train/seed8",
        "tests": {"plane": "force-data/viscous/test/seed8", "ball": "force-data/sphere/test/seed8"},
        "prior": "gp:tool-friction",
        "mean": "analytical",
        "points": 10,
        "region": True,
        "seed": 8,
        "restarts": 2,
        "iterations": 7,
        "tolerance": 1e-4,
    }
    assert fit.inputs == (fit.spec["train"], *fit.spec["tests"].values())
    assert len(jobs) == 3 * 4
    train, test = jobs[fit.spec["train"]].spec, jobs[fit.spec["tests"]["ball"]].spec
    assert train == {"scenario": {"surface": "tilted"}, "seed": 8, "seconds": 3.0, "rows": 50, "every": 5}
    assert test == {"scenario": {"surface": "sphere"}, "seed": TEST_SEED + 8, "seconds": 2.0, "rows": None, "every": 5}


def test_summaries_are_medians_and_ranges_over_seeds(results):
    one = experiment(OneTrial)
    for seed, mae, coverages in ((7, 0.3, (0.5, 0.9)), (8, 0.1, (1.0, 1.0)), (9, 0.2, (0.8, 0.6))):
        ball = {"mae": 2.0 * mae} if seed == 8 else {"mae": 2.0 * mae, "nlpd": 1.0}
        store(results, one.trial, seed, {"plane": {"mae": mae}, "ball": ball}, coverages)
    summary = one.summary(results)
    (trial,) = summary["trials"]
    assert trial["tests"]["plane"]["mae"] == {"median": 0.2, "min": 0.1, "max": 0.3, "values": [0.3, 0.1, 0.2]}
    assert trial["tests"]["ball"]["nlpd"] is None  # not for every seed
    assert trial["curve_coverage"]["values"] == [0.5, 0.9, 1.0, 1.0, 0.8, 0.6]
    assert trial["curve_coverage_of_seeds"]["values"] == pytest.approx([0.7, 1.0, 0.7])
    assert trial["search_seconds"]["median"] == 2.0
    plane, ball = one.rows(summary)
    told = {"label": "mine", "scenario": "tilted", "prior": "gp:tool-friction", "points": 10, "extrapolation": 1}
    scores = {"mae_median": 0.2, "mae_min": 0.1, "mae_max": 0.3}
    assert plane == {**told, "tested_on": "plane", **scores}
    assert ball["nlpd_median"] is None
    assert ball["mae_max"] == 0.6


def test_transfer_is_told_relative_to_where_it_was_learned(results):
    transfer = experiment(Transfer)
    for trial in transfer.trials():
        for seed in transfer.seeds:
            scores = {label: {"mae_noise_free": 0.02 * (1 + k) * seed} for k, label in enumerate(trial.tests)}
            store(results, trial, seed, scores)
    page = transfer.section(transfer.summary(results))
    plane, tilted = "0.1600 (0.1400–0.1800) [1.00]", "0.3200 (0.2800–0.3600) [2.00]"
    assert f"| tool friction | 10 | {plane} | {tilted} | 0.4800 (0.4200–0.5400) [3.00] |" in page
    assert page.count(f"| {plane} |") == 5
    assert page.count("[4.00]") == 2  # free motion, for both models of joint friction


def trial(label, **tests):
    return {
        "label": label,
        "points": 5,
        "tests": {name: {"mae": median_and_range(values)} for name, values in tests.items()},
    }


def test_tables_have_a_row_per_trial_and_test():
    given = [trial("one", home=[0.5, 0.7, 0.6]), trial("two", home=[1.0], away=[2.0])]
    assert score_table(given, ("mae", "nlpd")).splitlines() == [
        "| model | points | MAE | NLPD |",
        "|---|---:|---:|---:|",
        "| one | 5 | 0.6000 (0.5000–0.7000) | – |",
        "| two | 5 | 1.0000 | – |",
        "| two | 5 | 2.0000 | – |",
    ]
    assert only_test(given[0]) == {"mae": median_and_range([0.5, 0.7, 0.6])}
    with pytest.raises(ValueError, match="too many values"):
        only_test(given[1])


def test_dots_lie_at_the_medians_with_their_ranges():
    groups = {
        "first": {"a": only_test(trial("a", x=[0.5, 0.7, 0.6])), "b": only_test(trial("b", x=[30.0]))},
        "second": {"c": only_test(trial("c", x=[2.0, 3.0, 4.0]))},
    }
    figure = dots_figure(groups, "mae", "error [m]")
    first, second = figure.axes
    lines = [[tuple(line.get_xdata()), tuple(line.get_ydata())] for line in first.lines]
    assert lines == [[(0.5, 0.7), (0, 0)], [(0.6,), (0,)], [(30.0, 30.0), (1, 1)], [(30.0,), (1,)]]
    assert [text.get_text() for text in first.texts] == ["0.6", "30"]
    assert [text.get_text() for text in second.get_yticklabels()] == ["c"]
    figure.savefig(io.BytesIO(), format="png")
    for axes in (first, second):
        shown = [text.get_text() for text in axes.get_xticklabels() if text.get_text()]
        assert len(shown) >= 2
        assert not any("mathdefault" in text or "times" in text for text in shown)
