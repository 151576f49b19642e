"""The scenarios by name. A new one is a file with a config and a function, and an entry here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from types import MappingProxyType
from typing import Any

import forcegp.data
from forcegp.errors import InvalidInput
from forcegp.simulation.kuka_surface_config import KukaSurfaceConfig


@dataclass(frozen=True)
class Scenario:
    """A simulation that makes a Dataset. Its libraries are imported at `simulate`, so that listing scenarios is quick.

    summary: one line; config: frozen dataclass of all its numbers; function: "module:name" of a function
    `(config, progress=None) -> Dataset`.
    """

    summary: str
    config: type
    function: str

    def simulate(self, config: Any, progress: Callable[[int, int], None] | None = None) -> forcegp.data.Dataset:
        """Run it. `progress(steps done, steps in total)` is called now and then."""
        if not isinstance(config, self.config):
            raise InvalidInput(f"config is {type(config).__name__}; this scenario takes {self.config.__name__}.")
        module, _, name = self.function.partition(":")
        return getattr(import_module(module), name)(config, progress)


SCENARIOS: Mapping[str, Scenario] = MappingProxyType(
    {
        "kuka-surface": Scenario(
            summary="a KUKA iiwa slides its tool on a surface with friction that nobody models",
            config=KukaSurfaceConfig,
            function="forcegp.simulation.kuka_surface:simulate_kuka_surface",
        )
    }
)
