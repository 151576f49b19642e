"""A cable of MuJoCo that pulls at one joint: no law is stated, and its torque over the position is found."""

import numpy as np
import pytest
import torch

from forcegp import Dataset, Model, Noise, Robot, fit
from forcegp.forces import JointPositionForces

mujoco = pytest.importorskip("mujoco")

SCENE = """<mujoco><option gravity="0 0 -9.81"/><worldbody><site name="wall" pos="0.5 0 0.3"/>
<body name="upper"><joint name="shoulder" type="hinge" axis="0 1 0"/><geom type="capsule" size=".03"
  fromto="0 0 0 0 0 -.4"/><site name="eye" pos="0 0 -.3"/>
<body name="fore" pos="0 0 -.4"><joint name="elbow" type="hinge" axis="0 1 0"/><geom type="capsule" size=".02"
  fromto="0 0 0 0 0 -.3"/></body></body></worldbody>
<tendon><spatial stiffness="60" springlength="0.35"><site site="wall"/><site site="eye"/></spatial></tendon>
<actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def plant():
    model = mujoco.MjModel.from_xml_string(SCENE)
    data, generator = mujoco.MjData(model), np.random.default_rng(0)
    rows = {name: [] for name in ("q", "v", "u", "a", "pull")}
    for _ in range(150):
        data.qpos, data.qvel, data.ctrl = (generator.uniform(-x, x, 2) for x in (1.4, 2.0, 3.0))
        mujoco.mj_forward(model, data)
        for name, value in zip(rows, (data.qpos, data.qvel, data.ctrl, data.qacc, data.qfrc_passive), strict=True):
            rows[name].append(value.copy())
    return {name: np.array(values) for name, values in rows.items()}


@pytest.mark.filterwarnings("ignore:.*tendon:forcegp.errors.RobotFileWarning")
def test_the_pull_of_a_cable_is_a_curve_of_its_joint(plant, tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    model = Model(Robot.from_mjcf(tmp_path / "scene.xml"))
    a = plant["a"] + 0.05 * np.random.default_rng(1).normal(size=plant["a"].shape)
    log = Dataset(q=plant["q"], v=plant["v"], u=plant["u"], a=a, time=0.01 * np.arange(150), model=model)
    force = JointPositionForces(("shoulder",))
    posterior = fit(model.with_forces(force, noise=Noise(0.05)), log.rows(slice(0, 100)), restarts=1)
    q, v, u = (torch.tensor(plant[name][100:]) for name in "qvu")
    found = posterior.predict(q, v, u).unknown_force
    pull = torch.tensor(plant["pull"][100:])
    assert float((found.mean - pull)[:, 0].square().mean().sqrt()) < 0.02 * float(pull[:, 0].std())
    assert float(((found.mean - pull)[:, 0].abs() < 2.0 * found.std[:, 0]).double().mean()) > 0.9
    assert float(found.mean[:, 1].abs().max()) == 0.0 == float(pull[:, 1].abs().max())
