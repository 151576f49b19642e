"""`CompiledRobot`: the dynamics of one robot as machine code made for it, with first derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.codegen.library import default_folder
from forcegp.codegen.native_code import require_plain
from forcegp.codegen.row_function import NOT_POSITIVE, RowFunction, are_plain
from forcegp.errors import InvalidInput, NumericalError
from forcegp.robots.algorithms import NOT_POSITIVE_DEFINITE
from forcegp.robots.arguments import Inertials, JointValues, broadcast_batch, check_mapping
from forcegp.robots.compiled_programs import compiled_program
from forcegp.robots.dynamics_programs import ARGUMENTS, DIMENSIONS, MERGED, Request
from forcegp.robots.structure import RobotStructure
from forcegp.robots.unrolled import UnrolledRobot

INSTEAD_OF_TRANSFORMS = (
    "use batch dimensions and backward passes, or the robot itself (compiled.robot), whose results are the same"
)


class CompiledRobot:
    """The dynamics of a robot, compiled for it; made by ``robot.compile()``.

    The methods take, check and return what those of :class:`~forcegp.robots.Robot` do, and backward passes give the
    derivatives with respect to all arguments and inertial parameters. Results agree to rounding. Not supported, with
    an :class:`~forcegp.errors.InvalidInput` : second derivatives, transforms of ``torch.func``,
    forward-mode differentiation, and other devices than the CPU. Use the robot itself there.

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
        self._programs: dict[Request, RowFunction] = {}

    def __reduce__(self) -> tuple[type[CompiledRobot], tuple[RobotStructure, Path]]:
        return CompiledRobot, (self.robot, self.folder)

    def __repr__(self) -> str:
        return f"CompiledRobot({self.robot!r}, folder={str(self.folder)!r})"

    def prepare(self, *functions: str, inertials: bool = False, derivatives: bool = False) -> CompiledRobot:
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
        return self

    # ------------------------------------------------------------------ dynamics

    def mass_matrix(self, q: JointValues, inertials: Inertials | None = None) -> Float[Tensor, "... nv nv"]:
        """As :meth:`Robot.mass_matrix <forcegp.robots.Robot.mass_matrix>`."""
        return self._evaluate("mass_matrix", inertials, q=q)[0]

    def bias_forces(
        self, q: JointValues, v: JointValues, inertials: Inertials | None = None
    ) -> Float[Tensor, "... nv"]:
        """As :meth:`Robot.bias_forces <forcegp.robots.Robot.bias_forces>`."""
        return self._evaluate("bias_forces", inertials, q=q, v=v)[0]

    def mass_matrix_and_bias(
        self, q: JointValues, v: JointValues, inertials: Inertials | None = None
    ) -> tuple[Float[Tensor, "... nv nv"], Float[Tensor, "... nv"]]:
        """As :meth:`Robot.mass_matrix_and_bias <forcegp.robots.Robot.mass_matrix_and_bias>`."""
        mass, bias = self._evaluate("mass_matrix_and_bias", inertials, q=q, v=v)
        return mass, bias

    def gravity_forces(self, q: JointValues, inertials: Inertials | None = None) -> Float[Tensor, "... nv"]:
        """As :meth:`Robot.gravity_forces <forcegp.robots.Robot.gravity_forces>`."""
        return self._evaluate("gravity_forces", inertials, q=q)[0]

    def inverse_dynamics(
        self, q: JointValues, v: JointValues, a: JointValues, inertials: Inertials | None = None
    ) -> Float[Tensor, "... nv"]:
        """As :meth:`Robot.inverse_dynamics <forcegp.robots.Robot.inverse_dynamics>`."""
        return self._evaluate("inverse_dynamics", inertials, q=q, v=v, a=a)[0]

    def forward_dynamics(
        self, q: JointValues, v: JointValues, tau: JointValues, inertials: Inertials | None = None
    ) -> Float[Tensor, "... nv"]:
        """As :meth:`Robot.forward_dynamics <forcegp.robots.Robot.forward_dynamics>`."""
        return self._evaluate("forward_dynamics", inertials, q=q, v=v, tau=tau)[0]

    # ------------------------------------------------------------------ inside

    def program(self, request: Request) -> RowFunction:
        """The machine code of a request."""
        found = self._programs.get(request)
        if found is None:
            found = self._programs[request] = compiled_program(self._unrolled, request, self.folder)
        return found

    def _evaluate(self, function: str, inertials: Inertials | None, **arguments: Tensor) -> tuple[Tensor, ...]:
        nv, given = self.robot.nv, tuple(arguments.values())
        if not inertials and are_plain(given, nv):
            require_plain(given, "compiled dynamics", INSTEAD_OF_TRANSFORMS)
            batch = given[0].shape[:-1]
            if batch:
                return _shaped(run(self, Request(function), len(given[0]), given), batch, function, nv)
            bits, found = self.program(Request(function)).single(*given)
            if bits & NOT_POSITIVE:
                raise NumericalError(NOT_POSITIVE_DEFINITE)
            return _shaped(found, (), function, nv)
        arguments = {name: self.robot.checked_input(name, value) for name, value in arguments.items()}
        shapes = {name: value.shape[:-1] for name, value in arguments.items()}
        tensors = list(arguments.values())
        if inertials:
            tensors.append(self._merged(inertials))
            shapes["inertials"] = tensors[-1].shape[:-1]
        require_plain(tensors, "compiled dynamics", INSTEAD_OF_TRANSFORMS)
        batch = broadcast_batch(shapes)
        flat = [
            value.reshape(1, -1)
            if position == len(arguments) and value.dim() == 1  # one set of inertias serves all states
            else value.expand(*batch, -1).reshape(batch.numel(), value.shape[-1]).contiguous()
            for position, value in enumerate(tensors)
        ]
        results = self._run(Request(function, bool(inertials)), batch.numel(), flat)
        return _shaped(results, batch, function, self.robot.nv)

    def _merged(self, inertials: Inertials) -> Tensor:
        """The inertias of the bodies (..., 10 nv) from the parameters of links."""
        check_mapping(inertials)
        for name in inertials:
            self.robot.layout.require_moving(name, self.robot.name)
        given = [self.robot.checked_parameters(name, values) for name, values in inertials.items()]
        require_plain(given, "compiled dynamics", INSTEAD_OF_TRANSFORMS)
        named = zip(inertials, given, strict=True)
        own = broadcast_batch({f"inertials[{name!r}]": values.shape[:-1] for name, values in named})
        joined = torch.cat([values.expand(*own, 10) for values in given], dim=-1).reshape(own.numel(), -1)
        (found,) = self._run(Request(MERGED, links=tuple(inertials)), own.numel(), [joined])
        return found.reshape(*own, -1)

    def _run(self, request: Request, count: int, flat: list[Tensor]) -> tuple[Tensor, ...]:
        if torch.is_grad_enabled() and any(value.requires_grad for value in flat):
            return _Value.apply(self, request, count, *flat)  # type: ignore[return-value]  # torch does not type `apply`
        return run(self, request, count, flat)


