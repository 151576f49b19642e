"""`CompiledRobot`: the dynamics of one robot as machine code made for it, with first derivatives."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.codegen.library import NOT_POSITIVE, RowFunction, are_plain, default_folder, require_plain
from forcegp.errors import InvalidInput, NumericalError
from forcegp.robots.arguments import Inertials, JointValues, Positions, broadcast_batch
from forcegp.robots.dynamics_programs import ARGUMENTS, DIMENSIONS, KEEPING, MERGED, Request, compiled_program
from forcegp.robots.kinematics import NOT_POSITIVE_DEFINITE
from forcegp.robots.structure import RobotStructure
from forcegp.robots.unrolled import UnrolledRobot

INSTEAD_OF_TRANSFORMS = (
    "use batch dimensions and backward passes, or the robot itself (compiled.robot), whose results are the same"
)


class CompiledRobot:
    """The dynamics of a robot, compiled for it; made by ``robot.compile()``.

    The methods take, check and return what those of :class:`~forcegp.robots.Robot` do, also where a base moves, and
    backward passes give the derivatives with respect to all arguments and inertial parameters. Results agree to
    rounding. Not supported, with an :class:`~forcegp.errors.InvalidInput` : second derivatives, transforms of
    ``torch.func``, forward-mode differentiation, and other devices than the CPU. Use the robot itself there.

    A function is compiled when it is first called, and its derivatives when they are first asked for, unless a file in
    ``folder`` (``~/.cache/forcegp/compiled`` by default) holds them already; :meth:`prepare` does so ahead. Code from
    that folder runs with the rights of the process. Several states are computed at once, and large batches by as many
    threads as torch has.

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
        self._programs: dict[Request, RowFunction] = {}

    def __reduce__(self) -> "tuple[type[CompiledRobot], tuple[RobotStructure, Path]]":
        return CompiledRobot, (self.robot, self.folder)

    def __repr__(self) -> str:
        return f"CompiledRobot({self.robot!r}, folder={str(self.folder)!r})"

    def prepare(self, *functions: str, inertials: bool = False, derivatives: bool = False) -> "CompiledRobot":
        """Compile functions now: those named, or all; returns the same object.

        ``inertials``: for calls with ``inertials=``, which take the inertias as inputs; else for those without.
        ``derivatives``: also those of a backward pass, with respect to the arguments, the inertias, or both.
        """
        unknown = [name for name in functions if name not in ARGUMENTS]
        if unknown:
            raise InvalidInput(f"no function {unknown[0]!r} to compile; there are: {', '.join(ARGUMENTS)}")
        kinds = [(False, False)]
        if derivatives:
            kinds += [(True, False), *([(False, True), (True, True)] if inertials else [])]
        for name in functions or ARGUMENTS:
            for states, inertias in kinds:
                self.program(Request(name, inertials, states, inertias))
            if derivatives and name == KEEPING:
                self.program(Request(name, inertials, keeps=True))
        return self

    def mass_matrix(self, q: Positions, inertials: Inertials | None = None) -> Float[Tensor, "... nv nv"]:
        """As :meth:`Robot.mass_matrix <forcegp.robots.Robot.mass_matrix>`."""
        return self._evaluate("mass_matrix", inertials, q=q)[0]

    def bias_forces(self, q: Positions, v: JointValues, inertials: Inertials | None = None) -> Float[Tensor, "... nv"]:
        """As :meth:`Robot.bias_forces <forcegp.robots.Robot.bias_forces>`."""
        return self._evaluate("bias_forces", inertials, q=q, v=v)[0]

    def mass_matrix_and_bias(
        self, q: Positions, v: JointValues, inertials: Inertials | None = None
    ) -> tuple[Float[Tensor, "... nv nv"], Float[Tensor, "... nv"]]:
        """As :meth:`Robot.mass_matrix_and_bias <forcegp.robots.Robot.mass_matrix_and_bias>`."""
        mass, bias = self._evaluate("mass_matrix_and_bias", inertials, q=q, v=v)
        return mass, bias

    def gravity_forces(self, q: Positions, inertials: Inertials | None = None) -> Float[Tensor, "... nv"]:
        """As :meth:`Robot.gravity_forces <forcegp.robots.Robot.gravity_forces>`."""
        return self._evaluate("gravity_forces", inertials, q=q)[0]

    def inverse_dynamics(
        self, q: Positions, v: JointValues, a: JointValues, inertials: Inertials | None = None
    ) -> Float[Tensor, "... nv"]:
        """As :meth:`Robot.inverse_dynamics <forcegp.robots.Robot.inverse_dynamics>`."""
        return self._evaluate("inverse_dynamics", inertials, q=q, v=v, a=a)[0]

    def forward_dynamics(
        self, q: Positions, v: JointValues, tau: JointValues, inertials: Inertials | None = None
    ) -> Float[Tensor, "... nv"]:
        """As :meth:`Robot.forward_dynamics <forcegp.robots.Robot.forward_dynamics>`."""
        return self._evaluate("forward_dynamics", inertials, q=q, v=v, tau=tau)[0]

    def program(self, request: Request) -> RowFunction:
        """The machine code of a request."""
        found = self._programs.get(request)
        if found is None:
            found = self._programs[request] = compiled_program(self._unrolled, request, self.folder)
        return found

    def _evaluate(self, function: str, inertials: Inertials | None, **arguments: Tensor) -> tuple[Tensor, ...]:
        nv, given = self._nv, list(arguments.values())
        parameters = [*self.robot.checked_inertials(inertials).values()] if inertials else []
        plain = self._are_possible(arguments) if self._space.groups else are_plain(given, nv)
        if not plain:
            given = [self.robot.checked_input(name, value) for name, value in arguments.items()]
        require_plain((*given, *parameters), "compiled dynamics", INSTEAD_OF_TRANSFORMS)
        batch, own = given[0].shape[:-1], torch.Size()
        if plain and not parameters and not batch:
            bits, found = self.program(Request(function)).single(*given)
            if bits & NOT_POSITIVE:
                raise NumericalError(NOT_POSITIVE_DEFINITE)
            return _shaped(found, (), function, nv)
        simple = plain and all(x.dim() == 1 for x in parameters)
        if not simple:
            named = zip(inertials or (), parameters, strict=True)
            own = broadcast_batch({f"inertials[{name!r}]": values.shape[:-1] for name, values in named})
            parameters = [values.expand(*own, 10) for values in parameters]
            shapes = {name: value.shape[:-1] for name, value in zip(arguments, given, strict=True)}
            batch = broadcast_batch(shapes | ({"inertials": own} if parameters else {}))
            given = [value.expand(*batch, value.shape[-1]) for value in given]
        if not simple or len(batch) != 1:
            given = [value.reshape(batch.numel(), value.shape[-1]).contiguous() for value in given]
        call, tensors = _Call(function, tuple(inertials or ()), batch, own), (*given, *parameters)
        if torch.is_grad_enabled() and any(value.requires_grad for value in tensors):
            results = _Value.apply(self, call, *tensors)
        else:
            results, _ = values_of(self, call, tensors)
        return _shaped(results, batch, function, nv)  # type: ignore[arg-type]  # torch does not type `apply`

    def _are_possible(self, arguments: Mapping[str, Tensor]) -> bool:
        """`are_plain` where q has more entries than v and a length to check."""
        q, *others = arguments.values()
        plain = are_plain([q], self._space.nq) and are_plain(others, self._nv)
        if plain and all(x.shape[:-1] == q.shape[:-1] for x in others):
            self._space.check(q)
            return True
        return False


