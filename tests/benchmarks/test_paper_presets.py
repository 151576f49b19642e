"""The presets, and the page that the documentation shows."""

import json
from pathlib import Path

import pytest
from benchmarks.paper.reproduction import NAME, PRESETS, as_csv, experiments_of, report

from forcegp.errors import InvalidInput
from forcegp.jobs import Job

DOCS = Path(__file__).resolve().parents[2] / "docs" / "paper"


@pytest.mark.parametrize("preset", PRESETS)
def test_jobs_that_experiments_share_are_the_same(preset):
    known: dict[str, Job] = {}
    for experiment in PRESETS[preset]:
        experiment.require_possible()
        for job in experiment.jobs():
            assert known.setdefault(job.name, job) == job
    assert all(name in known for job in known.values() for name in job.inputs)


def test_other_points_and_seeds():
    (fig2b,) = experiments_of("smoke", "fig2b")
    changed = fig2b.with_points((50, 10, 50)).with_seeds((7, 8))
    assert changed.points == (10, 50)
    assert changed.seeds_of(10) == changed.seeds_of(50) == (7, 8)
    with pytest.raises(InvalidInput, match="asked for 401"):
        fig2b.with_points((401,)).require_possible()


def test_the_committed_page_is_made_of_the_committed_numbers():
    folder = DOCS / NAME
    experiments = [each for each in PRESETS["paper"] if (folder / f"{each.name}.json").exists()]
    documents = {
        experiment.name: json.loads((folder / f"{experiment.name}.json").read_text()) for experiment in experiments
    }
    assert {document["preset"] for document in documents.values()} == {"paper"}
    assert (DOCS / f"{NAME}.md").read_text() == report(experiments, documents)
    for experiment in experiments:
        document = documents[experiment.name]
        assert (folder / f"{experiment.name}.csv").read_text() == as_csv(experiment.rows(document["summary"]))
        assert all((folder / f"{name}.png").exists() for name in document["figures"])
