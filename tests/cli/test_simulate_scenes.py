"""`forcegp simulate` with other friction, surfaces and contacts."""

import json

import pytest

from forcegp import Dataset
from forcegp.mechanics import Sphere


@pytest.mark.parametrize("arm", ["ur5-free", "double-pendulum"])
def test_free_arms_have_no_tool(forcegp, tmp_path, arm):
    made = forcegp("simulate", arm, "--seconds", 0.5, "--seed", 3, "--out", "log.h5", "--json", folder=tmp_path)
    assert made.returncode == 0, made.stderr
    data, config = Dataset.load(tmp_path / "log.h5"), json.loads(made.stdout)["config"]
    assert (len(data), config["arm"], config["seed"], config["joint_friction"]) == (120, arm, 3, "stribeck")
    assert data.metadata["scenario"] == arm
    refused = forcegp("simulate", arm, "--surface", "sphere", "--out", "no.h5", folder=tmp_path)
    assert refused.returncode == 2
    assert f"--surface means nothing to {arm}" in refused.stderr
    refused = forcegp("simulate", arm, "--joint-friction", "lugre", "--out", "no.h5", folder=tmp_path)
    assert refused.returncode == 2
    assert "lugre" in refused.stderr


@pytest.mark.nightly
def test_a_quadruped_moves_on_a_floating_base(forcegp, tmp_path):
    made = forcegp("simulate", "quadruped", "--seconds", 0.5, "--seed", 3, "--out", "log.h5", "--json", folder=tmp_path)
    assert made.returncode == 0, made.stderr
    data = Dataset.load(tmp_path / "log.h5")
    assert (len(data), data.q.shape[1], data.nv, data.u.shape[1]) == (120, 19, 18, 16)
    words = ("fit", "log.h5", "--forces", "gp:joint-friction", "--points", 25)
    words = (*words, "--restarts", 1, "--iterations", 20, "--out", "run")
    done = forcegp(*words, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    words = ("score", "run", "log.h5", "--every", 40, "--out", "plots")
    scored = forcegp(*words, folder=tmp_path)
    assert scored.returncode == 0, scored.stderr
    assert (tmp_path / "plots" / "normal_force.png").exists()
    found = forcegp("import", "log.h5", "--stance", "auto", "--out", "found.h5", folder=tmp_path)
    assert found.returncode == 0, found.stderr
    assert "front_left_stands 100%" in found.stdout
    flags = Dataset.load(tmp_path / "found.h5").u[:, 12:]
    assert len(flags) > 100
    assert (flags == 1.0).all()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("--tool-friction viscous:2.5", {"friction": "viscous", "viscous_coefficient": 2.5}),
        (
            "--tool-friction stribeck:0.2 --surface sphere --joint-friction stribeck",
            {"friction": "stribeck", "coulomb_coefficient": 0.2, "surface": "sphere"},
        ),
    ],
)
def test_options_reach_the_dataset(forcegp, tmp_path, options, expected):
    made = forcegp(
        *("simulate", "kuka-surface", "--seconds", 0.5, "--out", "log.h5", "--json", *options.split()), folder=tmp_path
    )
    assert made.returncode == 0, made.stderr
    data, summary = Dataset.load(tmp_path / "log.h5"), json.loads(made.stdout)
    assert expected.items() <= summary["config"].items()
    assert expected.items() <= data.metadata["config"].items()
    assert ("Q_U.joint-friction" in data.truth) == ("--joint-friction" in options)
    assert isinstance(data.model.contacts[0].surface, Sphere) == ("sphere" in options)
