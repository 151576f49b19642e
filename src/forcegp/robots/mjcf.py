"""MJCF, MuJoCo's robot files: read by MuJoCo's own compiler, and written.

Every body becomes a link; several joints of one body are a chain of links without mass, which MuJoCo does not move.
"""

import base64
import math
import re
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from forcegp.atomic_files import unreadable
from forcegp.errors import RobotModelError, required_extra
from forcegp.robots.arguments import Problems
from forcegp.robots.inertia import inverse, transform
from forcegp.robots.layout import BASE, OUTSIDE, followed, joint_motion
from forcegp.robots.mjcf_model import CompiledModel, Translation
from forcegp.robots.structure import RobotStructure
from forcegp.robots.urdf import MOST_TAGS, Joint, free_joint, numbers, parse_xml
from forcegp.robots.urdf_file import read_text
from forcegp.sandbox import read_apart

DEEPEST = 20  # files that include files; each is read by a function that calls itself
SMALLEST = 2e-15  # kg m^2; MuJoCo takes no smaller inertia, so that ideal rods and points get this one
KINDS = {"floating": "free", "prismatic": "slide", "revolute": "hinge", "continuous": "hinge"}


def is_mjcf(text: str) -> bool:
    """Whether the root element of XML text is <mujoco>."""
    return re.sub(r"<!--.*?-->|<\?.*?\?>|\ufeff", "", text, flags=re.DOTALL).lstrip().startswith("<mujoco")


def translate(text: str, path: Path | None, for_system: bool, problems: Problems) -> Translation:
    """The robot of MJCF text beside its file; notes what is left out.

    Raises RobotModelError, MissingExtra, errors of XML.
    """
    folder = None if path is None else path.parent.resolve()
    asked = {"text": text, "folder": str(folder or ""), "outside": _meshes_outside(text, path, problems.source)}
    made = required_extra("mujoco", "mujoco", f"{problems.source}: MJCF")
    answer = read_apart("mujoco", problems.source, asked)
    if "refused" in answer:
        advice = "; correct that place."
        if answer["meshes"]:
            advice = f"; the mass of {', '.join(answer['meshes'][:4])} comes from meshes: give an <inertial>{advice}"
        raise RobotModelError(f"{problems.source}: MuJoCo refuses it ({answer['refused']}){advice}")
    for warning in answer["notes"]:
        problems.note("MuJoCo warns", warning)
    model = made.MjModel.from_binary_path("robot.mjb", {"robot.mjb": base64.b64decode(answer["model"])})
    return CompiledModel(made, model, answer["name"] or "robot", for_system, problems).translation()


def _meshes_outside(text: str, path: Path | None, source: str) -> list[str]:
    """Meshes that are not below the folder of a file and of those that it includes; a mesh may yet be of no use.

    Raises RobotModelError for other files there, and for files that name themselves.
    """
    folder = Path() if path is None else path.parent
    roots = [] if path is None else [folder.resolve(), path.resolve().parent]
    shapes, done, left, places = list[tuple[str, Path, str]](), set[Path](), MOST_TAGS, {""}
    outside = "{}: names the file {!r}, a pipe or device, or not below the folder of the robot's file; move it there."

    def is_inside(at: Path, name: str) -> bool:
        named, real = Path(name.replace("\\", "/")), (at / name).resolve()
        inside = ".." not in named.parts and not named.is_absolute() and any(map(real.is_relative_to, roots))
        return inside and unreadable(real, math.inf) is None

    def walk(text: str, source: str, at: Path, above: tuple[Path, ...]) -> None:
        nonlocal left
        root, left = parse_xml(text, source), left - text.count("<")
        if left < 0 or len(above) > DEEPEST:
            limits = f"more than {MOST_TAGS} tags, or files more than {DEEPEST} deep"
            raise RobotModelError(f"{source}: names {limits}; give the file of one robot.")
        for element in root.iter():
            name = element.get("file", "")
            if element.tag == "compiler":
                places.update(value for key, value in element.items() if key.endswith("dir"))
            elif element.tag in ("mesh", "flexcomp"):
                shapes.append((element.tag, at, name))
            elif element.tag in ("include", "model") and name:
                found = next((each / name for each in (at, folder) if (each / name).is_file()), folder / name)
                if not is_inside(found.parent, found.name) or not is_inside(folder, name):
                    raise RobotModelError(outside.format(source, name))
                if not found.is_file():
                    raise RobotModelError(f"{source}: includes {name!r}, which is not there; give the file beside it.")
                if found.resolve() in above:
                    raise RobotModelError(f"{source}: names {name!r}, which names this file again; take one out.")
                if found.resolve() not in done:
                    walk(read_text(found), str(found), found.parent, (*above, found.resolve()))
                    done.add(found.resolve())

    walk(text, source, folder, () if path is None else (path.resolve(),))
    apart = [
        (tag, name)
        for tag, at, name in shapes
        if name and not all(is_inside(each, str(Path(place, name))) for place in places for each in (at, folder))
    ]
    for name in (name for tag, name in apart if tag == "flexcomp"):  # is opened before it is known whether it is needed
        raise RobotModelError(outside.format(source, name))
    return [name for _, name in apart]


