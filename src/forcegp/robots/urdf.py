"""Strict URDF reader: XML text -> plain description. Everything that could be silently wrong is an error.

Format: http://wiki.ros.org/urdf/XML. Defaults are those of the format (origin: identity, axis: x); a missing
``<limit>`` means no limit. Visual, collision, transmission, sensor and simulator elements are ignored (and kept when
written back).
"""

import difflib
import math
from dataclasses import dataclass
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DTDForbidden, EntitiesForbidden, ExternalReferenceForbidden
from defusedxml import ElementTree as SafeElementTree

from forcegp.errors import (
    DanglingJoint,
    DuplicateName,
    InvalidNumber,
    MalformedUrdf,
    MissingElement,
    UnexpandedXacro,
    UnsafeXml,
    UnsupportedJoint,
)
from forcegp.robots.inertia import rotation_from_rpy, transform

FARTHEST = 1e9  # m; squares of larger numbers overflow
MOVABLE = ("revolute", "continuous", "prismatic", "floating", "planar")


@dataclass(frozen=True)
class InertialDescription:
    """Mass (kg), centre of mass (m) and inertia about it (kg m^2), both in the axes of the link frame."""

    mass: float
    center_of_mass: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class Joint:
    """A movable joint. Positions in rad or m, velocities per s, efforts in Nm or N; missing limits are infinite."""

    name: str
    type: str  # 'revolute' | 'continuous' | 'prismatic'; 'floating' | 'planar' | 'spherical' before they are laid out
    parent: str
    child: str
    axis: tuple[float, float, float]  # unit vector in the joint frame
    lower: float
    upper: float
    velocity_limit: float
    effort_limit: float
    damping: float  # Nms/rad or Ns/m
    friction: float  # Nm or N


@dataclass(frozen=True, eq=False)
class JointDescription(Joint):
    """One ``<joint>``, which may also be fixed; ``origin`` (4, 4) places it in its parent link."""

    origin: np.ndarray
    mimics: str | None


def free_joint(name: str, kind: str, parent: str, child: str) -> JointDescription:
    """A joint without limits and friction, at the origin of its parent; one that is planar moves along x and y."""
    limits = (-math.inf, math.inf, math.inf, math.inf)
    return JointDescription(name, kind, parent, child, (0.0, 0.0, 1.0), *limits, 0.0, 0.0, np.eye(4), None)


@dataclass(frozen=True)
class RobotDescription:
    """The mechanics in a URDF, in file order, before any check that it is a tree."""

    name: str
    source: str
    links: dict[str, InertialDescription | None]
    joints: tuple[JointDescription, ...]


def parse_urdf(text: str, *, source: str) -> RobotDescription:
    """Parse URDF text. ``source``, for example a path, is what the error messages call the file."""
    root = _parse_xml(text, source)
    if root.tag != "robot":
        raise MalformedUrdf(f"{source}: the root element is <{root.tag}>, not <robot>; give a URDF file.")
    _refuse_xacro(root, source)
    links: dict[str, InertialDescription | None] = {}
    for name, element in _named(root, "link", source).items():
        links[name] = _inertial(element, _Place(f"link {name!r}", source))
    if not links:
        raise MalformedUrdf(f"{source}: <robot> holds no <link>; a robot needs at least a base link and one joint.")
    joints = tuple(
        _joint(element, name, links, _Place(f"joint {name!r}", source))
        for name, element in _named(root, "joint", source).items()
    )
    return RobotDescription(_name(root, "robot", source), source, links, joints)


def _named(root: Element, kind: str, source: str) -> dict[str, Element]:
    found: dict[str, Element] = {}
    for element in root.findall(kind):
        name = _name(element, kind, source)
        if name in found:
            raise DuplicateName(f"{source}: two {kind}s are called {name!r}; {kind} names must be unique, rename one.")
        found[name] = element
    return found


@dataclass(frozen=True)
class _Place:
    """Who is speaking in an error message."""

    owner: str
    source: str

    def __str__(self) -> str:
        return f"{self.source}: {self.owner}"


