"""The scenarios of the experiments on force priors: what differs from the published `kuka-surface`."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

SCENARIOS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "viscous": {},
        "coulomb": {"friction": "coulomb"},
        "stribeck": {"friction": "stribeck"},
        "viscous-joints": {"joint_friction": "stribeck"},
        "stribeck-joints": {"friction": "stribeck", "joint_friction": "stribeck"},
        "tilted": {"surface": "tilted"},
        "sphere": {"surface": "sphere"},
        "tilted-joints": {"surface": "tilted", "joint_friction": "stribeck"},
        "sphere-joints": {"surface": "sphere", "joint_friction": "stribeck"},
        "free-joints": {"surface": "none", "joint_friction": "stribeck"},
        "bullet": {"contact": "bullet"},
        "patch": {"patch_factor": 4.0},
    }
)
"""Name -> fields of `KukaSurfaceConfig`."""

LABELS = {
    "viscous": "viscous tool friction (the paper's)",
    "coulomb": "Coulomb friction at the tool, proportional to the load",
    "stribeck": "Stribeck friction at the tool, proportional to the load",
    "viscous-joints": "viscous at the tool, Stribeck in the joints",
    "stribeck-joints": "Stribeck at the tool (load) and in the joints",
    "tilted": "tilted plane",
    "sphere": "sphere",
    "tilted-joints": "tilted plane",
    "sphere-joints": "sphere",
    "free-joints": "free motion",
    "bullet": "PyBullet's unilateral contact",
    "patch": "viscous, four times as much on a strip",
}
"""What pages call them."""
