"""`forcegp compare` from end to end."""

import dataclasses
import json
import re

import pytest
from tests.models.arm import arm_data

from forcegp.cli.main import main
from forcegp.data import Dataset
from forcegp.models import load_posterior
from forcegp.priors import named_prior

QUICK = ("--iterations", "8", "--restarts", "1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("compare")
    arm_data(60, seed=0).save(path / "train.h5")
    arm_data(40, seed=1).save(path / "test.h5")
    dataclasses.replace(arm_data(12, seed=2), system=None).save(path / "no_robot.h5")
    return path


@pytest.fixture
def here(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return folder


def test_the_table_has_a_line_per_candidate_and_the_verdict_follows(forcegp, folder):
    sum_of_two = "joint-friction+joint-ripple"
    words = ("--priors", f"joint,joint-friction,{sum_of_two}", "--points", 30)
    done = forcegp("compare", "train.h5", *words, "--test", "test.h5", *QUICK, folder=folder)
    assert done.returncode == 0, done.stderr
    for name, functions in (("joint", 3), ("joint-friction", 3), ("joint-friction + joint-ripple", 6)):
        numbers = r"\s+(\d+), \d+\s+-?\d+((?:\s+\S+){4,6})\s*$"
        row = re.search(rf"^\s*{re.escape(name)}{numbers}", done.stdout, re.M)
        assert row, done.stdout
        assert int(row[1]) == functions
        assert 0.0 < float(row[2].split()[-1]) < 10.0  # the error on the test data
    assert done.stdout.count("±") == 3
    told = " ".join(done.stdout.split())
    assert re.search(r"The data support joint-friction|joint-friction.* cannot be distinguished", told)
    assert re.search(r"Next: forcegp fit train\.h5 --prior \S+ --points 30 --out run", told)
    assert re.search(
        r"warning: (joint.*: )?the search .* did not converge .*--iterations", " ".join(done.stderr.split())
    )
    assert not list(folder.glob(".*"))


def test_json_and_the_folder_hold_the_same(forcegp, folder):
    words = ("--priors", "joint-friction,none,joint : inputs = v", "--out", "priors")
    more = ("--noise", "learned", "--force-noise", "0.01", "--block-seconds", "0.1", "--mean", "analytical")
    done = forcegp("compare", "train.h5", *words, *more, *QUICK, "--json", folder=folder)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    stored = json.loads((folder / "priors" / "comparison.json").read_text())
    assert {name: stored[name] for name in found} == found
    assert found["points"] == 60
    assert found["block_seconds"] == 0.1
    assert found["test"] is None
    assert [each["name"] for each in found["candidates"]] == ["joint-friction", "none", "joint : inputs = v"]
    assert [each["latents"] for each in found["candidates"]] == [3, 0, 3]
    assert [each["best"] for each in found["candidates"]].count(True) == 1
    assert not found["candidates"][1]["supported"]
    config = json.loads((folder / "priors" / "config.json").read_text())
    assert config["kind"] == "forcegp compare"
    assert config["options"]["priors"] == ["joint-friction", "none", "joint : inputs = v"]
    for name, place in stored["models"].items():
        posterior = load_posterior(folder / "priors" / place)
        assert posterior.model.prior == named_prior(name)
        assert posterior.model.noise.learn
        candidate = next(each for each in found["candidates"] if each["name"] == name)
        assert candidate["leave_one_out"] == pytest.approx(posterior.leave_out().total / 60)
    scored = forcegp("evaluate", "priors/joint-friction", "test.h5", "--json", folder=folder)
    assert scored.returncode == 0, scored.stderr
    again = forcegp("compare", "train.h5", *words, *QUICK, folder=folder)
    assert (again.returncode, again.stdout) == (2, "")
    assert "--overwrite" in again.stderr


TWO = "--priors joint,joint-friction"
WRONG = [
    ("compare train.h5", "--priors lists the candidates, and there is none; give two or more"),
    ("compare train.h5 --priors joint", "there is only joint; give two or more"),
    ("compare train.h5 --priors joint,joint", "--priors: 'joint' is the same as 'joint'"),
    ("compare train.h5 --priors joint,joint:inputs=q/v/u", "is the same as 'joint'"),
    ("compare train.h5 --priors joint,jiont-friction", "no prior 'jiont-friction'"),
    ("compare train.h5 --priors joint,joint:colour=red", "prior 'joint' cannot take 'colour=red'"),
    (f"compare train.h5 {TWO} --points 61", "--points 61 must be an integer from 2 to 60, the rows"),
    (f"compare train.h5 {TWO} --points 1", "--points 1 must be an integer from 2 to 60, the rows"),
    (f"compare train.h5 {TWO} --block-seconds 0", "seconds is 0.0; it must be positive"),
    (f"compare train.h5 {TWO} --block-seconds 50", "too few to compare by"),
    (f"compare train.h5 {TWO} --seed -1", "--seed=-1 must be an integer of at least 0"),
    (f"compare train.h5 {TWO} --noise loud", "--noise is 'loud'"),
    (f"compare train.h5 {TWO} --test missing.h5", "missing.h5 is not a file"),
    (f"compare train.h5 {TWO} --out train.h5", "train.h5 would be written over train.h5"),
    (f"compare no_robot.h5 {TWO}", "does not carry its robot; add --robot"),
    (f"compare missing.h5 {TWO}", "missing.h5 is not a file"),
]


@pytest.mark.parametrize(("words", "message"), WRONG, ids=[words for words, _ in WRONG])
def test_a_wrong_command_is_one_line_and_exit_code_2(here, capfd, words, message):
    before = sorted(here.rglob("*"))
    assert main(words.split()) == 2
    told = capfd.readouterr()
    assert told.out == ""
    assert told.err.startswith("forcegp: ")
    assert told.err.count("\n") == 1, told.err
    assert message in told.err
    assert sorted(here.rglob("*")) == before


def test_without_points_given_all_of_few_rows_are_taken(here, capfd):
    Dataset.load("train.h5").rows(slice(0, 24)).save("few.h5")
    assert main(["compare", "few.h5", *TWO.split(), "--iterations", "2", "--restarts", "1", "--jobs", "2"]) == 0
    assert "24 points of few.h5" in capfd.readouterr().out


def test_the_next_fit_has_the_robot_and_the_noise_that_were_compared(forcegp, folder):
    words = ("--priors", "joint-friction,none", "--points", 10, "--gravity", "0,0,-9.8", "--no-checks")
    done = forcegp("compare", "train.h5", *words, "--noise", "0.1", *QUICK, folder=folder)
    assert done.returncode == 0, done.stderr
    told = " ".join(done.stdout.split())
    assert re.search(r"Next: forcegp fit train\.h5 --gravity=0,0,-9\.8 --noise 0\.1 --prior \S+ --points 10", told)