def _parse_xml(text: str, source: str) -> Element:
    if not text.strip():
        raise MalformedUrdf(f"{source}: is empty; give a URDF file that starts with <robot name=...>.")
    try:
        return SafeElementTree.fromstring(text, forbid_dtd=True, forbid_entities=True, forbid_external=True)
    except (DTDForbidden, EntitiesForbidden, ExternalReferenceForbidden):
        raise UnsafeXml(
            f"{source}: contains a DTD, an entity definition or an external reference, which can read files or exhaust "
            "the memory; no URDF needs them, remove the <!DOCTYPE ...> block."
        ) from None
    except (ParseError, UnicodeError) as error:
        hint = ""
        if "unbound prefix" in str(error):
            hint = " If this is a xacro file, expand it first: xacro robot.urdf.xacro > robot.urdf."
        raise MalformedUrdf(f"{source}: is not well-formed XML ({error}); correct that place.{hint}") from None


def _refuse_xacro(root: Element, source: str) -> None:
    mechanics = [element for part in root if part.tag in ("link", "joint") for element in part.iter()]
    expressions = [element for element in mechanics if any("${" in v or "$(" in v for v in element.attrib.values())]
    macros = [element for element in root.iter() if "xacro}" in element.tag]
    for element in (*macros, *expressions):
        raise UnexpandedXacro(
            f"{source}: is an unexpanded xacro file (see <{element.tag.rsplit('}', 1)[-1]}>); "
            "run xacro first: xacro robot.urdf.xacro > robot.urdf."
        )


def _name(element: Element, kind: str, source: str) -> str:
    name = element.get("name")
    if name is None or not name.strip():
        raise MissingElement(f'{source}: a <{kind}> has no name; write <{kind} name="...">.')
    return name


def _attribute(element: Element, attribute: str, place: _Place) -> str:
    value = element.get(attribute)
    if value is None:
        raise MissingElement(f"{place}: <{element.tag}> has no attribute {attribute!r}; add it.")
    return value


def _child(element: Element, tag: str, place: _Place) -> Element:
    child = _optional_child(element, tag, place)
    if child is None:
        raise MissingElement(f"{place}: <{element.tag}> has no <{tag}>; add it.")
    return child


def _optional_child(element: Element, tag: str, place: _Place) -> Element | None:
    children = element.findall(tag)
    if len(children) > 1:
        raise DuplicateName(f"{place}: <{element.tag}> has {len(children)} <{tag}> elements; keep one.")
    return children[0] if children else None


def _number(text: str, what: str, place: _Place) -> float:
    try:
        if "_" in text:  # Python reads 1_000, the format does not
            raise ValueError
        return float(text)
    except ValueError:
        raise InvalidNumber(f"{place}: {what} is {text!r}, not a number; write it like 0.5 or 1e-3.") from None


def _scalar(element: Element | None, attribute: str, default: float, place: _Place) -> float:
    """A number that may be absent and may be infinite, but not NaN."""
    if element is None or attribute not in element.attrib:
        return default
    what = f"<{element.tag}> {attribute}"
    value = _number(element.attrib[attribute], what, place)
    if math.isnan(value):
        raise InvalidNumber(f"{place}: {what} is NaN; give a number.")
    return value


def _non_negative(element: Element | None, attribute: str, default: float, place: _Place) -> float:
    """A number >= 0 that may be absent; only what may be absent as infinite may be infinite."""
    value = _scalar(element, attribute, default, place)
    if value < 0.0 or (math.isinf(value) and not math.isinf(default)):
        allowed = "a number >= 0" if math.isinf(default) else "a finite number >= 0"
        what = "" if element is None else f"<{element.tag}> "
        raise InvalidNumber(f"{place}: {what}{attribute} is {value:g}; give {allowed}, or leave it out.")
    return value


def _vector(element: Element | None, attribute: str, default: tuple[float, ...], place: _Place) -> np.ndarray:
    if element is None or attribute not in element.attrib:
        return np.array(default, dtype=np.float64)
    words = element.attrib[attribute].split()
    what = f"<{element.tag}> {attribute}"
    if len(words) != len(default):
        raise InvalidNumber(f"{place}: {what} holds {len(words)} numbers ({' '.join(words)!r}), not {len(default)}.")
    return np.array([_number(word, what, place) for word in words])


