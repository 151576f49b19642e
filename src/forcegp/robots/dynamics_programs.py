"""The dynamics of one robot as programs: straight-line arithmetic from inputs to outputs."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from forcegp.codegen.c_writer import Program, write_program
from forcegp.codegen.graph import Graph, node_of
from forcegp.codegen.library import Purpose, RowFunction, VectorUnit, load_library
from forcegp.robots.unrolled import UnrolledKinematics, UnrolledRobot, factorize, scalars, solve_factorized

# Arguments of each function, and the shapes of its results in joints.
ARGUMENTS = {
    "mass_matrix": ("q",),
    "bias_forces": ("q", "v"),
    "mass_matrix_and_bias": ("q", "v"),
    "gravity_forces": ("q",),
    "inverse_dynamics": ("q", "v", "a"),
    "forward_dynamics": ("q", "v", "tau"),
}
DIMENSIONS = {"mass_matrix": (2,), "mass_matrix_and_bias": (2, 1)}


def trace_dynamics(unrolled: UnrolledRobot, function: str) -> Program:
    """Write a function of the robot down."""
    graph = Graph()
    inputs = {name: unrolled.robot.nq if name == "q" else unrolled.nv for name in ARGUMENTS[function]}
    given = {name: scalars(graph.more_inputs(size)) for name, size in inputs.items()}
    at = UnrolledKinematics(unrolled, given["q"], given.get("v"))
    positive = scalars([])
    if function == "forward_dynamics":
        L, positive = factorize(at.mass_matrix())
        made = [solve_factorized(L, 1.0 / positive, given["tau"] - at.bias_forces())]
    elif function == "inverse_dynamics":
        made = [at.inverse_dynamics(given["a"])]
    else:
        names = ("mass_matrix", "bias_forces") if function == "mass_matrix_and_bias" else (function,)
        made = [getattr(at, name)().ravel() for name in names]

    def nodes(array: Iterable[Any]) -> list[int]:
        return [node_of(graph, scalar) for scalar in array]

    return Program(graph, inputs, {f"result {k}": nodes(result) for k, result in enumerate(made)}, nodes(positive))


PURPOSE = Purpose("compiled dynamics", "robot.compile(folder=...)", "use the robot itself")


def compiled_program(unrolled: UnrolledRobot, function: str, folder: Path) -> RowFunction:
    """From ``folder`` if it is there, else compiled into it. Raises CompilerError as `load_library`."""

    def write(unit: VectorUnit) -> str:
        return write_program(trace_dynamics(unrolled, function), unit.lanes)

    constants: list[object] = [(joint.parent, joint.axis, joint.kind, *joint.drive) for joint in unrolled.joints]
    constants += [x.tolist() for joint in unrolled.joints for x in (joint.rotation, joint.origin)]
    constants += [unrolled.gravity.tolist(), unrolled.armature.tolist(), [body.tolist() for body in unrolled.inertias]]
    library, _ = load_library(
        f"{unrolled.robot.name[:40]}-{function}", f"{constants!r}\0{function}", write, folder, PURPOSE
    )
    sizes = [unrolled.robot.nq if name == "q" else unrolled.nv for name in ARGUMENTS[function]]
    return RowFunction(library, sizes, [unrolled.nv**d for d in DIMENSIONS.get(function, (1,))])
