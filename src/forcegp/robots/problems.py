"""All problems of one robot file in one report, with the arguments that mend them together."""

import contextlib
import shlex
import warnings
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from forcegp.errors import RobotFileWarning, RobotModelError

LISTED = 12
"""Problems of one kind that a message lists; the error has all of them."""


class Problems:
    """What is wrong with a file, and what was repaired.

    Parameters: ``source``, which every message begins with; ``given``, arguments of ``Robot.from_urdf`` that the
    remedy keeps; ``reader``, the function that reads the file.
    """

    def __init__(self, source: str, given: Mapping[str, Any] | None = None, reader: str = "Robot.from_urdf") -> None:
        self.source, self.given, self.reader = source, dict(given or {}), reader
        self.errors: list[RobotModelError] = []
        self.broken: set[str] = set()
        """Links of which something is reported, so that nothing else need be."""
        self.notes: dict[str, list[str]] = {}

    @contextlib.contextmanager
    def collected(self, link: str | None = None) -> Iterator[None]:
        """Keep an error of the file, of a ``link`` for example, for the report, and go on."""
        try:
            yield
        except RobotModelError as error:
            self.errors.append(error)
            if link is not None:
                self.broken.add(link)

    def note(self, what: str, where: str) -> None:
        """Note what was ignored or repaired, and of which element."""
        self.notes.setdefault(what, []).append(where)

    def offer_no_standstill(self, joints: Collection[str]) -> None:
        """Take locks, and a fixed base, out of the remedies where they would hold all of these joints."""
        remedies = [error.remedy for error in self.errors]
        bolted = {"base" for remedy in remedies if remedy.get("base") == "fixed"}
        if bolted.union(*(remedy.get("locked", ()) for remedy in remedies)).issuperset(joints):
            for remedy in remedies:
                remedy.pop("locked", None)
                if bolted:
                    remedy.pop("base", None)

    def warn(self, stacklevel: int) -> None:
        """One RobotFileWarning about all that was noted."""
        if self.notes:
            text = "; ".join(f"{what} ({', '.join(where)})" for what, where in self.notes.items())
            warnings.warn(f"{self.source}: {text}.", RobotFileWarning, stacklevel=stacklevel)

    def raise_all(self) -> None:
        """Raise what was collected as one error: of their class where they are alike, else a RobotModelError."""
        if not self.errors:
            return
        kinds, many = {type(error) for error in self.errors}, len(self.errors) > 1
        by_hand, remedy = not all(error.remedy for error in self.errors), self._remedy()
        text = f"{self.source}: {f'{len(self.errors)} problems: ' if many else ''}{' '.join(self._texts())}"
        if remedy:
            which = "the others, when the file is corrected" if by_hand else "all" if many else "it"
            text += f" The remedy for {which}: {remedy_text(remedy, self.reader)}"
        found = (kinds.pop() if len(kinds) == 1 else RobotModelError)(text, "", {} if by_hand else remedy)
        found.problems = tuple(str(error) for error in self.errors)
        raise found from None

    def _remedy(self) -> dict[str, Any]:
        """The arguments that mend what has a remedy, with those that were given."""
        remedy: dict[str, Any] = {}
        for arguments in (error.remedy for error in self.errors):
            for name, value in arguments.items():
                remedy[name] = {**remedy.get(name, {}), **value} if isinstance(value, Mapping) else value
        for name, value in self.given.items() if remedy else ():
            remedy[name] = {**value, **remedy.get(name, {})} if isinstance(value, Mapping) else remedy.get(name, value)
        return remedy

    def _texts(self) -> list[str]:
        """What was seen, with what to do once for all that are alike."""
        groups: dict[str, list[str]] = {}
        for error in self.errors:
            groups.setdefault(error.advice, []).append(error.seen.removeprefix(f"{self.source}: "))
        more = "; and {} more like these".format
        return [
            "; ".join(seen[:LISTED]) + (more(len(seen) - LISTED) if len(seen) > LISTED else "") + advice
            for advice, seen in groups.items()
        ]


def remedy_text(remedy: Mapping[str, Any], reader: str) -> str:
    """The arguments in Python, and the options of the command line that they are."""
    words = []
    for name, value in remedy.items():
        listed = ",".join(f"{k}={_short(v)}" for k, v in value.items()) if isinstance(value, Mapping) else value
        words.append(f"--{'lock' if name == 'locked' else name} {shlex.quote(listed)}")
    python = ", ".join(f"{name}={value!r}" for name, value in remedy.items())
    return f"{reader}(path, {python}), or {' '.join(words)}."


def _short(value: float) -> str:
    """A number that reads back exactly, as 0 for 0.0."""
    return f"{value:g}" if float(f"{value:g}") == value else repr(value)
