"""MJCF, MuJoCo's robot files: read by MuJoCo's own compiler, and written.

Every body becomes a link; several joints of one body are a chain of links without mass, which MuJoCo does not move.
"""

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element
from xml.sax.saxutils import quoteattr

import numpy as np

from forcegp.errors import RobotModelError, required_extra
from forcegp.robots.arguments import Problems
from forcegp.robots.inertia import inverse, transform
from forcegp.robots.layout import BASE, OUTSIDE, followed, joint_motion
from forcegp.robots.manifold import VELOCITIES
from forcegp.robots.mjcf_model import WORLD, CompiledModel, LoopDescription, Translation
from forcegp.robots.structure import RobotStructure
from forcegp.robots.urdf import MOST_TAGS, Joint, free_joint, numbers, parse_xml
from forcegp.robots.urdf_file import read_text

DEEPEST = 300
"""Levels of elements: MuJoCo's reader calls itself for each."""
COPIED = {"replicate": ("count",), "composite": ("count",), "flexcomp": ("count",)}
SIZED = {"hfield": ("nrow", "ncol"), "mesh": ("params", "params")}
MOST_POINTS = 100_000_000
"""MuJoCo's reader makes copies and points at once, and hangs at the next file after it ran out of memory."""


def is_mjcf(text: str) -> bool:
    """Whether the root element of XML text is <mujoco>."""
    return re.sub(r"<!--.*?-->|<\?.*?\?>|\ufeff", "", text, flags=re.DOTALL).lstrip().startswith("<mujoco")


def translate(text: str, path: Path | None, for_system: bool, problems: Problems) -> Translation:
    """The robot of MJCF text beside its file; notes what is left out.

    Raises RobotModelError, MissingExtra, errors of XML.
    """
    included: dict[str, bytes] = {}
    _require_bounded(text, [] if path is None else [path.parent], problems.source, included)
    made = required_extra("mujoco", "mujoco", f"{problems.source}: MJCF")
    needed: list[str] = []
    before, noted = made.get_mju_user_warning(), []
    made.set_mju_user_warning(noted.append)  # otherwise they go into a file in the current folder
    try:
        if path is not None and path.suffix == ".xml":  # no other suffix is taken
            spec = made.MjSpec.from_file(str(path))
        else:
            spec = made.MjSpec.from_string(text, include=included)
            spec.modelfiledir = "" if path is None else str(path.parent)
        needed = _without_appearance(made, spec)
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            model = spec.compile()
    except (ValueError, TypeError, RuntimeError, IndexError, made.FatalError) as error:
        reason = " ".join(str(error).removeprefix("Error: ").split())
        missing = needed and any(word in reason for word in ("file", "mesh", "resource"))
        advice = f"; the mass of {', '.join(needed[:4])} comes from meshes: give an <inertial>" if missing else ""
        raise RobotModelError(f"{problems.source}: MuJoCo refuses it ({reason}){advice}; correct that place.") from None
    finally:
        made.set_mju_user_warning(before)
    for warning in dict.fromkeys((*noted, *(str(each.message) for each in warned))):
        problems.note("MuJoCo warns", warning)
    return CompiledModel(made, model, spec.modelname or "robot", for_system, problems).translation()


def _require_bounded(text: str, folders: Sequence[Path], source: str, included: dict[str, bytes]) -> None:
    """Refuse files that exhaust memory or stack of MuJoCo's reader; ``included`` receives the files that they name."""
    root = parse_xml(text, source)
    count, deepest = 0.0, 0
    stack = [(root, 1, 1.0)]
    while stack:
        element, depth, times = stack.pop()
        count, deepest = count + times, max(deepest, depth)
        points = _product(element, SIZED)
        times *= _product(element, COPIED)
        if count + times > MOST_TAGS or points > MOST_POINTS or deepest > DEEPEST:
            raise RobotModelError(
                f"{source}: holds more than {MOST_TAGS} elements, copies included, {MOST_POINTS} points of a shape or "
                f"{DEEPEST} levels; give the file of one robot."
            )
        stack += [(child, depth + 1, times) for child in element]
    for name in (element.get("file", "") for element in root.iter("include")):
        if name in included:
            continue
        found = next((folder / name for folder in folders if (folder / name).is_file()), None)
        if found is None:
            raise RobotModelError(f"{source}: includes {name!r}, which is not there; give the file beside it.")
        inner = read_text(found)
        included[name] = inner.encode()
        _require_bounded(inner, [*folders, found.parent], str(found), included)


