"""`--learn-from` and `--window`: a raw log without accelerations."""

import json

import pytest
from tests.models.raw_log import motion

from forcegp.data import differentiated
from forcegp.models import load_posterior

FIT = ("fit", "raw.h5", "--prior", "joint-friction", "--points", 12, "--iterations", 10, "--restarts", 1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("raw")
    motion().save(where / "raw.h5")
    return where


def test_a_raw_log_teaches_without_accelerations(forcegp, folder):
    name, window = "weak-form", 0.1
    done = forcegp(*FIT, "--learn-from", name, "--window", window, "--out", name, folder=folder)
    assert done.returncode == 0, done.stderr
    assert "learned from 12 points" in " ".join(done.stdout.split())
    assert "12 windows of 6 nodes" in " ".join(done.stdout.split())
    posterior = load_posterior(folder / name)
    assert posterior.settings["observe"]["seconds"] == window
    assert len(posterior.training) == 12
    config = json.loads((folder / name / "config.json").read_text())
    assert config["options"]["learn_from"] == name
    scored = forcegp("evaluate", name, "raw.h5", folder=folder)
    assert scored.returncode == 0, scored.stderr
    assert "12 training points" in " ".join(scored.stdout.split())


def test_more_points_than_windows_takes_all_windows(forcegp, folder):
    words = ("--learn-from", "weak-form", "--window", 0.5, "--json", "--out", "few")
    done = forcegp(*FIT[:4], "--points", 100, "--iterations", 2, "--restarts", 1, *words, folder=folder)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["points"] == 5


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--window", "0.1"), "--window means nothing to accelerations; add --learn-from weak-form"),
        (("--learn-from", "weak-form", "--window", "0.004"), "a window of 0.004 s has 3 rows"),
        (("--learn-from", "weak-form", "--window", "-1"), "WeakForm seconds is -1.0; it must be positive"),
        (("--learn-from", "weak-form", "--engine", "inducing"), "windows are conditioned on exactly"),
        (("--learn-from", "positions"), "learn-from"),
    ],
)
def test_what_makes_no_sense_is_one_line(forcegp, folder, words, message):
    refused = forcegp(*FIT, *words, "--out", "refused", folder=folder)
    assert refused.returncode == 2
    (line,) = refused.stderr.strip().splitlines()
    assert message in line
    assert not (folder / "refused").exists()


def test_contacts_are_not_looked_for_in_accelerations_that_nobody_measured(forcegp, folder):
    words = ("--contact", "hand@0,0,0.2:plane:0,0,1,1.045", "--learn-from", "weak-form", "--out", "contact")
    differentiated(motion(), "q").save(folder / "differences.h5")
    fit = ("fit", "differences.h5", *FIT[2:4], "--points", 8, "--iterations", 1, "--restarts", 1)
    done = forcegp(*fit, *words, folder=folder)
    assert done.returncode == 0, done.stderr
    assert "as a contact" not in done.stderr


def test_other_models_refuse_windows(forcegp, folder):
    words = ("fit", "raw.h5", "--model", "independent-gp", "--learn-from", "weak-form", "--out", "refused")
    refused = forcegp(*words, folder=folder)
    assert refused.returncode == 2
    assert "--learn-from means nothing to --model independent-gp" in refused.stderr


def test_known_physics_alone_is_scored_on_windows_too(forcegp, folder):
    words = ("fit", "raw.h5", "--model", "analytical", "--points", 6, "--iterations", 2, "--learn-from", "weak-form")
    done = forcegp(*words, "--out", "physics", folder=folder)
    assert done.returncode == 0, done.stderr
    posterior = load_posterior(folder / "physics")
    assert posterior.training.weights is not None
    assert float(posterior.noise_std.max()) < 100.0  # the column `a`, which holds 1000, was not looked at
