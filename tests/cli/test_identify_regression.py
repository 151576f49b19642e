"""`forcegp identify --model least-squares|consistent` from end to end, and what begins with its folder."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.analytical.test_identification import recorded
from tests.models.arm import URDF, arm_system

from forcegp import Robot
from forcegp.analytical import motion_residuals
from forcegp.data import Dataset
from forcegp.mechanics import ConstantJointForce, MechanicalSystem


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """train.h5 and test.h5 of an arm with friction that their robot does not know, and free.h5, too short and noisy."""
    place = tmp_path_factory.mktemp("regression")
    for name, rows, seed, noise in (("train", 120, 0, 0.05), ("test", 60, 1, 0.05), ("free", 12, 4, 3.0)):
        data = recorded(rows, seed, torque_noise=noise)
        replace(data, system=arm_system(0)).save(place / f"{name}.h5")
    (place / "arm.urdf").write_text(URDF)
    return place


def test_a_consistent_robot_and_a_fit_that_begins_with_it(forcegp, folder):
    done = forcegp(
        *("identify", "train.h5", "--model", "consistent", "--friction", "viscous,coulomb,offset"),
        *("--test", "test.h5", "--out", "found", "--json"),
        folder=folder,
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    kept = json.loads((folder / "found" / "identification.json").read_text())
    assert {name: value for name, value in told.items() if name not in ("run", "data")} == kept
    for data in ("training", "test"):
        before, after = kept[data]["before"]["force_rms"], kept[data]["after"]["force_rms"]
        assert (np.array(after) < 0.3 * np.array(before)).all()
    assert kept["parameters"]["coulomb.pan"]["identified"] == pytest.approx(0.8, abs=0.2)
    test = Dataset.load(folder / "test.h5")
    system = MechanicalSystem.from_json((folder / "found" / "system.json").read_text())
    force, _ = motion_residuals(test, system)
    np.testing.assert_allclose(np.sqrt((force**2).mean(0)), kept["test"]["after"]["force_rms"], rtol=1e-9)
    assert any(isinstance(known, ConstantJointForce) for known in system.known_forces)
    robot = Robot.from_urdf(folder / "found" / "identified.urdf")
    q = torch.zeros(3).double()
    whole = system.mass_matrix(system.robot.kinematics(q))  # with the rotors that were found
    torch.testing.assert_close(robot.mass_matrix(q), whole)
    text = (folder / "found" / "identified.urdf").read_text()
    assert all(f"{link}: {count:.0f}" in text for link, count in kept["weak"].items())
    assert not kept["weak"] or "the log holds nothing of" in text
    assert robot.joint("pan").friction == kept["parameters"]["coulomb.pan"]["identified"]
    config = json.loads((folder / "found" / "config.json").read_text())
    assert sorted(config["files"]) == sorted(file.name for file in (folder / "found").iterdir())
    assert config["options"]["model"] == "consistent"


def test_the_report_and_least_squares_that_belong_to_no_robot(forcegp, folder):
    done = forcegp(
        *("identify", "free.h5", "--model", "least-squares", "--prior-strength", 1e-4, "--out", "numbers"),
        folder=folder,
    )
    assert done.returncode == 0, done.stderr
    assert "no body has the inertia that least squares found" in done.stderr
    assert "--model consistent finds a robot" in " ".join(done.stderr.split())
    assert not (folder / "numbers" / "identified.urdf").exists()
    assert "coulomb [Nm]" in done.stdout
    assert "base parameters, condition number" in done.stdout
    assert "Directions of single bodies that the prior decides" in done.stdout
    assert "together it decides" in done.stdout  # of a fixed arm always some
    row = next(line for line in done.stdout.splitlines() if line.split()[:1] == ["hand"])
    assert re.search(r"\d ± \S+( +-?\d+\.\d ± \S+,?){3} +\d+ of 10", row), row


def test_a_prior_of_processes_is_refused(forcegp, folder):
    done = forcegp("identify", "free.h5", "--model", "consistent", "--prior", "joint", "--out", "x", folder=folder)
    assert done.returncode == 2
    assert "--prior means nothing to --model consistent" in done.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--model consistent --learn hand:mass", "--learn means nothing to --model consistent"),
        ("--model least-squares --likelihood acceleration", "inertias='consistent'"),
        ("--model consistent --friction sticky", "out of viscous, coulomb, stribeck, load, direction, offset"),
        ("--model consistent --prior-strength 0", "must be > 0"),
        ("--model structured", "nothing to estimate; add --learn"),
    ],
)
def test_choices_that_make_no_sense(folder, monkeypatch, capsys, words, said):
    from forcegp.cli.main import main

    monkeypatch.chdir(folder)
    assert main(["identify", "train.h5", "--out", "no", *words.split()]) == 2
    assert said in capsys.readouterr().err
    assert not (folder / "no").exists()
