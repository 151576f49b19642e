"""What commands share: how options are declared, checks of what they read and write, and `run`."""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import platform
import re
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, get_args, get_type_hints

import docstring_parser
from tyro.conf import Positional, UseAppendAction, arg
from tyro.constructors import PrimitiveConstructorSpec

import forcegp.data
from forcegp import atomic_files
from forcegp.cli.terminal import Terminal
from forcegp.errors import FileFormatError, InvalidInput


def unless_given(metavar: str, default: str, constructor: type | None = None) -> Any:
    """Annotates an option that is None or empty unless it is given: what `--help` calls its value, and its default."""
    return arg(metavar=metavar, constructor=constructor, help_behavior_hint=f"(default: {default})")


def split_list(text: str, goes_on: str | None = None) -> list[str]:
    """Entries between commas. What matches `goes_on`, or is in parentheses, continues an entry. Raises InvalidInput."""
    entries: list[str] = []
    for piece in text.split(","):
        open_ = bool(entries) and entries[-1].count("(") > entries[-1].count(")")
        if entries and (open_ or (goes_on is not None and re.fullmatch(goes_on, piece.strip()))):
            entries[-1] += f",{piece}"
        else:
            entries.append(piece.strip())
    if "" in entries:
        raise InvalidInput(f"{text!r} holds an empty entry; write one comma between two entries, as in a,b.")
    return entries


def listed(of: type[str | float] = str, goes_on: str | None = None) -> PrimitiveConstructorSpec[tuple[Any, ...]]:
    """Annotates a tuple that is written as one list with commas; `goes_on` continues an entry."""

    def instance(words: Sequence[str]) -> tuple[Any, ...]:
        entries = split_list(words[0], goes_on)
        try:
            return tuple(map(of, entries))
        except ValueError:
            raise ValueError(f"{words[0]!r} is no list of numbers, as 0.1,0.2 is.") from None

    return PrimitiveConstructorSpec(
        nargs=1, metavar="LIST", instance_from_str=instance, is_instance=lambda given: isinstance(given, tuple),
        str_from_instance=lambda given: [",".join(map(str, given))],
    )  # fmt: skip


NUMBERS = r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?(:.*)?"
"""What continues an entry that holds numbers: FRAME@x,y,z:SURFACE:n,n,n,n, or WHAT=X,X."""
FIELDS = r"\w+ *=.*"  # what continues a force: NAME:FIELD=VALUE,FIELD=VALUE


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
MAPPING = InputPath(" is not a file; give --mapping a YAML file.")
DATASET = InputPath(" is not a file; give the path of a dataset written by forcegp (.h5).")
MODEL = InputPath(" does not exist; give the folder that `forcegp fit --out` wrote", Path.exists)
URDF = InputPath(": no such file; give the path of a URDF file.", Path.exists)
IDENTIFIED = InputPath(": no such file or folder; give a folder that `forcegp fit` wrote.", Path.exists)
LOG = InputPath(" does not exist; give the path of a log.", Path.exists)
THERE = InputPath(" does not exist; give folders of forcegp fit, and a dataset (.h5) after them.", Path.exists)


@dataclass(frozen=True)
class Option:
    """One option of a command: its type with annotations, and its default."""

    hint: Any
    default: Any

    @property
    def marks(self) -> tuple[Any, ...]:
        """What annotates it."""
        return getattr(self.hint, "__metadata__", ())

    @property
    def repeats(self) -> bool:
        """Whether it may be given several times, each with a value of its own."""
        return get_args(UseAppendAction[int])[1] in self.marks

    def flag(self, name: str) -> str | None:
        """--points, or --no-checks for a switch that is on; None for what has no name on the command line."""
        if get_args(Positional[int])[1] in self.marks:
            return None
        return f"--{'no-' if self.default is True else ''}{name.replace('_', '-')}"


def options_of(kind: Any, usual: Any = None) -> dict[str, Option]:
    """The options of a command or subject by name, those of its subjects among them."""
    found, hints = {}, get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        default = field.default if usual is None else getattr(usual, field.name)
        if is_dataclass(hints[field.name]):
            found |= options_of(hints[field.name], None if default is MISSING else default)
        else:
            found[field.name] = Option(hints[field.name], default)
    return found


def values_of(given: Any) -> dict[str, Any]:
    """The value of every option of a command or subject by name."""
    found: dict[str, Any] = {}
    for name, value in vars(given).items():
        found |= values_of(value) if is_dataclass(value) else {name: value}
    return found


def with_texts(kind: Any) -> Any:
    """The class, with the text below each field in one paragraph: tyro breaks its lines where the source does."""
    hints, names = get_type_hints(kind, include_extras=True), {field.name for field in fields(kind)}
    for each in filter(is_dataclass, kind.__mro__):
        for text in docstring_parser.parse_from_object(each).params:
            if text.arg_name in names & each.__annotations__.keys():
                help_ = arg(help=" ".join((text.description or "").split()))
                each.__annotations__[text.arg_name] = Annotated[hints[text.arg_name], help_]
    for subject in filter(is_dataclass, hints.values()):
        with_texts(subject)
    return kind


