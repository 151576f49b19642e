"""Devices that tests run on: those that are there, and one that is pretended, which finds mistakes without a GPU.

A `PretendTensor` computes on the CPU but says that it lies on another device (`PRETEND`). Inside `pretend_device()`
everything that is made on that device is one, and what a GPU would refuse raises `MixedDevices`: an operation on
tensors of that device and of the CPU together, but for numbers (0-dimensional tensors) in element-wise operations.
Every trip of data from the device to the host (`float(x)`, `bool(x)`, `x.tolist()`, `x.cpu()`) is counted.

The device is called "meta", the one type besides "cpu" that every build of torch can differentiate on.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

PRETEND = torch.device("meta")
aten = torch.ops.aten

DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="this machine has no GPU")),
]
"""For `pytest.mark.parametrize("device", DEVICES)`: real devices."""


class MixedDevices(Exception):
    """What raises "Expected all tensors to be on the same device" on a GPU."""


class PretendTensor(torch.Tensor):
    """A tensor that says it is on `PRETEND`; its numbers are in `inner`, on the CPU."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor, requires_grad: bool = False) -> PretendTensor:
        made = torch.Tensor._make_wrapper_subclass(
            cls, inner.size(), strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype,
            device=PRETEND, requires_grad=requires_grad,
        )  # fmt: skip
        made.inner = inner
        return made

    def __tensor_flatten__(self) -> tuple[list[str], None]:
        return ["inner"], None

    @staticmethod
    def __tensor_unflatten__(parts: dict[str, torch.Tensor], context: None, size: Any, stride: Any) -> PretendTensor:
        return PretendTensor(parts["inner"])

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _dispatch(func, args, kwargs or {}, Counter())

    def tolist(self) -> Any:
        _ROUND_TRIPS[-1]["tolist"] += 1
        return self.inner.tolist()

    def __repr__(self) -> str:
        return f"PretendTensor({self.inner!r})"


class _PretendGenerator(torch.Generator):
    """A generator of the pretended device, which draws the numbers of the CPU's."""

    def __new__(cls, device: Any = "cpu") -> Any:
        made = super().__new__(cls, "cpu")
        _GENERATORS[made._cdata] = torch.device(device)
        return made

    @property
    def device(self) -> torch.device:
        return _GENERATORS[self._cdata]


_GENERATORS: dict[int, torch.device] = {}
"""By their address: an operation sees another Python object of the same generator."""
_ROUND_TRIPS: list[Counter[str]] = [Counter()]


class _Mode(TorchDispatchMode):
    def __init__(self, trips: Counter[str]) -> None:
        super().__init__()
        self.trips = trips

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _dispatch(func, args, kwargs or {}, self.trips)


class _FromNumbers(TorchFunctionMode):
    """Where torch makes tensors without numbers for "meta": torch.tensor, torch.as_tensor, and lists as indices."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func in (torch.tensor, torch.as_tensor) and _is_pretended(kwargs.get("device")):
            return func(*args, **{**kwargs, "device": "cpu"}).to(PRETEND)
        if func in (torch.Tensor.__getitem__, torch.Tensor.__setitem__) and isinstance(args[0], PretendTensor):
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            index = tuple(_index(part) if isinstance(part, list) else part for part in index)
            args = (args[0], index, *args[2:])
        return func(*args, **kwargs)


def _index(entries: list[Any]) -> torch.Tensor:
    return torch.tensor(entries, dtype=None if entries else torch.long).to(PRETEND)


def _is_pretended(device: Any) -> bool:
    return device is not None and torch.device(device).type == PRETEND.type


@contextlib.contextmanager
def pretend_device() -> Iterator[Counter[str]]:
    """Where `PRETEND` exists; gives the numbers of trips to the host by their kind, counted so far."""
    trips: Counter[str] = Counter()
    original = torch.Generator
    _ROUND_TRIPS.append(trips)
    torch.Generator = _PretendGenerator  # type: ignore[misc]  # restored below
    try:
        with _Mode(trips), _FromNumbers():
            yield trips
    finally:
        torch.Generator = original  # type: ignore[misc]
        _ROUND_TRIPS.pop()


def _dispatch(func: Any, args: Any, kwargs: dict[str, Any], trips: Counter[str]) -> Any:
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    pretended, asked = [x for x in tensors if isinstance(x, PretendTensor)], kwargs.get("device")
    if func in (aten._to_copy.default, aten.copy_.default):
        _count_copy(func, args, asked, trips)
    elif pretended:
        _check_mixed(func, tensors)
    if func is aten._local_scalar_dense.default and pretended:
        trips["number"] += 1
    generator = kwargs.get("generator")
    wanted = pretended[0].device if pretended else torch.device(asked or "cpu")
    if generator is not None and _GENERATORS.get(generator._cdata, torch.device("cpu")).type != wanted.type:
        raise MixedDevices(f"{func}: a generator of another device for a tensor on {wanted}")
    inner = tree_map(lambda x: x.inner if isinstance(x, PretendTensor) else x, (args, kwargs))
    if asked is not None:
        inner[1]["device"] = torch.device("cpu")
    with _no_dispatch():
        result = func(*inner[0], **inner[1])
    on_device = bool(pretended) if asked is None else _is_pretended(asked)
    if func is aten.copy_.default:
        return args[0]
    if not on_device:
        return result
    wrapped = tree_map(lambda x: PretendTensor(x) if isinstance(x, torch.Tensor) else x, result)
    return return_and_correct_aliasing(func, args, kwargs, wrapped)


def _no_dispatch() -> Any:
    return torch._C._DisableTorchDispatch()


def _count_copy(func: Any, args: Any, asked: Any, trips: Counter[str]) -> None:
    if func is aten.copy_.default:
        to_host = isinstance(args[1], PretendTensor) and not isinstance(args[0], PretendTensor)
    else:
        to_host = isinstance(args[0], PretendTensor) and asked is not None and torch.device(asked).type == "cpu"
    if to_host:
        trips["copy"] += 1


def _check_mixed(func: Any, tensors: list[torch.Tensor]) -> None:
    numbers_are_fine = torch.Tag.pointwise in func.tags
    for x in tensors:
        assert x.device.type == "cpu" or isinstance(x, PretendTensor), "a tensor without numbers slipped in"
        if not isinstance(x, PretendTensor) and not (numbers_are_fine and x.dim() == 0):
            raise MixedDevices(f"{func} on tensors of the device and a tensor of shape {tuple(x.shape)} on the CPU")
