"""One tree of errors. Every message says what was given, what is allowed and what to do."""

import contextlib
import difflib
import importlib
import math
import re
from collections.abc import Collection, Iterator, Mapping
from typing import Any, TypeVar

Kind = TypeVar("Kind")


class ForceGPError(Exception):
    """Base of every error that forcegp raises on purpose; the command line turns it into one line and exit code 2."""


class InvalidInput(ForceGPError, ValueError):
    """An argument has a wrong shape, type or value."""


class RobotModelError(ForceGPError):
    """The robot description cannot be used.

    `remedy` holds the arguments of `Robot.from_file` under which this file is taken, by name; empty where the file must
    be corrected first. `problems` are all that were found.
    """

    def __init__(self, seen: str, advice: str = "", remedy: Mapping[str, Any] | None = None):
        super().__init__(seen + advice)
        self.seen, self.advice, self.remedy = seen, advice, dict(remedy or {})
        self.problems: tuple[str, ...] = (seen + advice,)


class NonPhysicalInertia(RobotModelError):
    """Inertial parameters that no mass distribution can have."""


class UnknownName(ForceGPError, KeyError):
    """A name that is not there: a frame, link or joint of a robot, an estimate, a force."""

    def __str__(self) -> str:  # KeyError would print the repr, quotes and all
        return str(self.args[0])


class ContactError(ForceGPError):
    """A contact that cannot constrain the robot, or whose surface cannot be evaluated or stored."""


class DatasetError(ForceGPError):
    """Data that break the Dataset's contract: row, column and remedy are named."""


class MistakenUnit(DatasetError):
    """Numbers that fit another unit: `quantity` and `unit` are those of `ColumnMapping.unit`; `sure`, or one of two."""

    def __init__(self, message: str, quantity: str, unit: str, sure: bool = True):
        super().__init__(message)
        self.quantity, self.unit, self.sure = quantity, unit, sure


class FileFormatError(ForceGPError):
    """A file that is not what its name promises, or is from an unknown version."""


class NumericalError(ForceGPError):
    """A factorisation or optimisation failed, with the cause and the remedy."""


class NotEnoughMemory(ForceGPError, MemoryError):
    """A computation would need more memory than is free; raised before anything is allocated."""


class FitError(NumericalError):
    """No restart of the optimisation gave a usable model."""


class SimulationError(ForceGPError):
    """A simulated motion that diverged or left the robot's limits, so that its data are of no use."""


class CompilerError(ForceGPError):
    """Dynamics that cannot be compiled or loaded: no C compiler, one that failed, or a folder that cannot be used."""


class BackendError(ForceGPError):
    """A worker died: it was killed, or out of memory."""


class MissingExtra(ForceGPError, ImportError):
    """An optional dependency is not installed; the message holds the pip command."""


def required_extra(module: str, extra: str, what: str) -> Any:
    """The module of an optional package, which `what` needs; MissingExtra names the `extra` that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise MissingExtra(f"{what} needs {package}: pip install 'forcegp[{extra}]'") from error


class NumericalWarning(UserWarning):
    """Something was repaired (jitter added, say) and the result is still usable."""


class DataWarning(UserWarning):
    """The data can be used but look as if something was mistaken: a surface in the wrong place, say."""


class RobotFileWarning(DataWarning):
    """What was ignored, replaced or repaired in a robot file."""


class ContactWarning(DataWarning):
    """The rows contradict the contacts that are stated: no motion along the surface."""


LARGEST = 1e9
"""Numbers of robots and laws beyond this, in SI units, are mistakes: no mass, inertia, damping or stiffness is."""


def require_plausible(stored: Any, name: str = "") -> None:
    """Raise ValueError for a number that no robot has in SI units, whatever it is."""
    for key, value in stored.items() if isinstance(stored, Mapping) else enumerate(stored):
        if isinstance(value, Mapping | list):
            require_plausible(value, f"{name}{key} ")
        elif isinstance(value, int | float) and abs(value) > LARGEST:
            raise ValueError(f"{name}{key} is {value:g}, more than {LARGEST:g} in SI units")


ACTING = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
"""What acts on a terminal; compiled here, for at its first use there may be no memory left to say so."""
LONGEST_TEXT = 4000  # letters in one text on a terminal


def printable(text: str) -> str:
    r"""The text with what would act on a terminal instead of being seen written out, as in \x1b.

    Control characters but line breaks and tabs, and what turns the direction of writing round (Unicode, TR 36, 2.10).
    Of a text of more letters than `LONGEST_TEXT`, beginning and end: files hold names of millions.
    """
    if len(text) > LONGEST_TEXT:
        text = f"{text[: LONGEST_TEXT // 2]} ... {text[-LONGEST_TEXT // 2 :]}"
    return ACTING.sub(lambda found: ascii(found[0])[1:-1], text)


def spreadsheet_cell(text: str) -> str:
    """The text for a cell of a CSV file: what a spreadsheet would compute gets a quotation mark before it (OWASP)."""
    return f"'{text}" if text[:1] in ("=", "+", "-", "@", "\t", "\r") else text


def require_type(name: str, given: object, kind: type[Kind], example: str = "") -> Kind:
    """The argument `name`, which is a `kind`; InvalidInput with an `example` for any other."""
    if not isinstance(given, kind):
        raise InvalidInput(f"{name} is a {type(given).__name__}; give a {kind.__name__}{example}")
    return given


def require_number(name: str, given: object, words: str, least: float = math.ulp(0.0), below: float = math.inf) -> None:
    """Raise `NAME is GIVEN; WORDS` for what is no number of at least `least` (above 0) and less than `below`."""
    if isinstance(given, bool) or not isinstance(given, int | float) or not least <= given < below:
        raise InvalidInput(f"{name} is {given!r}; {words}.")


def lacks_memory(error: Exception) -> bool:
    """Whether memory ran out, which PyTorch and MuJoCo say in errors of any kind."""
    return isinstance(error, MemoryError) or "allocate memory" in str(error) or "out of memory" in str(error)


@contextlib.contextmanager
def usable_arguments(of: str) -> Iterator[None]:
    """Also a decorator: what Python raises for values of another kind becomes an InvalidInput that names `of`."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        if isinstance(error, ForceGPError):
            raise
        if lacks_memory(error):
            raise MemoryError(str(error)) from error
        raise InvalidInput(f"{of} was given a value of another kind: {error}; see help({of})") from error


def require_known(
    kind: str,
    given: object,
    owner: str,
    valid: Collection[str],
    error: type[ForceGPError] = InvalidInput,
    *,
    cutoff: float = 0.6,
    synonyms: Mapping[str, str] | None = None,
) -> None:
    """Raise `no frame 'tool1' in iiwa7; did you mean 'tool0'? Valid frames: ...` for others; `cutoff` as in difflib."""
    if isinstance(given, str) and given in valid:
        return
    names, given = sorted(valid), str(given)
    meant = (synonyms or {}).get(given.lower())
    close = [meant] if meant in names else difflib.get_close_matches(given, names, n=1, cutoff=cutoff)
    hint = f"; did you mean {close[0]!r}?" if close else "."
    raise error(f"no {kind} {given!r} in {owner}{hint} Valid {kind}s: {', '.join(names) or '(none)'}")
