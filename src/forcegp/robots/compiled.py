"""The dynamics of one robot as machine code: what torch computes, traced into scalars, and `CompiledRobot`."""

from math import prod
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from forcegp.codegen.c_writer import Program, write_program
from forcegp.codegen.library import NOT_POSITIVE, RowFunction, are_plain, default_folder, load_library, require_plain
from forcegp.codegen.tracing import trace
from forcegp.errors import InvalidInput, NumericalError
from forcegp.robots.arguments import broadcast_batch
from forcegp.robots.kinematics import NOT_POSITIVE_DEFINITE, Kinematics
from forcegp.robots.structure import RigidBodyDynamics, RobotStructure

INSTEAD = "use the robot itself (compiled.robot), whose results are the same"
# Arguments of each function, and the shapes of its results, of which that of none is (nv,).
ARGUMENTS = {
    "mass_matrix": ("q",),
    "bias_forces": ("q", "v"),
    "mass_matrix_and_bias": ("q", "v"),
    "gravity_forces": ("q",),
    "inverse_dynamics": ("q", "v", "a"),
    "forward_dynamics": ("q", "v", "tau"),
    "frame_motion": ("q", "v"),
}


def shapes_of(function: str, nv: int) -> tuple[tuple[int, ...], ...]:
    """Of the results of a function at one state."""
    held = {"mass_matrix": ((nv, nv),), "mass_matrix_and_bias": ((nv, nv), (nv,))}
    return {**held, "frame_motion": ((4, 4), (6, nv), (6,))}.get(function, ((nv,),))


def trace_dynamics(robot: RobotStructure, function: str, *place: Any) -> Program:
    """Write a function of the robot down, that of a frame at its `place`: a name and a point."""
    sizes = {name: robot.nq if name == "q" else robot.nv for name in ARGUMENTS[function]}

    def results(q: Tensor, *others: Tensor) -> list[Tensor]:
        at = Kinematics.of(robot, q, others[0] if others else None)
        if function == "forward_dynamics":
            M, bias = at.mass_matrix_and_bias()
            # from the last joint on: parents stand before children, so nothing fills in (Featherstone 2008, table 6.3)
            L, net = torch.linalg.cholesky(M.flip(-1, -2)), (others[1] - bias).flip(-1)
            x = torch.linalg.solve_triangular(L, net[..., None], upper=False)
            x = torch.linalg.solve_triangular(L.mT.flip(-1, -2), x.flip(-2), upper=False)
            return [x, L.diagonal(dim1=-2, dim2=-1)]
        found = at.inverse_dynamics(others[1]) if len(others) > 1 else getattr(at, function)(*place)
        return [*found] if isinstance(found, tuple) else [found]

    graph, found = trace(results, [torch.full((1, size), 0.5, dtype=torch.float64) for size in sizes.values()])
    made = [nodes.flatten().tolist() for nodes in found]
    positive = made.pop() if function == "forward_dynamics" else []
    return Program(graph, sizes, {f"result {k}": nodes for k, nodes in enumerate(made)}, positive)


class CompiledRobot(RigidBodyDynamics):
    """The dynamics of a robot, compiled for it at the first call; made by ``robot.compile()``.

    Methods take, check and return what those of `Robot` do, to rounding. InvalidInput for derivatives, transforms of
    ``torch.func`` and other devices than the CPU; CompilerError where something must be compiled and no C compiler is
    there. Code is kept in ``folder`` (``~/.cache/forcegp/compiled`` by default) and runs with your rights.
    """

    def __init__(self, robot: RobotStructure, folder: str | Path | None = None) -> None:
        if robot.device.type != "cpu":
            seen = f"compiled dynamics runs on the CPU, and the robot is on {robot.device}"
            raise InvalidInput(f"{seen}; compile robot.to('cpu'), or use the robot itself.")
        self.robot = robot
        self.folder = default_folder() if folder is None else Path(folder).expanduser()
        self._nv, self._space = robot.nv, robot.space
        self._programs: dict[tuple[Any, ...], RowFunction] = {}

    def __reduce__(self) -> "tuple[type[CompiledRobot], tuple[RobotStructure, Path]]":
        return CompiledRobot, (self.robot, self.folder)

    def __repr__(self) -> str:
        return f"CompiledRobot({self.robot!r}, folder={str(self.folder)!r})"

    def program(self, function: str, *place: Any) -> RowFunction:
        """The machine code of a function, or of one of a frame."""
        if (function, *place) not in self._programs:
            robot = self.robot

            def write(lanes: int) -> str:
                return write_program(trace_dynamics(robot, function, *place), lanes)

            constants = [x.tolist() if isinstance(x, Tensor) else x for x in vars(robot.tree).values()]
            name = f"{robot.name[:40]}-{function}"
            constants += [(body, offset.tolist()) for body, offset in map(robot.frame, place[:1])]
            library = load_library(name, f"{constants!r}{place[1:]}\0{function}", write, folder=self.folder)
            outputs = [prod(shape) for shape in shapes_of(function, self._nv)]
            self._programs[function, *place] = RowFunction(library, len(ARGUMENTS[function]), outputs)
        return self._programs[function, *place]

    @override
    def _dynamics(self, function: str, *arguments: Any) -> Any:
        nv, space, names = self._nv, self._space, ARGUMENTS[function]
        given, place = list(arguments[: len(names)]), arguments[len(names) :]
        plain = not space.groups and are_plain(given, nv)
        if space.groups and are_plain(given[:1], space.nq) and are_plain(given[1:], nv):  # q has entries of its own
            plain = all(x.shape[:-1] == given[0].shape[:-1] for x in given)
            space.check(given[0])
        if not plain:
            given = [self.robot.checked_input(name, value) for name, value in zip(names, given, strict=True)]
            if torch.is_grad_enabled() and any(value.requires_grad for value in given):
                raise InvalidInput(f"compiled dynamics has no derivatives; {INSTEAD}.")
        require_plain(given, "compiled dynamics", INSTEAD)
        batch, program = given[0].shape[:-1], self.program(function, *place)
        if plain and not batch:
            bits, results = program.single(*given)
        else:
            if not plain:
                batch = broadcast_batch({name: value.shape[:-1] for name, value in zip(names, given, strict=True)})
                given = [x.expand(*batch, -1).reshape(batch.numel(), x.shape[-1]).contiguous() for x in given]
            results = [torch.empty(batch.numel(), size, dtype=torch.float64) for size in program.outputs]
            bits = program.rows(given, results)
        if bits & NOT_POSITIVE:
            raise NumericalError(NOT_POSITIVE_DEFINITE)
        made = zip(results, shapes_of(function, nv), strict=True)
        found = [x if len(shape) == len(batch) == 1 else x.view(*batch, *shape) for x, shape in made]
        return found[0] if len(found) == 1 else tuple(found)
