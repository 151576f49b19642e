"""Readers of files that others wrote, those of MuJoCo, xacro, MATLAB and ROS, in a process of their own with limits.

What crashes, hangs or takes all memory there is an error here. `python -m forcegp.sandbox` is that process: it
takes one request as JSON and gives one answer as JSON; it imports no torch, and of forcegp the `module` asked for.
"""

import base64
import contextlib
import importlib
import json
import math
import os
import subprocess
import sys
import sysconfig
import warnings
from pathlib import Path
from typing import Any

from forcegp.errors import ForceGPError, RobotModelError, lacks_memory

SECONDS = 30  # CPU time of one file, and half of its wall time: whole robots with meshes take two
MEMORY = 1 << 30  # bytes of address space; MuJoCo itself takes 130 MB
LARGEST = {"nbody": 2_000, "njnt": 2_000, "nsite": 2_000, "ngeom": 20_000}
"""Parts of a compiled model: robots have some hundred."""

ACTS = ("subprocess", "os", "socket", "ctypes", "shutil")  # first words of Python's audit events that no macro needs


def read_apart(
    reader: str,
    source: str,
    request: dict[str, Any],
    error: type[ForceGPError] = RobotModelError,
    remedy: str = "give the file of one robot, without copies in great number",
) -> dict[str, Any]:
    """The answer of a reader ("mujoco", "xacro", "matlab", or that of a module).

    `refused` in it is the reason of one that failed. Raises the `error` where there is none: the reader crashed, or
    needed more than `SECONDS` or `MEMORY`, or those of the request.
    """
    path = os.pathsep.join(folder for folder in sys.path if folder)
    ones = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MALLOC_ARENA_MAX", "PYTHONDONTWRITEBYTECODE")
    settings = dict.fromkeys(ones, "1") | {"PYTHONPATH": path, "PYTHONWARNINGS": "ignore", "MUJOCO_GL": "disable"}
    asked = {"reader": reader, "seconds": SECONDS, "memory": MEMORY, "largest": LARGEST} | request
    try:
        how: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "timeout": 2 * asked["seconds"]}
        command, given = [sys.executable, "-P", "-m", __name__], json.dumps(asked).encode()
        return json.loads(subprocess.run(command, input=given, env=os.environ | settings, check=False, **how).stdout)
    except (subprocess.TimeoutExpired, ValueError):
        limits = f"{asked['seconds']} s or {asked['memory'] >> 20} MiB"
        raise error(f"{source}: {reader} crashed at it, or needed more than {limits}; {remedy}.") from None


def _answer(request: dict[str, Any]) -> dict[str, Any]:
    if os.name == "posix":  # elsewhere only the wall time is limited
        import resource

        for limit, value in (("CPU", "seconds"), ("AS", "memory"), ("FSIZE", "memory")):
            resource.setrlimit(getattr(resource, f"RLIMIT_{limit}"), (request[value], request[value]))
    if "module" in request:
        return importlib.import_module(request["module"]).answer(request)
    return {"mujoco": _compiled, "xacro": _expanded, "matlab": _variables}[request["reader"]](request)


def _expanded(request: dict[str, Any]) -> dict[str, Any]:
    """The text of a .xacro file, whose expressions open files below its folder and of ROS packages only."""
    for name in ("yaml", "ament_index_python.packages"):  # which xacro loads when a file asks
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    xacro, library = importlib.import_module("xacro"), sysconfig.get_paths()
    packages = os.pathsep.join(os.environ.get(name, "") for name in ("AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH"))
    shown = [Path(request["path"]).parent, request["path"] + "/..", library["stdlib"], library["platstdlib"]]
    allowed = [Path(each).resolve() for each in (*shown, *filter(None, packages.split(os.pathsep)))]

    def watch(event: str, given: tuple[Any, ...]) -> None:
        refused = event.split(".")[0] in ACTS and event not in ("os.listdir", "os.scandir")
        if event == "open" and not isinstance(given[0], int):
            real = Path(os.fsdecode(given[0])).resolve()
            refused = given[2] & (os.O_WRONLY | os.O_RDWR) or not any(real.is_relative_to(each) for each in allowed)
            refused = refused or (real.exists() and not real.is_file())  # a pipe would be waited for
        if refused:
            raise PermissionError(f"its expressions only read below its folder: {event} {given[:1]}")

    sys.addaudithook(watch)
    try:
        return {"text": xacro.process_file(request["path"]).toxml()}
    except (Exception, SystemExit) as error:  # whatever the expressions of the file raise
        return {"refused": " ".join(str(error).split())}


