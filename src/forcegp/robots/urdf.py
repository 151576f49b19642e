"""URDF text -> plain description (http://wiki.ros.org/urdf/XML). What could be silently wrong is a collected error."""

import difflib
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DTDForbidden, EntitiesForbidden, ExternalReferenceForbidden
from defusedxml import ElementTree as SafeElementTree

from forcegp.errors import (
    InvalidNumber,
    MalformedUrdf,
    UnsafeXml,
    UnsupportedJoint,
)
from forcegp.robots.arguments import Problems
from forcegp.robots.inertia import rotation_from_rpy, transform

MOST_TAGS = 200_000
"""A robot file of two hundred joints has some ten thousand."""
MECHANICS = ("inertial", "origin", "parent", "child", "axis", "limit", "dynamics", "mimic")
"""Parts of a link or joint that are read."""
DEFINITIONS = ("}arg", "}property", "}macro")
"""Elements of xacro that add nothing by themselves."""


def parse_xml(text: str, source: str) -> Element:
    """The root element of XML text without entities and of a size that a robot has. Raises MalformedUrdf, UnsafeXml."""
    text = with_prefixes(text.lstrip())  # as other readers do: nothing may stand before an XML declaration
    if text.count("<") > MOST_TAGS:
        raise MalformedUrdf(f"{source}: holds more than {MOST_TAGS} tags; give the URDF file of one robot.")
    if not text:
        raise MalformedUrdf(f"{source}: is empty; give a URDF file that starts with <robot name=...>.")
    try:
        return SafeElementTree.fromstring(text, forbid_dtd=True, forbid_entities=True, forbid_external=True)
    except (DTDForbidden, EntitiesForbidden, ExternalReferenceForbidden):
        raise UnsafeXml(
            f"{source}: contains a DTD, an entity definition or an external reference, which can read files or exhaust "
            "the memory; no URDF needs them, remove the <!DOCTYPE ...> block."
        ) from None
    except (ParseError, UnicodeError) as error:
        raise MalformedUrdf(f"{source}: is not well-formed XML ({error}); correct that place.") from None


def with_prefixes(text: str) -> str:
    """The text with declarations for prefixes such as ``drake:``, which readers of URDF do not ask for."""
    used = set(re.findall(r"[<\s]([A-Za-z_][\w.-]*):[A-Za-z_]", text)) - {"xml", "xmlns"}
    declared = "".join(f' xmlns:{prefix}="{prefix}"' for prefix in sorted(used) if f"xmlns:{prefix}" not in text)
    return re.sub(r"<robot(?=[\s>])", f"<robot{declared}", text, count=1)


def numbers(values: Iterable[float]) -> str:
    """Numbers as an attribute holds them, with digits that read back exactly."""
    return " ".join(repr(float(value)) for value in values)


def refuse_xacro(root: Element, source: str) -> None:
    """Refuse macros, and expressions in what is read; not in <gazebo> or <visual>, nor definitions."""
    owners = [owner for owner in root if owner.tag in ("link", "joint")]
    read = [*owners, *(inner for owner in owners for part in owner if part.tag in MECHANICS for inner in part.iter())]
    left = DEFINITIONS if root.find("link") is not None else ()
    macros = [
        element
        for owner in (root, *owners)
        for element in owner
        if "xacro}" in element.tag and not element.tag.endswith(left)
    ]
    for element in (*macros, *(each for each in read if re.search(r"\$[{(]", " ".join(each.attrib.values())))):
        raise MalformedUrdf(
            f"{source}: is an unexpanded xacro file (see <{element.tag.rsplit('}', 1)[-1]}>); "
            "name it .xacro, or run xacro first: xacro robot.urdf.xacro > robot.urdf."
        )


FARTHEST = 1e9  # m; squares of larger numbers overflow
LIGHTEST = 1e-20  # kg; what is lighter is a slip, and divides badly
MOVABLE = ("revolute", "continuous", "prismatic")
ENDS = ("parent", "child")


