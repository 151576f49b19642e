"""Models refined on the motions of all training rows, in a comparison with those that were not."""

import pytest
from tests.fit.test_motion_fit import bump, line, recording
from tests.validation.moving_arm import given_system

from forcegp.errors import InvalidInput
from forcegp.validation import Comparison, split_named, validate
from forcegp.validation.candidates import candidate

NAMES = "identified+gp:joint-friction", "identified+gp:joint-friction@motions:.5"


def test_refined_models_move_better(tmp_path):
    data = recording(bump, 1, seconds=16.0)
    splits = split_named(data, "blocks:4:2,4")
    compared = Comparison(data, data, data.model, splits, points=60, horizons=(0.25, 0.5), starts=6, restarts=1)
    found = validate(compared, tmp_path / "out", models=NAMES, seeds=1)
    plain, refined = (found.document["models"][name]["motions"]["rms"][-1]["median"] for name in NAMES)
    assert refined < 0.5 * plain


def test_laws_stand_side_by_side(tmp_path):
    """The cart has dry friction: laws without it are worse."""
    data = recording(line, 1, seconds=10.0)
    compared = Comparison(data, data, data.model, split_named(data, "blocks:4:2,4"), points=40, horizons=(0.1, 0.2))
    dry, viscous = names = "bodies+viscous+coulomb", "bodies+viscous+coulomb:0"
    found = validate(compared, tmp_path / "out", models=names, seeds=1).document["models"]
    error = {name: found[name]["nrmse"]["median"] for name in names}
    assert error[dry] < 0.9 * error[viscous]  # the noise alone is 0.2
    assert viscous in found[viscous]["summary"]
    assert found[viscous]["kind"] == "identified"


@pytest.mark.parametrize(
    ("name", "kind", "identification", "all_rows"),
    [
        ("given", "given", None, False),
        ("identified", "identified", "USUAL", True),
        ("identified@torques", "identified", "bodies+viscous+coulomb@torques", True),
        ("identified@motions:1", "identified", "USUAL", True),
        ("viscous+stribeck@torques+motions:1", "identified", "viscous+stribeck@torques", True),
        ("gp:joint", "force prior", None, False),
        ("gp:joint-friction", "force prior", None, True),
        ("identified+gp:joint", "force prior", "USUAL", False),
        ("viscous+gp:joint:kernel=(linear + matern-3/2)", "force prior", None, False),
        ("identified+gp:joint-accelerations", "residual", "USUAL", False),
        ("gp:independent", "black box", None, False),
    ],
)
def test_what_a_name_stands_for(name, kind, identification, all_rows):
    usual = "bodies+viscous+coulomb@accelerations"
    found = candidate(name, given_system(), usual)
    assert (found.kind, found.all_rows) == (kind, all_rows)
    assert found.identification == (usual if identification == "USUAL" else identification)


@pytest.mark.parametrize("name", ["given@motions:1", "only@motions:1"])
def test_models_without_anything_to_refine_are_refused(name):
    with pytest.raises(InvalidInput, match="nothing to refine on motions"):
        candidate(name, given_system(), "bodies")
