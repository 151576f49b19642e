"""The iiwa of `pybullet_data` with another tool, as one URDF text for PyBullet and for `forcegp.robots.Robot` alike."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

from forcegp.errors import MissingExtra, RobotModelError

TOOL_LINK = "lbr_iiwa_link_7"
BASE_LINK = "lbr_iiwa_link_0"


def kuka_urdf(
    *,
    base_height: float,
    tool_mass: float,
    tool_center_of_mass: Sequence[float],
    tool_inertia: Sequence[float],
    joint_damping: float,
) -> str:
    """The URDF with the given inertia of link 7 [kg, m, kg m^2], joint damping [Nms/rad] and base height [m].

    A link `world` with a fixed joint carries the base. Meshes and materials are left out: no file path may go into a
    Dataset, and collisions are off. The base cannot move and is massless. The licence comment of the original stays at
    the head. Raises MissingExtra without PyBullet.
    """
    path = _original()
    text = path.read_text(encoding="utf-8")
    root = ElementTree.fromstring(text)
    for unused in root.findall("material"):
        root.remove(unused)
    for link in root.findall("link"):
        for child in list(link):
            if child.tag != "inertial":
                link.remove(child)
    for dynamics in root.iter("dynamics"):
        dynamics.set("damping", repr(float(joint_damping)))
    tool, base = (root.find(f"link[@name='{name}']/inertial") for name in (TOOL_LINK, BASE_LINK))
    if tool is None or base is None:
        raise RobotModelError(
            f"{path} lacks {TOOL_LINK!r} or {BASE_LINK!r} with inertia; install pybullet 3.2.6 or 3.2.7."
        )
    _write_inertial(tool, tool_mass, tool_center_of_mass, tool_inertia)
    _write_inertial(base, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    _mount(root, base_height)
    ElementTree.indent(root)
    head = text[: text.index("<robot")]
    changes = "<!-- Changed by forcegp: base mounted on `world`, tool inertia and damping set, meshes left out. -->\n"
    return head + changes + ElementTree.tostring(root, encoding="unicode") + "\n"


def _original() -> Path:
    try:
        import pybullet_data
    except ImportError as error:
        raise MissingExtra("the kuka-surface scenario needs PyBullet: pip install 'forcegp[sim]'") from error
    return Path(pybullet_data.getDataPath()) / "kuka_iiwa" / "model.urdf"


def _write_inertial(
    inertial: ElementTree.Element, mass: float, center_of_mass: Sequence[float], moments: Sequence[float]
) -> None:
    inertial.clear()
    ElementTree.SubElement(inertial, "origin", rpy="0 0 0", xyz=_numbers(center_of_mass))
    ElementTree.SubElement(inertial, "mass", value=repr(float(mass)))
    diagonal = dict(zip(("ixx", "iyy", "izz"), (repr(float(moment)) for moment in moments), strict=True))
    ElementTree.SubElement(inertial, "inertia", ixy="0", ixz="0", iyz="0", **diagonal)


def _mount(root: ElementTree.Element, height: float) -> None:
    joint = ElementTree.Element("joint", name="world_joint", type="fixed")
    ElementTree.SubElement(joint, "parent", link="world")
    ElementTree.SubElement(joint, "child", link=BASE_LINK)
    ElementTree.SubElement(joint, "origin", rpy="0 0 0", xyz=_numbers((0.0, 0.0, height)))
    root.insert(0, joint)
    root.insert(0, ElementTree.Element("link", name="world"))


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
