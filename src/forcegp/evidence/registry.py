"""Kinds of evidence by name, as commands and files have them."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

from forcegp.errors import InvalidInput, require_known, usable_arguments
from forcegp.evidence.evidence import Accelerations, Evidence, Motions, Torques
from forcegp.evidence.windows import Windows

EVIDENCE: dict[str, type[Evidence]] = {
    "accelerations": Accelerations,
    "torques": Torques,
    "windows": Windows,
    "motions": Motions,
}
"""Kinds by the name that commands and files have for them. Add yours: EVIDENCE["mine"] = Mine."""


def evidence_class(name: str) -> Any:
    """The kind of this name. Raises InvalidInput."""
    require_known("evidence", name, "forcegp", EVIDENCE)
    return EVIDENCE[name]


@usable_arguments("parse_evidence")
def parse_evidence(words: str | Sequence[str]) -> tuple[Evidence, ...]:
    """The evidence of a text or of its parts: `NAME[:VALUE][:FIELD=VALUE...]` with commas: "torques,motions:1"."""
    given = words.split(",") if isinstance(words, str) else words
    return tuple(_one(word.strip()) for word in given)


def _one(word: str) -> Evidence:
    name, *options = word.split(":")
    kind = evidence_class(name)
    allowed = {f.name: f.default for f in fields(kind)}
    given: dict[str, Any] = {}
    for option in options:
        key, equals, value = option.partition("=")
        if not equals and option is options[0]:
            key, value = next(iter(allowed)), option
        if key not in allowed or not value:
            raise InvalidInput(
                f"evidence {name!r} cannot take {option!r}; write FIELD=VALUE with {', '.join(allowed)}."
            )
        default = allowed[key]
        if isinstance(default, bool):
            if value not in ("true", "false"):
                raise InvalidInput(f"evidence {name!r} has {key}={value}; give true or false.")
            given[key] = value == "true"
        elif isinstance(default, str):
            given[key] = value
        else:
            try:
                given[key] = int(value) if isinstance(default, int) else float(value)
            except ValueError:
                raise InvalidInput(f"evidence {name!r} has {key}={value}; give a number.") from None
    return kind(**given)
