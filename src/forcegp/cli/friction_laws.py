"""`--friction`: which laws of friction an identification estimates, as words."""

from __future__ import annotations


def friction_laws(words: str) -> tuple[str, ...]:
    """`viscous,coulomb` as a tuple; `none` is no friction. Names are checked by `forcegp.analytical`."""
    return tuple(word for word in (part.strip() for part in words.split(",")) if word and word != "none")
