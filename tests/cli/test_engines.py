"""`--engine` and `--learning-points`: said in the report, stored with the model, refused where they mean nothing."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tests.posterior.arm import arm_data

from forcegp.posterior import load_posterior

INDUCING = ("--engine", "inducing", "--learning-points", 20)
FIT = ("fit", "arm.h5", "--points", 40, "--iterations", 3, "--restarts", 1)


@pytest.fixture
def folder(tmp_path):
    arm_data(50, seed=0).save(tmp_path / "arm.h5")
    return tmp_path


def test_the_engine_is_said_and_stored(forcegp, folder):
    done = forcegp(*FIT, "--engine", "inducing", "--learning-points", 20, "--out", "run", folder=folder)
    assert done.returncode == 0, done.stderr
    assert "inducing: as asked for" in done.stdout
    assert "learned from 40 points (parameters: from 20 of them" in " ".join(done.stdout.split())
    posterior = load_posterior(folder / "run")
    assert posterior.engine.name == "inducing"
    assert (len(posterior.training.q), len(posterior.training.reference.q)) == (40, 20)
    config = json.loads((folder / "run" / "config.json").read_text())
    assert config["resolved"]["learning_points"] == 20
    told = forcegp(*FIT, "--forces", "gp:joint-friction", *INDUCING, "--json", "--out", "friction", folder=folder)
    summary = json.loads(told.stdout)
    assert (summary["points"], summary["learning_points"]) == (40, 20)
    assert summary["settings"]["refined"].startswith("on all rows")
    scored = forcegp("score", "run", "arm.h5", folder=folder)
    assert scored.returncode == 0, scored.stderr


@pytest.mark.nightly
def test_more_rows_than_memory_holds_is_one_line(forcegp, folder):
    few, count = arm_data(50, seed=0), 100_000
    again = {name: np.tile(getattr(few, name), (count // 50, 1)) for name in ("q", "v", "u", "a")}
    again["u"] = again["u"] + 1e-9 * np.arange(count)[:, None]
    episode = np.zeros(count, dtype=few.episode.dtype)
    replace(few, **again, time=0.01 * np.arange(count), episode=episode, truth={}).save(folder / "many.h5")
    words = ("fit", "many.h5", "--engine", "exact", "--points", 100_000, "--learning-points", 20, "--no-checks")
    refused = forcegp(*words, "--restarts", 1, "--out", "run", folder=folder)
    assert refused.returncode == 2
    (line,) = refused.stderr.strip().splitlines()
    assert "N=100000 rows needs" in line
    assert "use engine='inducing'" in line
    assert not (folder / "run").exists()
