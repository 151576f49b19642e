"""`NAME/motions`: models refined on the motions of all training rows, in a comparison with those that were not."""

import pytest
from tests.models.test_motion_fit import bump, line, recording
from tests.validation.moving_arm import given_system

from forcegp.errors import InvalidInput
from forcegp.validation import Comparison, split_named, validate
from forcegp.validation.candidates import candidates

NAMES = "joint-friction@identified", "joint-friction@identified/motions"


def test_refined_models_move_better(tmp_path):
    data = recording(bump, 1, seconds=16.0)
    splits = split_named(data, "blocks:4:2,4")
    compared = Comparison(data, data, data.system, splits, points=60, horizons=(0.25, 0.5), starts=6, restarts=1)
    found = validate(compared, tmp_path / "out", models=NAMES, seeds=1)
    plain, refined = (found.document["models"][name]["motions"]["rms"][-1]["median"] for name in NAMES)
    assert refined < 0.5 * plain


def test_friction_laws_stand_side_by_side(tmp_path):
    """The cart has dry friction: laws without it are worse, and so is what rests on them."""
    data = recording(line, 1, seconds=10.0)
    compared = Comparison(data, data, data.system, split_named(data, "blocks:4:2,4"), points=40, horizons=(0.1, 0.2))
    dry, viscous, on_top = names = (
        *("identified-acceleration-all", "identified-acceleration-all:viscous"),
        "joint-friction@identified:viscous",
    )
    found = validate(compared, tmp_path / "out", models=names, seeds=1).document["models"]
    error = {name: found[name]["nrmse"]["median"] for name in names}
    assert max(error[dry], error[on_top]) < 0.9 * error[viscous]  # the noise alone is 0.2
    assert found[viscous]["summary"].endswith("(friction viscous); noise from training rows held out")


@pytest.mark.parametrize("name", ["identified-torque:dry", "joint@identified:", "joint@torque:viscous,none"])
def test_unknown_laws_are_named(name):
    with pytest.raises(InvalidInput, match=r"no identification is called .*out of viscous, coulomb"):
        candidates([name], given_system())


@pytest.mark.parametrize("name", ["analytical/motions", "independent-gp/motions"])
def test_models_without_anything_to_refine_are_refused(name):
    with pytest.raises(InvalidInput, match="no physics to refine on motions, or is the one that was given"):
        candidates([name], given_system())
