"""A folder of cells: whole or not at all, one version, one preset, one process at a time."""

import json

import pytest

from forcegp.errors import FileFormatError, InvalidInput
from forcegp.experiments.results import Results, write_json


@pytest.fixture
def results(tmp_path):
    return Results.open(tmp_path / "out", "smoke")


def store(results, name, digest, result):
    with results.writing(name) as folder:
        write_json(folder / "cell.json", {"digest": digest, "spec": {}, "result": result})


def test_a_cell_is_found_again(results):
    store(results, "fits/a/n10", "10", {"mae": 0.5})
    again = Results.open(results.folder, "smoke")
    assert again.has("fits/a/n10", "10")
    assert again.result("fits/a/n10") == {"mae": 0.5}
    assert not again.has("fits/a/n20", "20")


def test_a_cell_that_fails_leaves_nothing(results):
    def interrupted():
        with results.writing("fits/a") as folder:
            (folder / "part.txt").write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [entry.name for entry in (results.folder / "cells" / "fits").iterdir()] == []


def test_other_settings_are_named_and_not_mixed(results):
    store(results, "a", "10", {})
    with pytest.raises(FileFormatError, match=r"cells/a/cell\.json was computed with other settings"):
        results.has("a", "11")


@pytest.mark.parametrize("content", ["", '{"spec": {}', '{"spec": {}}', "[1]"])
def test_a_half_written_cell_is_named_and_kept(results, content):
    store(results, "a", "1", {})
    file = results.cell_folder("a") / "cell.json"
    file.write_text(content)
    with pytest.raises(FileFormatError, match="only this cell is computed anew"):
        results.has("a", "1")
    assert file.read_text() == content


def test_another_version_and_another_preset_are_refused(results):
    with pytest.raises(InvalidInput, match="results of preset 'smoke', not 'paper'"):
        Results.open(results.folder, "paper")
    description = results.folder / "reproduction.json"
    stored = json.loads(description.read_text())
    description.write_text(json.dumps({**stored, "forcegp_version": "0.0.1"}))
    with pytest.raises(FileFormatError, match=r"holds results of forcegp 0\.0\.1 .* old results stay"):
        Results.open(results.folder, "smoke")


def test_folders_of_something_else_are_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(InvalidInput, match="was not written by `forcegp reproduce`"):
        Results.open(tmp_path, "smoke")
    with pytest.raises(InvalidInput, match="was not written by"):
        Results.open(tmp_path / "thesis.tex", "smoke")
    (tmp_path / "empty").mkdir()
    assert Results.open(tmp_path / "empty", "smoke").folder.is_dir()


def test_only_one_at_a_time(results):
    with results.locked(), pytest.raises(InvalidInput, match="another `forcegp reproduce` is at work"):  # noqa: SIM117
        with Results.open(results.folder, "smoke").locked():
            pass
    with results.locked():
        pass  # free again


def test_leftovers_of_killed_runs_go(results):
    store(results, "fits/a", "1", {})
    leftover = results.folder / "cells" / "fits" / ".b.0123456789ab.tmp"
    leftover.mkdir()
    results.remove_leftovers()
    assert not leftover.exists()
    assert results.has("fits/a", "1")


def test_a_run_killed_before_its_description_does_not_block_the_folder(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / ".reproduction.json.0123456789ab.tmp").write_text('{"kind"')
    results = Results.open(folder, "smoke")
    with results.locked():
        results.remove_leftovers()
    assert sorted(entry.name for entry in folder.iterdir()) == [".lock", "reproduction.json"]


def test_a_cell_that_another_process_finished_meanwhile_stays(results):
    with results.writing("a") as folder:
        write_json(folder / "cell.json", {"digest": "1", "spec": {}, "result": {"first": False}})
        store(results, "a", "1", {"first": True})
    assert results.result("a") == {"first": True}
    assert not list(results.folder.glob("**/*.tmp"))
