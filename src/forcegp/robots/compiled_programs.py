"""Programs of one robot as machine code: found in a folder, or written down, compiled and kept there."""

from __future__ import annotations

from pathlib import Path

from forcegp.codegen.c_writer import write_program
from forcegp.codegen.library import VectorUnit, load_library
from forcegp.codegen.native_code import Purpose
from forcegp.codegen.row_function import RowFunction
from forcegp.robots.dynamics_programs import Request, trace_dynamics
from forcegp.robots.unrolled import UnrolledRobot

PURPOSE = Purpose("compiled dynamics", "robot.compile(folder=...)", "use the robot itself")


def compiled_program(unrolled: UnrolledRobot, request: Request, folder: Path) -> RowFunction:
    """The program of a request: from ``folder`` if it is there, else compiled into it.

    Raises :class:`~forcegp.errors.CompilerError` as `load_library`.
    """

    def write(unit: VectorUnit) -> str:
        return write_program(trace_dynamics(unrolled, request), unit.lanes)

    constants: list[object] = [(joint.parent, joint.revolute) for joint in unrolled.joints]
    constants += [x.tolist() for joint in unrolled.joints for x in (joint.rotation, joint.origin)]
    constants += [unrolled.gravity.tolist(), unrolled.armature.tolist()]
    if request.links:
        tree = unrolled.robot.tree
        constants = [unrolled.robot.layout.moving]
        constants += [x.tolist() for x in (tree.link_inertias, tree.link_offsets, tree.carried)]
    elif not request.free_inertias:
        constants += [body.tolist() for body in unrolled.inertias]
    key = f"{constants!r}\0{request!r}"
    library, _ = load_library(f"{unrolled.robot.name[:40]}-{request.function}", key, write, folder, PURPOSE)
    sizes = request.sizes(unrolled)
    return RowFunction(library, [sizes[name] for name in request.inputs], [sizes[name] for name in request.outputs])
