"""The dynamics of one robot as machine code: what torch computes, traced into scalars, and `CompiledRobot`."""

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


def trace_dynamics(robot: RobotStructure, function: str) -> Program:
    """Write a function of the robot down."""
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
        found = at.inverse_dynamics(others[1]) if len(others) > 1 else getattr(at, function)()
        return [*found] if isinstance(found, tuple) else [found]

    examples = [torch.full((1, size), 0.5, dtype=torch.float64) for size in sizes.values()]
    graph, found = trace(results, examples)
    made = [nodes.flatten().tolist() for nodes in found]
    positive = made.pop() if function == "forward_dynamics" else []
    return Program(graph, sizes, {f"result {k}": nodes for k, nodes in enumerate(made)}, positive)


class CompiledRobot(RigidBodyDynamics):
    """The dynamics of a robot, compiled for it at the first call; made by ``robot.compile()``.

    Methods take, check and return what those of `Robot` do, to rounding. InvalidInput for derivatives, transforms of
    ``torch.func`` and other devices than the CPU; CompilerError where something must be compiled and no C compiler is
    there. Code is kept in ``folder`` (``~/.cache/forcegp/compiled`` by default) and runs with the rights of the
    process.
    """

    def __init__(self, robot: RobotStructure, folder: str | Path | None = None) -> None:
        if robot.device.type != "cpu":
            raise InvalidInput(
                f"compiled dynamics runs on the CPU, and the robot is on {robot.device}; compile robot.to('cpu'), or "
                "use the robot itself."
            )
        self.robot = robot
        self.folder = default_folder() if folder is None else Path(folder).expanduser()
        self._nv, self._space = robot.nv, robot.space
        self._programs: dict[str, RowFunction] = {}

    def __reduce__(self) -> "tuple[type[CompiledRobot], tuple[RobotStructure, Path]]":
        return CompiledRobot, (self.robot, self.folder)

    def __repr__(self) -> str:
        return f"CompiledRobot({self.robot!r}, folder={str(self.folder)!r})"

    def program(self, function: str) -> RowFunction:
        """The machine code of a function."""
        if function not in self._programs:
            robot = self.robot

            def write(lanes: int) -> str:
                return write_program(trace_dynamics(robot, function), lanes)

            constants = [x.tolist() if isinstance(x, Tensor) else x for x in vars(robot.tree).values()]
            name = f"{robot.name[:40]}-{function}"
            library = load_library(name, f"{constants!r}\0{function}", write, folder=self.folder)
            outputs = [self._nv**d for d in DIMENSIONS.get(function, (1,))]
            self._programs[function] = RowFunction(library, len(ARGUMENTS[function]), outputs)
        return self._programs[function]

    @override
    def _dynamics(self, function: str, *arguments: Tensor) -> Any:
        nv, space, given, names = self._nv, self._space, list(arguments), ARGUMENTS[function]
        plain = not space.groups and are_plain(given, nv)
        if space.groups and are_plain(given[:1], space.nq) and are_plain(given[1:], nv):  # q has entries of its own
            plain = all(x.shape[:-1] == given[0].shape[:-1] for x in given)
            space.check(given[0])
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
                given = [x.expand(*batch, -1).reshape(batch.numel(), x.shape[-1]).contiguous() for x in given]
            results = [torch.empty(batch.numel(), size, dtype=torch.float64) for size in program.outputs]
            bits = program.rows(batch.numel(), given, results)
        if bits & NOT_POSITIVE:
            raise NumericalError(NOT_POSITIVE_DEFINITE)
        made = zip(results, DIMENSIONS.get(function, (1,)), strict=True)
        found = [x if d == len(batch) == 1 else x.view(*batch, *(nv,) * d) for x, d in made]
        return found[0] if len(found) == 1 else tuple(found)
