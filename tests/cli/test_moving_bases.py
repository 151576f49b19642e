"""Regression, payload and `forcegp auto` of robots whose base moves, from end to end."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from tests.fit.test_identified_moving_bases import FEET, recorded
from tests.robots.test_moving_bases import LIMBS

from forcegp import Dataset, Robot, load_posterior
from forcegp.data.views import decided
from forcegp.evidence.bodies import body_pseudo_inertias, carrying, with_bodies
from forcegp.forces import Coulomb
from forcegp.model import Model
from forcegp.simulation.moving_bases import simulate_quadrotor, simulate_quadruped
from forcegp.simulation.scenarios import QuadrotorConfig, QuadrupedConfig

COLUMNS = ("--time", "t", "--q", "x,y,z,qx,qy,qz,qw", "--v", "v{1..6}", "--u", "rotor_{1..4}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Rows of a walker that carries 1.6 times its trunk, and the log of a drone in calm air with its system."""
    place, walker = tmp_path_factory.mktemp("moving"), Model(Robot.from_urdf_text(LIMBS, base="floating"), FEET)
    heavier = body_pseudo_inertias(walker.robot).numpy() * np.array([1.6, 1.0, 1.0, 1.0])[:, None, None]
    known = (*walker.forces, Coulomb(0.5, 0.2))
    truth = replace(
        walker, robot=with_bodies(walker.robot, dict(zip(carrying(walker.robot), heavier, strict=True))), forces=known
    )
    replace(recorded(truth, 300, noise=1e-3), model=walker).save(place / "walk.h5")
    flight = simulate_quadrotor(QuadrotorConfig(seconds=6.0, seed=1, wind=0.0, noise=0.0))
    names = ["t", *["x", "y", "z", "qx", "qy", "qz", "qw"], *(f"v{k}" for k in range(1, 7)), *flight.model.inputs]
    table = np.column_stack([flight.time, flight.q, flight.v, flight.u])
    np.savetxt(place / "flight.csv", table, "%.9g", ",", header=",".join(names), comments="")
    (place / "drone.json").write_text(flight.model.to_json())
    dog = simulate_quadruped(QuadrupedConfig(seconds=3.0, seed=1))
    columns = {"q": dog.q, "v": dog.v, "u": dog.u[:, :12]}
    names = ["t", *(f"{name}{k}" for name, x in columns.items() for k in range(x.shape[1]))]
    table = np.column_stack([dog.time, *columns.values()])
    np.savetxt(place / "dog.csv", table, "%.9g", ",", header=",".join(names), comments="")
    np.save(place / "stands.npy", np.column_stack([dog.time, dog.u[:, 12:]]))
    (place / "dog.urdf").write_text(dog.model.robot.urdf_text)
    return place


@pytest.mark.nightly
def test_a_walker_is_identified_and_a_fit_begins_with_it(folder, forcegp):
    words = ("fit", "walk.h5", "--forces", "bodies,viscous,coulomb,rotor", "--out", "found")
    content = json.loads(forcegp(*words, "--json", folder=folder).ok().stdout)
    bodies = body_pseudo_inertias(Robot.from_urdf_text(LIMBS, base="floating")).numpy()[:, 3, 3]
    masses = [each["value"] for name, each in content["estimates"].items() if name.endswith(".mass")]
    assert sum(masses) == pytest.approx(bodies.sum() + 0.6 * bodies[0], rel=0.01)
    assert content["estimates"]["coulomb.level.a_hip"]["value"] == pytest.approx(0.5, abs=0.02)
    forcegp("fit", "walk.h5", "--identified", "found", "--forces", "gp:joint-friction", "--points", 30,
            "--restarts", 1, "--noise", 0.01, "--out", "run", folder=folder).ok()  # fmt: skip


@pytest.mark.nightly
def test_a_load_on_the_trunk(folder, forcegp):
    done = forcegp("payload", "walk.h5", "--cutoff", "none", "--forces", "coulomb", "--json", folder=folder).ok()
    trunk, content = Robot.from_urdf_text(LIMBS, base="floating").link("trunk"), json.loads(done.stdout)
    assert content["link"] == "trunk"
    assert content["parameters"]["payload.mass"]["value"] == pytest.approx(0.6 * trunk.mass, rel=0.05)