def _origin(element: Element | None, place: _Place) -> np.ndarray:
    xyz = _vector(element, "xyz", (0.0, 0.0, 0.0), place)
    rpy = _vector(element, "rpy", (0.0, 0.0, 0.0), place)
    if not np.isfinite(rpy).all():
        raise InvalidNumber(f"{place}: <origin> rpy {rpy.tolist()} is not finite; give angles in rad.")
    return transform(rotation_from_rpy(rpy), xyz)


def _inertial(link: Element, place: _Place) -> InertialDescription | None:
    element = _optional_child(link, "inertial", place)
    if element is None:
        return None
    mass = _number(_attribute(_child(element, "mass", place), "value", place), "<mass> value", place)
    entries = _child(element, "inertia", place)
    ixx, ixy, ixz, iyy, iyz, izz = (
        _number(_attribute(entries, key, place), f"<inertia> {key}", place)
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    origin = _origin(_optional_child(element, "origin", place), place)
    rotation = origin[:3, :3]
    about_center = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    if not np.array_equal(rotation, np.eye(3)):
        about_center = rotation @ about_center @ rotation.T
    return InertialDescription(mass, origin[:3, 3], 0.5 * (about_center + about_center.T))


def _joint(
    element: Element, name: str, links: dict[str, InertialDescription | None], place: _Place
) -> JointDescription:
    kind = _attribute(element, "type", place)
    if kind not in (*MOVABLE, "fixed"):
        close = difflib.get_close_matches(kind, (*MOVABLE, "fixed"), n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise UnsupportedJoint(f"{place} has the unknown type {kind!r}; allowed: {', '.join(MOVABLE)}, fixed.{hint}")
    ends = {}
    for end in ("parent", "child"):
        ends[end] = _attribute(_child(element, end, place), "link", place)
        if ends[end] not in links:
            close = difflib.get_close_matches(ends[end], links, n=1)
            hint = f" (did you mean {close[0]!r}?)" if close else ""
            raise DanglingJoint(
                f"{place} names the {end} link {ends[end]!r}, which the file does not define{hint}; "
                f"correct the name or add the link. Links: {', '.join(sorted(links))}"
            )
    origin = _origin(_optional_child(element, "origin", place), place)
    if not (np.abs(origin) < FARTHEST).all():
        raise InvalidNumber(f"{place}: <origin> xyz {origin[:3, 3].tolist()} is not finite or far; give metres.")
    axis = _vector(_optional_child(element, "axis", place), "xyz", (1.0, 0.0, 0.0), place)
    length = float(np.linalg.norm(axis))
    if kind in MOVABLE and not (math.isfinite(length) and length > 0.0):
        raise InvalidNumber(f"{place}: <axis> {axis.tolist()} has no direction; give a non-zero, finite vector.")
    unit = tuple((axis / length).tolist()) if kind in MOVABLE else (1.0, 0.0, 0.0)
    limit = _optional_child(element, "limit", place)
    lower, upper = -math.inf, math.inf
    if limit is not None and kind in ("revolute", "prismatic") and ("lower" in limit.attrib or "upper" in limit.attrib):
        # the format's default for the one that is left out is 0
        lower, upper = (_scalar(limit, side, 0.0, place) for side in ("lower", "upper"))
        if lower > upper:
            raise InvalidNumber(f"{place}: lower limit {lower:g} is above upper limit {upper:g}; swap them.")
    dynamics = _optional_child(element, "dynamics", place)
    mimic = _optional_child(element, "mimic", place)
    return JointDescription(
        name=name,
        type=kind,
        parent=ends["parent"],
        child=ends["child"],
        origin=origin,
        axis=unit,
        lower=lower,
        upper=upper,
        velocity_limit=_non_negative(limit, "velocity", math.inf, place),
        effort_limit=_non_negative(limit, "effort", math.inf, place),
        damping=_non_negative(dynamics, "damping", 0.0, place),
        friction=_non_negative(dynamics, "friction", 0.0, place),
        mimics=None if mimic is None else mimic.get("joint", "another joint"),
    )
