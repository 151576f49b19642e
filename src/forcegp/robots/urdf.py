"""URDF text -> plain description (http://wiki.ros.org/urdf/XML). What could be silently wrong is a collected error."""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml import DTDForbidden, EntitiesForbidden, ExternalReferenceForbidden
from defusedxml import ElementTree as SafeElementTree

from forcegp.errors import LARGEST, RobotModelError, require_known
from forcegp.robots.arguments import Problems
from forcegp.robots.inertia import rotation_from_rpy, transform

MOST_TAGS = 200_000  # a robot file of two hundred joints has some ten thousand
FAR, LIGHT = 10.0, 1e-9
"""Lengths in m and masses in kg that are named: of a file in millimetres or grams, or with a slip of the pen."""
MECHANICS = ("inertial", "origin", "parent", "child", "axis", "limit", "dynamics", "mimic")
"""Parts of a link or joint that are read."""
DEFINITIONS = ("}arg", "}property", "}macro")  # elements of xacro that add nothing by themselves
FARTHEST = 1e9  # m; squares of larger numbers overflow
LIGHTEST = 1e-20  # kg; what is lighter is a slip, and divides badly
MOVABLE = ("revolute", "continuous", "prismatic")


def parse_xml(text: str, source: str) -> Element:
    """The root element of XML text without entities and of a size that a robot has. Raises RobotModelError."""
    text = with_prefixes(text.lstrip())  # as other readers do: nothing may stand before an XML declaration
    if text.count("<") > MOST_TAGS:
        raise RobotModelError(f"{source}: holds more than {MOST_TAGS} tags; give the URDF file of one robot.")
    if not text:
        raise RobotModelError(f"{source}: is empty; give a URDF file that starts with <robot name=...>.")
    try:
        return SafeElementTree.fromstring(text, forbid_dtd=True, forbid_entities=True, forbid_external=True)
    except (DTDForbidden, EntitiesForbidden, ExternalReferenceForbidden):
        seen = f"{source}: contains a DTD, an entity definition or an external reference"
        why = "which can read files or exhaust the memory"
        raise RobotModelError(f"{seen}, {why}; no URDF needs them, remove the <!DOCTYPE ...> block.") from None
    except (ParseError, UnicodeError) as error:
        raise RobotModelError(f"{source}: is not well-formed XML ({error}); correct that place.") from None


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
    macros = (element for owner in (root, *owners) for element in owner if "xacro}" in element.tag)
    found = [element for element in macros if not element.tag.endswith(left)]
    for element in (*found, *(each for each in read if re.search(r"\$[{(]", " ".join(each.attrib.values())))):
        seen = f"{source}: is an unexpanded xacro file (see <{element.tag.rsplit('}', 1)[-1]}>)"
        raise RobotModelError(f"{seen}; name it .xacro, or run xacro first: xacro robot.urdf.xacro > robot.urdf.")


@dataclass(frozen=True, eq=False)
class Link:
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
    """One ``<joint>``. Positions in rad or m, velocities per s, efforts in Nm or N.

    Limits that are missing, or of `LARGEST` and beyond, are infinite.
    """

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
    armature: float  # kg m^2 or kg, inertia of the rotor seen at the joint; an attribute that URDF itself lacks
    origin: np.ndarray = field(compare=False)  # (4, 4), places it in its parent link
    mimics: Mimic | None


def free_joint(name: str, parent: str, child: str) -> Joint:
    """A floating joint without limits, friction and rotor, at the origin of its parent."""
    limits = (-math.inf, math.inf, math.inf, math.inf)
    return Joint(name, "floating", parent, child, (0.0, 0.0, 1.0), *limits, 0.0, 0.0, 0.0, np.eye(4), None)


@dataclass(frozen=True)
class RobotDescription:
    """The mechanics in a URDF, in file order, before any check that it is a tree."""

    name: str
    source: str
    links: dict[str, Link | None]
    joints: tuple[Joint, ...]
    complete: bool = True
    """Whether every joint of the file could be read."""


