"""Checks of what callers pass in, numbers, shapes and robot files; real numbers become float64, others are refused."""

import contextlib
import math
import operator
import shlex
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeGuard

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import ForceGPError, InvalidInput, RobotFileWarning, RobotModelError, UnknownName, require_known

LARGEST = 2**63 - 1  # of the integers that every library takes
LISTED = 12  # problems of one kind that a message lists; the error has all of them


def is_sequence(given: object) -> TypeGuard[Iterable[Any]]:
    """Whether there is something to iterate over; tensors and arrays without dimensions only look so."""
    return isinstance(given, Iterable) and getattr(given, "ndim", 1) != 0


def real_array(name: str, given: Any, kinds: str = "fiu", error: type[ForceGPError] = InvalidInput) -> np.ndarray:
    """`given` as an array of real numbers, or of integers with `kinds` "iu", not necessarily copied."""
    kind = "real numbers" if "f" in kinds else "integers"
    if np.ma.is_masked(given):
        where = np.argwhere(np.ma.getmaskarray(given))
        seen = f"{name} has {len(where)} masked values, the first at {tuple(where[0].tolist())}"
        raise error(f"{seen}; a mask would be lost: drop these rows, or fill them with numbers that were measured.")
    try:
        values = np.asarray(given)
    except (TypeError, ValueError, RuntimeError) as cause:  # ragged lists, tensors that require a gradient
        raise error(f"{name} is not an array of {kind}: {cause}") from cause
    if values.dtype.kind not in kinds:
        raise error(f"{name} must be an array of {kind}; given: {values.dtype} of shape {values.shape}.")
    return values


def real_tensor(name: str, given: Any, device: torch.device) -> Tensor:
    """In float64: a tensor stays, with its graph, else a copy on `device`. Raises InvalidInput for no real numbers."""
    if type(given) is Tensor and given.dtype is torch.float64 and given.layout is torch.strided:
        return given
    if not isinstance(given, Tensor):
        return torch.tensor(real_array(name, given).astype(np.float64), device=device)
    if given.layout != torch.strided or given.dtype == torch.bool or given.is_complex():
        raise InvalidInput(f"{name} must be a tensor of real numbers; given: {given.dtype}, {given.layout}.")
    return given.to(torch.float64)  # itself where it is


def require_finite(name: str, values: Tensor) -> None:
    """Raise InvalidInput for numbers that are not finite, and inside `vmap`, where no number can be looked at."""
    try:
        # the sum takes half as long, and is finite where all numbers are, unless they are very large
        finite = math.isfinite(float(values.detach().sum())) or bool(torch.isfinite(values.detach()).all())
    except RuntimeError:
        seen = f"{name} comes from torch.func.vmap, inside which numbers cannot be checked"
        advice = "batch dimensions lead, so call this once without vmap, with all states as rows (n, nv)."
        raise InvalidInput(f"{seen}; {advice}") from None
    if not finite:
        raise InvalidInput(f"{name} has values that are not finite; drop or repair those rows.")


def whole_number(name: str, given: Any, least: int, most: int = LARGEST, why: str = "") -> int:
    """`given` as an int in these limits; `why` explains the upper. Raises InvalidInput, also for booleans and 1.0."""
    try:
        value = operator.index(given)
    except TypeError:
        value = least - 1
    if isinstance(given, bool | np.bool_) or not least <= value <= most:
        allowed = f"an integer of at least {least}" if most == LARGEST else f"an integer from {least} to {most}"
        raise InvalidInput(f"`{name}={given!r}` must be {allowed}{why and f', {why}'}")
    return value


def usable_device(device: torch.device | str) -> torch.device:
    """``device`` if float64 can be there. Raises InvalidInput that names the devices which are there."""
    try:
        asked = torch.device(device)
        torch.zeros(1, dtype=torch.float64, device=asked)
    except (RuntimeError, AssertionError, TypeError, NotImplementedError):  # as torch's backends happen to raise
        there = ["cpu", *(f"cuda:{k}" for k in range(torch.cuda.device_count()))]
        seen = f"device {str(device)!r} cannot be used here; there is {', '.join(there)} for torch {torch.__version__}"
        raise InvalidInput(f"{seen} (docs/how-to/gpu.md names builds for GPUs).") from None
    return asked


