"""A folder of jobs: whole or not at all, one configuration, one process at a time."""

import pytest

from forcegp.atomic_files import atomic_folder, remove_leftovers, write_json
from forcegp.errors import FileFormatError, InvalidInput
from forcegp.jobs import JobStore

KIND = "forcegp score"


@pytest.fixture
def results(tmp_path):
    return JobStore.open(tmp_path / "out", KIND, {"preset": "smoke"})


def store(results, name, digest, result):
    with atomic_folder(results.place(name)) as folder:
        folder.mkdir()
        write_json(folder / "job.json", {"digest": digest, "code": "", "spec": {}, "result": result})


def test_a_job_is_found_again(results):
    store(results, "fits/a/n10", "10", {"mae": 0.5})
    again = JobStore.open(results.folder, KIND, {"preset": "smoke"})
    assert again.has("fits/a/n10", "10")
    assert again.result("fits/a/n10") == {"mae": 0.5}
    assert not again.has("fits/a/n20", "20")


@pytest.mark.parametrize("content", ["", '{"spec": {}', '{"spec": {}}', "[1]"])
def test_a_half_written_job_is_named_and_kept(results, content):
    store(results, "a", "1", {})
    file = results.place("a") / "job.json"
    file.write_text(content)
    with pytest.raises(FileFormatError, match="only this job is computed anew"):
        results.has("a", "1")
    assert file.read_text() == content


def test_another_configuration_is_refused(results):
    with pytest.raises(InvalidInput, match=r"another preset \('smoke', not 'paper'\); choose another `folder`\.$"):
        JobStore.open(results.folder, KIND, {"preset": "paper"})
    with pytest.raises(InvalidInput, match=r"another preset .*choose another `folder`, or add `overwrite=True`"):
        JobStore.open(results.folder, KIND, {"preset": "paper"}, overwrite=False)
    with pytest.raises(InvalidInput, match=r"results with another points, preset \("):
        JobStore.open(results.folder, KIND, {"preset": "paper", "points": list(range(100))})


def test_overwrite_starts_anew(results):
    store(results, "a", "10", {})
    again = JobStore.open(results.folder, KIND, {"preset": "paper"}, overwrite=True)
    assert not again.has("a", "10")
    assert JobStore.open(results.folder, KIND, {"preset": "paper"}, overwrite=False) == again


def test_folders_of_something_else_are_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(InvalidInput, match="was not written by `forcegp score`"):
        JobStore.open(tmp_path, KIND, {"preset": "smoke"})
    with pytest.raises(InvalidInput, match="was not written by"):
        JobStore.open(tmp_path / "thesis.tex", KIND, {"preset": "smoke"})
    (tmp_path / "empty").mkdir()
    assert JobStore.open(tmp_path / "empty", KIND, {"preset": "smoke"}).folder.is_dir()


def test_only_one_at_a_time(results):
    other = JobStore.open(results.folder, KIND, {"preset": "smoke"})
    with results.locked(), pytest.raises(InvalidInput, match="another `forcegp score` is at work"), other.locked():
        pass
    with results.locked():
        pass  # free again


def test_a_run_killed_before_its_description_does_not_block_the_folder(tmp_path):
    folder = tmp_path / "out"
    left = folder / ".jobs.json.0123456789ab.tmp"
    left.mkdir(parents=True)
    (left / "jobs.json").write_text('{"kind"')
    results = JobStore.open(folder, KIND, {"preset": "smoke"})
    with results.locked():
        remove_leftovers(results.folder)
    assert sorted(entry.name for entry in folder.iterdir()) == [".lock", "jobs", "jobs.json"]