def _product(element: Element, names: Mapping[str, Sequence[str]]) -> float:
    """Of the numbers above 1 in attributes of these names."""
    product = 1.0
    for word in " ".join(element.get(name, "") for name in names.get(element.tag, ())).split():
        try:
            product *= max(1.0, float(word))
        except ValueError:  # the kind of a mesh
            continue
    return product


def _without_appearance(mujoco: Any, spec: Any) -> list[str]:
    """Remove what changes no motion, so that no file of it is needed; the bodies whose mass comes from meshes."""
    for name in ("keys", "sensors", "skins", "cameras", "lights", "numerics", "texts", "tuples"):
        for element in list(getattr(spec, name)):
            spec.delete(element)
    for owner in (*spec.geoms, *spec.sites, *spec.tendons):
        owner.material = ""
    for name in (name for name in dir(spec) if name.startswith("nuser_")):
        setattr(spec, name, -1)
    spec.memory, spec.nuserdata, spec.compiler.fusestatic = -1, 0, False
    meshes, bodies = set(), []
    for geom in spec.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_HFIELD or (geom.meshname and not _has_mass(mujoco, spec, geom)):
            geom.type, geom.meshname, geom.hfieldname = mujoco.mjtGeom.mjGEOM_SPHERE, "", ""
            geom.size, geom.mass = [0.01, 0.0, 0.0], 0.0
        elif geom.meshname:
            meshes.add(geom.meshname)
            bodies.append(geom.parent.name or "a body without name")
    unused = [mesh for mesh in spec.meshes if mesh.name not in meshes] if not len(spec.flexes) else []
    for element in (*unused, *spec.materials, *spec.textures, *spec.hfields):
        spec.delete(element)
    return list(dict.fromkeys(bodies))


def _has_mass(mujoco: Any, spec: Any, geom: Any) -> bool:
    """Whether the mass of a body contains that of this shape."""
    compiler, kinds = spec.compiler, mujoco.mjtInertiaFromGeom
    given = compiler.inertiafromgeom == kinds.mjINERTIAFROMGEOM_AUTO and geom.parent.explicitinertial
    low, high = compiler.inertiagrouprange
    weighs = geom.mass != 0.0 if np.isfinite(geom.mass) else geom.density != 0.0
    return (
        not (given or compiler.inertiafromgeom == kinds.mjINERTIAFROMGEOM_FALSE)
        and low <= geom.group <= high
        and weighs
        and geom.parent.name != WORLD
    )


SMALLEST = 2e-15
"""kg m^2; MuJoCo takes no smaller inertia, so that ideal rods and points get this one."""
KINDS = {"floating": "free", "prismatic": "slide", "revolute": "hinge", "continuous": "hinge"}


class _Axis(NamedTuple):
    """One <joint> of a body: where it is in the frame of the body."""

    attributes: str
    pose: np.ndarray
    axis: tuple[float, float, float] | None  # none: it may turn about every one


