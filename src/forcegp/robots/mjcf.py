"""MJCF, MuJoCo's robot files, as URDF text, rotor inertias and closed loops.

MuJoCo's own compiler reads the file: what it says is what MuJoCo simulates, with masses inferred from shapes, default
classes and included files. Every body of the compiled model becomes a link of the same name, whose frame is the body's.
Several joints of one body are a chain of links without mass. Positions q are MuJoCo's `qpos`, also where a joint has a
`ref`; but quaternions are x, y, z, w here and w, x, y, z there, and the linear velocity of a free body has the axes of
the body here and of the world there.

What changes accelerations and has no place in a robot (springs, tendons, gains of actuators ...) is noted by name.
"""

import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from forcegp.errors import MalformedMjcf, NonPhysicalInertia, UnreadableRobotFile, required_extra
from forcegp.robots.inertia import physical_objection
from forcegp.robots.mjcf_model import WORLD, CompiledModel, Translation
from forcegp.robots.problems import Problems
from forcegp.robots.urdf import MOST_TAGS, parse_xml, well_formed
from forcegp.robots.urdf_file import IN_THE_FILE, nearest_inertia, read_text

DEEPEST = 300
"""Levels of elements: MuJoCo's reader calls itself for each."""
COPIED = {"replicate": ("count",), "composite": ("count",), "flexcomp": ("count",)}
SIZED = {"hfield": ("nrow", "ncol"), "mesh": ("params", "params")}
MOST_POINTS = 100_000_000
"""MuJoCo's reader makes copies and points at once, and hangs at the next file after it ran out of memory."""


def is_mjcf(text: str) -> bool:
    """Whether the root element of XML text is <mujoco>."""
    return re.sub(r"<!--.*?-->|<\?.*?\?>|\ufeff", "", text, flags=re.DOTALL).lstrip().startswith("<mujoco")


def translate(text: str, path: Path | None, nearest: bool, for_system: bool, problems: Problems) -> Translation:
    """The robot of MJCF text; ``path`` is its file, if there is one: others lie beside it.

    ``problems`` collects impossible inertias, replaced where ``nearest`` is asked for, and what is left out; closed
    loops are, unless ``for_system``. Raises MalformedMjcf, MissingExtra, and the errors of XML text.
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
        _repair(spec, nearest, problems)
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            model = spec.compile()
    except (ValueError, TypeError, RuntimeError, IndexError, made.FatalError) as error:
        reason = " ".join(str(error).removeprefix("Error: ").split())
        missing = needed and any(word in reason for word in ("file", "mesh", "resource"))
        advice = f"; the mass of {', '.join(needed[:4])} comes from meshes: give an <inertial>" if missing else ""
        raise MalformedMjcf(f"{problems.source}: MuJoCo refuses it ({reason}){advice}; correct that place.") from None
    finally:
        made.set_mju_user_warning(before)
    for warning in dict.fromkeys((*noted, *(str(each.message) for each in warned))):
        problems.note("MuJoCo warns", warning)
    return CompiledModel(made, model, spec.modelname or "robot", for_system, problems).translation()


def _require_bounded(text: str, folders: Sequence[Path], source: str, included: dict[str, bytes]) -> None:
    """Refuse files that exhaust memory or stack of MuJoCo's reader; ``included`` receives the files that they name."""
    root = parse_xml(well_formed(text), source)
    count, deepest = 0.0, 0
    stack = [(root, 1, 1.0)]
    while stack:
        element, depth, times = stack.pop()
        count, deepest = count + times, max(deepest, depth)
        points = _product(element, SIZED)
        times *= _product(element, COPIED)
        if count + times > MOST_TAGS or points > MOST_POINTS or deepest > DEEPEST:
            raise MalformedMjcf(
                f"{source}: holds more than {MOST_TAGS} elements, copies included, {MOST_POINTS} points of a shape or "
                f"{DEEPEST} levels; give the file of one robot."
            )
        stack += [(child, depth + 1, times) for child in element]
    for name in (element.get("file", "") for element in root.iter("include")):
        if name in included:
            continue
        found = next((folder / name for folder in folders if (folder / name).is_file()), None)
        if found is None:
            raise UnreadableRobotFile(f"{source}: includes {name!r}, which is not there; give the file beside it.")
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


def _repair(spec: Any, nearest: bool, problems: Problems) -> None:
    """Replace inertias that no body has: MuJoCo's compiler stops at the first. They are problems or notes."""
    for body in spec.bodies if not spec.compiler.balanceinertia else ():
        if not body.explicitinertial or not body.mass > 0.0:
            continue
        full, inertia = body.fullinertia, np.diag(body.inertia)
        if np.isfinite(full[0]):
            xx, yy, zz, xy, xz, yz = full
            inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        objection = physical_objection(body.mass, np.zeros(3), inertia)
        if objection is None or not np.isfinite(inertia).all():
            continue
        new = nearest_inertia(inertia)
        if np.isfinite(full[0]):
            body.fullinertia = [*new.diagonal(), new[0, 1], new[0, 2], new[1, 2]]
        else:
            body.inertia = new.diagonal()
        seen = f"{problems.source}: no physical body has the inertia of body {body.name!r}: {objection}"
        if nearest:
            what = "an inertia that no body has is replaced by the nearest one that a body has"
            problems.note(what, f"body {body.name!r}: {objection}")
        else:
            advice = f"{IN_THE_FILE}, or take the nearest inertia that a body has."
            problems.errors.append(NonPhysicalInertia(seen, advice, {"inertias": "nearest"}))
