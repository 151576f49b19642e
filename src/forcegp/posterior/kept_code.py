"""What took long to make of a posterior, kept on disk: later processes that make the same predictor find it there.

Records lie beside the compiled libraries, named by a hash of all that decides them: the code of this package, the
system, the prior, the data and the hyper-parameters. Models whose parts cannot be described, such as surfaces of the
user's own code, have none. The oldest records go where all together grow too large.
"""

import contextlib
import ctypes
import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from forcegp.atomic_files import atomic_file
from forcegp.codegen.library import (
    RowFunction,
    VectorUnit,
    aligned,
    code_digest,
    default_folder,
    opened_library,
    own_file,
    own_folder,
)
from forcegp.errors import CompilerError, ForceGPError
from forcegp.inference.one_input_calls import refreshed_calls
from forcegp.inference.posterior import LatentPosterior
from forcegp.inference.prepared_kernels import CompressedCovariance
from forcegp.posterior.fused_rollouts import FusedLoop, steps_of
from forcegp.posterior.predictor_code import PURPOSE, PredictorCode
from forcegp.robots.manifold import ConfigurationSpace

LARGEST = 2**30
"""Bytes of all records together."""


def record_key(describe: Callable[[], Any], numbers: Iterable[Tensor]) -> str | None:
    """The hash of a description as JSON values, of tensors, and of the code; None where there is no description."""
    try:
        text = json.dumps([describe(), torch.__version__, repr(VectorUnit.of_this_processor()), code_digest()])
    except (ForceGPError, TypeError, ValueError):
        return None
    digest = hashlib.sha256(text.encode())
    for x in numbers:
        values = x.detach().cpu().contiguous()
        digest.update(repr((values.shape, values.dtype)).encode())
        digest.update(values.numpy().data)
    return digest.hexdigest()[:32]


def written_record(key: str | None, kind: str, numbers: Mapping[str, Tensor], library: str = "") -> None:
    """Keep numbers; where they cannot be kept, they are made again."""
    with contextlib.suppress(OSError, CompilerError):
        if key is None:
            return
        folder = own_folder(default_folder(), PURPOSE)
        data = save({name: x.detach().contiguous() for name, x in numbers.items()}, {"library": library})
        with atomic_file(folder / f"predictor-{key}-{kind}.safetensors") as path:
            path.write_bytes(data)
        left = LARGEST
        for path in sorted(folder.glob("predictor-*.safetensors"), key=lambda path: -path.stat().st_mtime):
            left -= path.stat().st_size
            if left < 0:
                path.unlink()


def found_record(key: str | None, kind: str) -> tuple[dict[str, Tensor], Path] | None:
    """The numbers and the file of the library, None where there are none or others could have written them."""
    with contextlib.suppress(OSError, SafetensorError, CompilerError):
        if key is None:
            return None
        path = own_folder(default_folder(), PURPOSE) / f"predictor-{key}-{kind}.safetensors"
        if path.is_file():
            own_file(path, PURPOSE)
            with safe_open(path, "pt") as file:  # type: ignore[reportUnknownVariableType]  # no types
                numbers = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # it is no dict
                library = path.parent / Path(file.metadata()["library"]).name
            path.touch()
            return numbers, library
    return None


def kept_covariance(key: str | None, make: Callable[[], CompressedCovariance]) -> CompressedCovariance:
    """A compressed covariance, found or made."""
    found = found_record(key, "compressed")
    if found is not None:
        numbers = found[0]
        factors = tuple(numbers[str(k)] for k in range(len(numbers) - 1))
        return CompressedCovariance(factors, numbers["inflation"])
    made = make()
    written_record(key, "compressed", {str(k): F for k, F in enumerate(made.factors)} | {"inflation": made.inflation})
    return made


@dataclass(eq=False)
class KeptCode:
    """The programs of a predictor: found, or made of the code that `trace` returns.

    `sizes` of q, v and u in this `space`, and `contacts`, decide how many numbers they give.
    """

    space: ConfigurationSpace
    sizes: tuple[int, int, int]
    contacts: int
    trace: Callable[[], PredictorCode]
    key: str | None

    @cached_property
    def traced(self) -> PredictorCode:
        """The code, traced when something is made of it."""
        return self.trace()

    @property
    def is_traced(self) -> bool:
        """Whether something was made anew."""
        return "traced" in vars(self)

    def refreshed(self, latent: LatentPosterior) -> "KeptCode":
        """That of another posterior with the same kernels. Raises InvalidInput as `refreshed_calls`."""
        made = replace(self.traced, sums=refreshed_calls(self.traced.sums, latent))
        return KeptCode(self.space, self.sizes, self.contacts, partial(replace, made), None)

    def function(self, kind: str) -> RowFunction:
        """As `PredictorCode.function`."""
        (_, nv, nu), m = self.sizes, self.contacts
        around = nv * nu + nv**2 + m * nv + m
        sizes = {"linearize": [nv * (2 * nv + nu)], "covariance": [nv**2], "forces": [around]}.get(kind, [])
        library, tables = self._program(kind)
        return RowFunction(library, self.sizes, [nv, *sizes], tables)

    def loops(self, integrator: str, latent: LatentPosterior, samples: int, seed: int) -> list[FusedLoop] | None:
        """As `PredictorCode.loops`."""
        if samples or integrator not in steps_of(self.space):
            return self.traced.loops(integrator, latent, samples, seed)
        return [FusedLoop(*self._program(integrator))]

    def _program(self, kind: str) -> tuple[ctypes.CDLL, Sequence[Tensor]]:
        found = found_record(self.key, kind)
        if found is not None and found[1].is_file():
            numbers, library = found
            return opened_library(library, PURPOSE), [aligned(numbers[str(k)].numpy()) for k in range(len(numbers))]
        code = self.traced
        loaded, tables = code.library(kind), code.tables if kind == "covariance" else code.tables[: len(code.sums)]
        written_record(self.key, kind, {str(k): x for k, x in enumerate(tables)}, Path(loaded._name).name)
        return loaded, tables
