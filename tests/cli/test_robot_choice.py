"""The options that choose a robot: as objects, and as words."""

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.posterior.arm import URDF, arm_data, arm_model
from tests.robots.test_robot_file import BROKEN

from forcegp.cli.main import parse_arguments
from forcegp.cli.robot_options import SYSTEM_FILE
from forcegp.data import Dataset
from forcegp.errors import ForceGPError
from forcegp.forces import Coulomb
from forcegp.model import Model
from forcegp.robots import Robot


def options(*words: str):
    return parse_arguments(["fit", "log.h5", "--out", "run", *words]).robot


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """arm.urdf, broken.urdf, a pipe, recorded.h5, system.json with friction."""
    folder = tmp_path_factory.mktemp("robots")
    (folder / "arm.urdf").write_text(URDF)
    (folder / "broken.urdf").write_text(BROKEN)
    os.mkfifo(folder / "pipe")
    arm_data(20, 0, arm_model(0)).save(folder / "recorded.h5")
    model = arm_model(0)
    (folder / SYSTEM_FILE).write_text(replace(model, forces=(*model.forces, Coulomb([0.1, 0.2, 0.3]))).to_json())
    return folder


def test_every_option_reaches_the_robot(folder):
    words = "--robot", str(folder / "arm.urdf"), "--armature", "pan=0.5", "--gravity", "0,1,-9", "--lock", "bend=0.3"
    chosen = options(*words).chosen().robot
    assert chosen.joint_names == ("pan", "lift")
    assert chosen.locked == {"bend": 0.3}
    assert (chosen.armature.tolist(), chosen.gravity.tolist()) == ([0.5, 0.0], [0.0, 1.0, -9.0])


def test_what_no_urdf_holds_stays_as_recorded(folder):
    recorded = Model(Robot.from_urdf_text(URDF, gravity=(0.0, 0.0, -1.6), armature=[0.1, 0.2, 0.3]))
    words = "--robot", str(folder / "arm.urdf")
    same = options(*words).chosen(recorded).robot
    assert (same.gravity.tolist(), same.armature.tolist()) == ([0.0, 0.0, -1.6], [0.1, 0.2, 0.3])
    for given in (words, ()):  # also without another URDF
        other = options(*given, "--armature", "lift=0.9", "--gravity", "0,0,-9.81").chosen(recorded).robot
        assert other.gravity.tolist() == [0.0, 0.0, -9.81]
        assert other.armature.tolist() == [0.1, 0.9, 0.3]
    assert options().chosen(recorded) is recorded
    assert options().chosen() is None


def test_an_identified_system_brings_its_forces_and_keeps_the_contacts_of_the_data(folder):
    data = arm_data(5, 1)
    for given in (folder, folder / SYSTEM_FILE):
        model = options("--identified", str(given)).chosen_model(data, folder / "log.h5")
        np.testing.assert_array_equal(model.forces[-1].level, [0.1, 0.2, 0.3])
        assert model.contacts == data.model.contacts
        np.testing.assert_array_equal(options("--identified", str(given)).chosen().forces[-1].level, [0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        *(("--robot arm.urdf --gravity 0,0", "holds 2 numbers"), ("--robot arm.urdf --lock pan", "is not JOINT=RAD")),
        ("--robot arm.urdf --gravity 0,0,down", "is no list of numbers"),
        ("--robot arm.urdf --lock pan=nan", "'nan' is not a finite number"),
        ("--robot arm.urdf --lock pan=1e308", "'1e308' is not a finite number of at most 1e+09"),
        ("--robot arm.urdf --armature pan=1,pan=2", "names pan twice"),
        *(("--robot arm.urdf --armature elbow=1", "elbow"), ("--robot arm.urdf --lock elbow=1", "elbow")),
        ("--robot arm.urdf --identified .", "leave --robot out"),
        ("--robot arm.urdf --lock bend=0", "has joints pan, lift; recorded.h5 has pan, lift, bend"),
        ("--identified nowhere", "give a folder that `forcegp fit` wrote"),
        ("--identified pipe", "it is not a regular file"),  # to open it would wait for a writer for ever
    ],
)
def test_mistakes_are_told(folder, monkeypatch, words, said):
    monkeypatch.chdir(folder)
    data = Dataset.load("recorded.h5")
    with pytest.raises(ForceGPError, match=re.escape(said)):
        options(*words.split()).chosen_model(data, Path("recorded.h5"))