Vector = Sequence[float | int] | np.ndarray | Tensor
Armature = Vector | Mapping[str, float | int]
"""Rotor inertias at the joints (kg m^2 or kg), one per joint or by joint name."""
JointValues = Float[Tensor, "*#batch nv"]
"""One value per joint, float64 (..., nv); the batch dimensions of several arguments broadcast."""
Positions = Float[Tensor, "*#batch nq"]
"""Positions, float64 (..., nq): more than joints where some have a quaternion, or cos and sin."""


def checked_tensor(name: str, value: object, size: int, meaning: str, device: torch.device) -> Tensor:
    """The tensor in float64; :class:`~forcegp.errors.InvalidInput` unless it is real (..., size) on ``device``."""
    if not isinstance(value, Tensor):
        seen = f"{name} is a {type(value).__name__}"
        raise InvalidInput(f"{seen}; give a tensor: torch.as_tensor({name}, dtype=torch.float64).")
    if value.dim() == 0 or value.shape[-1] != size:
        raise InvalidInput(f"{name} has shape {tuple(value.shape)}; its last dimension must be {size} ({meaning}).")
    if value.device != device:
        seen = f"{name} is on {value.device} but the robot on {device}"
        raise InvalidInput(f"{seen}; use robot.to({str(value.device)!r}) or {name}.to({str(device)!r}).")
    return real_tensor(name, value, device)


def broadcast_batch(shapes: Mapping[str, torch.Size]) -> torch.Size:
    """Common batch shape; :class:`~forcegp.errors.InvalidInput` where there is none."""
    different = {shape for shape in shapes.values() if shape}
    if len(different) <= 1:  # the usual case; torch's function imports for a quarter of a second at first
        return next(iter(different), torch.Size())
    try:
        return torch.broadcast_shapes(*shapes.values())
    except RuntimeError:
        listed = ", ".join(f"{name} {tuple(shape)}" for name, shape in shapes.items())
        seen = f"batch shapes do not broadcast: {listed}"
        raise InvalidInput(f"{seen}; make them equal, or 1 where one value serves all.") from None


def finite_vector(name: str, values: Any, size: int, meaning: str = "") -> np.ndarray:
    """``size`` finite numbers as an array; ``meaning`` follows them in the error, " x, y, z" for example."""
    try:
        plain = values.detach().cpu().numpy() if isinstance(values, Tensor) else values
        array = real_array(name, plain).astype(np.float64)
    except (InvalidInput, TypeError, NotImplementedError):  # text, of which every letter could be a digit; sparse, meta
        array = np.full((), np.nan)
    if array.shape != (size,) or not np.isfinite(array).all():
        raise InvalidInput(f"{name} is {values!r}; give {size} finite numbers{meaning}.")
    return array


def checked_point(point: Vector, device: torch.device) -> Tensor:
    """A point (3,) in m as a float64 tensor on ``device``; InvalidInput for others."""
    if not isinstance(point, Tensor):
        point = torch.as_tensor(finite_vector("point", point, 3), device=device)
    if point.dim() != 1:
        raise InvalidInput(f"point has shape {tuple(point.shape)}; give one point (3,), x, y, z in m.")
    return checked_tensor("point", point, 3, "x, y, z in m", device)


def by_joint(given: Any, joints: tuple[str, ...], robot: str) -> Any:
    """Values in joint order if they are given by joint name, 0 for those not named; else as they are given."""
    if not isinstance(given, Mapping):
        return given
    for name in given:
        require_known("joint", name, robot, joints, UnknownName)
    return [given.get(name, 0.0) for name in joints]


