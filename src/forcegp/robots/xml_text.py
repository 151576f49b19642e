"""XML text of robot files: of a bounded size, without entities, and without macros in what is read."""

import re
from collections.abc import Iterable
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DTDForbidden, EntitiesForbidden, ExternalReferenceForbidden
from defusedxml import ElementTree as SafeElementTree

from forcegp.errors import MalformedUrdf, UnexpandedXacro, UnsafeXml

MOST_TAGS = 200_000
"""A robot file of two hundred joints has some ten thousand."""
MECHANICS = ("inertial", "origin", "parent", "child", "axis", "limit", "dynamics", "mimic")
"""Parts of a link or joint that are read."""
TAG = re.compile(r"""<[A-Za-z_](?:[^<>"']|"[^"<]*"|'[^'<]*')*>""")
VALUE = re.compile(r"""("[^"]*"|'[^']*')""")
DEFINITIONS = ("}arg", "}property", "}macro")
"""Elements of xacro that add nothing by themselves."""


def well_formed(text: str) -> str:
    """The text, or where it is no XML, what other readers of robot files make of it.

    Comments may hold anything, and attributes need no space between them.
    """
    if text.count("<") > MOST_TAGS:
        return text  # refused where it is read
    try:
        SafeElementTree.fromstring(_with_prefixes(text.lstrip()))
    except (ParseError, UnicodeError):
        return TAG.sub(lambda tag: VALUE.sub(r"\1 ", tag[0]), without_comments(text))
    except (DTDForbidden, EntitiesForbidden, ExternalReferenceForbidden):
        pass  # refused where it is read
    return text


def without_comments(text: str) -> str:
    """The text with every comment cut but for its lines, so that errors name the place; in linear time."""
    parts, place = [], 0
    while (start := text.find("<!--", place)) >= 0 and (end := text.find("-->", start + 4)) >= 0:
        parts += [text[place:start], "\n" * text.count("\n", start, end)]
        place = end + 3
    return "".join([*parts, text[place:]])


def parse_xml(text: str, source: str) -> Element:
    """The root element of XML text without entities and of a size that a robot has. Raises MalformedUrdf, UnsafeXml."""
    text = _with_prefixes(text.lstrip())  # as other readers do: nothing may stand before an XML declaration
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


def _with_prefixes(text: str) -> str:
    """The text with declarations for prefixes such as ``drake:``, which readers of URDF do not ask for."""
    used = set(re.findall(r"[<\s]([A-Za-z_][\w.-]*):[A-Za-z_]", text)) - {"xml", "xmlns"}
    declared = "".join(f' xmlns:{prefix}="{prefix}"' for prefix in sorted(used) if f"xmlns:{prefix}" not in text)
    return re.sub(r"<robot(?=[\s>])", f"<robot{declared}", text, count=1)


def numbers(values: Iterable[float]) -> str:
    """Numbers as an attribute holds them, with digits that read back exactly."""
    return " ".join(repr(float(value)) for value in values)


def refuse_xacro(root: Element, source: str) -> None:
    """Macros, and expressions in what is read; those inside of <gazebo>, <sensor> or <visual> change no dynamics.

    Nor do definitions that an expanded file still holds.
    """
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
        raise UnexpandedXacro(
            f"{source}: is an unexpanded xacro file (see <{element.tag.rsplit('}', 1)[-1]}>); "
            "name it .xacro, or run xacro first: xacro robot.urdf.xacro > robot.urdf."
        )
