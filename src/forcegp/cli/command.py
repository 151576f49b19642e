"""What every command shares: two flags, and `run`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from tyro.conf import arg

from forcegp.cli.terminal import Terminal

Json = Annotated[bool, arg(help="Print one JSON object on stdout, and nothing else there.")]
Debug = Annotated[bool, arg(help="Show the traceback of an error.")]


class Command(ABC):
    """One command: a frozen dataclass with its options as fields, the two below last, and what it does as `run`."""

    interrupted: ClassVar[str] = "no partial output was kept"
    """What Ctrl-C has left behind."""
    json: Json
    debug: Debug

    @abstractmethod
    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Do it and return what `--json` prints. Raises ForceGPError or OSError for what the user can mend."""