@pytest.mark.nightly
def test_auto_goes_from_a_flight_to_a_page(folder, forcegp):
    models = ("--forces", "given", "--cutoff", "none", "--lag", 0.06)
    done = forcegp("auto", "flight.csv", *COLUMNS, "--identified", "drone.json", *models, "--out", "answer", "--json",
                   folder=folder).ok()  # fmt: skip
    content = json.loads(done.stdout)
    answer = "\n".join(content["answer"])
    assert "a base that moves and 0 joints" in answer
    assert "u is taken to be on time: a delay is found" in answer
    assert "rotors follow within" in answer
    assert answer.count("thrust coefficients are right") == 1  # of the whole mass: there is no payload
    assert "payload: none" in answer
    assert "dry friction" not in answer
    assert "forcegp excite" not in answer
    masses = [each["value"] for name, each in content["identified"]["parameters"].items() if name.endswith(".mass")]
    assert sum(masses) == pytest.approx(1.2 * 1.02 / 1.1, rel=0.05)  # by thrust
    assert content["models"]["given"]["scores"]["position after 1 s"]["rmse"]["all"]["median"] > 0.0
    assert "whole mass" in (folder / "answer" / "report.html").read_text()
    flight = Dataset.load(folder / "answer" / "prepared.h5")
    a = load_posterior(folder / "answer" / "model").predict(flight.q, flight.v, flight.u).mean.numpy()
    assert np.abs(a - flight.a)[:, 2].mean() < np.abs(flight.a)[:, 2].std()


DOG = "import dog.csv --time t --q q{0..18} --v v{0..17} --u u{0..11} --out dog.h5 --overwrite"
LEGS = "front_left_foot", "front_right_foot", "rear_left_foot", "rear_right_foot"


def test_feet_whose_stance_no_column_states(folder, forcegp):
    words = (*DOG.split(), "--robot", "dog.urdf", "--base", "floating", "--feet", ",".join(LEGS))
    assert re.search(r"stance +front_left_foot_stands", forcegp(*words, folder=folder).ok().stdout)
    log, (time, *flags) = Dataset.load(folder / "dog.h5"), np.load(folder / "stands.npy").T
    assert log.model.inputs[12:] == tuple(f"{leg}_stands" for leg in LEGS)
    known = decided(log)  # others have a flag of .5
    for column, true in enumerate(flags, 12):
        np.testing.assert_array_equal(known.u[:, column], np.interp(known.time, time, true) > 0.5)
    assert 0.8 * len(time) < len(known) < len(log) == len(time)
    assert len(log.model.contacts) == 12


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (f"{DOG} --feet front_left_foot", "give --robot ARM.urdf, or --identified"),
        (f"{DOG} --feet front_left_foot --identified drone.json", "brings its contacts along; leave --feet out"),
        (f"{DOG} --robot dog.urdf --feet front_left_foot", "base='floating'"),
        ("auto flight.csv --out x", "give --robot ARM.urdf, or --identified"),
    ],
)
def test_what_cannot_be_is_one_line_before_the_work(folder, forcegp, words, message):
    forcegp(*words.split(), folder=folder).refused(message)
    assert not (folder / "x").exists()


def test_a_base_that_was_not_measured_is_told_what_to_record(tmp_path, forcegp):
    """And what can be learned without: doing so works."""
    (tmp_path / "hopper.urdf").write_text(LIMBS)
    joints, time = Robot.from_urdf_text(LIMBS, base="floating").single_joint_names, np.arange(200) / 100
    table = np.column_stack([time, *(np.sin((k + 1) * time) for k in range(2 * len(joints)))])
    names = ["t", *(f"q_{name}" for name in joints), *(f"u_{name}" for name in joints)]
    np.savetxt(tmp_path / "log.csv", table, "%.9g", ",", header=",".join(names), comments="")
    words = ("import", "log.csv", "--time", "t", "--q", "q_{joints}", "--u", "u_{joints}", "--robot", "hopper.urdf")
    refused = forcegp(*words, "--base", "floating", "--out", "log.h5", folder=tmp_path)
    told = refused.refused("was not measured: record its pose by motion capture")
    assert "on a stand: a robot with --base fixed" in told
    forcegp(*words, "--base", "fixed", "--beyond-limits", "--out", "log.h5", folder=tmp_path).ok()
