"""Values that nobody expects: numbers, texts, JSON of any shape, and edits of JSON, bytes and XML."""

import json
import pickle
import random
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from typing import Any

from hypothesis import strategies as st
from tests.fuzz.oracle import CANARY


def words(text: str) -> tuple[str, ...]:
    return tuple(text.split())


NUMBERS = words("0 -0 1 -1 2 0.5 1e400 -1e400 1e308 1e-320 nan NaN inf -inf 1.5 1_000 0x10 1,5 ٣ 1e5000 + .")
NUMBERS += ("10000000000000000000000000", "-9223372036854775809")
TEXTS = ("", " ", "\t", "a\nb", "a" * 5000, "\u202e")
TEXTS += words("x q a,b , = : é 🤖 ../.. %s {} {x} [ - -- none auto null true ' \" \\ * ** $HOME ~ q_{joints}")
WORDS = st.sampled_from(NUMBERS + TEXTS)

PLAIN = (None, True, False, 0, -0.0, 1, -1, 2, 10**30, 2**63, 1.5, 1e308, -1e308, 1e-320, float("nan"), float("inf"))
SHORT = ("", "x", "nan", "1", "\x00", "\ud800", "é", "q", "rad", "analytical", "joint", "x" * 300)
SCALARS = st.sampled_from((*PLAIN, *SHORT))
JSON = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(WORDS, inner, max_size=3), max_leaves=6
)
RAW = ("@deep", "@digits")
"""Stand for JSON that `json.dumps` does not write: nested 100,000 times, and a number of 5000 digits."""


@dataclass(frozen=True)
class JsonEdit:
    """`how` is done at the entry number `where` of a document."""

    where: int
    how: str
    value: Any = None


JSON_EDITS = st.builds(
    JsonEdit, st.integers(0, 2000), st.sampled_from(("set", "set", "set", "delete", "add", "another")),
    JSON | st.sampled_from(RAW),
)  # fmt: skip


def edited_json(document: Any, edits: list[JsonEdit]) -> str:
    """The text of the document after these edits, which may no longer be JSON."""
    document = json.loads(json.dumps(document))
    for edit in edits:
        holders = list(_entries(document))
        if not holders:
            break
        holder, key = holders[edit.where % len(holders)]
        match edit.how:
            case "set":
                holder[key] = edit.value
            case "delete":
                del holder[key]
            case "another":
                other, name = holders[(7 * edit.where + 3) % len(holders)]
                holder[key] = json.loads(json.dumps(other[name]))
            case _:
                if isinstance(holder, dict):
                    holder["extra"] = edit.value
                else:
                    holder.append(edit.value)
    return json.dumps(document).replace('"@deep"', "[" * 100_000 + "]" * 100_000).replace('"@digits"', "9" * 5000)


def _entries(node: Any):
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in list(items):
        yield node, key
        if not (isinstance(value, list) and len(value) > 30):  # thousands of numbers alike
            yield from _entries(value)


@dataclass(frozen=True)
class Damage:
    """What happens to the bytes of a file; all of it is drawn from `seed`."""

    seed: int
    how: str


DAMAGE = st.builds(
    Damage,
    st.integers(0, 2**31),
    st.sampled_from(("flip", "flip", "cut", "lose", "insert", "ones", "empty", "random", "twice", "pickle", "zeros")),
)


def damaged(content: bytes, damage: Damage) -> bytes:
    generator = random.Random(damage.seed)
    place, count = generator.randrange(len(content) + 1), generator.choice((1, 4, 40, 1000))
    match damage.how:
        case "flip" if content:
            place = min(place, len(content) - 1)
            return content[:place] + bytes([content[place] ^ (1 << generator.randrange(8))]) + content[place + 1 :]
        case "cut":
            return content[:place]
        case "lose":
            return content[:place] + content[place + count :]
        case "insert":
            return content[:place] + generator.randbytes(count) + content[place:]
        case "ones":
            return content[:place] + b"\xff" * 8 + content[place + 8 :]
        case "zeros":
            return content[:place] + b"\x00" * count + content[place + count :]
        case "empty":
            return b""
        case "random":
            return generator.randbytes(count)
        case "twice":
            return content + content
        case "pickle":
            return hostile_pickle()
        case _:
            return content