def _shaped(results: Sequence[Tensor], batch: Sequence[int], function: str, nv: int) -> tuple[Tensor, ...]:
    dimensions = DIMENSIONS.get(function, (1,))
    return tuple(x.reshape(*batch, *(nv,) * d) for x, d in zip(results, dimensions, strict=True))


def run(owner: CompiledRobot, request: Request, count: int, tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Results of a request, (count, size) each, from its inputs in order."""
    program = owner.program(request)
    if request.is_value:
        outputs = tuple(torch.empty(count, size, dtype=torch.float64) for size in program.outputs)
    else:
        inputs = dict(zip(request.inputs, tensors, strict=True))
        outputs = tuple(torch.empty_like(inputs[name]) for name in request.wanted)
    if program.rows(count, tensors, outputs) & NOT_POSITIVE:
        raise NumericalError(NOT_POSITIVE_DEFINITE)
    return outputs


class _Value(torch.autograd.Function):
    """A function of the robot; its backward pass is the program of its derivatives."""

    @staticmethod
    def forward(ctx: Any, owner: CompiledRobot, request: Request, count: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.owner, ctx.request, ctx.count = owner, request, count
        ctx.save_for_backward(*tensors)
        return run(owner, request, count, list(tensors))

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        needed = dict(zip(ctx.request.inputs, ctx.needs_input_grad[3:], strict=True))
        inertias = needed.pop("inertias", False)
        request = replace(ctx.request, states=any(needed.values()), inertias=inertias)
        tensors = *ctx.saved_tensors, *(cotangent.contiguous() for cotangent in cotangents)
        found = dict(zip(request.wanted, _Derivative.apply(ctx.owner, request, ctx.count, *tensors), strict=True))
        return None, None, None, *(found.get(name) for name in ctx.request.inputs)


class _Derivative(torch.autograd.Function):
    """Derivatives of a function of the robot, which have none themselves."""

    @staticmethod
    def forward(ctx: Any, owner: CompiledRobot, request: Request, count: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        return run(owner, request, count, list(tensors))

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> tuple[None, ...]:
        raise InvalidInput(
            "compiled dynamics has first derivatives only; for second ones use the robot itself (compiled.robot), "
            "whose results are the same."
        )