def _variables(request: dict[str, Any]) -> dict[str, Any]:
    """The variables of a MATLAB file: arrays of numbers are in the file `kept`, and {"#": name} stands for each."""
    io, numpy = importlib.import_module("scipy.io"), importlib.import_module("numpy")
    kept: dict[str, Any] = {}

    def plain(value: Any) -> Any:
        if isinstance(value, numpy.ndarray) and value.dtype.kind in "fiub":
            kept[name := f"a{len(kept)}"] = value
            return {"#": name}
        found = value.tolist() if isinstance(value, numpy.ndarray | numpy.generic) else None
        return found if type(found) in (list, str, int, float, bool) else ""  # what has no numbers

    try:
        sizes = (8 * math.prod(shape) for _, shape, _ in io.whosmat(request["path"]))
        if (claimed := sum(sizes)) > request["most"]:
            return {"refused": f"it claims {claimed >> 20} MiB, more than it can hold"}
        content = io.loadmat(request["path"], simplify_cells=True)
        text = json.dumps({name: each for name, each in content.items() if not name.startswith("__")}, default=plain)
        numpy.savez(request["kept"], **kept)
        return {"content": text}
    except Exception as error:  # whatever scipy meets in a damaged file
        return {"refused": f"{type(error).__name__}: {error}"}


def _compiled(request: dict[str, Any]) -> dict[str, Any]:
    """A compiled model as MuJoCo stores it, without what changes no motion."""
    mujoco: Any = importlib.import_module("mujoco")
    numpy = importlib.import_module("numpy")
    if request["folder"]:
        os.chdir(request["folder"])  # files that it names are found from here
    noted: list[str] = []
    needed: list[str] = []
    mujoco.set_mju_user_warning(noted.append)
    try:
        spec = mujoco.MjSpec.from_string(request["text"])
        spec.modelfiledir = request["folder"]
        needed = _without_appearance(mujoco, spec)
        meshes = next((mesh.file for mesh in spec.meshes if mesh.file in request["outside"]), None)
        if meshes is not None:
            return {"refused": f"mesh {meshes!r} is a pipe, or not below the folder of the file", "meshes": needed}
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            model = spec.compile()
    except (ValueError, TypeError, RuntimeError, IndexError, mujoco.FatalError) as error:
        reason = " ".join(str(error).removeprefix("Error: ").split())
        if "unknown exception" in reason or lacks_memory(error):
            raise MemoryError(reason) from None
        missing = any(word in reason for word in ("file", "mesh", "resource"))
        return {"refused": reason, "meshes": needed if missing else []}
    for part, most in request["largest"].items():
        if getattr(model, part) > most:
            return {"refused": f"{part} is {getattr(model, part)}, more than the {most} of one robot", "meshes": []}
    stored = numpy.empty(mujoco.mj_sizeModel(model), numpy.uint8)
    mujoco.mj_saveModel(model, None, stored)
    notes = list(dict.fromkeys((*noted, *(str(each.message) for each in warned))))
    return {"model": base64.b64encode(stored).decode(), "name": spec.modelname, "notes": notes}


def _without_appearance(mujoco: Any, spec: Any) -> list[str]:
    """Remove what changes no motion, so that no file of it is needed; the bodies whose mass comes from meshes."""
    for name in ("keys", "sensors", "skins", "cameras", "lights", "numerics", "texts", "tuples"):
        for element in list(getattr(spec, name)):
            spec.delete(element)
    for owner in (*spec.geoms, *spec.sites, *spec.tendons):
        owner.material = ""
    for name in (name for name in dir(spec) if name.startswith("nuser_")):
        setattr(spec, name, -1)
    spec.memory, spec.nuserdata, spec.nkey = -1, 0, 0
    spec.compiler.fusestatic = spec.compiler.usethread = False
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


def _has_mass(mujoco: Any, spec: Any, geom: Any) -> bool:  # that of a body contains that of this shape
    compiler, kinds = spec.compiler, mujoco.mjtInertiaFromGeom
    given = compiler.inertiafromgeom == kinds.mjINERTIAFROMGEOM_AUTO and geom.parent.explicitinertial
    low, high = compiler.inertiagrouprange
    counts = not (given or compiler.inertiafromgeom == kinds.mjINERTIAFROMGEOM_FALSE) and low <= geom.group <= high
    weighs = (geom.density if math.isnan(geom.mass) else geom.mass) != 0.0
    return counts and weighs and geom.parent.name != "world"


if __name__ == "__main__":
    channel = os.dup(1)
    os.dup2(2, 1)  # what a library prints is no answer
    answer = json.dumps(_answer(json.load(sys.stdin)))
    with os.fdopen(channel, "w", encoding="utf-8") as out:
        out.write(answer)