def parse_urdf(text: str, problems: Problems) -> RobotDescription:
    """Parse URDF text. ``problems`` collects what is wrong with links and joints, which are then left out."""
    source, element = problems.source, parse_xml(text, problems.source)
    if element.tag != "robot":
        other = "Robot.from_mjcf reads this file" if element.tag == "mujoco" else "give a URDF file"
        raise RobotModelError(f"{source}: the root element is <{element.tag}>, not <robot>; {other}.")
    refuse_xacro(element, source)
    name = (element.get("name") or "").strip() or "robot"
    if "name" not in element.attrib:
        problems.note("a <robot> without a name is called 'robot'", "<robot>")
    named, parts = (_named(element, kind, problems) for kind in ("link", "joint"))
    problems.raise_all()  # nothing can be said of what has no name
    links: dict[str, Link | None] = dict.fromkeys(named)
    for link, part in named.items():
        with problems.collected(link):
            links[link] = _inertial(_Part(part, f"link {link!r}", problems))
    if not links:
        raise RobotModelError(f"{source}: <robot> holds no <link>; a robot needs at least a base link and one joint.")
    joints = []
    for joint, part in parts.items():
        with problems.collected():
            joints.append(_joint(_Part(part, f"joint {joint!r}", problems), joint, links))
    far = {f"centre of mass of {link}": at.center_of_mass for link, at in links.items() if at is not None}
    for what, place in (far | {f"origin of {joint.name}": joint.origin[:3, 3] for joint in joints}).items():
        if np.linalg.norm(place) > FAR:
            problems.note(f"more than {FAR:g} m away; are lengths in metres?", what)
    for link in (joint.child for joint in joints if joint.type != "fixed"):  # others weigh with what they are fixed to
        if (at := links.get(link)) is not None and 0.0 < at.mass < LIGHT:
            problems.note(f"lighter than {LIGHT:g} kg; are masses in kilograms?", link)
    return RobotDescription(name, source, links, tuple(joints), len(joints) == len(parts))


def _named(root: Element, kind: str, problems: Problems) -> dict[str, Element]:
    found: dict[str, Element] = {}
    for element in root.findall(kind):
        with problems.collected():
            name = element.get("name", "")
            if not name.strip():
                raise RobotModelError(f'{problems.source}: a <{kind}> has no name; write <{kind} name="...">.')
            if name in found:
                seen = f"{problems.source}: two {kind}s are called {name!r}"
                raise RobotModelError(seen, f"; {kind} names must be unique, rename one.")
            found[name] = element
    return found


@dataclass(frozen=True)
class _Part:
    """An element of a link or joint, None where it is not there; in error messages, whose it is."""

    element: Element | None
    owner: str
    problems: Problems

    def __str__(self) -> str:
        return f"{self.problems.source}: {self.owner}"

    def child(self, tag: str, needed: bool = False) -> "_Part":
        children = [] if self.element is None else self.element.findall(tag)
        if len(children) > 1:  # as in other readers
            self.problems.note(f"the first of several <{tag}> counts", self.owner)
        if needed and not children:
            inside = "it" if self.element is None else f"<{self.element.tag}>"
            raise RobotModelError(f"{self}: {inside} has no <{tag}>; add it.")
        return _Part(children[0] if children else None, self.owner, self.problems)

    def get(self, attribute: str) -> str | None:
        return None if self.element is None else self.element.get(attribute)

    def text(self, attribute: str) -> str:
        if (value := self.get(attribute)) is None:
            tag = "" if self.element is None else self.element.tag
            raise RobotModelError(f"{self}: <{tag}> has no attribute {attribute!r}; add it.")
        return value

    def parsed(self, text: str, what: str) -> float:
        try:
            if "_" in text or not text.isascii():  # Python reads 1_000 and digits of every script, the format does not
                raise ValueError
            return float(text)
        except ValueError:
            raise RobotModelError(f"{self}: {what} is {text!r}, not a number; write it like 0.5 or 1e-3.") from None

    def number(self, attribute: str, default: float, negative: str = "") -> float:
        """A number that may be absent and infinite, but not NaN; `negative` is what one below 0 is taken as."""
        if (text := self.get(attribute)) is None or self.element is None:
            return default
        what = f"<{self.element.tag}> {attribute}"
        value = self.parsed(text, what)
        if math.isnan(value) or (default == 0.0 and negative and math.isinf(value)):
            raise RobotModelError(f"{self}: {what} is {'NaN' if math.isnan(value) else 'inf'}; give a finite number.")
        if negative and default == 0.0 and value > LARGEST:
            raise RobotModelError(f"{self}: {what} is {value:g}, more than {LARGEST:g} in SI units; correct it.")
        if negative and value < 0.0:
            self.problems.note(f"a negative {what} is taken as {negative}", self.owner)
            return default
        return value

    def vector(self, attribute: str, default: tuple[float, ...]) -> np.ndarray:
        if (text := self.get(attribute)) is None or self.element is None:
            return np.array(default, dtype=np.float64)
        words, what = text.split(), f"<{self.element.tag}> {attribute}"
        if len(words) != len(default):
            raise RobotModelError(f"{self}: {what} holds {len(words)} numbers ({text!r}), not {len(default)}.")
        return np.array([self.parsed(word, what) for word in words])

    def origin(self) -> np.ndarray:
        """The pose (4, 4) of its <origin>."""
        at = self.child("origin")
        xyz, rpy = (at.vector(name, (0.0, 0.0, 0.0)) for name in ("xyz", "rpy"))
        if not np.isfinite(rpy).all():
            raise RobotModelError(f"{self}: <origin> rpy {rpy.tolist()} is not finite; give angles in rad.")
        if not (np.abs(xyz) < FARTHEST).all():
            raise RobotModelError(f"{self}: <origin> xyz {xyz.tolist()} is not finite or far; give metres.")
        return transform(rotation_from_rpy(rpy), xyz)