class MjcfWriter:
    """The text of one robot; `left_out` are frames that it lacks."""

    def __init__(self, robot: RobotStructure) -> None:
        self.robot, description = robot, robot.description
        self.held, _ = followed(description, robot.locked, Problems(robot.source))
        self.groups = {group.name: group for group in robot.layout.groups}
        self.moving = {joint.name for joint in robot.layout.bodies} | set(self.groups)
        self.children: dict[str, list[Joint]] = {link: [] for link in description.links}
        for joint in description.joints:
            self.children[joint.parent].append(joint)
        self.lines: list[str] = []
        self.left_out: list[str] = []

    def text(self) -> str:
        """The whole file."""
        robot, root = self.robot, next(iter(self.robot.layout.links))
        if BASE in self.groups and BASE not in {joint.name for joint in robot.description.joints}:
            self._chain(free_joint(BASE, OUTSIDE, root), np.eye(4), 2)
        elif root == "world" and not robot.link(root).mass:
            self._below(root, 2)
        else:
            self._body(root, np.eye(4), [], 2)
        motors = [f"    <motor name={quoteattr(name)} joint={quoteattr(name)}/>" for name in robot.single_joint_names]
        couplings = [
            f"    <joint joint1={quoteattr(joint.name)} joint2={quoteattr(joint.mimics.joint)} "
            f'polycoef="{numbers((joint.mimics.offset, joint.mimics.multiplier, 0.0, 0.0, 0.0))}"/>'
            for joint in robot.description.joints
            if joint.mimics is not None and joint.name in self.moving
        ]
        text = [
            f"<mujoco model={quoteattr(robot.name)}>",
            '  <compiler angle="radian" autolimits="true" inertiafromgeom="false"/>',
            f'  <option gravity="{numbers(robot.gravity.tolist())}"/>',
            *("  <worldbody>", *self.lines, "  </worldbody>"),
            *_block("equality", couplings),
            *_block("actuator", motors),
        ]
        return "\n".join([*text, "</mujoco>\n"])

    def _body(self, link: str, pose: np.ndarray, joints: Sequence[tuple[Joint, np.ndarray]], depth: int) -> None:
        """One body with its joints, which have poses in its frame, and what hangs on it."""
        space = "  " * depth
        self.lines.append(f"{space}<body name={quoteattr(link)}{_placed(pose)}>")
        self.lines += [f"{space}  {_jointed(joint, at)}" for joint, at in joints]
        inertial = self.robot.link(link)
        if inertial.mass > 0.0:
            self.lines.append(f"{space}  {_inertial(inertial.mass, inertial.center_of_mass, inertial.inertia)}")
        self._below(link, depth + 1)
        self.lines.append(f"{space}</body>")

    def _below(self, link: str, depth: int) -> None:
        for joint in self.children[link]:
            self._chain(joint, joint.origin, depth)

    def _chain(self, joint: Joint, pose: np.ndarray, depth: int) -> None:
        """The body that a joint moves, with the joints above it that move no mass."""
        if joint.name not in self.moving:
            self._body(joint.child, pose @ joint_motion(joint, self.held.get(joint.name, 0.0)), [], depth)
            return
        joints = [(joint, np.eye(4))]
        while not any(self.robot.link(name).mass > 0.0 for name in self._rigid(joint.child)):
            rigid = self._rigid(joint.child)
            below = [(at @ each.origin, each) for name, at in rigid.items() for each in self.children[name]]
            below = [(step, each) for step, each in below if each.name in self.moving]
            if len(below) != 1 or joint.type == "floating":
                seen = f"{self.robot.source}: link {joint.child!r} moves and has no mass"
                why = "which MuJoCo takes only between two joints of one degree of freedom"
                raise RobotModelError(f"{seen}, {why}; give it a mass.")
            self.left_out += rigid
            step, joint = below[0]
            joints = [*((each, inverse(step) @ at) for each, at in joints), (joint, np.eye(4))]
            pose = pose @ step
        if joint.type == "floating" and (depth != 2 or not np.array_equal(pose, np.eye(4))):
            seen = f"{self.robot.source}: joint {joint.name!r} floats beside the origin of the world"
            raise RobotModelError(f"{seen}, which MuJoCo does not take; move its origin there.")
        self._body(joint.child, pose, joints, depth)

    def _rigid(self, link: str) -> dict[str, np.ndarray]:  # links that move together, with poses in the first one
        found = {link: np.eye(4)}
        for name in (names := [link]):
            for joint in self.children[name]:
                if joint.name not in self.moving:
                    still = joint.origin @ joint_motion(joint, self.held.get(joint.name, 0.0))
                    found[joint.child] = found[name] @ still
                    names.append(joint.child)
        return found


