"""`forcegp identify` from end to end: what it writes, what it prints, and how it refuses."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.models.arm import NOISE, URDF, arm_data, arm_system

from forcegp import JointFriction, Robot, load_posterior
from forcegp.cli.main import main
from forcegp.mechanics import Actuation, RigidBodyBias, ViscousJointFriction
from forcegp.models.identification.physical_parameters import PhysicalParameters
from forcegp.robots import LinkInertia


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """arm.h5, whose system has a hand that is too heavy; the truth weighs 0.6 kg and has damping 0.3 Nms/rad."""
    place = tmp_path_factory.mktemp("identify")
    truth = arm_system(known_forces=(Actuation(), RigidBodyBias(), ViscousJointFriction(0.3)))
    data = arm_data(60, 3, truth)
    a = truth.dynamics(*(torch.tensor(x) for x in (data.q, data.v, data.u))).acceleration(torch.zeros(60, 3).double())
    noise = NOISE * np.random.default_rng(0).standard_normal((60, 3))
    heavy = PhysicalParameters.of(truth, LinkInertia("hand", ("mass",))).system_at(torch.tensor([0.3]).double())
    wrong = replace(heavy, known_forces=(Actuation(), RigidBodyBias()))
    replace(data, a=a.numpy() + noise, truth={}, system=wrong).save(place / "arm.h5")
    (place / "arm.urdf").write_text(URDF)
    (place / "mine").mkdir()
    (place / "mine" / "thesis.txt").write_text("years of work")
    return place


def test_the_whole_command(forcegp, folder):
    done = forcegp(
        *("identify", "arm.h5", "--learn", "hand:mass,com,viscous-joint-friction=0.1"),
        *("--model", "analytical", "--points", 50, "--out", "run"),
        folder=folder,
    )
    assert done.returncode == 0, done.stderr
    assert "viscous-joint-friction was not among the known forces" in done.stderr
    told = json.loads((folder / "run" / "identification.json").read_text())
    mass = told["parameters"]["hand.mass"]
    assert mass["start"] == pytest.approx(0.6 * np.exp(0.3))
    assert mass["identified"] == pytest.approx(0.6, abs=5 * mass["standard_error"])
    assert 0.0 < mass["standard_error"] < 0.05
    assert told["parameters"]["viscous-joint-friction.bend"]["identified"] == pytest.approx(0.3, abs=0.1)
    assert told["history"][0]["hand.mass"] == pytest.approx(mass["start"])
    robot = Robot.from_urdf(folder / "run" / "identified.urdf")
    assert robot.link("hand").mass == mass["identified"]
    posterior = load_posterior(folder / "run")
    assert posterior.system.robot.link("hand").mass == mass["identified"]
    assert len(posterior.system.known_forces) == 3
    config = json.loads((folder / "run" / "config.json").read_text())
    assert config["kind"] == "forcegp identify"
    assert sorted(config["files"]) == sorted(file.name for file in (folder / "run").iterdir())
    line = next(line for line in done.stdout.splitlines() if line.strip().startswith("mass"))
    assert re.fullmatch(r"\s+mass(\s+\d\.\d+){2}\s+\S+\s+\d\.\d+ … \d\.\d+\s+kg\s*", line)
    assert "The data identify every parameter that was learned." in done.stdout
    evaluated = forcegp("evaluate", "run", "arm.h5", "--json", folder=folder)
    assert evaluated.returncode == 0, evaluated.stderr


def test_what_is_not_identified_is_said_on_one_json_object(forcegp, folder):
    done = forcegp(
        *("identify", "arm.h5", "--learn", "upper:com", "--points", 20, "--model", "analytical", "--json"),
        *("--contact", "none", "--out", "weak"),
        folder=folder,
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["parameters"]["upper.com.z"]["standard_error"] is None
    assert "upper.com.z/r" in summary["verdict"]


def test_estimates_come_from_all_points_or_the_report_names_both_numbers(forcegp, folder):
    words = ("identify", "arm.h5", "--learn", "hand:mass", "--model", "analytical", "--points", 50)
    all_points = forcegp(*words, "--json", "--out", "all", folder=folder)
    assert json.loads(all_points.stdout)["learning_points"] == 50
    some = forcegp(*words, "--learning-points", 20, "--out", "some", folder=folder)
    assert "identified from 20 of 50 points" in " ".join(some.stdout.split())
    of_20 = forcegp(*words[:-1], 20, "--json", "--out", "few", folder=folder)
    told = json.loads((folder / "some" / "identification.json").read_text())
    assert told["parameters"] == json.loads(of_20.stdout)["parameters"]
    found = json.loads(all_points.stdout)["parameters"]["hand.mass"]
    assert found["standard_error"] < told["parameters"]["hand.mass"]["standard_error"]


def test_the_unknown_forces_are_of_the_prior_that_is_named(forcegp, folder):
    words = (
        "identify",
        "arm.h5",
        "--learn",
        "hand:mass",
        "--prior",
        "joint-friction",
        "--points",
        30,
        "--out",
        "friction",
    )
    done = forcegp(*words, folder=folder)
    assert done.returncode == 0, done.stderr
    posterior = load_posterior(folder / "friction")
    assert isinstance(posterior.model.prior, JointFriction)
    told = json.loads((folder / "friction" / "identification.json").read_text())["parameters"]["hand.mass"]
    assert told["identified"] == pytest.approx(0.6, abs=5 * told["standard_error"])


WRONG = [
    ("--learn hand:mass --model analytical --prior joint", "leave --prior out"),
    ("--learn hand:mass --prior jont", "no prior 'jont'"),
    ("--learn hnd:mass", "no link 'hnd' in arm; did you mean 'hand'?"),
    ("--learn hand:weight", "inertial parts mass, com, inertia, and 'weight' was asked of 'hand'"),
    ("--learn base:mass", "fixed in the world"),
    ("--learn hand", "--learn hand is not LINK:PARTS"),
    ("--learn armature", "armature is 0 for pan, lift, bend"),
    ("--learn armature=heavy", "'heavy' is not a number"),
    ("--learn armature:pn=0.1", "no joint 'pn' in arm; did you mean 'pan'?"),
    ("--learn hand:mass,hand:mass,com", "mass of 'hand' is named twice"),
    ("--learn hand:mass --model analytical --mean zero", "leave --mean zero out"),
    ("--learn hand:mass --prior-strength -1", "prior_strength is -1.0"),
    ("--learn hand:mass --noise loud", "--noise is 'loud'"),
    ("--learn hand:mass --points 1", "--points 1 must be"),
    ("--learn hand:mass --learning-points 1", "learning_points is 1"),
    ("", "nothing to estimate; add --learn"),
]


@pytest.mark.parametrize(("words", "message"), WRONG)
def test_errors_are_one_line(folder, monkeypatch, capsys, words, message):
    monkeypatch.chdir(folder)
    assert main(["identify", "arm.h5", *words.split(), "--out", "new"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert message in error
    assert not (folder / "new").exists()


def test_a_folder_of_others_is_not_replaced(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    words = ["identify", "arm.h5", "--learn", "hand:mass", "--out", "mine", "--overwrite"]
    assert main(words) == 2
    assert "was not written by `forcegp identify`" in capsys.readouterr().err


def test_a_massless_frame_is_named(folder, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(folder)
    joint = '<joint name="tip_joint" type="fixed"><parent link="hand"/><child link="tip"/></joint>'
    tip = f'<link name="tip"/>{joint}</robot>'
    (tmp_path / "tip.urdf").write_text(URDF.replace("</robot>", tip))
    words = ["identify", "arm.h5", "--robot", str(tmp_path / "tip.urdf"), "--learn", "tip:mass", "--out", "new"]
    assert main(words) == 2
    assert "massless frame" in capsys.readouterr().err
