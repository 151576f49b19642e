"""`forcegp fit`: forces and evidence by name, what is written and printed, and what is refused."""

import json
import math
import re

import numpy as np
import pytest
import torch
from tests.cli.one_line import assert_refused
from tests.fit.test_motion_fit import line, recording
from tests.goldens.compare import assert_unchanged, numbers_in
from tests.posterior.arm import arm_data
from tests.simulation.pendulum import double_pendulum

from forcegp import Dataset, JointFriction, Model, Robot, Viscous, load_posterior
from forcegp.cli.fit import estimates_table
from forcegp.evidence import motion_residuals
from forcegp.posterior import Estimate

JOINTS = ("upper_hinge", "lower_hinge")
QUICK = ("--points", 12, "--iterations", 5, "--restarts", 1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """pendulum.h5 and test.h5 with dry friction of 0.4 Nm and viscous friction of 0.2 Nms; arm.h5."""
    place = tmp_path_factory.mktemp("fit")
    for name, seed, seconds in (("pendulum", 1, 10.0), ("test", 2, 3.0)):
        double_pendulum(seconds, seed, noise=0.05).rows(slice(None, None, 4)).save(place / f"{name}.h5")
    arm_data(40, seed=0).save(place / "arm.h5")
    return place


@pytest.fixture(scope="module")
def identified(forcegp, folder):
    """What fit prints of laws and bodies, which it wrote into `found`."""
    words = ("fit", "pendulum.h5", "--forces", "bodies,viscous,coulomb,offset", "--evidence", "torques")
    return forcegp(*words, "--out", "found", folder=folder).ok()


def test_laws_and_bodies_are_estimated(identified, folder):
    kept = json.loads((folder / "found" / "estimates.json").read_text())
    for joint in JOINTS:
        assert kept["parameters"][f"coulomb.level.{joint}"]["value"] == pytest.approx(0.4, rel=0.2)
        assert kept["parameters"][f"viscous.{joint}"]["value"] == pytest.approx(0.2, abs=0.1)
    assert kept["evidence"] == "torques"
    values = [each["value"] for each in kept["parameters"].values()]
    assert_unchanged("cli/fit", {"kept": values, "shown": numbers_in(identified.stdout)}, rtol=1e-2)
    assert kept["settled"]
    posterior = load_posterior(folder / "found")
    assert posterior.parameters["viscous.upper_hinge"].value == kept["parameters"]["viscous.upper_hinge"]["value"]
    model, test = Model.from_json((folder / "found" / "system.json").read_text()), Dataset.load(folder / "test.h5")
    before, after = (np.sqrt((motion_residuals(test, each)[0] ** 2).mean(0)) for each in (test.model, model))
    assert (after < 0.3 * before).all()
    robot, q = Robot.from_urdf(folder / "found" / "identified.urdf"), torch.zeros(2).double()
    torch.testing.assert_close(robot.mass_matrix(q), model.robot.mass_matrix(q))
    assert robot.joint("upper_hinge").friction == kept["parameters"]["coulomb.level.upper_hinge"]["value"]
    config = json.loads((folder / "found" / "config.json").read_text())
    assert sorted(config["files"]) == sorted(file.name for file in (folder / "found").iterdir())
    assert config["kind"] == "forcegp fit"
    assert config["options"]["forces"] == ["bodies", "viscous", "coulomb", "offset"]
    assert config["resolved"]["evidence"] == "torques"


def test_the_table_of_estimates_is_for_people(identified):
    rows = identified.stdout.splitlines()
    pattern = r"\s+(level\.)?upper_hinge\s+-?\d+\.\d+\s+(-?\d+\.\d+)\s+-?\d+\.\d+ … -?\d+\.\d+\s+\S.*(log|prior)\s*"
    values = [float(found[2]) for row in rows if (found := re.fullmatch(pattern, row))]
    assert any(value == pytest.approx(0.4, rel=0.2) for value in values), identified.stdout
    assert "Next: forcegp score found TEST.h5" in " ".join(identified.stdout.split())


def test_functions_beside_what_was_identified(forcegp, folder, identified):
    words = ("fit", "pendulum.h5", "--identified", "found", "--forces", "gp:joint-friction", "--noise", "learned")
    done = forcegp(*words, *QUICK, "--out", "beside", "--json", folder=folder).ok()
    assert json.loads(done.stdout)["points"] == 12
    assert "forces: actuation, rigid-bodies, viscous, coulomb, offset" in done.stderr
    posterior = load_posterior(folder / "beside")
    assert isinstance(posterior.model.unknown_forces[0], JointFriction)
    assert any(isinstance(law, Viscous) for law in posterior.model.laws)


@pytest.mark.parametrize(
    ("forces", "description"),
    [
        ("gp:joint", "analytical mean"), ("only,gp:joint", "zero mean"),
        ("only,gp:joint-accelerations", "unconstrained accelerations, zero mean"), ("none", "analytical model"),
        ("gp:independent", "independent"),
    ],
)  # fmt: skip
def test_models_by_name(forcegp, folder, forces, description):
    out = re.sub(r"\W", "-", forces)
    done = forcegp("fit", "arm.h5", "--forces", forces, *QUICK, "--out", out, "--json", folder=folder).ok()
    assert description in json.loads(done.stdout)["model"].lower()
    scored = forcegp("score", out, "arm.h5", "--every", 4, "--json", folder=folder).ok()
    black_box = forces == "gp:independent"
    (model,) = json.loads(scored.stdout)["models"].values()
    assert (model["scores"]["constraint"]["mae"]["all"]["median"] > 1e-6) == black_box


@pytest.mark.nightly
def test_motions_refine_what_was_found(forcegp, folder):
    """A cart with friction of 3 Ns/m and 4 N, whose model has 1 and 1."""
    recording(line, 1, seconds=4.0).save(folder / "cart.h5")
    words = ("fit", "cart.h5", "--forces", "viscous,coulomb", "--evidence", "torques,motions:.5:bodies=false")
    done = forcegp(*words, "--out", "moved", folder=folder).ok()
    assert "7 windows of 0.5 s, whose initial states" in " ".join(done.stdout.split())
    posterior = load_posterior(folder / "moved")
    assert posterior.settings["motions"]["seconds"] == 0.5
    assert posterior.parameters["coulomb.level.x"].value == pytest.approx(4.0, rel=0.05)


def test_the_engine_is_said_and_stored(forcegp, folder):
    done = forcegp("fit", "arm.h5", *QUICK, "--engine", "inducing", "--out", "inducing", folder=folder).ok()
    assert "inducing: as asked for" in done.stdout
    assert load_posterior(folder / "inducing").engine.name == "inducing"


WRONG = [
    ("--forces jont", "no force 'jont' in 'jont'"),
    ("--forces none,viscous", "forces are none and viscous; leave one of both out"),
    ("--forces gp:independent,viscous", "no other force can stand beside it"),
    ("--forces gp:joint --evidence torques", "functions are learned from accelerations"),
    ("--forces viscous --evidence acceleration", "did you mean 'accelerations'?"),
    ("--evidence torques,accelerations --forces viscous", "the same rows twice"),
    ("--forces gp:independent --evidence motions:1", "motions refine numbers of laws and bodies"),
    *(("--jobs 0", "jobs is 0; give"), ("--engine fast", "engine")),
]


@pytest.mark.parametrize(("words", "message"), WRONG)
def test_what_makes_no_sense_is_one_line(folder, monkeypatch, capfd, words, message):
    monkeypatch.chdir(folder)
    assert_refused(f"fit arm.h5 {words} --noise 0.1 --no-checks --out new", message, folder, capfd)


def test_decimals_show_two_digits_of_the_interval():
    cases = {"a": (0.123456, 0.0123), "b": (12.3456, 1.23), "c": (1234.56, 123.0), "d": (2.0, 0.0), "e": (0.0, 0.0)}
    entries = {k: Estimate(k, "1", value, std, value, math.inf, "log", "") for k, (value, std) in cases.items()}
    shown = [str(cell) for cell in estimates_table("", entries).columns[2].cells if str(cell)]
    assert shown == ["0.123", "12.3", "1235", "2.0000", "0.0000"]
