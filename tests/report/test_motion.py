"""Scenes of recordings: poses against Pinocchio, arrows against the components of the posterior."""

from unittest.mock import MagicMock

import numpy as np
import pinocchio
import pytest
import torch
from tests.fit.test_identified_moving_bases import FEET, recorded
from tests.goldens.compare import assert_unchanged, drawn
from tests.robots.test_moving_bases import LIMBS

from forcegp import Dataset, JointFriction, Model, Robot, fit
from forcegp.forces import Coulomb
from forcegp.report import recorded_scene, scene_notes
from forcegp.report.motion import LONGEST_ARROW, PALE, _drawn
from forcegp.scores import model_pictures


def test_poses_are_pinocchios(swinging):
    scene, model = recorded_scene(swinging, seconds=1.0), pinocchio.buildModelFromXML(swinging.model.robot.urdf_text)
    data = model.createData()
    for row in (0, len(scene.time) - 1):
        pinocchio.forwardKinematics(model, data, scene.q[row])
        pinocchio.updateFramePlacements(model, data)
        for place, shape in enumerate(scene.shapes):
            pose = data.oMf[model.getFrameId(shape.link)].homogeneous
            np.testing.assert_allclose(scene.poses[row, place], pose, atol=1e-12)


def test_frames_are_even_in_time_and_not_more_than_thirty_a_second(swinging):
    scene = recorded_scene(swinging, start=1.0, seconds=2.0)
    assert 58 <= len(scene.time) <= 61
    assert (scene.time[0], scene.time[-1]) == (0.0, pytest.approx(2.0, abs=0.01))
    first = np.searchsorted(swinging.time - swinging.time[0], 1.0 - 1e-9)
    np.testing.assert_array_equal(scene.q[0], swinging.q[first])


def test_without_a_model_the_recorded_torques_are_shown(swinging):
    (arrows,) = recorded_scene(swinging, seconds=0.5).arrows
    assert (arrows.title, arrows.unit, arrows.names) == ("recorded u", "Nm", swinging.joint_names)
    assert not arrows.half.any()


def test_joint_arrows_are_laws_and_learned_part_together(swinging, friction):
    scene = recorded_scene(swinging, friction, seconds=1.0)
    (arrows,) = scene.arrows
    rows = [int(np.flatnonzero((swinging.q == q).all(1))[0]) for q in scene.q]
    q, v, u = (torch.tensor(x[rows]) for x in (swinging.q, swinging.v, swinging.u))
    total = friction.predict(q, v, u).unknown_force
    np.testing.assert_allclose(arrows.mean, (total.mean - 0.1 * v).numpy(), atol=1e-10)
    np.testing.assert_allclose(arrows.half, 1.959963984540054 * total.std.numpy(), rtol=1e-9)
    robot = swinging.model.robot
    pose = robot.frame_pose(q, robot.joints[1].child).numpy()
    np.testing.assert_allclose(arrows.start[:, 1], pose[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(arrows.direction[:, 1], pose[:, :3, :3] @ robot.joints[1].axis, atol=1e-12)


def test_friction_that_remembers_knows_the_rows_between_the_frames(swinging):
    law = Coulomb(0.4, 0.01, sigma=40.0, memory=True)
    (arrows,) = recorded_scene(swinging, fit(swinging.model.with_forces(law), swinging), seconds=1.0).arrows
    bristles = np.zeros((1, 2))
    for step in np.diff(swinging.q[swinging.time <= swinging.time[0] + 1.0 + 1e-9], axis=0):
        way = np.sign(step)
        bristles = np.concatenate([bristles, way + (bristles[-1:] - way) * np.exp(-40.0 * np.abs(step))])
    np.testing.assert_allclose(arrows.mean[-1], -0.4 * bristles[-1], atol=0.02)


def test_arrows_are_drawn_to_scale(swinging, friction):
    scene = recorded_scene(swinging, friction, seconds=1.0)
    (arrows,) = scene.arrows
    mean, interval = arrows.tips(5, scene.arrow_length)
    lengths = np.linalg.norm(mean[:, 1] - mean[:, 0], axis=1)
    np.testing.assert_allclose(lengths / scene.arrow_length, np.abs(arrows.mean[5]) / arrows.largest, rtol=1e-9)
    farther = np.linalg.norm(interval[:, 1] - interval[:, 0], axis=1)
    expected = (np.abs(arrows.mean[5]) + arrows.half[5]) / arrows.largest
    np.testing.assert_allclose(farther / scene.arrow_length, expected, rtol=1e-9)
    assert scene.arrow_length == LONGEST_ARROW * scene.size
    assert f"{arrows.largest:.3g} Nm would be" in scene_notes(scene)[0]
    server = MagicMock()
    _drawn(server, scene)
    color, pale = (call.args[2].astype(float) for call in server.scene.add_arrows.call_args_list)
    np.testing.assert_allclose((pale - color) / (255.0 - color), PALE, atol=0.02)


def test_a_foot_that_stands_has_one_arrow():
    """Its three constraints are one force, that of the multipliers in world axes; a foot that swings has none."""
    rows = recorded(Model(Robot.from_urdf_text(LIMBS, base="floating"), FEET), 40)
    model = fit(rows.model.with_forces(JointFriction(), noise=0.1), rows, points=20, restarts=1)
    scene = recorded_scene(rows, model)
    feet = {arrows.title: arrows for arrows in scene.arrows if arrows.title.startswith("contact force")}
    assert sorted(feet) == ["contact force at a_foot", "contact force at b_foot"]
    chosen = [int(np.flatnonzero((rows.q == q).all(1))[0]) for q in scene.q]
    forces = model.predict(rows.q, rows.v, rows.u).contact_force.mean.numpy().reshape(len(rows), 6, 3)[chosen]
    for k, arrows in enumerate(feet.values()):
        whole = forces[:, 3 * k : 3 * k + 3].sum(1)
        np.testing.assert_allclose(arrows.mean * arrows.direction[:, 0], whole, atol=1e-8)


def test_scenes_are_what_they_were(swinging, friction, on_plane):
    given = on_plane.training
    data = Dataset(q=given.q, v=given.v, u=given.u, a=0.0 * given.q, time=0.01 * np.arange(20), model=on_plane.model)
    scenes = {"pendulum": recorded_scene(swinging, friction, start=0.5, seconds=1.0)}
    scenes |= {"plane": recorded_scene(data, on_plane), "recorded": recorded_scene(data)}
    parts = ("time", "q", "poses", "arrows", "size", "arrow_length")
    found = {name: {part: getattr(scene, part) for part in parts} for name, scene in scenes.items()}
    for name, scene in scenes.items():
        found[f"{name} tips"] = [arrows.tips(3, scene.arrow_length) for arrows in scene.arrows]
        found[f"{name} shapes"] = [(shape.link, shape.vertices, len(shape.faces)) for shape in scene.shapes]
    (picture,), missing = model_pictures(friction, swinging)
    assert (picture.name, missing) == ("forces", [])
    assert_unchanged("report/scenes", found | {"picture": drawn(picture.figure)}, rtol=1e-3)
