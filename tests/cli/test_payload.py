"""`forcegp payload`, and the fit that it stands for."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.fit.test_payload import CENTER, MASS, TEXT, Found, loaded, log
from tests.goldens.compare import assert_unchanged

from forcegp import Dataset, Model, Payload, Robot
from forcegp.cli.payload import other_causes, payload_text, without_explained
from forcegp.doubts import Doubts, look, wrong
from forcegp.simulation import QuadrotorConfig, simulate_quadrotor


@pytest.mark.parametrize(
    ("half", "far", "told"),
    [
        (0.01, 0.008, "0.5 ± 0.01 kg at (20, 0, 50) mm of hand, if the URDF's links are right"),
        (0.01, 0.015, "0.5 ± 0.01 kg at (20, 0, 50 ± 15) mm of hand, if the URDF's links are right"),
        (0.2, 0.008, "0.5 ± 0.2 kg at (20, 0, 50) mm of hand, if the URDF's links are right"),
        (0.2, 1.1, "0.5 ± 0.2 kg at (20, 0, ?) mm of hand, if the URDF's links are right"),
        (0.27, 0.008, "none, or 0.5 ± 0.3 kg"),  # three to four standard errors were none in logs of cogging, or stops
        (1.1, 0.015, "none, or at most 1.6 kg"),
        (1.7, 0.015, "not known from this log (0.5 ± 2 kg)"),
    ],
)
def test_what_is_hardly_known_of_a_payload_is_said(half, far, told):
    names = "mass", *(f"center_of_mass.{axis}" for axis in "xyz")
    numbers = zip(names, (0.5, 0.02, 0.0, 0.05), (half, 0.001, 0.001, far), strict=True)
    each = {
        f"payload.{name}": SimpleNamespace(value=value, std=error / 2.0, interval=(value - error, value + error))
        for name, value, error in numbers
    }
    hand = '<link name="hand"><inertial><mass value="5"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    joint = '<joint name="j" type="continuous"><parent link="base"/><child link="hand"/></joint>'
    robot = Robot.from_urdf_text(f'<robot name="r"><link name="base"/>{hand}</inertial></link>{joint}</robot>')
    assert payload_text(SimpleNamespace(estimates=each, model=Model(robot, (), (Payload("hand", 0.5),)))) == told


@pytest.mark.parametrize(("carried", "noise"), [(True, 0.0), (True, 0.05), (False, 0.0)])
def test_a_payload_takes_back_factors_of_joints_that_it_explains(carried, noise):
    """Not those of a joint of which more than .5 % of the torque stays, nor what is wrong for sure."""
    data, one = log(loaded() if carried else TEXT, 1, noise=0.02), np.arange(6) == 2
    data = replace(data, u=data.u * (1.0 + noise * one * np.sin(9.0 * data.time[:, None])))
    found = Found(data, rows=400).posterior
    told = {"about": "torque constant", "what": "w.", "do": "d.", "joints": ("elbow_joint",)}
    left = without_explained(Doubts(kind(**told) for kind in (look, wrong)), found, data)
    assert [each.level for each in left] == (["wrong"] if carried and not noise else ["wrong", "look"])


def test_a_base_that_moves_has_no_factors_of_joints():
    flight = simulate_quadrotor(QuadrotorConfig(seconds=1.0, seed=1))
    found = SimpleNamespace(model=flight.model, estimates={"payload.mass": SimpleNamespace(value=1.0, std=0.01)})
    doubts = Doubts([look(about="masses", what="w.", do="d.", joints=("arm",))])
    assert [*without_explained(doubts, found, flight)] == [*doubts]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("payload")
    log(loaded(), 1, noise=0.02).save(place / "loaded.h5")
    log(TEXT, 2, noise=0.02).save(place / "empty.h5")
    return place


WORDS = ("payload", "loaded.h5", "--cutoff", "none", "--delay", 0)


@pytest.fixture(scope="module")
def held(folder, forcegp):
    return forcegp(*WORDS, "--out", "held", "--json", folder=folder).ok()


def require_mass(content):
    assert content["parameters"]["payload.mass"]["value"] == pytest.approx(MASS, rel=0.01)
    low, high = content["parameters"]["payload.mass"]["interval_95"]
    assert low < content["parameters"]["payload.mass"]["value"] < high


def test_the_payload_is_printed_and_written(folder, forcegp, held):
    content = json.loads(held.stdout)
    require_mass(content)
    assert_unchanged("cli/payload", {name: each["value"] for name, each in content["parameters"].items()}, rtol=1e-2)
    assert "mean nothing" not in " ".join(held.stderr.split())
    written = folder / "held"
    assert json.loads((written / "payload.json").read_text())["link"] == "tool0"
    assert Robot.from_urdf(written / "loaded.urdf").link("tool0").mass == pytest.approx(MASS, rel=0.01)
    assert forcegp(*WORDS, "--out", "held", folder=folder).returncode == 2  # the folder exists
    checked = forcegp("check", "loaded.h5", "--identified", written, "--json", folder=folder)
    assert "payload" not in {each["about"] for each in json.loads(checked.stdout)["doubts"]}


LIGHT = ("--forces", "viscous,coulomb,offset,rotor")  # laws that are found sooner


@pytest.mark.nightly
def test_a_baseline_replaces_the_robot_file_and_people_see_millimetres(folder, forcegp):
    shown = forcegp(*WORDS, *LIGHT, "--baseline", "empty.h5", "--out", "both", folder=folder).ok()
    content = json.loads((folder / "both" / "payload.json").read_text())
    assert content["baseline"]
    require_mass(content)
    mass = re.search(r"mass\s+\S+\s+(\S+)\s+\S+ … \S+\s+kg", shown.stdout)
    place = re.search(r"center_of_mass.z\s+\S+\s+(\S+)\s+\S+ … \S+\s+mm", shown.stdout)
    assert float(mass[1]) == pytest.approx(MASS, rel=0.01)
    assert float(place[1]) == pytest.approx(1e3 * CENTER[2], abs=2.0)


@pytest.mark.nightly
def test_a_load_that_was_weighed_calibrates_the_drives(folder, forcegp):
    """Torques 12 % too large: another log's mass is right with the gains of the first, whose file is no robot's."""
    for name in ("loaded", "empty"):
        data = Dataset.load(folder / f"{name}.h5")
        replace(data, u=1.12 * data.u).save(folder / f"{name}_off.h5")
    known = ("payload", "loaded_off.h5", "--cutoff", "none", "--delay", 0, "--mass", MASS, "--out", "calibrated")
    forcegp(*known, folder=folder).ok()
    other = ("payload", "loaded_off.h5", "--cutoff", "none", "--delay", 0, "--identified", "calibrated", "--json")
    found = json.loads(forcegp(*other, folder=folder).stdout)
    require_mass(found)
    assert found["conditional_on"] == "masses of the URDF"
    assert found["parameters"]["gain.elbow_joint"]["value"] == pytest.approx(1.0 / 1.12, rel=0.01)
    both = forcegp(*WORDS, "--baseline", "empty.h5", "--forces", "gain,viscous,offset", folder=folder)
    both.refused("only their products are known")


def test_a_payload_that_may_be_none_has_no_place(folder, forcegp):
    """Its mass is a positive number with an interval around 0; the warning stands with that alone."""
    nothing = forcegp("payload", "empty.h5", *WORDS[2:], *LIGHT, "--json", folder=folder)
    low, high = json.loads(nothing.stdout)["parameters"]["payload.mass"]["interval_95"]
    assert low <= 0.0 < high
    assert "centre of mass and inertia mean nothing" in " ".join(nothing.stderr.split())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("payload nothing.h5", "nothing.h5 is not a file"),
        ("payload loaded.h5 --link tool9", "tool9"),
        ("payload loaded.h5 --cutoff high", "--cutoff is 'high'"),
        ("payload loaded.h5 --mass 1e300", "--mass is 1e+300; give kg, above 0 and below 1e+09"),
        ("payload loaded.h5 --cutoff none --delay 0 --forces gp:joint", "would hide a payload; name laws"),
    ],
)
def test_what_cannot_be_is_one_line(folder, forcegp, words, message):
    forcegp(*words.split(), folder=folder).refused(message)


def test_causes_of_so_many_factors_that_nobody_can_look_for_them_are_not_in_the_answer():
    numbers = *({"gains": dict.fromkeys(joints, 1.1)} for joints in ("abc", "abcd")), {"masses": {"a": 1, "b": 2}}
    few, many, masses = ({"about": "payload", "what": "so.", "do": "Look.", "numbers": each} for each in numbers)
    mass = {"payload.mass": {"value": 0.1, "std": 0.2}}  # none: of lengths and masses just one is told beside it
    assert other_causes({"doubts": [few, masses], "parameters": mass}) == {"gains": "so. Look."}
    one = {**masses, "numbers": {"masses": {"a": 1.1}}}
    assert (
        other_causes({"doubts": [masses]})
        == {"masses": "so. Look."}
        == other_causes({"doubts": [one], "parameters": mass})
    )
    assert other_causes({"doubts": [many, {**few, "about": "torque sensor"}]}) == other_causes({}) == {}