def _shaped(results: Sequence[Tensor], batch: Sequence[int], function: str, nv: int) -> tuple[Tensor, ...]:
    dimensions = DIMENSIONS.get(function, (1,))
    return tuple(
        x if d == len(batch) == 1 else x.view(*batch, *(nv,) * d) for x, d in zip(results, dimensions, strict=True)
    )


class _Call(NamedTuple):
    """A function at (batch) states with parameters (own, 10) of links, whose batch broadcasts to that of the states."""

    function: str
    links: tuple[str, ...]
    batch: torch.Size
    own: torch.Size

    def joined(self, parameters: Sequence[Tensor]) -> Tensor:
        """The parameters of all links, a row for each set."""
        return torch.cat(list(parameters), dim=-1).view(self.own.numel(), -1)


def values_of(
    owner: CompiledRobot, call: _Call, tensors: Sequence[Tensor], keeps: bool = False
) -> tuple[list[Tensor], list[Tensor]]:
    """Results (count, size), and what derivatives take beside states and cotangents: the inertias and what was kept."""
    states, parameters = (list(part) for part in _split(call, tensors))
    if parameters:
        rows = call.joined(parameters)
        (inertias,) = run(owner, Request(MERGED, links=call.links), len(rows), [rows])
        if call.own:
            size = inertias.shape[1]
            inertias = inertias.view(*call.own, size).expand(*call.batch, size).reshape(-1, size)
        states.append(inertias)
    request = Request(call.function, bool(parameters), keeps=keeps and call.function == KEEPING)
    made = run(owner, request, call.batch.numel(), states)
    results = len(request.results)
    return made[:results], [*states[len(ARGUMENTS[call.function]) :], *made[results:]]