class MjcfWriter:
    """The text of one robot; `left_out` are frames that it lacks."""

    def __init__(self, robot: RobotStructure, loops: Sequence[LoopDescription] = ()) -> None:
        self.robot, description = robot, robot.description
        self.held, _ = followed(description, robot.locked, Problems(robot.source))
        self.groups = {group.name: group for group in robot.layout.groups}
        self.moving = {joint.name for joint in robot.layout.bodies} | set(self.groups)
        self.children: dict[str, list[Joint]] = {link: [] for link in description.links}
        for joint in description.joints:
            self.children[joint.parent].append(joint)
        self.rotors = dict(zip(robot.joint_names, robot.armature.tolist(), strict=True))
        self.lines: list[str] = []
        self.left_out: list[str] = []
        self.sites: dict[str, list[str]] = {}
        self.equalities = self._couplings()
        for loop in loops:  # sites: the anchors of bodies would be taken from the posture at q = 0
            for end, link, point in zip("12", loop.frames, loop.points, strict=True):
                name = quoteattr(f"{loop.name}_{end}")
                self.sites.setdefault(link, []).append(f'<site name={name} pos="{numbers(point)}"/>')
            ends = " ".join(f"site{end}={quoteattr(f'{loop.name}_{end}')}" for end in "12")
            tag = "weld" if loop.turning else "connect"
            self.equalities.append(f"    <{tag} name={quoteattr(loop.name)} {ends}/>")

    def text(self) -> str:
        """The whole file."""
        robot, root = self.robot, next(iter(self.robot.layout.links))
        named = {joint.name for joint in robot.description.joints}
        if BASE in self.groups and BASE not in named:
            self._chain(free_joint(BASE, OUTSIDE, root), np.eye(4), 2)
        elif root == "world" and not self._mass(root):
            self.lines += [f"    {site}" for site in self.sites.get(root, ())]
            self._below(root, 2)
        else:
            self._body(root, np.eye(4), [], 2)
        motors = [f"    <motor name={quoteattr(name)} joint={quoteattr(name)}/>" for name in robot.single_joint_names]
        return "\n".join(
            [
                f"<mujoco model={quoteattr(robot.name)}>",
                '  <compiler angle="radian" autolimits="true" inertiafromgeom="false"/>',
                f'  <option gravity="{numbers(robot.gravity.tolist())}"/>',
                "  <worldbody>",
                *self.lines,
                "  </worldbody>",
                *_block("equality", self.equalities),
                *_block("actuator", motors),
                "</mujoco>\n",
            ]
        )

    def _mass(self, link: str) -> float:
        inertial = self.robot.description.links[link]
        return inertial.mass if inertial else 0.0

    def _body(self, link: str, pose: np.ndarray, joints: Sequence[_Axis], depth: int) -> None:
        """One body, and what hangs on it."""
        space = "  " * depth
        self.lines.append(f"{space}<body name={quoteattr(link)}{_placed(pose)}>")
        for joint in joints:
            place = "" if joint.axis is None else _axis(joint)
            self.lines.append(f"{space}  <joint {joint.attributes}{place}/>")
        inertial = self.robot.description.links[link]
        if inertial is not None and inertial.mass > 0.0:
            self.lines.append(f"{space}  {_inertial(inertial.mass, inertial.center_of_mass, inertial.inertia)}")
        self.lines += [f"{space}  {site}" for site in self.sites.get(link, ())]
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
        joints = self._axes(joint)
        while not any(self._mass(name) > 0.0 for name in self._rigid(joint.child)):
            below = self._next(joint.child)
            if len(below) != 1 or joint.type == "floating":
                raise RobotModelError(
                    f"{self.robot.source}: link {joint.child!r} moves and has no mass, which MuJoCo takes only between "
                    "two joints of one degree of freedom; give it a mass."
                )
            self.left_out += self._rigid(joint.child)
            step, joint = below[0]
            joints = [each._replace(pose=inverse(step) @ each.pose) for each in joints] + self._axes(joint)
            pose = pose @ step
        free = joint.type == "floating"
        if free and (depth != 2 or not np.array_equal(pose, np.eye(4))):
            raise RobotModelError(
                f"{self.robot.source}: joint {joint.name!r} floats beside the origin of the world, which MuJoCo does "
                "not take; move its origin there."
            )
        self._body(joint.child, pose, joints, depth)

    def _rigid(self, link: str) -> dict[str, np.ndarray]:
        """The links that move together, with their poses in the first one."""
        found = {link: np.eye(4)}
        for name in (names := [link]):
            for joint in self.children[name]:
                if joint.name not in self.moving:
                    still = joint.origin @ joint_motion(joint, self.held.get(joint.name, 0.0))
                    found[joint.child] = found[name] @ still
                    names.append(joint.child)
        return found

    def _next(self, link: str) -> list[tuple[np.ndarray, Joint]]:
        """The joints that move against these links, and the frames of their children."""
        return [
            (pose @ joint.origin, joint)
            for name, pose in self._rigid(link).items()
            for joint in self.children[name]
            if joint.name in self.moving
        ]

    def _axes(self, joint: Joint) -> list[_Axis]:
        """A joint as MuJoCo's."""
        free, name = joint.type == "floating", joint.name
        rotor = f"{name}.{VELOCITIES[-1]}" if free else name
        return [_Axis(self._attributes(joint, name, KINDS[joint.type], rotor), np.eye(4), None if free else joint.axis)]

    def _attributes(self, joint: Joint, name: str, kind: str, rotor: str | None = None) -> str:
        given = {"armature": self.rotors.get(rotor or name, 0.0), "damping": joint.damping}
        given["frictionloss"] = joint.friction
        parts = [f'{key}="{value!r}"' for key, value in given.items() if value]
        if joint.lower < joint.upper and not math.isinf(joint.upper - joint.lower):
            parts.append(f'range="{joint.lower!r} {joint.upper!r}"')
        if 0.0 < joint.effort_limit < math.inf and kind in ("hinge", "slide"):
            parts.append(f'actuatorfrcrange="{-joint.effort_limit!r} {joint.effort_limit!r}"')
        return " ".join([f'name={quoteattr(name)} type="{kind}"', *parts])

    def _couplings(self) -> list[str]:
        return [
            f"    <joint joint1={quoteattr(joint.name)} joint2={quoteattr(joint.mimics.joint)} "
            f'polycoef="{numbers((joint.mimics.offset, joint.mimics.multiplier, 0.0, 0.0, 0.0))}"/>'
            for joint in self.robot.description.joints
            if joint.mimics is not None and joint.name in self.moving
        ]


