"""`--rows`: which rows of a recording are learned from, where its contacts may open."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import forcegp
import forcegp.data
from forcegp.errors import ContactError

RowsChoice = Literal["auto", "in-contact", "all"]

NEARLY_ALL = 0.995
"""Share of rows in contact from which on the contacts count as closed all the time (impacts and noise take a few)."""
HARDLY_ANY = 0.2
"""Share below which something is wrong with the contact, rather than the tool in the air."""


def rows_to_learn(
    dataset: forcegp.Dataset, system: forcegp.MechanicalSystem, choice: RowsChoice
) -> tuple[forcegp.Dataset, str | None]:
    """The rows in which all contacts of `system` act (`forcegp.data.rows_in_contact`), or all; and a note on it.

    "auto" leaves rows out where a plausible share of them is not in contact, and else takes all, with a note.
    The note is printed after the fit, so that an error before it stands alone. Raises ContactError with "in-contact" if
    there are none.
    """
    if choice == "all" or not system.contacts:
        return dataset, None
    try:
        touching = forcegp.data.rows_in_contact(replace(dataset, system=system))
    except ContactError:
        if choice == "in-contact":
            raise
        return dataset, None  # the fit raises a clearer error
    share = len(touching) / len(dataset)
    if choice == "auto" and share >= NEARLY_ALL:
        return dataset, None
    text = f"{len(touching)} of {len(dataset)} rows move as a contact demands ({share:.1%})"
    if choice == "auto" and share < HARDLY_ANY:
        return dataset, f"{text}; all were learned from. Check the contact, or give --rows in-contact."
    return replace(
        touching, system=dataset.system
    ), f"{text}; these alone were learned from (--rows all takes every row)"