class Hostile:
    """Makes a folder where it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        import os

        return os.mkdir, (CANARY,)


def hostile_pickle() -> bytes:
    """A pickle that makes a folder where it is read."""
    return pickle.dumps(Hostile())


@dataclass(frozen=True)
class XmlEdit:
    """`how` is done at the element number `where` of an XML file."""

    where: int
    how: str
    name: str
    value: str


XML_EDITS = st.builds(
    XmlEdit,
    st.integers(0, 500),
    st.sampled_from(("drop", "twice", "attribute", "attribute", "attribute", "lose", "tag", "text", "into", "swap")),
    st.sampled_from(("name", "value", "xyz", "rpy", "link", "type", "mass", "ixx", "lower", "upper", "effort", "x")),
    st.sampled_from(
        NUMBERS
        + TEXTS
        + ("0 0 0", "1 2", "1 0 0 0", "nan 0 0", "1e200 0 0", "base", "upper", "mimic", "floating", "fixed")
    ),
)
MJCF_EDITS = st.builds(
    XmlEdit,
    st.integers(0, 500),
    st.sampled_from(("drop", "twice", "lose", "tag", "into", "swap", "extra", *["attribute"] * 8)),
    st.sampled_from(
        words(
            "name joint joint1 body1 site range axis pos type ref mass armature polycoef gear anchor fullinertia mimic "
            "freejoint replicate count include file equality connect weld actuator motor option compiler default class "
            "multiplier offset euler quat damping limited size geom body springref stiffness"
        )
    ),
    st.sampled_from(
        (
            *(*NUMBERS, "0 0 0", "0 0 0 0", "1 2", "nan 0 0", "1e200 0 0", "a" * 5000, ""),
            *words("../secret.txt secret.txt x/y free ball slide hinge floating planar left right crank coupler world"),
            *words("true radian"),
        )
    ),
)
"""Also for mimic joints and moving bases of URDF."""
PROLOGUES = {
    "none": b"",
    **{
        name: b'<?xml version="1.0" encoding="%s"?>' % name.encode()
        for name in ("", "\x00", *words("punycode utf-7 idna zlib rot13 undefined unicode_escape utf-16"))
    },
    "version": b'<?xml version="1e400"?>',
    "mark": b"\xff\xfe",
    "bomb": b'<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa">'
    + b"".join(b'<!ENTITY %c "%s">' % (c, b"&%c;" % (c - 1) * 10) for c in range(98, 108))
    + b"]><r>&k;</r>",
    "external": b'<!DOCTYPE r [<!ENTITY a SYSTEM "secret.txt">]>',
    "deep": b"<a>" * 50_000,
}


def edited_xml(text: str, edits: list[XmlEdit]) -> str:
    root = ET.fromstring(text)
    for edit in edits:
        elements = list(root.iter())
        element = elements[edit.where % len(elements)]
        parents = {child: parent for parent in elements for child in parent}
        parent = parents.get(element)
        match edit.how:
            case "drop" if parent is not None:
                parent.remove(element)
            case "twice" if parent is not None:
                parent.append(element)
            case "attribute":
                own = list(element.attrib)
                element.set(own[edit.where % len(own)] if own else edit.name, _xml(edit.value))
            case "lose" if element.attrib:
                del element.attrib[sorted(element.attrib)[edit.where % len(element.attrib)]]
            case "tag":
                element.tag = edit.name
            case "text":
                element.text = _xml(edit.value)
            case "extra":
                element.set(edit.name, _xml(edit.value))
            case "into":
                other = ET.SubElement(element, edit.name)
                other.set(edit.name, _xml(edit.value))
            case "swap":
                other = elements[(3 * edit.where + 1) % len(elements)]
                element.attrib, other.attrib = other.attrib, element.attrib
    return ET.tostring(root, encoding="unicode")


def _xml(value: str) -> str:
    return value.replace("\x00", "")
