"""The experiments on force priors: their presets, their page, their command, and all at the smallest size."""

import csv
import json
from dataclasses import replace

import pytest
from benchmarks.force_priors.__main__ import main
from benchmarks.force_priors.presets import PAGE, PRESETS
from benchmarks.force_priors.trials import SCENARIOS, Trial
from benchmarks.paper.reproduction import as_csv, report

from forcegp.jobs import Job

EXPERIMENTS = [experiment.name for experiment in PRESETS["smoke"]]
FIGURES = ("data-efficiency", "friction-errors", "friction-curves", "friction-normal-force")


@pytest.mark.parametrize("preset", PRESETS)
def test_jobs_that_experiments_share_are_the_same(preset):
    known: dict[str, Job] = {}
    for experiment in PRESETS[preset]:
        experiment.require_possible()
        for job in experiment.jobs():
            assert known.setdefault(job.name, job) == job
    assert all(name in known for job in known.values() for name in job.inputs)


@pytest.mark.parametrize("preset", PRESETS)
def test_trials_are_told_apart_by_their_names(preset):
    """One name is one model on one scenario, in all experiments: they share jobs, and no job is of two trials."""
    known: dict[str, Trial] = {}
    for experiment in PRESETS[preset]:
        trials = experiment.trials()
        assert len({trial.name for trial in trials}) == len(trials)
        for trial in trials:
            first = known.setdefault(trial.name, trial)
            assert replace(trial, label="") == replace(first, label="")
            assert {trial.scenario, *trial.tests.values()} <= set(SCENARIOS)
    assert len({repr(replace(trial, label="")) for trial in known.values()}) == len(known)


@pytest.mark.parametrize(
    "change",
    [{"points": 3}, {"prior": "gp:joint:inputs=q"}, {"mean": "zero"}, {"region": True}, {"scenario": "tilted"}],
)
def test_what_differs_between_trials_shows_in_their_names(change):
    trial = Trial("one", "viscous", "gp:joint", 10, {"there": "sphere"})
    assert replace(trial, **change).name != trial.name
    assert replace(trial, label="other").name == trial.name
    assert replace(trial, tests={"there": "tilted"}).name != trial.name
    assert "/" not in replace(trial, prior="gp:joint:inputs=q/v").name.split("/")[1]


def test_the_committed_page_is_made_of_the_committed_numbers(repository):
    docs, experiments = repository / "docs/benchmarks", PRESETS["forces"]
    folder = docs / PAGE.name
    documents = {each.name: json.loads((folder / f"{each.name}.json").read_text()) for each in experiments}
    assert {document["preset"] for document in documents.values()} == {"forces"}
    assert (docs / f"{PAGE.name}.md").read_text() == report(experiments, documents, PAGE)
    for experiment in experiments:
        document = documents[experiment.name]
        assert (folder / f"{experiment.name}.csv").read_text() == as_csv(experiment.rows(document["summary"]))
        assert all((folder / f"{name}.png").exists() for name in document["figures"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("fig2b",), "no figure 'fig2b'"),
        (("friction", "--preset", "smoke", "--points", "201"), "have 200 rows, so give 2 to 200"),
    ],
)
def test_refusals_are_one_line_and_leave_nothing(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*words, "--out", "new"]) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Everything once, in `out` and in `docs`."""
    pytest.importorskip("pybullet")
    folder = tmp_path_factory.mktemp("force-priors")
    words = ["--preset", "smoke", "--jobs", "2", "--out", str(folder / "out")]
    assert main([*words, "--docs", str(folder / "docs")]) == 0
    page = (folder / "out" / "force-priors.md").read_text()
    kept = {file: file.stat().st_mtime_ns for file in (folder / "out" / "jobs").glob("**/job.json")}
    assert main(words) == 0
    assert (folder / "out" / "force-priors.md").read_text() == page
    assert kept == {file: file.stat().st_mtime_ns for file in kept}  # a second run computes nothing
    return folder


@pytest.mark.nightly  # minutes of fits; the tests of jobs and tables cover the cells
def test_all_figures_tables_and_the_page_are_there(folder):
    for root in (folder / "out", folder / "docs"):
        page = (root / "force-priors.md").read_text()
        assert page.startswith("# Force priors: results\n")
        assert "    python -m benchmarks.force_priors --preset smoke\n" in page
        for name in EXPERIMENTS:
            document = json.loads((root / "force-priors" / f"{name}.json").read_text())
            rows = list(csv.DictReader((root / "force-priors" / f"{name}.csv").read_text().splitlines()))
            assert len(rows) == sum(len(trial["tests"]) for trial in document["summary"]["trials"])
            assert all(float(row["mae_median"]) > 0.0 for row in rows)
        for figure in FIGURES:
            assert f"(force-priors/{figure}.png)" in page
            assert (root / "force-priors" / f"{figure}.png").read_bytes().startswith(b"\x89PNG")
        assert "Its numbers mean nothing for the models" in page
        assert "nan" not in page.lower()


@pytest.mark.nightly
def test_components_add_up_and_forces_move_to_other_contacts(folder):
    results = folder / "out" / "force-priors"
    summaries = {name: json.loads((results / f"{name}.json").read_text())["summary"] for name in EXPERIMENTS}
    sums = [
        scores["component_sum_error"]["max"]
        for trial in summaries["friction"]["trials"]
        for scores in trial["tests"].values()
    ]
    assert len(sums) > 10
    assert max(sums) < 1e-9
    moved = summaries["transfer"]["trials"]
    assert {label for trial in moved for label in trial["tests"]} == {"plane", "tilted plane", "sphere", "free motion"}
