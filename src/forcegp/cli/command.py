"""What commands share: two flags, checks of what they read and write, where to compute, and `run`."""

from __future__ import annotations

import contextlib
import json
import os
import platform
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, ClassVar, get_type_hints

from tyro.conf import arg

import forcegp.parallel
from forcegp.atomic_files import SUMS, added_files, atomic_folder, require_writable, write_digests, write_json
from forcegp.cli.terminal import Terminal
from forcegp.errors import FileFormatError, InvalidInput

Json = Annotated[bool, arg(help="Print one JSON object on stdout, and nothing else there.")]
Debug = Annotated[bool, arg(help="Show the traceback of an error.")]


def unless_given(metavar: str, default: str, constructor: type | None = None) -> Any:
    """Annotates an option that is None unless it is given: what `--help` calls its value, and its default."""
    return arg(metavar=metavar, constructor=constructor, help_behavior_hint=f"(default: {default})")


def numbers_of(text: str, complaint: str, *, one: bool = False) -> list[float]:
    """The numbers between the commas of an option, of which there may be `one`. Raises InvalidInput as complained."""
    try:
        return [float(part) for part in ([text] if one else text.split(","))]
    except ValueError:
        raise InvalidInput(complaint) from None


@dataclass(frozen=True)
class InputPath:
    """Annotates a field with a path that must be there: `refusal` follows the path in the error where it is not."""

    refusal: str
    is_there: Callable[[Path], bool] = Path.is_file


CONFIG = "config.json"
LIBRARIES = ("forcegp", "torch", "gpytorch", "numpy", "scipy")
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
                within = Path(os.path.realpath(other)).is_relative_to(os.path.realpath(path))
                if _same(path, other) or (self.replaces and within):
                    does = "reads" if other in inputs else "writes, too"
                    raise InvalidInput(
                        f"{path} would be written over {other}, which this command {does}; choose another name."
                    )

    def words(self, *names: str) -> list[str]:
        """The options of these names that are not left at their defaults, as words of a command."""
        words: list[str] = []
        for name in names:
            given, flag = getattr(self, name), f"--{name.replace('_', '-')}"
            if given is False and getattr(type(self), name):
                words.append(f"--no-{flag[2:]}")
            elif given is True and not getattr(type(self), name):
                words.append(flag)
            elif given != getattr(type(self), name):
                for each in given if isinstance(given, tuple) else (given,):
                    text = f"{each:g}" if isinstance(each, float) else str(each)
                    words += [f"{flag}={text}"] if name == "gravity" else [flag, text]  # it may begin with a minus
        return words

    @property
    def kind(self) -> str:
        """The command as people write it, by which folders that it wrote are recognised."""
        return f"forcegp {type(self).__name__.lower()}"

    def require_free(self, path: Path | None) -> None:
        """Refuse what exists, unless it is an empty folder, or one that only this command wrote to, with --overwrite.

        None is no folder. Raises InvalidInput, or OSError where nothing can be written, before any work is done.
        """
        if path is None:
            return
        if path.exists() and not (path.is_dir() and not any(path.iterdir())):
            if not path.is_dir() or _config(path).get("kind") != self.kind:
                raise InvalidInput(
                    f"{path} exists and was not written by `{self.kind}`, so it is not overwritten; choose another "
                    "name."
                )
            if not getattr(self, "overwrite", True):
                raise InvalidInput(f"{path} exists already; choose another name, or add --overwrite.")
            others = added_files(path)
            if others:
                raise InvalidInput(
                    f"{path} holds files that `{self.kind}` did not write ({', '.join(others[:3])}), so it is not "
                    "overwritten; move them away, or choose another name."
                )
        require_writable(path)

    @contextlib.contextmanager
    def folder(self, path: Path, content: Mapping[str, Any]) -> Iterator[Path]:
        """A new folder to write into, there once all is in it.

        It gets a `config.json` with this content, versions and the list of its files, and the digests of all. Raises as
        `require_free`, also for what appeared meanwhile.
        """
        with atomic_folder(path) as folder:
            folder.mkdir()
            yield folder
            present = (file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file())
            versions = {"python": platform.python_version()} | {name: version(name) for name in LIBRARIES}
            files = sorted({CONFIG, SUMS, *present})
            write_json(folder / CONFIG, {"kind": self.kind, **content, "versions": versions, "files": files})
            write_digests(folder)
            self.require_free(path)

    @abstractmethod
    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Do it and return what `--json` prints. Raises ForceGPError or OSError for what the user can mend."""


def _same(one: Path, other: Path) -> bool:
    """Whether two paths lead to the same file or folder, also by links."""
    with contextlib.suppress(OSError):  # one of them does not exist
        return one.samefile(other)
    return os.path.realpath(one) == os.path.realpath(other)


@dataclass(frozen=True, kw_only=True)
class BackendOptions(Command):
    """What every command asks that can compute in several processes."""

    jobs: Annotated[int | None, arg(metavar="J", constructor=int, help_behavior_hint="")] = None
    backend: Annotated[str | None, arg(metavar="serial|joblib", constructor=str, help_behavior_hint="")] = None
    """serial: in this process. joblib: in processes of this machine. (default: serial for one job, else joblib)"""

    def _backend(self, default: str | None = None) -> forcegp.parallel.Backend:
        """The backend that is asked for, or else the default. Raises InvalidInput for contradicting options."""
        return forcegp.parallel.backend_for(self.backend or default, self.jobs)


def require_free_file(
    path: Path, *, overwrite: bool, own: Callable[[Path], bool], what: str = "a dataset of forcegp"
) -> None:
    """Refuse what exists (but `own` or empty, with --overwrite) or cannot be written: InvalidInput, OSError."""
    if path.is_dir():
        raise InvalidInput(f"{path} is a folder; give --out the name of a file, for example {path / 'data.h5'}.")
    if path.exists() and not path.is_file():
        raise InvalidInput(f"{path} is not a regular file; choose another name.")
    if path.exists() and not overwrite:
        raise InvalidInput(f"{path} exists already; choose another name, or add --overwrite.")
    if not path.parent.is_dir():
        raise InvalidInput(f"the folder {path.parent} does not exist; create it first.")
    if path.exists() and path.stat().st_size and not own(path):
        raise InvalidInput(f"{path} is not {what}, so it is not overwritten; choose another name.")
    require_writable(path)


def _config(path: Path) -> dict[str, Any]:
    try:
        config = json.loads((path / CONFIG).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return config if isinstance(config, dict) else {}