def _inertial(mass: float, center: np.ndarray, inertia: np.ndarray) -> str:
    """With principal moments, which MuJoCo keeps to the last digit."""
    moments, axes = np.linalg.eigh(inertia)
    axes = axes * np.sign(np.linalg.det(axes))
    moments = np.maximum(moments, SMALLEST)
    moments[2] = min(moments[2], (moments[0] + moments[1]) * (1.0 - 1e-15))
    pose = _placed(transform(axes, center))
    pose = pose if "pos" in pose else f' pos="0 0 0"{pose}'
    return f'<inertial{pose} mass="{mass!r}" diaginertia="{numbers(moments)}"/>'


def _axis(joint: _Axis) -> str:
    position = joint.pose[:3, 3]
    place = f' pos="{numbers(position)}"' if position.any() else ""
    return f'{place} axis="{numbers(joint.pose[:3, :3] @ np.array(joint.axis))}"'


def _placed(pose: np.ndarray) -> str:
    """Attributes pos and quat, where they are not the default."""
    from scipy.spatial.transform import Rotation

    quaternion = np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)
    position = f' pos="{numbers(pose[:3, 3])}"' if pose[:3, 3].any() else ""
    return position + ("" if np.array_equal(pose[:3, :3], np.eye(3)) else f' quat="{numbers(quaternion)}"')


def _block(tag: str, lines: Sequence[str]) -> list[str]:
    return [f"  <{tag}>", *lines, f"  </{tag}>"] if lines else []
