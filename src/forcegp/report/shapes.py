"""What the links of a robot look like: the visual elements of a URDF, and capsules for links that have none."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import torch

from forcegp.errors import InvalidInput, RobotModelError, required_extra
from forcegp.robots import Robot
from forcegp.robots.inertia import rotation_from_rpy, transform
from forcegp.robots.urdf import parse_xml
from forcegp.robots.urdf_file import read_robot_file

FORMATS = (".stl", ".obj", ".ply", ".off")
"""Meshes that are read; none of them can name another file that would be read with it."""
LARGEST_FILE = 50 << 20
MOST_FACES = 2500
"""Faces of one link, so that the page of a report stays small; finer meshes lose vertices that lie close together."""
FINEST, COARSER = 200.0, 1.4
"""Cells of the first grid over the diagonal of a mesh, and how much larger those of the next one are."""
THICKNESS = 0.035  # radius of a capsule relative to the reach of the robot
SHORTEST = 1e-4  # m


@dataclass(frozen=True, eq=False)
class LinkShape:
    """Triangles of one link in its own frame: `vertices` (n, 3) in m and `faces` (k, 3) as rows of them."""

    link: str
    vertices: np.ndarray
    faces: np.ndarray


def trimesh_module() -> Any:
    """The package trimesh. Raises MissingExtra without it."""
    return required_extra("trimesh", "view", "drawing the robot")


def link_shapes(robot: Robot, urdf: str | Path | None = None) -> tuple[list[LinkShape], list[str]]:
    """The shape of every link, and sentences about those that could not be drawn as their file says.

    `urdf` is a file whose visual elements are taken by the names of the links; its meshes are those below
    its folder, or that of its ROS package. Without it those of the robot's own URDF count, of which only boxes,
    cylinders and spheres are drawn: a Robot has no folder. Links with mass but no shape become capsules to the joints.

    Raises MissingExtra without trimesh, and InvalidInput for a file that is no URDF.
    """
    trimesh_module()
    text = robot.urdf_text if urdf is None else read_robot_file(urdf)
    try:
        root = parse_xml(text, str(urdf))
    except RobotModelError as error:
        raise InvalidInput(f"{urdf} is not a URDF ({error}); give the file that describes the robot.") from None
    drawn, doubts = {}, []
    for link in root.findall("link"):
        name = link.get("name", "")
        if name in robot.link_names:
            present = list[Any]()
            for element in link.iter("visual"):
                try:
                    present += [_visual(element, None if urdf is None else Path(urdf), doubts)]
                except (ValueError, TypeError, IndexError):  # attributes that are missing, too few or no numbers
                    doubts.append(f"a shape of link {name!r} lacks numbers that it needs; it is left out.")
            if present := [mesh for mesh in present if mesh is not None]:
                drawn[name] = _few_faces(trimesh_module().util.concatenate(present))
    shaped = bool(drawn)
    for name, mesh in _capsules(robot).items():
        if robot.link(name).mass > 0.0 or not shaped:  # a frame without mass needs no shape beside others
            drawn.setdefault(name, mesh)
    return [LinkShape(name, np.array(mesh.vertices), np.array(mesh.faces)) for name, mesh in drawn.items()], doubts


def reach(robot: Robot) -> float:
    """The length of the robot in m: the farthest that a chain of joints stretches."""
    lengths: dict[str, float] = {}
    for joint in robot.all_joints:
        lengths[joint.child] = lengths.get(joint.parent, 0.0) + float(np.linalg.norm(joint.origin[:3, 3]))
    centers = [np.linalg.norm(robot.link(name).center_of_mass) for name in robot.link_names]
    return max(max(lengths.values(), default=0.0), float(max(centers, default=0.0)), 0.1)


def _visual(element: Element, urdf: Path | None, doubts: list[str]) -> Any:
    """The mesh of one visual element in the frame of its link; None where it cannot be drawn, with a doubt why."""
    creation, geometry = trimesh_module().creation, element.find("geometry")
    kinds = {} if geometry is None else {child.tag: child for child in geometry}
    mesh: Any = None
    if "box" in kinds:
        mesh = creation.box(extents=_numbers(kinds["box"], "size"))
    elif "cylinder" in kinds:
        length, radius = (_numbers(kinds["cylinder"], name)[0] for name in ("length", "radius"))
        mesh = creation.cylinder(radius=radius, height=length, sections=24)
    elif "sphere" in kinds:
        mesh = creation.icosphere(subdivisions=2, radius=_numbers(kinds["sphere"], "radius")[0])
    elif "mesh" in kinds:
        mesh = _loaded(kinds["mesh"], urdf, doubts)
    if mesh is not None:
        pose = (_numbers(element.find("origin"), name) for name in ("rpy", "xyz"))
        rpy, xyz = (np.array(values or (0.0, 0.0, 0.0)) for values in pose)
        mesh.apply_transform(transform(rotation_from_rpy(rpy), xyz))
    return mesh


def _numbers(element: Element | None, name: str) -> list[float]:
    values = [] if element is None else [float(word) for word in element.get(name, "").split()]
    if not np.isfinite(values).all():
        raise ValueError(name)
    return values


def _loaded(element: Element, urdf: Path | None, doubts: list[str]) -> Any:
    """A mesh file; None, and a doubt, where it is not there or of another kind."""
    name = element.get("filename", "")
    path = None if urdf is None else _found(name, urdf)
    if path is None or path.suffix.lower() not in FORMATS or path.stat().st_size > LARGEST_FILE:
        why = "is not below the folder of the URDF" if path is None else f"is no {'/'.join(FORMATS)} up to 50 MiB"
        doubts.append(f"{name} {why}; its link is drawn as a capsule.")
        return None
    try:
        mesh = trimesh_module().load(path, force="mesh", skip_materials=True)
        if not len(mesh.faces):
            raise ValueError("it holds no faces")
    except Exception as error:  # of which trimesh has many kinds
        doubts.append(f"{name} could not be read ({error}); its link is drawn as a capsule.")
        return None
    if scale := _numbers(element, "scale"):
        mesh.apply_scale(scale)
    return mesh


def _found(name: str, urdf: Path) -> Path | None:
    """The file that a URDF names, or one of a package, below the folder of the URDF or that of its `package.xml`."""
    plain = name.removeprefix("file://")
    package = plain.removeprefix("package://").removeprefix("model://")
    within = package.partition("/")[2] if package != plain else package
    above = urdf.resolve().parents
    root = next((folder for folder in above if (folder / "package.xml").is_file()), above[0])
    candidates = ((folder / end).resolve() for folder in above for end in (package, within))
    return next((each for each in candidates if each.is_relative_to(root) and each.is_file()), None)


def _few_faces(mesh: Any) -> Any:
    """The same mesh, where it has too many faces with vertices in cells of a grid merged into their mean."""
    step, fine = float(np.linalg.norm(mesh.extents)) / FINEST, mesh
    while len(mesh.faces) > MOST_FACES:
        _, cell = np.unique(np.round(fine.vertices / step), axis=0, return_inverse=True)
        count = np.bincount(cell)[:, None]
        means = np.stack([np.bincount(cell, weights=column) for column in fine.vertices.T], axis=1) / count
        mesh = trimesh_module().Trimesh(means, cell[fine.faces], process=False)
        mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
        step *= COARSER
    return mesh


def _capsules(robot: Robot) -> dict[str, Any]:
    """Every link as capsules to the joints that it carries; the last one to twice its centre of mass."""
    radius = THICKNESS * reach(robot)
    ends: dict[str, list[np.ndarray]] = {name: [] for name in robot.link_names}
    for joint in robot.description.joints:
        ends[joint.parent].append(joint.origin[:3, 3])
    out = {}
    for name, places in ends.items():
        center = robot.link(name).center_of_mass
        if not places and robot.link(name).mass > 0.0:
            places = [2.0 * center]
        parts = list[Any]()
        for place in places:
            if (height := float(np.linalg.norm(place))) > SHORTEST:
                parts.append(mesh := trimesh_module().creation.capsule(height=height, radius=radius, count=(12, 12)))
                mesh.apply_translation((0.0, 0.0, 0.5 * height - 0.5 * (mesh.bounds[0, 2] + mesh.bounds[1, 2])))
                mesh.apply_transform(trimesh_module().geometry.align_vectors((0.0, 0.0, 1.0), place))
        if not parts and robot.link(name).mass > 0.0:
            parts = [trimesh_module().creation.icosphere(subdivisions=2, radius=radius)]
        if parts:
            out[name] = trimesh_module().util.concatenate(parts)
    return out


def poses_of_links(robot: Robot, q: torch.Tensor, links: list[str]) -> np.ndarray:
    """World poses (rows, links, 4, 4) of links at positions q (rows, nv)."""
    with torch.no_grad():
        state = robot.kinematics(q)
        poses = [state.frame_pose(name).expand(len(q), 4, 4).cpu().numpy() for name in links]
    return np.stack(poses, axis=1) if poses else np.zeros((len(q), 0, 4, 4))
