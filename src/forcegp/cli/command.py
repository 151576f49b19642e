"""What every command shares: two flags, the check that its input files are there, and `run`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, get_type_hints

from tyro.conf import arg

from forcegp.cli.terminal import Terminal
from forcegp.errors import FileFormatError

Json = Annotated[bool, arg(help="Print one JSON object on stdout, and nothing else there.")]
Debug = Annotated[bool, arg(help="Show the traceback of an error.")]


@dataclass(frozen=True)
class InputPath:
    """Annotates a field with a path that must be there: `refusal` follows the path in the error where it is not."""

    refusal: str
    is_there: Callable[[Path], bool] = Path.is_file


DATASET = InputPath(" is not a file; give the path of a dataset written by forcegp (.h5).")
MODEL = InputPath(" does not exist; give the folder that `forcegp fit --out` wrote", Path.exists)
URDF = InputPath(": no such file; give the path of a URDF file.", Path.exists)
IDENTIFIED = InputPath(": no such file or folder; give a folder that `forcegp identify` wrote.", Path.exists)
LOG = InputPath(" does not exist; give the path of a log.", Path.exists)


class Command(ABC):
    """One command: a frozen dataclass with its options as fields, the two below last, and what it does as `run`."""

    interrupted: ClassVar[str] = "no partial output was kept"
    """What Ctrl-C has left behind."""
    json: Json
    debug: Debug

    @property
    def options(self) -> tuple[str, ...]:
        """The names of its fields, which are those of its options."""
        return tuple(vars(self))

    def check_inputs(self) -> None:
        """Raise FileFormatError for an input that does not exist, at once: `run` imports torch, which takes seconds."""
        for name, annotation in get_type_hints(type(self), include_extras=True).items():
            for mark in getattr(annotation, "__metadata__", ()):
                given = getattr(self, name) if isinstance(mark, InputPath) else None
                for path in given if isinstance(given, tuple) else () if given is None else (given,):
                    if not mark.is_there(path):
                        raise FileFormatError(f"{path}{mark.refusal}")

    @abstractmethod
    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Do it and return what `--json` prints. Raises ForceGPError or OSError for what the user can mend."""
