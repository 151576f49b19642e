"""Forces by themselves and other systems, on the command line: files of a small arm."""

import dataclasses
import json
import re

import numpy as np
import pytest
from tests.evaluation.friction import friction_data
from tests.posterior.arm import URDF, arm_model

from forcegp import Dataset, evaluate, load_posterior
from forcegp.cli.main import main
from forcegp.evaluation import force_scores
from forcegp.mechanics import Contact, Plane
from forcegp.robots import Robot

PNG = b"\x89PNG\r\n\x1a\n"
QUICK = ("--points", "30", "--iterations", "25", "--restarts", "1")


def other_system():
    """The same arm with a heavier hand, on a lower, level plane."""
    robot = Robot.from_urdf_text(URDF.replace('mass value="0.6"', 'mass value="1.2"'))
    return arm_model().with_robot(robot).with_contacts([Contact("hand", (0.0, 0.0, 0.2), Plane((0.0, 0.0, 1.0), 0.3))])


@pytest.fixture(scope="module")
def arm(forcegp, tmp_path_factory):
    """A folder with train.h5, test.h5, other.h5 (another robot and plane) and the model `run` with joint friction."""
    folder = tmp_path_factory.mktemp("arm")
    friction_data(60, seed=0).save(folder / "train.h5")
    friction_data(50, seed=1).save(folder / "test.h5")
    other = friction_data(50, seed=2, model=other_system())
    # friction_data knows the tool's friction on its own plane only
    dataclasses.replace(other, truth={"a": other.truth["a"], "lambda": other.truth["lambda"]}).save(folder / "other.h5")
    words = ("--forces", "gp:joint-friction,gp:contact-friction:kernel=linear", *QUICK)
    fitted = forcegp("fit", "train.h5", *words, "--out", "run", folder=folder)
    assert fitted.returncode == 0, fitted.stderr
    return folder


def test_every_force_that_the_truth_knows_is_scored_and_drawn(arm, forcegp, tmp_path):
    figures = tmp_path / "figures"
    done = forcegp("evaluate", "run", "test.h5", "--plots", figures, "--json", folder=arm)
    assert done.returncode == 0, done.stderr
    scores = json.loads(done.stdout)
    expected = force_scores(load_posterior(arm / "run"), Dataset.load(arm / "test.h5"))
    assert list(scores["forces"]["joint_force"]) == ["joint-friction", "contact-friction"]
    for name, score in expected.joint_force.items():
        assert scores["forces"]["joint_force"][name]["relative_rmse"] == pytest.approx(score.relative_rmse, rel=1e-6)
    told = scores["forces"]["multiplier"]
    assert told["relative_rmse"] == pytest.approx(expected.multiplier.relative_rmse, rel=1e-6)
    assert told["mae"] == pytest.approx(scores["multiplier_mae"], rel=1e-6)
    assert scores["normal_force_rests_on_prior"] is False
    assert scores["system"] == "model"
    pictures = {"prediction.png", "forces.png", "normal_force.png"}
    assert {file.name for file in figures.iterdir()} == pictures | {"evaluation.json", "config.json", "SHA256SUMS"}
    assert all((figures / name).read_bytes().startswith(PNG) for name in pictures)


def test_the_table_tells_errors_of_forces_and_what_the_normal_force_rests_on(arm, forcegp, tmp_path):
    done = forcegp("evaluate", "run", "test.h5", folder=arm)
    assert done.returncode == 0, done.stderr
    told = " ".join(done.stdout.split())
    for name in ("joint-friction, at the joints", "contact-friction, at the joints", "contact-friction, at its point"):
        assert re.search(rf"{name} RMS error \S+ %, \S+ % in the 95 % band", told), told
    assert re.search(r"multiplier\) MAE \S+ N, RMS error \S+ %, \S+ % in the 95 % band; this prior leaves no", told)
    assert "rest on the prior alone" not in told

    words = ("fit", arm / "train.h5", "--forces", "gp:joint-friction,gp:joint", *QUICK, "--out", tmp_path / "joint")
    assert forcegp(*words).returncode == 0
    done = forcegp("evaluate", tmp_path / "joint", "test.h5", folder=arm)
    assert "forces along the contact normal rest on the prior alone" in " ".join(done.stdout.split())