def locked_positions(locked: Mapping[str, float | int]) -> dict[str, float]:
    """Positions (rad or m) of locked joints as floats."""
    out = {}
    for name, position in locked.items():
        with contextlib.suppress(TypeError, ValueError):
            out[name] = float(position)
        if not math.isfinite(out.get(name, math.nan)):
            raise InvalidInput(f"locked[{name!r}] is {position!r}; give a finite position in rad or m.")
    return out


class Problems:
    """What is wrong with a file, and what was repaired, in one report with the arguments that mend it together.

    `source` begins every message; `given` are arguments that the remedy keeps; `reader` reads the file.
    """

    def __init__(self, source: str, given: Mapping[str, Any] | None = None, reader: str = "Robot.from_urdf") -> None:
        self.source, self.given, self.reader = source, dict(given or {}), reader
        self.errors: list[RobotModelError] = []
        self.broken: set[str] = set()
        """Links of which something is reported, so that nothing else need be."""
        self.notes: dict[str, list[str]] = {}

    @contextlib.contextmanager
    def collected(self, link: str | None = None) -> Iterator[None]:
        """Keep an error of the file, of a `link` for example, for the report, and go on."""
        try:
            yield
        except RobotModelError as error:
            self.errors.append(error)
            if link is not None:
                self.broken.add(link)

    def note(self, what: str, where: str) -> None:
        """Note what was ignored or repaired, and of which element."""
        self.notes.setdefault(what, []).append(where)

    def warn(self, stacklevel: int) -> None:
        """One RobotFileWarning about all that was noted."""
        if self.notes:
            text = "; ".join(f"{what} ({', '.join(where)})" for what, where in self.notes.items())
            warnings.warn(f"{self.source}: {text}.", RobotFileWarning, stacklevel=stacklevel)

    def raise_all(self) -> None:
        """Raise what was collected as one error: of their class where they are alike, else a RobotModelError."""
        if not self.errors:
            return
        remedy: dict[str, Any] = {}
        for arguments in (*(error.remedy for error in self.errors), self.given):
            for name, value in arguments.items() if remedy or arguments is not self.given else ():
                before = remedy.get(name)
                remedy[name] = {**value, **(before or {})} if isinstance(value, Mapping) else before or value
        alike: dict[str, list[str]] = {}  # what to do is said once for all that are alike
        for error in self.errors:
            alike.setdefault(error.advice, []).append(error.seen.removeprefix(f"{self.source}: "))
        texts = [
            "; ".join([*seen[:LISTED], *([f"and {len(seen) - LISTED} more like these"] * (len(seen) > LISTED))])
            + advice
            for advice, seen in alike.items()
        ]
        many, by_hand = len(self.errors) > 1, not all(error.remedy for error in self.errors)
        text = f"{self.source}: {f'{len(self.errors)} problems: ' if many else ''}{' '.join(texts)}"
        if remedy:
            which = "the others, when the file is corrected" if by_hand else "all" if many else "it"
            text += f" The remedy for {which}: {remedy_text(remedy, self.reader)}"
        kinds = {type(error) for error in self.errors}
        found = (kinds.pop() if len(kinds) == 1 else RobotModelError)(text, "", {} if by_hand else remedy)
        found.problems = tuple(str(error) for error in self.errors)
        raise found from None


def remedy_text(remedy: Mapping[str, Any], reader: str) -> str:
    """The arguments in Python, and the options of the command line that they are."""
    words = []
    for name, value in remedy.items():
        short = {k: f"{x:g}" if float(f"{x:g}") == x else repr(x) for k, x in value.items()} if name == "locked" else {}
        listed = ",".join(f"{k}={x}" for k, x in short.items()) if short else value
        words.append(f"--{'lock' if name == 'locked' else name} {shlex.quote(listed)}")
    python = ", ".join(f"{name}={value!r}" for name, value in remedy.items())
    return f"{reader}(path, {python}), or {' '.join(words)}."
