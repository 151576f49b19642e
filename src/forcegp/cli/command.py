"""What commands share: two flags, the check that input files are there, where to compute, and `run`."""

from __future__ import annotations

import contextlib
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, get_type_hints

from tyro.conf import arg

import forcegp.parallel
from forcegp.cli.terminal import Terminal
from forcegp.errors import FileFormatError, InvalidInput

Json = Annotated[bool, arg(help="Print one JSON object on stdout, and nothing else there.")]
Debug = Annotated[bool, arg(help="Show the traceback of an error.")]


def unless_given(metavar: str, default: str, constructor: type | None = None) -> Any:
    """Annotates an option that is None unless it is given: what `--help` calls its value, and its default."""
    return arg(metavar=metavar, constructor=constructor, help_behavior_hint=f"(default: {default})")


@dataclass(frozen=True)
class InputPath:
    """Annotates a field with a path that must be there: `refusal` follows the path in the error where it is not."""

    refusal: str
    is_there: Callable[[Path], bool] = Path.is_file


OUTPUTS = ("out", "plots", "docs", "write_mapping")
"""Names of the fields with what a command writes: never an input, nor another output."""
DATASET = InputPath(" is not a file; give the path of a dataset written by forcegp (.h5).")
MODEL = InputPath(" does not exist; give the folder that `forcegp fit --out` wrote", Path.exists)
URDF = InputPath(": no such file; give the path of a URDF file.", Path.exists)
IDENTIFIED = InputPath(": no such file or folder; give a folder that `forcegp identify` wrote.", Path.exists)
LOG = InputPath(" does not exist; give the path of a log.", Path.exists)
MAPPING = InputPath(" is not a file; give --mapping a YAML file.")


class Command(ABC):
    """One command: a frozen dataclass with its options as fields, the two below last, and what it does as `run`."""

    interrupted: ClassVar[str] = "no partial output was kept"
    """What Ctrl-C has left behind."""
    replaces: ClassVar[bool] = True
    """Whether an old folder of results goes, with all that is in it; else it is gone on with."""
    json: Json
    debug: Debug

    @property
    def options(self) -> tuple[str, ...]:
        """The names of its fields, which are those of its options."""
        return tuple(vars(self))

    def check_paths(self) -> None:
        """Refuse inputs that do not exist and outputs that would destroy an input or another output.

        At once: `run` imports torch, which takes seconds. Raises FileFormatError and InvalidInput.
        """
        inputs: list[Path] = []
        for name, annotation in get_type_hints(type(self), include_extras=True).items():
            for mark in getattr(annotation, "__metadata__", ()):
                given = getattr(self, name) if isinstance(mark, InputPath) else None
                for path in given if isinstance(given, tuple) else () if given is None else (given,):
                    if not mark.is_there(path):
                        raise FileFormatError(f"{path}{mark.refusal}")
                    inputs.append(path)
        outputs = [path for name in OUTPUTS if (path := getattr(self, name, None)) is not None]
        for path in (*inputs, *outputs):
            if any("\ud800" <= letter <= "\udfff" for letter in str(path)):  # bytes that Python could not decode
                raise InvalidInput(f"the name {str(path)!r} is not UTF-8, so it could not be reported; rename it.")
        for place, path in enumerate(outputs):
            for other in (*inputs, *outputs[:place], *outputs[place + 1 :]):
                if _same(path, other) or (self.replaces and _within(other, path)):
                    does = "reads" if other in inputs else "writes, too"
                    raise InvalidInput(
                        f"{path} would be written over {other}, which this command {does}; choose another name."
                    )

    @abstractmethod
    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Do it and return what `--json` prints. Raises ForceGPError or OSError for what the user can mend."""


def _same(one: Path, other: Path) -> bool:
    """Whether two paths lead to the same file or folder, also by links."""
    with contextlib.suppress(OSError):  # one of them does not exist
        return one.samefile(other)
    return os.path.realpath(one) == os.path.realpath(other)


def _within(inner: Path, outer: Path) -> bool:
    return Path(os.path.realpath(inner)).is_relative_to(os.path.realpath(outer))


@dataclass(frozen=True, kw_only=True)
class BackendOptions(Command):
    """What every command asks that can compute in several processes, or on several machines."""

    jobs: Annotated[int | None, arg(metavar="J", constructor=int, help_behavior_hint="")] = None
    backend: Annotated[str | None, arg(metavar="serial|joblib|ray", constructor=str, help_behavior_hint="")] = None
    """serial: in this process. joblib: in processes of this machine. ray: on the machines of a Ray cluster; see
    docs/clusters.md. (default: serial for one job, else joblib)"""
    address: Annotated[str | None, unless_given("HOST:PORT", "that of this machine", str)] = None
    """The head of the Ray cluster, for --backend ray."""

    def _backend(self, default: str | None = None) -> forcegp.parallel.Backend:
        """The backend that is asked for, or else the default: this process for one job, several for more.

        Raises InvalidInput for options that contradict each other.
        """
        if self.backend is None and self.address is not None:
            raise InvalidInput(f"--address is {self.address}, that of a cluster; add --backend ray.")
        name = self.backend or default
        return (
            forcegp.parallel.backend_for(None, self.jobs)
            if name is None
            else forcegp.parallel.backend_of(name, self.jobs, self.address)
        )