def test_another_robot_and_contact_are_named_with_the_remedy_and_the_remedy_helps(arm, forcegp):
    default = forcegp("evaluate", "run", "other.h5", "--json", folder=arm)
    assert default.returncode == 0, default.stderr
    (warning,) = [each for each in json.loads(default.stdout)["warnings"] if "not those of the data" in each]
    assert warning.startswith("the contacts and robot of the model are not those of the data")
    assert "--system data" in warning
    assert [line for line in default.stderr.splitlines() if "--system data" in line] == [f"warning: {warning}"]

    there = forcegp("evaluate", "run", "other.h5", "--system", "data", "--json", folder=arm)
    assert there.returncode == 0, there.stderr
    scores, before = json.loads(there.stdout), json.loads(default.stdout)
    assert scores["system"] == "data"
    assert not any("not those of the data" in each for each in scores["warnings"])
    assert scores["mae_noise_free"] < 0.2 * before["mae_noise_free"]
    assert scores["constraint_error"] < 1e-9 < before["constraint_error"]
    data = Dataset.load(arm / "other.h5")
    expected = evaluate(load_posterior(arm / "run").with_model(data.model), data)
    np.testing.assert_allclose(scores["mae_per_joint"], expected.mae_per_joint, rtol=1e-6)
    shown = forcegp("evaluate", "run", "other.h5", "--system", "data", folder=arm)
    assert "carried to another robot or contacts" in " ".join(shown.stdout.split())


def test_rollouts_move_to_the_system_of_the_recording(arm, forcegp, tmp_path):
    words = ("rollout", "run", "other.h5", "--start-rows", "0", "--seconds", "0.05")
    default = forcegp(*words, "--out", tmp_path / "model", "--json", folder=arm)
    assert default.returncode == 0, default.stderr
    assert "--system data" in default.stderr
    there = forcegp(*words, "--out", tmp_path / "data", "--system", "data", "--json", folder=arm)
    assert there.returncode == 0, there.stderr
    assert "--system data" not in there.stderr
    ends = [json.loads(done.stdout)["constraint_max"] for done in (default, there)]
    assert ends[1] < 0.2 * ends[0]  # the recorded states lie on the other plane
    assert json.loads((tmp_path / "data" / "config.json").read_text())["options"]["system"] == "data"


def refused(words, capfd) -> str:
    """The one line that `forcegp` refuses these words with."""
    assert main([str(word) for word in words]) == 2
    captured = capfd.readouterr()
    assert captured.out == ""
    lines = [line for line in captured.err.splitlines() if line.startswith("forcegp: ")]
    assert len(lines) == 1
    return lines[0]


def test_what_cannot_move_is_refused_in_one_line(arm, forcegp, tmp_path, capfd):
    fitted = forcegp("fit", "train.h5", "--forces", "gp:independent", *QUICK, "--out", tmp_path / "gp", folder=arm)
    assert fitted.returncode == 0, fitted.stderr
    told = refused(("evaluate", tmp_path / "gp", arm / "other.h5", "--system", "data"), capfd)
    assert "cannot move to another" in told
    dataclasses.replace(Dataset.load(arm / "test.h5"), model=None).save(tmp_path / "bare.h5")
    told = refused(("evaluate", arm / "run", tmp_path / "bare.h5", "--system", "data"), capfd)
    assert "the data carry no robot" in told
    assert "--system" in refused(("evaluate", arm / "run", arm / "test.h5", "--system", "moon"), capfd)


def test_a_robot_that_was_identified_stays_and_takes_the_contacts_of_the_data(arm, forcegp, tmp_path):
    words = ("fit", "train.h5", "--forces", "rigid-bodies:learn=hand,gp:joint-friction", *QUICK)
    done = forcegp(*words, "--out", tmp_path / "found", "--json", folder=arm)
    assert done.returncode == 0, done.stderr
    same = forcegp("evaluate", tmp_path / "found", "test.h5", "--json", folder=arm)
    # another mass is what was asked for
    assert not any("of the data" in each for each in json.loads(same.stdout)["warnings"])
    moved = forcegp("evaluate", tmp_path / "found", "other.h5", "--system", "data", "--json", folder=arm)
    assert moved.returncode == 0, moved.stderr
    assert "the robot stays the identified one" in moved.stderr
    data, found = Dataset.load(arm / "other.h5"), load_posterior(tmp_path / "found")
    expected = evaluate(found.with_contacts(data.model.contacts), data)
    np.testing.assert_allclose(json.loads(moved.stdout)["mae_per_joint"], expected.mae_per_joint, rtol=1e-6)
