"""URDF files: inertials, friction and impossible inertias replaced in the text."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from defusedxml import minidom
from jaxtyping import Float

from forcegp.atomic_files import unreadable
from forcegp.errors import LARGEST, InvalidInput, NonPhysicalInertia, RobotModelError, UnknownName, required_extra
from forcegp.robots.arguments import Armature, Problems, by_joint, finite_vector
from forcegp.robots.inertia import physical_objection
from forcegp.robots.layout import Layout
from forcegp.robots.urdf import RobotDescription, numbers, parse_urdf, with_prefixes
from forcegp.sandbox import read_apart

HEAVIEST = 1e9  # kg and kg m^2, of one link: far from where products of inertias overflow
LARGEST_FILE = 16 << 20  # bytes; robot files have some hundred thousand
IN_THE_FILE = ". Correct its <inertial> (inertia is about the centre of mass, in kg m^2, in the axes of its <origin>)"
InertiaChoice = Literal["strict", "nearest"]
"""What to do about a link with an inertia that no body has: refuse it, or replace it by the nearest possible."""

MARGIN = 1e-3
"""Smallest second moment of a repaired body as a fraction of their sum: 3 % of its size thick, not a plate."""


def read_text(path: str | Path) -> str:
    """Decode a URDF file; :class:`RobotModelError` where there is none or it is not text."""
    path = Path(path)
    if why := unreadable(path, LARGEST_FILE):
        raise RobotModelError(f"{path}: {why}; give the URDF file of one robot.")
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise RobotModelError(f"{path}: no such file; give the path of a URDF file.") from None
    except IsADirectoryError:
        inside = sorted(entry.name for entry in path.iterdir() if entry.suffix == ".urdf")
        hint = f" It holds {', '.join(inside)}." if inside else ""
        raise RobotModelError(f"{path}: is a directory; give the path of the URDF file itself.{hint}") from None
    except OSError as error:
        raise RobotModelError(f"{path}: cannot be read ({error.strerror}); check path and permissions.") from None
    try:
        return data.decode()
    except UnicodeDecodeError:
        raise RobotModelError(f"{path}: is not UTF-8 text; save the robot file as UTF-8.") from None


def replace_inertial(
    text: str, link: str, mass: float, center_of_mass: np.ndarray, inertia: np.ndarray, *, source: str
) -> str:
    """URDF text with the ``<inertial>`` (kg, m, kg m^2, link axes) of ``link`` replaced or added, read back exactly."""
    document = _document(text)
    owner = _found(document, "link", link, source)
    new = minidom.parseString(inertial_element(mass, center_of_mass, inertia)).documentElement
    old = _child(owner, "inertial")
    owner.replaceChild(new, old) if old else owner.appendChild(new)
    return _written(document)


def replace_dynamics(text: str, joints: Mapping[str, Mapping[str, float]], *, source: str) -> str:
    """URDF text with these attributes ('damping', 'friction', 'armature') of the ``<dynamics>`` of joints."""
    document = _document(text)
    for joint, values in joints.items():
        owner = _found(document, "joint", joint, source)
        if (dynamics := _child(owner, "dynamics")) is None:
            if not any(values.values()):
                continue
            dynamics = owner.appendChild(document.createElement("dynamics"))
            values = {"damping": 0.0, **values}  # other readers refuse an element without damping and friction
        for name, value in values.items():
            dynamics.setAttribute(name, repr(value))
    return _written(document)


def with_joint_values(text: str, layout: Layout, values: Mapping[str, Sequence[float]], *, source: str) -> str:
    """URDF text with these attributes (nv,) of all joints of one degree of freedom; those that follow one have 0."""
    free = {body for group in layout.groups for body in range(group.bodies.start, group.bodies.stop)}
    given = {}
    for body, (joint, drive) in enumerate(zip(layout.bodies, layout.drives, strict=True)):
        own = joint.name == layout.joints[drive.joint].name
        if body not in free:
            given[joint.name] = {name: float(each[drive.joint]) if own else 0.0 for name, each in values.items()}
    return replace_dynamics(text, given, source=source)


def with_armature(text: str, layout: Layout, given: Armature, robot: str, *, source: str) -> str:
    """URDF text with these rotor inertias (kg m^2 or kg), in joint order or by joint name; 0 where none is given."""
    joints = tuple(joint.name for joint in layout.joints)
    values = finite_vector("armature", by_joint(given, joints, robot), len(joints))
    if (values < 0.0).any():
        joint = joints[int(np.argmin(values))]
        raise InvalidInput(f"armature of joint {joint!r} is {values.min():g}; a rotor inertia cannot be negative.")
    free = [k for group in layout.groups for k in range(group.rows.start, group.rows.stop)]
    for name, value in ((joints[k], values[k]) for k in free if values[k]):
        raise InvalidInput(f"armature of joint {name!r} is {value:g}; a base that moves has no rotors, give 0.")
    return with_joint_values(text, layout, {"armature": values.tolist()}, source=source)


def with_limits(text: str) -> str:
    """URDF text whose joints have the limits that urdfdom needs: `LARGEST`, which reads as none, where it has none."""
    document, lacking = _document(text), False
    for joint in document.documentElement.childNodes:
        if joint.nodeName != "joint" or joint.getAttribute("type") not in ("revolute", "prismatic"):
            continue
        limit = _child(joint, "limit") or joint.appendChild(document.createElement("limit"))
        free = {"lower": -LARGEST, "upper": LARGEST}
        ends = {} if any(map(limit.hasAttribute, free)) else free
        for name, value in {**ends, "effort": LARGEST, "velocity": LARGEST}.items():
            if not limit.hasAttribute(name):
                limit.setAttribute(name, f"{value:g}")
                lacking = True
    return _written(document) if lacking else text


def _document(text: str) -> Any:
    return minidom.parseString(with_prefixes(text))


def _found(document: Any, kind: str, name: str, source: str) -> Any:  # directly in the root; raises UnknownName
    for element in document.documentElement.childNodes:
        if element.nodeName == kind and element.getAttribute("name") == name:
            return element
    raise UnknownName(f"{source}: no {kind} {name!r} in the URDF text.")


def _child(owner: Any, tag: str) -> Any:
    return next((part for part in owner.childNodes if part.nodeName == tag), None)


def _written(document: Any) -> str:
    return "".join(node.toxml() for node in document.childNodes) + "\n"


def inertial_element(mass: float, center_of_mass: Iterable[float], inertia: np.ndarray) -> str:
    """The text of an ``<inertial>``, in the axes of its link."""
    entries = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    moments = " ".join(f'{key}="{float(inertia[index])!r}"' for key, index in entries.items())
    origin = f'<origin xyz="{numbers(center_of_mass)}" rpy="0 0 0"/>'
    return f'<inertial>{origin}<mass value="{float(mass)!r}"/><inertia {moments}/></inertial>'


def nearest_inertia(inertia: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The inertia (kg m^2) of the body whose second moments are nearest, and at least `MARGIN` of their sum."""
    moments, axes = np.linalg.eigh(inertia)
    second = 0.5 * moments.sum() - moments
    second = np.maximum(second, MARGIN * np.maximum(second, 0.0).sum())
    return (axes * (second.sum() - second)) @ axes.T


