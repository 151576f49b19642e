"""Scenarios that make a `Dataset` with ground truth. Simulators are imported when one runs."""

from typing import TYPE_CHECKING

from forcegp.simulation.kuka_surface_config import KukaSurfaceConfig
from forcegp.simulation.scenarios import SCENARIOS, Scenario

if TYPE_CHECKING:
    from forcegp.simulation.kuka_surface import simulate_kuka_surface

__all__ = ["SCENARIOS", "KukaSurfaceConfig", "Scenario", "simulate_kuka_surface"]


def __getattr__(name: str) -> object:
    """Import the scenario's function at first use: it needs torch, a listing of options does not."""
    if name == "simulate_kuka_surface":
        from forcegp.simulation.kuka_surface import simulate_kuka_surface

        return simulate_kuka_surface
    raise AttributeError(f"module 'forcegp.simulation' has no attribute {name!r}; public names: {', '.join(__all__)}")
