"""`--jobs`: the same model wherever it is computed; what is wrong is one line and exit code 2."""

import json

import pytest
from tests.posterior.arm import arm_data

from forcegp.cli.main import main
from forcegp.posterior import load_posterior

FIT = ("fit", "arm.h5", "--forces", "gp:joint", "--points", 10, "--iterations", 3, "--restarts", 2)


@pytest.fixture
def folder(tmp_path):
    arm_data(20, seed=0).save(tmp_path / "arm.h5")
    return tmp_path


@pytest.mark.nightly
def test_a_fit_in_processes_is_the_fit_in_one(forcegp, folder):
    for jobs in ("1", "2"):
        done = forcegp(*FIT, "--jobs", jobs, "--out", jobs, "--json", folder=folder)
        assert done.returncode == 0, done.stderr
        assert [line for line in done.stderr.splitlines() if "did not converge" not in line] == []
        assert json.loads(done.stdout)["settings"]["restarts"] == 2
    one, two = (load_posterior(folder / name) for name in ("1", "2"))
    assert one.settings["restart_objective"] == pytest.approx(two.settings["restart_objective"], rel=1e-9)


def test_jobs_that_cannot_be_meant_are_one_line(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main([*map(str, FIT[:2]), "--jobs", "0", "--out", "run"]) == 2
    told = capsys.readouterr().err
    assert "jobs is 0; give" in told
    assert len(told.strip().splitlines()) == 1
    assert not (folder / "run").exists()
