"""`forcegp simulate` with other friction, surfaces and contacts."""

import json

import pytest

from forcegp import Dataset


def test_options_of_other_scenarios_are_refused(forcegp, tmp_path):
    for words, message in (
        (("quadruped", "--surface", "tilted"), "--surface means nothing to quadruped"),
        (("quadruped", "--joint-friction", "lugre"), "lugre"),
    ):
        refused = forcegp("simulate", *words, "--out", "no.h5", folder=tmp_path)
        assert refused.returncode == 2
        assert message in refused.stderr


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("--tool-friction viscous:2.5", {"friction": "viscous", "viscous_coefficient": 2.5}),
        (
            "--tool-friction stribeck:0.2 --surface tilted --joint-friction stribeck",
            {"friction": "stribeck", "coulomb_coefficient": 0.2, "surface": "tilted"},
        ),
    ],
)
def test_options_reach_the_dataset(forcegp, tmp_path, options, expected):
    made = forcegp(
        *("simulate", "kuka-surface", "--seconds", 0.5, "--out", "log.h5", "--json", *options.split()), folder=tmp_path
    )
    assert made.returncode == 0, made.stderr
    data, summary = Dataset.load(tmp_path / "log.h5"), json.loads(made.stdout)
    assert expected.items() <= summary["config"].items()
    assert expected.items() <= data.metadata["config"].items()
    assert ("Q_U.joint-friction" in data.truth) == ("--joint-friction" in options)
    assert (data.model.contacts[0].surface.normal[2] < 1.0) == ("tilted" in options)