@dataclass(frozen=True)
class InertialDescription:
    """Mass (kg), centre of mass (m), inertia about it (kg m^2; NaN if not given), in the axes of the link frame."""

    mass: float
    center_of_mass: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class Mimic:
    """A joint moves with another: ``q = multiplier q_other + offset``, in rad or m."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Joint:
    """One ``<joint>``. Positions in rad or m, velocities per s, efforts in Nm or N; missing limits are infinite."""

    name: str
    type: str  # 'revolute' | 'continuous' | 'prismatic', of a file also 'fixed' and 'floating'
    parent: str
    child: str
    axis: tuple[float, float, float]  # unit vector in the joint frame
    lower: float
    upper: float
    velocity_limit: float
    effort_limit: float
    damping: float  # Nms/rad or Ns/m
    friction: float  # Nm or N
    origin: np.ndarray = field(compare=False)  # (4, 4), places it in its parent link
    mimics: Mimic | None


def free_joint(name: str, parent: str, child: str) -> Joint:
    """A floating joint without limits and friction, at the origin of its parent."""
    limits = (-math.inf, math.inf, math.inf, math.inf)
    return Joint(name, "floating", parent, child, (0.0, 0.0, 1.0), *limits, 0.0, 0.0, np.eye(4), None)


@dataclass(frozen=True)
class RobotDescription:
    """The mechanics in a URDF, in file order, before any check that it is a tree."""

    name: str
    source: str
    links: dict[str, InertialDescription | None]
    joints: tuple[Joint, ...]
    complete: bool = True
    """Whether every joint of the file could be read."""


def parse_urdf(text: str, problems: Problems) -> RobotDescription:
    """Parse URDF text. ``problems`` collects what is wrong with links and joints, which are then left out."""
    source, element = problems.source, parse_xml(text, problems.source)
    if element.tag != "robot":
        other = "Robot.from_mjcf reads this file" if element.tag == "mujoco" else "give a URDF file"
        raise MalformedUrdf(f"{source}: the root element is <{element.tag}>, not <robot>; {other}.")
    refuse_xacro(element, source)
    name = (element.get("name") or "").strip() or "robot"
    if "name" not in element.attrib:
        problems.note("a <robot> without a name is called 'robot'", "<robot>")
    named, parts = (_named(element, kind, problems) for kind in ("link", "joint"))
    problems.raise_all()  # nothing can be said of what has no name
    links: dict[str, InertialDescription | None] = dict.fromkeys(named)
    for link, part in named.items():
        with problems.collected(link):
            links[link] = _inertial(part, _Place(f"link {link!r}", source, problems))
    if not links:
        raise MalformedUrdf(f"{source}: <robot> holds no <link>; a robot needs at least a base link and one joint.")
    joints = []
    for joint, part in parts.items():
        with problems.collected():
            joints.append(_joint(part, joint, links, _Place(f"joint {joint!r}", source, problems)))
    return RobotDescription(name, source, links, tuple(joints), len(joints) == len(parts))


def _named(root: Element, kind: str, problems: Problems) -> dict[str, Element]:
    found: dict[str, Element] = {}
    for element in root.findall(kind):
        with problems.collected():
            name = element.get("name", "")
            if not name.strip():
                raise MalformedUrdf(f'{problems.source}: a <{kind}> has no name; write <{kind} name="...">.')
            if name in found:
                seen = f"{problems.source}: two {kind}s are called {name!r}"
                raise MalformedUrdf(seen, f"; {kind} names must be unique, rename one.")
            found[name] = element
    return found


@dataclass(frozen=True)
class _Place:
    """Who is speaking in an error message."""

    owner: str
    source: str
    problems: Problems

    def __str__(self) -> str:
        return f"{self.source}: {self.owner}"


def _attribute(element: Element, attribute: str, place: _Place) -> str:
    value = element.get(attribute)
    if value is None:
        raise MalformedUrdf(f"{place}: <{element.tag}> has no attribute {attribute!r}; add it.")
    return value


def _child(element: Element, tag: str, place: _Place) -> Element:
    child = _optional_child(element, tag, place)
    if child is None:
        raise MalformedUrdf(f"{place}: <{element.tag}> has no <{tag}>; add it.")
    return child


def _optional_child(element: Element, tag: str, place: _Place) -> Element | None:
    children = element.findall(tag)
    if len(children) > 1:  # as in other readers
        place.problems.note(f"the first of several <{tag}> counts", place.owner)
    return children[0] if children else None


def _number(text: str, what: str, place: _Place) -> float:
    try:
        if "_" in text or not text.isascii():  # Python reads 1_000 and digits of every script, the format does not
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


def _loss(element: Element | None, attribute: str, place: _Place) -> float:
    """Damping or dry friction: a finite number >= 0 that may be absent; a negative one is none."""
    value = _non_negative(element, attribute, 0.0, place, "none")
    if math.isinf(value):
        raise InvalidNumber(f"{place}: <dynamics> {attribute} is inf; give a finite number >= 0, or leave it out.")
    return value


def _non_negative(element: Element | None, attribute: str, default: float, place: _Place, none: str) -> float:
    value = _scalar(element, attribute, default, place)
    if element is not None and value < 0.0:
        place.problems.note(f"a negative <{element.tag}> {attribute} is taken as {none}", place.owner)
        return default
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
    if not (np.abs(xyz) < FARTHEST).all():
        raise InvalidNumber(f"{place}: <origin> xyz {xyz.tolist()} is not finite or far; give metres.")
    return transform(rotation_from_rpy(rpy), xyz)


def _inertial(link: Element, place: _Place) -> InertialDescription | None:
    element = _optional_child(link, "inertial", place)
    if element is None:
        return None
    mass_element = _optional_child(element, "mass", place)
    if mass_element is None or "value" not in mass_element.attrib:  # as in other readers
        place.problems.note("an <inertial> without mass is left out", place.owner)
        return None
    mass = _number(mass_element.attrib["value"], "<mass> value", place)
    if 0.0 < mass < LIGHTEST:
        raise InvalidNumber(f"{place}: <mass> value is {mass!r} kg, too small for a body; give 0 for a mere frame.")
    entries = _optional_child(element, "inertia", place)
    products = [] if entries is None else [key for key in ("ixy", "ixz", "iyz") if key not in entries.attrib]
    if products:
        place.problems.note("a product of inertia that is not given is 0", place.owner)
    given = {} if entries is None else {key: "0" for key in products} | entries.attrib

    def entry(key: str) -> float:
        if entries is None:  # a mere frame has none
            return np.nan if mass else 0.0
        text = given[key] if key in given else _attribute(entries, key, place)
        return _number(text, f"<inertia> {key}", place)

    ixx, ixy, ixz, iyy, iyz, izz = map(entry, ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    origin = _origin(_optional_child(element, "origin", place), place)
    rotation = origin[:3, :3]
    about_center = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    if not np.array_equal(rotation, np.eye(3)):
        about_center = rotation @ about_center @ rotation.T
    return InertialDescription(mass, origin[:3, 3], 0.5 * (about_center + about_center.T))


def _joint(element: Element, name: str, links: dict[str, InertialDescription | None], place: _Place) -> Joint:
    kind = _attribute(element, "type", place)
    kinds = (*MOVABLE, "fixed", "floating")
    if kind not in kinds:
        close = difflib.get_close_matches(kind, kinds, n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise UnsupportedJoint(f"{place} has the unknown type {kind!r}; allowed: {', '.join(kinds)}.{hint}")
    ends = {}
    for end in ENDS:
        ends[end] = _attribute(_child(element, end, place), "link", place)
        if ends[end] not in links:
            close = difflib.get_close_matches(ends[end], links, n=1)
            hint = f" (did you mean {close[0]!r}?)" if close else ""
            raise MalformedUrdf(
                f"{place} names the {end} link {ends[end]!r}, which the file does not define{hint}",
                f"; correct the name or add the link. Links: {', '.join(sorted(links))}",
            )
    origin = _origin(_optional_child(element, "origin", place), place)
    axis_element = _optional_child(element, "axis", place)
    axis = _vector(axis_element, "xyz", (1.0, 0.0, 0.0), place)
    length, directed = float(np.linalg.norm(axis)), kind in MOVABLE
    if directed and not (math.isfinite(length) and length > 0.0):
        held = (place.problems.given.get("locked") or {}).get(name)
        if held != 0.0:
            seen = f"{place}: <axis> {axis.tolist()} has no direction"
            advice = "; give a non-zero, finite vector, or lock the joint."
            place.problems.errors.append(InvalidNumber(seen, advice, {"locked": {name: 0.0}}))
        directed = False
    unit = tuple((axis / length).tolist()) if directed else (1.0, 0.0, 0.0)
    limit = _optional_child(element, "limit", place)
    lower, upper = -math.inf, math.inf
    if limit is not None and kind in ("revolute", "prismatic") and ("lower" in limit.attrib or "upper" in limit.attrib):
        # the format's default for the one that is left out is 0
        lower, upper = (_scalar(limit, side, 0.0, place) for side in ("lower", "upper"))
        if lower > upper:
            place.problems.note("a lower limit above the upper one is taken as no limit", place.owner)
            lower, upper = -math.inf, math.inf
    dynamics = _optional_child(element, "dynamics", place)
    mimic = _optional_child(element, "mimic", place)
    if mimic is not None and kind == "fixed":
        place.problems.note("the <mimic> of a fixed joint is ignored", place.owner)
    return Joint(
        name=name,
        type=kind,
        parent=ends["parent"],
        child=ends["child"],
        origin=origin,
        axis=unit,
        lower=lower,
        upper=upper,
        velocity_limit=_non_negative(limit, "velocity", math.inf, place, "no limit"),
        effort_limit=_non_negative(limit, "effort", math.inf, place, "no limit"),
        damping=_loss(dynamics, "damping", place),
        friction=_loss(dynamics, "friction", place),
        mimics=None if mimic is None or kind == "fixed" else _mimic(mimic, place),
    )


def _mimic(element: Element, place: _Place) -> Mimic:
    numbers = [_scalar(element, name, default, place) for name, default in (("multiplier", 1.0), ("offset", 0.0))]
    if not np.isfinite(numbers).all():
        raise InvalidNumber(f"{place}: <mimic> holds numbers that are not finite; correct multiplier and offset.")
    return Mimic(_attribute(element, "joint", place), *numbers)
