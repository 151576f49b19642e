"""Rows of every scenario, as they were."""

import pytest
from tests.goldens.compare import assert_unchanged

from forcegp.simulation import SCENARIOS, simulate

SCENES = {
    "plane": ("kuka-surface", {"settle_seconds": 1.0, "seconds": 0.5, "seed": 5}),
    "dry": ("kuka-surface", {"settle_seconds": 1.0, "seconds": 0.5, "surface": "tilted", "friction": "stribeck"}),
    "free": ("kuka-surface", {"settle_seconds": 0.5, "seconds": 0.5, "surface": "none", "joint_friction": "stribeck"}),
    "quadruped": ("quadruped", {"seconds": 4.5, "seed": 1, "payload": 3.0}),
    "quadrotor": ("quadrotor", {"seconds": 0.5, "episodes": 2}),
}


@pytest.mark.parametrize("scene", SCENES)
def test_rows_of_a_seed_are_what_they_were(scene):
    name, numbers = SCENES[scene]
    data = simulate(name, **numbers)
    columns = {each: getattr(data, each) for each in ("time", "episode", "q", "v", "u", "a", "noise_std")}
    more = {"truth": data.truth, "wind": data.metadata.get("wind"), "payload": data.metadata.get("payload")}
    assert_unchanged(f"simulation/{scene}", {**columns, **more})


def test_numbers_of_scenarios_are_what_they_were():
    given = {
        name: {each: x for each, x in members.items() if isinstance(x, float | tuple | str)}
        for name, members in {name: vars(config) for name, (config, _) in SCENARIOS.items()}.items()
    }
    assert_unchanged("simulation/numbers", given)
