"""Shapes of links: what a URDF draws, what is missing, and capsules, against closed forms."""

import numpy as np
import pytest
import trimesh
from tests.posterior.arm import URDF

from forcegp import Robot
from forcegp.errors import InvalidInput
from forcegp.report import RecordedScene, recording, shapes

VISUAL = '<visual><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{geometry}</geometry></visual>'


def drawn(tmp_path, **visuals):
    """The shapes of the arm whose links have these visual elements, and the doubts."""
    text = URDF
    for link, (geometry, xyz, rpy) in visuals.items():
        start = f'<link name="{link}">'
        text = text.replace(start, start + VISUAL.format(geometry=geometry, xyz=xyz, rpy=rpy))
    path = tmp_path / "robots" / "arm.urdf"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    found, doubts = shapes.link_shapes(Robot.from_urdf_text(URDF), path)
    return {shape.link: shape for shape in found}, doubts


@pytest.mark.parametrize(
    ("geometry", "low", "high"),
    [
        ('<box size="0.2 0.4 0.6"/>', (-0.2, -0.1, -0.3), (0.2, 0.1, 0.3)),  # turned by a quarter about z
        ('<cylinder radius="0.1" length="1"/>', (-0.1, -0.1, -0.5), (0.1, 0.1, 0.5)),
        ('<sphere radius="0.3"/>', (-0.3, -0.3, -0.3), (0.3, 0.3, 0.3)),
    ],
)
def test_solids_have_their_size_and_place(tmp_path, geometry, low, high):
    found, doubts = drawn(tmp_path, fore=(geometry, "1 2 3", "0 0 1.5707963267948966"))
    center = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(found["fore"].vertices.min(0), center + low, atol=0.005)
    np.testing.assert_allclose(found["fore"].vertices.max(0), center + high, atol=0.005)
    assert not doubts


@pytest.mark.parametrize("name", ["package://shop/meshes/block.stl", "../shop/meshes/block.stl"])
def test_meshes_are_found_scaled_and_placed(tmp_path, name):
    folder = tmp_path / "shop" / "meshes"
    folder.mkdir(parents=True)
    (tmp_path / "package.xml").touch()
    trimesh.creation.box(extents=(1.0, 2.0, 3.0)).export(folder / "block.stl")
    found, doubts = drawn(tmp_path, hand=(f'<mesh filename="{name}" scale="0.1 0.1 0.1"/>', "0 0 1", "0 0 0"))
    np.testing.assert_allclose(np.ptp(found["hand"].vertices, axis=0), [0.1, 0.2, 0.3], atol=1e-6)
    np.testing.assert_allclose(found["hand"].vertices.mean(0), [0.0, 0.0, 1.0], atol=1e-6)
    assert not doubts


def test_a_fine_mesh_loses_faces_and_keeps_its_size(tmp_path):
    (tmp_path / "robots").mkdir()
    trimesh.creation.icosphere(subdivisions=5, radius=0.2).export(tmp_path / "robots" / "ball.stl")
    found, _ = drawn(tmp_path, hand=('<mesh filename="ball.stl"/>', "0 0 0", "0 0 0"))
    assert len(found["hand"].faces) <= shapes.MOST_FACES
    np.testing.assert_allclose(np.linalg.norm(found["hand"].vertices, axis=1), 0.2, atol=0.01)


@pytest.mark.parametrize(
    ("name", "content", "doubt"),
    [
        ("away.stl", None, "away.stl is not below the folder of the URDF"),
        *((x, None, f"{x} is not below") for x in ("../secret.stl", "file:///SECRET", "package://a/../secret.stl")),
        ("link.stl", None, "link.stl is not below"),
        ("scene.gltf", "{}", "scene.gltf is no .stl/.obj/.ply/.off up to 50 MiB"),
        ("broken.obj", "f 1 2 nonsense", "broken.obj could not be read"),
    ],
)
def test_what_cannot_be_read_becomes_a_capsule_and_is_named(tmp_path, name, content, doubt):
    (tmp_path / "robots" / "a").mkdir(parents=True)
    trimesh.creation.box().export(tmp_path / "secret.stl")
    (tmp_path / "robots" / "link.stl").symlink_to(tmp_path / "secret.stl")
    name, doubt = (text.replace("/SECRET", str(tmp_path / "secret.stl")) for text in (name, doubt))
    if content is not None:
        (tmp_path / "robots" / name).write_text(content)
    found, (said,) = drawn(tmp_path, hand=(f'<mesh filename="{name}"/>', "0 0 0", "0 0 0"))
    assert said.startswith(doubt)
    assert len(found["hand"].faces) > 0


@pytest.mark.parametrize("solid", ["cylinder", "sphere", "box", 'box size="1"', 'cylinder radius="nan" length="1"'])
def test_solids_without_their_numbers_are_left_out(tmp_path, solid):
    _, (said,) = drawn(tmp_path, hand=(f"<{solid}/>", "0 0 0", "0 0 0"))
    assert said == "a shape of link 'hand' lacks numbers that it needs; it is left out."


def test_a_capsule_reaches_from_joint_to_joint():
    found, doubts = shapes.link_shapes(Robot.from_urdf_text(URDF))
    upper = next(shape for shape in found if shape.link == "upper")
    radius = shapes.THICKNESS * shapes.reach(Robot.from_urdf_text(URDF))
    np.testing.assert_allclose(upper.vertices[:, 2].min(), -radius, atol=1e-6)
    np.testing.assert_allclose(upper.vertices[:, 2].max(), 0.3 + radius, atol=1e-6)  # joint lift is 0.3 m above
    assert shapes.reach(Robot.from_urdf_text(URDF)) == pytest.approx(0.3 + 0.3 + 0.25)
    assert not doubts


def test_a_file_that_is_no_urdf_is_refused(tmp_path):
    path = tmp_path / "note.urdf"
    path.write_text("hello")
    with pytest.raises(InvalidInput, match="is not a URDF"):
        shapes.link_shapes(Robot.from_urdf_text(URDF), path)


def test_a_box_without_size_is_drawn(tmp_path):
    path, nothing = tmp_path / "arm.urdf", '<visual><geometry><box size="0 0 0"/></geometry></visual>'
    trunk = URDF[URDF.index("<inertial>") : URDF.index("</inertial>")]
    path.write_text(URDF.replace('<link name="base"/>', f'<link name="base">{nothing}{trunk}</inertial></link>'))
    robot = Robot.from_urdf(path, base="floating")
    found, doubts = shapes.link_shapes(robot, path)
    assert not doubts
    poses = np.tile(np.eye(4), (1, len(found), 1, 1))
    scene = RecordedScene(robot, np.zeros(1), np.zeros((1, robot.nq)), found, poses, [], 1.0)
    assert "<html" in recording(scene).lower()
