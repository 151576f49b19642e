"""Kinds of evidence by name, as commands and files have them."""

from collections.abc import Sequence
from typing import Any

from forcegp.errors import require_known, usable_arguments
from forcegp.evidence.evidence import Accelerations, Evidence, Motions, Torques
from forcegp.evidence.windows import Windows
from forcegp.forces.registry import called

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
    return called(f"evidence {name!r}", evidence_class(name), options)