def with_chosen_inertias(
    choice: str, text: str, description: RobotDescription, layout: Layout, problems: Problems
) -> tuple[str, RobotDescription]:
    """URDF text and description with possible inertias for impossible ones of moving links; every other byte stays.

    With "strict" `problems` collects these links, with "nearest" it notes them. Raises InvalidInput for another choice.
    """
    if choice not in get_args(InertiaChoice):
        raise InvalidInput(f"inertias is {choice!r}; give one of {', '.join(get_args(InertiaChoice))}.")
    links, source, changed = dict(description.links), description.source, False
    for name in layout.moving:
        inertial = links[name]
        if inertial is None or name in problems.broken:
            continue
        bare, center = bool(np.isnan(inertial.inertia).all()), inertial.center_of_mass
        given = np.zeros((3, 3)) if bare else inertial.inertia
        heavy = HEAVIEST < max(inertial.mass, np.abs(given).max()) < np.inf
        objection = f"its mass or inertia is above {HEAVIEST:.0e} kg or kg m^2" if heavy else None
        objection = objection or physical_objection(inertial.mass, center, given)
        seen = f"{source}: no physical body has the inertia of link {name!r}: {objection}"
        if objection is None and bare:
            seen = f"{source}: link {name!r} has a mass and its <inertial> no <inertia>"
        elif objection is None:
            continue
        if heavy or not (inertial.mass >= 0.0 and np.isfinite([inertial.mass, *given.flat, *center]).all()):
            problems.broken.add(name)
            links[name] = None  # what follows is computed without numbers that are not finite
            problems.errors.append(NonPhysicalInertia(seen, f"{IN_THE_FILE}."))
            continue
        nearest = nearest_inertia(given) if inertial.mass > 0.0 else np.zeros((3, 3))
        links[name] = replace(inertial, inertia=nearest)
        if choice == "strict":
            lacks = "; add it, or take the mass as a point at its centre."
            advice = lacks if objection is None else f"{IN_THE_FILE}, or take the nearest inertia that a body has."
            problems.errors.append(NonPhysicalInertia(seen, advice, {"inertias": "nearest"}))
            continue
        changed, text = True, replace_inertial(text, name, inertial.mass, center, nearest, source=source)
        if objection is None:
            problems.note("a mass without <inertia> is taken as a point", f"link {name!r}")
            continue
        relative = 100.0 * np.linalg.norm(nearest - given) / np.linalg.norm(given)
        where = f"link {name!r}: {objection}; changed by {relative:.2g} %"
        problems.note("an inertia that no body has is replaced by the nearest one that a body has", where)
    links = dict(parse_urdf(text, Problems(source)).links) if changed else links
    for name, inertial in links.items():
        if inertial is not None and name not in layout.moving and np.isnan(inertial.inertia).all():
            links[name] = replace(inertial, inertia=np.zeros((3, 3)))  # of a link that never moves
    return text, replace(description, links=links)


def read_robot_file(path: str | Path) -> str:
    """URDF text of a file, .xacro expanded. Raises RobotModelError, MissingExtra."""
    text = read_text(path)
    if Path(path).suffix != ".xacro":
        return text
    required_extra("xacro", "xacro", f"{path}: a file that is not expanded elsewhere")
    answer = read_apart("xacro", str(path), {"path": str(Path(path).absolute())})
    if "refused" in answer:
        seen = f"{path}: xacro could not expand it ({answer['refused']})"
        advice = "correct it, or expand it where its packages are: xacro robot.xacro > robot.urdf."
        raise RobotModelError(f"{seen}; {advice}")
    return answer["text"]