def _inertial(link: _Part) -> Link | None:
    element = link.child("inertial")
    text = element.child("mass").get("value")
    if element.element is None:
        return None
    if text is None:  # as in other readers
        link.problems.note("an <inertial> without mass is left out", link.owner)
        return None
    mass = link.parsed(text, "<mass> value")
    if 0.0 < mass < LIGHTEST:
        raise RobotModelError(f"{link}: <mass> value is {mass!r} kg, too small for a body; give 0 for a mere frame.")
    entries = element.child("inertia")
    if entries.element is None:  # a mere frame has none
        moments = np.full((3, 3), np.nan if mass else 0.0)
    else:
        if any(entries.get(key) is None for key in ("ixy", "ixz", "iyz")):
            link.problems.note("a product of inertia that is not given is 0", link.owner)
        moments = np.zeros((3, 3))
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"):
            i, j = ("xyz".index(axis) for axis in key[1:])
            given = entries.text(key) if i == j else entries.get(key) or "0"
            moments[i, j] = moments[j, i] = link.parsed(given, f"<inertia> {key}")
    origin = element.origin()
    if not np.array_equal(origin[:3, :3], np.eye(3)):
        moments = origin[:3, :3] @ moments @ origin[:3, :3].T
    return Link(mass, origin[:3, 3], 0.5 * (moments + moments.T))


def _joint(at: _Part, name: str, links: dict[str, Link | None]) -> Joint:
    kind, kinds = at.text("type"), (*MOVABLE, "fixed", "floating")
    require_known("type", kind, at.owner, kinds, RobotModelError)
    ends = {}
    for end in ("parent", "child"):
        ends[end] = at.child(end, needed=True).text("link")
        require_known(f"{end} link", ends[end], at.owner, links, RobotModelError)
    origin, axis = at.origin(), at.child("axis").vector("xyz", (1.0, 0.0, 0.0))
    length, directed = float(np.linalg.norm(axis)), kind in MOVABLE
    if directed and not (math.isfinite(length) and length > 0.0):
        if (at.problems.given.get("locked") or {}).get(name) != 0.0:
            seen = f"{at}: <axis> {axis.tolist()} has no direction"
            advice = "; give a non-zero, finite vector, or lock the joint."
            at.problems.errors.append(RobotModelError(seen, advice, {"locked": {name: 0.0}}))
        directed = False
    limit, dynamics, mimic = (at.child(tag) for tag in ("limit", "dynamics", "mimic"))
    lower, upper = -math.inf, math.inf
    if kind in ("revolute", "prismatic") and (limit.get("lower"), limit.get("upper")) != (None, None):
        lower, upper = (limit.number(side, 0.0) for side in ("lower", "upper"))  # the format's default is 0
        if lower > upper:
            at.problems.note("a lower limit above the upper one is taken as no limit", at.owner)
            lower, upper = -math.inf, math.inf
    mimics = None
    if mimic.element is not None and kind == "fixed":
        at.problems.note("the <mimic> of a fixed joint is ignored", at.owner)
    elif mimic.element is not None:
        ratio = mimic.number("multiplier", 1.0), mimic.number("offset", 0.0)
        if not np.abs(ratio).max() <= FARTHEST:
            raise RobotModelError(f"{at}: <mimic> holds numbers not finite or above {FARTHEST:g}; correct them.")
        mimics = Mimic(mimic.text("joint"), *ratio)
    return Joint(
        name=name,
        type=kind,
        parent=ends["parent"],
        child=ends["child"],
        origin=origin,
        axis=tuple((axis / length).tolist()) if directed else (1.0, 0.0, 0.0),
        lower=lower if lower > -LARGEST else -math.inf,
        upper=upper if upper < LARGEST else math.inf,
        velocity_limit=fastest if (fastest := limit.number("velocity", math.inf, "no limit")) < LARGEST else math.inf,
        effort_limit=most if (most := limit.number("effort", math.inf, "no limit")) < LARGEST else math.inf,
        damping=dynamics.number("damping", 0.0, "none"),
        friction=dynamics.number("friction", 0.0, "none"),
        armature=dynamics.number("armature", 0.0, "none") if kind in MOVABLE else 0.0,
        mimics=mimics,
    )
