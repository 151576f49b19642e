"""`CompiledRobot`: the dynamics of one robot as machine code made for it."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from forcegp.codegen.c_writer import Program, write_program
from forcegp.codegen.graph import Graph, node_of
from forcegp.codegen.library import (
    NOT_POSITIVE,
    RowFunction,
    are_plain,
    default_folder,
    load_library,
    require_plain,
)
from forcegp.errors import InvalidInput, NumericalError, require_known
from forcegp.robots.arguments import broadcast_batch
from forcegp.robots.kinematics import NOT_POSITIVE_DEFINITE
from forcegp.robots.structure import RigidBodyDynamics, RobotStructure
from forcegp.robots.unrolled import UnrolledKinematics, UnrolledRobot, factorize, scalars, solve_factorized

INSTEAD = "use the robot itself (compiled.robot), whose results are the same"
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


class CompiledRobot(RigidBodyDynamics):
    """The dynamics of a robot, compiled for it; made by ``robot.compile()``.

    The methods take, check and return what those of :class:`~forcegp.robots.Robot` do, also where a base moves.
    Results agree to rounding. Not supported, with an :class:`~forcegp.errors.InvalidInput`: derivatives, transforms of
    ``torch.func``, and other devices than the CPU. Use the robot itself there.

    A function is compiled when it is first called, unless a file in ``folder`` (``~/.cache/forcegp/compiled`` by
    default) holds it already; :meth:`prepare` does so ahead. Code from that folder runs with the rights of the process.
    Several states are computed at once, and large batches by as many threads as torch has.

    Raises :class:`~forcegp.errors.CompilerError` where something must be compiled and no C compiler is there.
    """

    def __init__(self, robot: RobotStructure, folder: str | Path | None = None) -> None:
        if robot.device.type != "cpu":
            raise InvalidInput(
                f"compiled dynamics runs on the CPU, and the robot is on {robot.device}; compile robot.to('cpu'), or "
                "use the robot itself."
            )
        self.robot = robot
        self.folder = default_folder() if folder is None else Path(folder).expanduser()
        self._unrolled = UnrolledRobot(robot)
        self._nv, self._space = robot.nv, robot.space
        self._programs: dict[str, RowFunction] = {}

    def __reduce__(self) -> "tuple[type[CompiledRobot], tuple[RobotStructure, Path]]":
        return CompiledRobot, (self.robot, self.folder)

    def __repr__(self) -> str:
        return f"CompiledRobot({self.robot!r}, folder={str(self.folder)!r})"

    def prepare(self, *functions: str) -> "CompiledRobot":
        """Compile functions now: those named, or all; returns the same object. Raises InvalidInput for other names."""
        for name in functions or ARGUMENTS:
            require_known("function", name, "a compiled robot", ARGUMENTS)
            self.program(name)
        return self

    def program(self, function: str) -> RowFunction:
        """The machine code of a function."""
        if function not in self._programs:
            unrolled, nv = self._unrolled, self._nv

            def write(lanes: int) -> str:
                return write_program(trace_dynamics(unrolled, function), lanes)

            name = f"{self.robot.name[:40]}-{function}"
            library = load_library(name, f"{unrolled.constants!r}\0{function}", write, folder=self.folder)
            outputs = [nv**d for d in DIMENSIONS.get(function, (1,))]
            self._programs[function] = RowFunction(library, len(ARGUMENTS[function]), outputs)
        return self._programs[function]

    @override
    def _dynamics(self, function: str, *arguments: Tensor) -> Any:
        nv, given, names = self._nv, list(arguments), ARGUMENTS[function]
        plain = self._are_possible(given) if self._space.groups else are_plain(given, nv)
        if not plain:
            given = [self.robot.checked_input(name, value) for name, value in zip(names, given, strict=True)]
            if torch.is_grad_enabled() and any(value.requires_grad for value in given):
                raise InvalidInput(f"compiled dynamics has no derivatives; {INSTEAD}.")
        require_plain(given, "compiled dynamics", INSTEAD)
        batch, program = given[0].shape[:-1], self.program(function)
        if plain and not batch:
            bits, results = program.single(*given)
        else:
            if not plain:
                batch = broadcast_batch({name: value.shape[:-1] for name, value in zip(names, given, strict=True)})
                given = [value.expand(*batch, value.shape[-1]) for value in given]
            if not plain or len(batch) != 1:
                given = [value.reshape(batch.numel(), value.shape[-1]).contiguous() for value in given]
            results = [torch.empty(batch.numel(), size, dtype=torch.float64) for size in program.outputs]
            bits = program.rows(batch.numel(), given, results)
        if bits & NOT_POSITIVE:
            raise NumericalError(NOT_POSITIVE_DEFINITE)
        made = zip(results, DIMENSIONS.get(function, (1,)), strict=True)
        found = [x if d == len(batch) == 1 else x.view(*batch, *(nv,) * d) for x, d in made]
        return found[0] if len(found) == 1 else tuple(found)

    def _are_possible(self, given: Sequence[Tensor]) -> bool:
        """`are_plain` where q has more entries than v and a length to check."""
        q, *others = given
        plain = are_plain([q], self._space.nq) and are_plain(others, self._nv)
        if plain and all(x.shape[:-1] == q.shape[:-1] for x in others):
            self._space.check(q)
            return True
        return False
