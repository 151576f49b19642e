"""Files of a robot: URDF, or xacro that is expanded to one; and rotor inertias, which URDF has no element for.

Rotor inertias (armature) of `arm.urdf` stand in `arm.armature.json`, one number per joint, in kg m^2 or kg. A comment
in the URDF tells people of them.
"""

import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from forcegp.atomic_files import write_json
from forcegp.errors import InvalidNumber, MalformedUrdf, RobotFileWarning, required_extra
from forcegp.robots.urdf_file import before_the_end, read_text, write_text

COMMENT = "<!-- rotor inertias (armature), which URDF has no element for, stand in the file *.armature.json -->\n"


def read_robot_file(path: str | Path) -> str:
    """URDF text of a file, whose macros are expanded where it is called .xacro.

    Raises UnreadableRobotFile, MissingExtra without the package xacro, and MalformedUrdf where it fails.
    """
    text = read_text(path)
    if Path(path).suffix != ".xacro":
        return text
    xacro = required_extra("xacro", "xacro", f"{path}: a file that is not expanded elsewhere")
    try:
        document: Any = xacro.process_file(str(path))  # a document of minidom; its annotation is too wide
        return document.toxml()
    except (Exception, SystemExit) as error:  # whatever the expressions of the file raise
        raise MalformedUrdf(
            f"{path}: xacro could not expand it ({' '.join(str(error).split())}); correct it, or "
            "expand it where its packages are: xacro robot.xacro > robot.urdf."
        ) from None


def armature_path(path: str | Path) -> Path:
    """`arm.armature.json` beside `arm.urdf`."""
    return Path(path).with_suffix(".armature.json")


def read_armature(path: str | Path) -> dict[str, float] | None:
    """The rotor inertias that stand beside a URDF file; None where there are none. Raises InvalidNumber for others."""
    beside = armature_path(path)
    if not beside.is_file():
        return None
    try:
        given = json.loads(beside.read_text(encoding="utf-8"))
        return {str(joint): float(value) for joint, value in given.items()}
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        raise InvalidNumber(f"{beside}: holds no rotor inertia per joint; correct it, or remove it.") from None


def with_comment(text: str, armature: Mapping[str, float], *, source: str, stacklevel: int) -> str:
    """The URDF text with a comment where some rotor inertia is not zero, and a RobotFileWarning that says which."""
    present = {joint: value for joint, value in armature.items() if value}
    if not present:
        return text
    warnings.warn(
        f"{source}: URDF has no element for rotor inertias ({', '.join(present)}): they go into a file beside it "
        "(.armature.json), which Robot.from_urdf reads back; give them to other programs by hand.",
        RobotFileWarning,
        stacklevel=stacklevel,
    )
    return text if COMMENT in text else before_the_end(text, COMMENT)


def write_robot_file(path: Path, text: str, armature: Mapping[str, float]) -> None:
    """Write URDF text, and rotor inertias beside it where there are some or an older file has others."""
    if any(armature.values()) or armature_path(path).exists():
        write_json(armature_path(path), dict(armature))
    write_text(text, path)
