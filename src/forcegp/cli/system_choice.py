"""The option --system: predict under the robot and contacts of the model, or under those of the data."""

from __future__ import annotations

from typing import Literal

import forcegp
import forcegp.evaluation
import forcegp.models
from forcegp.cli.terminal import Terminal
from forcegp.errors import InvalidInput

SystemChoice = Literal["model", "data"]


def carried_over(
    terminal: Terminal, posterior: forcegp.models.Posterior, dataset: forcegp.Dataset, choice: SystemChoice
) -> forcegp.models.Posterior:
    """The posterior for the chosen system.

    A robot whose inertias or friction coefficients were identified stays, and only the contacts are those of the data,
    which is reported on stderr. Raises InvalidInput where the data carry no system or the model cannot move there.
    """
    if choice == "model":
        return posterior
    if dataset.system is None:
        raise InvalidInput("--system data: the data carry no robot and contacts; leave the option out.")
    system = forcegp.evaluation.moved_system(posterior, dataset.system)
    if system is not dataset.system:
        terminal.note("--system data: contacts of the data; the robot stays the identified one")
    return posterior.with_system(system)
