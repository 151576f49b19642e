"""The scripts in examples/: short, listed in their README, and each runs and finds what it is about.

tests/test_pages.py runs the two swing-ups, and benchmarks/payload.py the log of the UR5.
"""

import re
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.examples import run_example
from tests.recordings.log_files import write_bag2

from forcegp import ContactMonitor

FOLDER = Path(__file__).resolve().parents[1] / "examples"
GENERATORS = {"ur5_log.py"}  # longer: nobody reads a generator of data to learn from it


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    return lambda name: run_example((FOLDER / name).read_text(encoding="utf-8"), tmp_path)


def test_scripts_are_short():
    lengths = {path.name: len(path.read_text(encoding="utf-8").splitlines()) for path in FOLDER.glob("*.py")}
    assert {name for name, lines in lengths.items() if lines >= 40} == GENERATORS


def test_all_are_listed():
    listed = set(re.findall(r"`(\w+\.py)`", (FOLDER / "README.md").read_text(encoding="utf-8")))
    assert listed == {path.name for path in FOLDER.glob("*.py")}


@pytest.mark.nightly
def test_a_first_model(run, tmp_path):
    urdf, learned = (float(error) for error in re.findall(r"error (\S+)", run("first_model.py")))
    assert learned < 0.05 * urdf
    assert (tmp_path / "friction.png").stat().st_size > 10_000


def test_the_check_of_a_log(run):
    assert run("check_log.py").startswith("torque sign: the torque of elbow has the opposite sign")


def test_a_payload(run):
    pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install 'forcegp[mujoco]'")
    printed = run("payload.py")
    mass, margin, x, _, z = (float(x) for x in re.findall(r"-?\d+\.?\d*", printed))
    assert abs(mass - 0.7) <= margin
    assert (x, z) == (pytest.approx(20.0, abs=3.0), pytest.approx(50.0, abs=3.0))


@pytest.mark.nightly
def test_computed_torque(run):
    urdf, learned = (float(error) for error in re.findall(r": (\S+) mrad", run("computed_torque.py")))
    assert learned < 0.05 * urdf


def test_a_prior_of_ones_own(run):
    named, own = (float(error) for error in re.findall(r"error (\S+)", run("custom_prior.py")))
    assert own < 0.1 * named


def measured(rows, dt, push=0.0):
    """Two links in MuJoCo under PD, with noise; from row 200 on a force of `push` N up at the centre of the last."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install 'forcegp[mujoco]'")
    from two_links import URDF

    model = mujoco.MjModel.from_xml_string(f"{URDF}</robot>")
    model.opt.timestep, rng, found = dt / 4, np.random.default_rng(rows), []
    data = mujoco.MjData(model)
    for k in range(rows):
        wanted = 0.5 * np.sin(np.array([2.1, 3.3]) * k * dt + [0.0, 1.0])
        u = data.qfrc_bias + [5.0, 2.0] * (wanted - data.qpos) - [0.3, 0.1] * data.qvel
        found.append((k * dt, *data.qpos, *data.qvel, *u))
        data.qfrc_applied[:], data.xfrc_applied[-1, 2] = u, push * (k >= 200)
        mujoco.mj_step(model, data, 4)
    rows = np.array(found) + rng.standard_normal((rows, 7)) * [0, 0, 0, 2e-3, 2e-3, 2e-3, 2e-3]
    return {"time": rows[:, 0], "q": rows[:, 1:3], "v": rows[:, 3:5], "u": rows[:, 5:]}


def test_a_bag_that_is_played_live(tmp_path, monkeypatch):
    """The push is found while the bag is played, not before, and the view shows it; a gripper is on the topic, too."""
    pytest.importorskip("viser")
    monkeypatch.syspath_prepend(FOLDER)
    from live_monitor import contacts
    from live_view import LiveView
    from play_bag import play
    from two_links import NOMINAL

    dt, speed, free, log = 1 / 128, 4.0, measured(5300, 1 / 128), measured(280, 1 / 128, push=1.0)
    monitor = ContactMonitor(NOMINAL, dt=dt).calibrate([(free["q"], free["v"], free["u"])])
    bag, view = write_bag2(tmp_path / "bag", log, gripper=True), LiveView(NOMINAL.robot, port=0)
    with socket.create_server(("127.0.0.1", 0)) as node:
        thread, begun = threading.Thread(target=play, args=(bag, speed, node.getsockname())), time.monotonic()
        thread.start()
        with node.accept()[0] as player:
            found = [(*each, time.monotonic() - begun) for each in contacts(monitor, player, view)]
        thread.join()
    view.server.stop()
    assert 0.0 < found[0][0] - 1.7e9 - 200 * dt < 0.1
    assert {place.link for _, place, _ in found} == {"fore"}
    assert 0.4 < found[-1][1].force[2] < 1.1
    assert all(at >= (stamp - 1.7e9) / speed for stamp, _, at in found)
    pose = NOMINAL.robot.frame_pose(torch.tensor(log["q"][-1]), "fore")
    np.testing.assert_allclose(view.arrow.points[0, 1], (pose @ torch.tensor([0.1, 0, 0, 1]).double())[:3], atol=0.02)
    np.testing.assert_allclose(np.diff(view.arrow.points[0, :, 2]), 0.01, atol=0.0015)
