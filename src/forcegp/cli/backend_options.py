"""`--jobs`, `--backend` and `--address`: where a command computes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

import forcegp.parallel
from forcegp.cli.command import Command, unless_given
from forcegp.errors import InvalidInput


@dataclass(frozen=True, kw_only=True)
class BackendOptions(Command):
    """What every command asks that can compute in several processes, or on several machines."""

    jobs: Annotated[int | None, arg(metavar="J", constructor=int, help_behavior_hint="")] = None
    backend: Annotated[str | None, arg(metavar="serial|joblib|ray", constructor=str, help_behavior_hint="")] = None
    """serial: in this process. joblib: in processes of this machine. ray: on the machines of a Ray cluster; see
    docs/clusters.md. (default: serial for one job, else joblib)"""
    address: Annotated[str | None, unless_given("HOST:PORT", "that of this machine", str)] = None
    """The head of the Ray cluster, for --backend ray."""

    def _backend(self, default: str | None = None) -> forcegp.parallel.Backend:
        """The backend that is asked for, or else the default: this process for one job, several for more.

        Raises InvalidInput for options that contradict each other.
        """
        if self.backend is None and self.address is not None:
            raise InvalidInput(f"--address is {self.address}, that of a cluster; add --backend ray.")
        name = self.backend or default
        return (
            forcegp.parallel.backend_for(None, self.jobs)
            if name is None
            else forcegp.parallel.backend_of(name, self.jobs, self.address)
        )