def derivatives_of(
    owner: CompiledRobot, call: _Call, request: Request, held: Sequence[Tensor], tensors: Sequence[Tensor]
) -> list[Tensor | None]:
    """Derivatives in the states and the parameters of links, None for those not asked for; `tensors` as in `_Value`."""
    states, (*parameters,) = _split(call, tensors[: len(ARGUMENTS[call.function]) + len(call.links)])
    cotangents = tensors[len(states) + len(parameters) :]
    found: list[Tensor | None] = [*run(owner, request, call.batch.numel(), [*states, *held, *cotangents])]
    if not request.states:
        found = [*[None] * len(states), *found]
    if not request.inertias:
        return [*found, *[None] * len(parameters)]
    inertias, rows = found.pop(), call.joined(parameters)
    assert inertias is not None  # the last that was asked for
    if call.own:
        size = inertias.shape[1]
        inertias = inertias.view(*call.batch, size).sum_to_size(*call.own, size).reshape(-1, size)
    merging = Request(MERGED, states=True, links=call.links)
    (gradient,) = run(owner, merging, len(rows), [rows, inertias])
    return [*found, *gradient.view(*call.own, len(parameters), 10).unbind(-2)]


def _split(call: _Call, each: Sequence[Any]) -> tuple[Sequence[Any], Sequence[Any]]:
    count = len(ARGUMENTS[call.function])
    return each[:count], each[count:]


def run(owner: CompiledRobot, request: Request, count: int, tensors: Sequence[Tensor]) -> list[Tensor]:
    """Results of a request, (count, size) each, from its inputs in order."""
    program = owner.program(request)
    outputs = [torch.empty(count, size, dtype=torch.float64) for size in program.outputs]
    if request.inertias:  # the last; one set of inertias receives the sum over all states
        outputs[-1] = torch.empty_like(tensors[len(request.arguments) - 1])
    if program.rows(count, tensors, outputs) & NOT_POSITIVE:
        raise NumericalError(NOT_POSITIVE_DEFINITE)
    return outputs


class _Value(torch.autograd.Function):
    """A function of the robot, of states and parameters of links; its backward pass is the program of derivatives."""

    @staticmethod
    def forward(ctx: Any, owner: CompiledRobot, call: _Call, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.owner, ctx.call = owner, call
        results, ctx.held = values_of(owner, call, tensors, keeps=True)
        ctx.save_for_backward(*tensors)
        return tuple(results)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        states, inertias = (any(part) for part in _split(ctx.call, ctx.needs_input_grad[2:]))
        request = Request(ctx.call.function, bool(ctx.call.links), states, inertias)
        tensors = *ctx.saved_tensors, *(cotangent.contiguous() for cotangent in cotangents)
        given = ctx.owner, ctx.call, request, ctx.held
        if torch.is_grad_enabled():
            return None, None, *_Derivative.apply(*given, *tensors)
        return None, None, *derivatives_of(*given, tensors)


class _Derivative(torch.autograd.Function):
    """Derivatives of a function of the robot, which have none themselves."""

    @staticmethod
    def forward(
        ctx: Any, owner: CompiledRobot, call: _Call, request: Request, held: Sequence[Tensor], *tensors: Tensor
    ) -> tuple[Tensor | None, ...]:
        return tuple(derivatives_of(owner, call, request, held, tensors))

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> tuple[None, ...]:
        raise InvalidInput(
            "compiled dynamics has first derivatives only; for second ones use the robot itself (compiled.robot), "
            "whose results are the same."
        )