@dataclass(frozen=True, kw_only=True)
class Command(ABC):
    """One command: its options, of which those of a subject (robot, filter, ...) are a dataclass, and `run`."""

    interrupted: ClassVar[str] = "no partial output was kept"
    """What Ctrl-C has left behind."""
    replaces: ClassVar[bool] = True
    """Whether an old folder of results goes, with all that is in it; else it is gone on with."""

    overwrite: bool = False
    """Replace what is there, if forcegp wrote it."""
    json: bool = False
    """Print one JSON object on stdout, and nothing else there."""
    debug: bool = False
    """Show the traceback of an error."""

    def check_paths(self) -> None:
        """Refuse at once inputs that do not exist, and an output that would destroy one."""
        inputs: list[Path] = []
        values = values_of(self)
        for name, option in options_of(type(self)).items():
            for mark in option.marks:
                given = values[name] if isinstance(mark, InputPath) else None
                for path in given if isinstance(given, tuple) else () if given is None else (given,):
                    if not mark.is_there(path):
                        raise FileFormatError(f"{path}{mark.refusal}")
                    if why := atomic_files.unreadable(path, math.inf):
                        raise FileFormatError(f"{path} {why}; give a regular file.")
                    inputs.append(path)
        path = self.output
        for given in (*inputs, *([] if path is None else [path])):
            if any(letter == "\0" or "\ud800" <= letter <= "\udfff" for letter in str(given)):
                raise InvalidInput(f"the name {str(given)!r} holds NUL or is not UTF-8; give another, or rename it.")
        if path is None:
            return
        here = Path(os.path.realpath(path))
        for other in inputs:
            there = Path(os.path.realpath(other))
            same = there == here or (here.exists() and here.samefile(there))  # also by a hard link
            if same or (self.replaces and there.is_relative_to(here)):
                raise InvalidInput(f"{path} would be written over {other}, which this command reads; choose another.")

    @property
    def output(self) -> Path | None:
        """The file or folder that this command writes: never an input."""
        return getattr(self, "out", None)

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """No other command of this user and machine writes to the same place meanwhile. Raises InvalidInput."""
        # not beside the output: a lock would stay there, and the folder may not exist yet
        user = os.getuid() if hasattr(os, "getuid") else None  # Windows has a folder for each user
        place = Path(tempfile.gettempdir(), f"forcegp-locks-{user}")
        place.mkdir(mode=0o700, exist_ok=True)
        if user is not None and place.lstat().st_uid != user:
            raise InvalidInput(f"{place} belongs to another user; set TMPDIR to a folder of your own.")
        if self.output is None:
            yield
            return
        name = hashlib.sha256(os.path.realpath(self.output).encode()).hexdigest()
        writing = f"another command of forcegp is writing {self.output}; wait for it, or choose another name."
        with atomic_files.locked(place / name, writing):
            yield

    def words(self, *names: str) -> list[str]:
        """The options of these names that are not left at their defaults, as words of a command."""
        words: list[str] = []
        values, options = values_of(self), options_of(type(self))
        for name in names:
            given, option = values[name], options[name]
            flag = str(option.flag(name))
            if option.repeats:
                words += [word for each in given for word in (flag, each)]
            elif isinstance(given, bool):
                words += [flag] if given is not option.default else []
            elif given != option.default:
                each = given if isinstance(given, tuple) else (given,)
                text = ",".join(f"{value:g}" if isinstance(value, float) else str(value) for value in each)
                words += [f"{flag}={text}"] if name == "gravity" or text.startswith("-") else [flag, text]
        return words

    @property
    def name(self) -> str:
        """The word after `forcegp`."""
        return type(self).__name__.lower()

    @property
    def kind(self) -> str:
        """The command as people write it, by which folders that it wrote are recognised."""
        return f"forcegp {self.name}"

    def require_free(self, path: Path | None) -> None:
        """Refuse what exists, but empty folders, and with --overwrite what only this command wrote."""
        if path is not None:
            atomic_files.require_replaceable(path, f"`{self.kind}`", self.wrote, overwrite=self.overwrite)
            atomic_files.require_writable(path)

    def wrote(self, folder: Path) -> bool:
        """Whether this command wrote a folder. Raises FileFormatError for a config.json that is none."""
        there = (folder / CONFIG).exists()
        return there and atomic_files.read_json(folder / CONFIG, "choose another name").get("kind") == self.kind

    def require_free_file(
        self, path: Path | None, own: Callable[[Path], bool] | None = None, what: str = "a dataset of forcegp"
    ) -> None:
        """Refuse what exists, but with --overwrite an empty file, or one that is `own`: `what` forcegp writes."""
        if path is None:
            return
        if path.is_dir():
            raise InvalidInput(f"{path} is a folder; give --out the name of a file, for example {path / 'data.h5'}.")
        if path.exists() and not path.is_file():
            raise InvalidInput(f"{path} is not a regular file; choose another name.")
        if path.exists() and not self.overwrite:
            raise InvalidInput(f"{path} exists already; choose another name, or add --overwrite.")
        if not path.parent.is_dir():
            raise InvalidInput(f"the folder {path.parent} does not exist; create it first.")
        if path.exists() and path.stat().st_size and not (own or forcegp.data.is_dataset)(path):
            raise InvalidInput(f"{path} is not {what}, so it is not overwritten; choose another name.")
        atomic_files.require_writable(path)

    @contextlib.contextmanager
    def folder(self, path: Path, content: Mapping[str, Any]) -> Iterator[Path]:
        """A new folder, there once all is in it, with a config.json of this content, and digests of all files."""
        with atomic_files.atomic_folder(path) as folder:
            folder.mkdir()
            yield folder
            present = (file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file())
            from importlib.metadata import version  # 30 ms that --help and errors do without

            versions = {"python": platform.python_version()} | {name: version(name) for name in LIBRARIES}
            files = sorted({CONFIG, atomic_files.SUMS, *present})
            atomic_files.write_json(
                folder / CONFIG, {"kind": self.kind, **content, "versions": versions, "files": files}
            )
            atomic_files.write_digests(folder)
            self.require_free(path)

    @abstractmethod
    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Do it and return what `--json` prints. Raises ForceGPError or OSError for what the user can mend."""