def _inertial(mass: float, center: np.ndarray, inertia: np.ndarray) -> str:
    """With principal moments, which MuJoCo keeps to the last digit."""
    moments, axes = np.linalg.eigh(inertia)
    axes, moments = axes * np.sign(np.linalg.det(axes)), np.maximum(moments, SMALLEST)
    moments[2] = min(moments[2], (moments[0] + moments[1]) * (1.0 - 1e-15))
    pose = _placed(transform(axes, center))
    pose = pose if "pos" in pose else f' pos="0 0 0"{pose}'
    return f'<inertial{pose} mass="{mass!r}" diaginertia="{numbers(moments)}"/>'


def _jointed(joint: Joint, pose: np.ndarray) -> str:
    given = {"armature": joint.armature, "damping": joint.damping, "frictionloss": joint.friction}
    parts = [f'{key}="{value!r}"' for key, value in given.items() if value]
    if joint.lower < joint.upper and not math.isinf(joint.upper - joint.lower):
        parts.append(f'range="{joint.lower!r} {joint.upper!r}"')
    if joint.type != "floating":
        if 0.0 < joint.effort_limit < math.inf:
            parts.append(f'actuatorfrcrange="{-joint.effort_limit!r} {joint.effort_limit!r}"')
        if pose[:3, 3].any():
            parts.append(f'pos="{numbers(pose[:3, 3])}"')
        parts.append(f'axis="{numbers(pose[:3, :3] @ np.array(joint.axis))}"')
    return " ".join([f'<joint name={quoteattr(joint.name)} type="{KINDS[joint.type]}"', *parts]) + "/>"


def _placed(pose: np.ndarray) -> str:  # attributes pos and quat, where they are not the default
    quaternion = np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)
    position = f' pos="{numbers(pose[:3, 3])}"' if pose[:3, 3].any() else ""
    return position + ("" if np.array_equal(pose[:3, :3], np.eye(3)) else f' quat="{numbers(quaternion)}"')


def _block(tag: str, lines: Sequence[str]) -> list[str]:
    return [f"  <{tag}>", *lines, f"  </{tag}>"] if lines else []
