"""Every law passes the suite of all laws; so does one that forcegp does not bring."""

from dataclasses import dataclass

import torch
from tests.forces.law_conformance import LawConformance
from tests.forces.third_party_law import HardeningSpring

from forcegp.forces import (
    FORCES,
    Coefficient,
    Coulomb,
    DirectionalFriction,
    GearFriction,
    JointLaw,
    LoadFriction,
    Offset,
    Spring,
    Stribeck,
    Viscous,
)

THREE = [0.5, 0.4, 0.3]


class TestViscous(LawConformance):
    law = Viscous(THREE)


class TestSprungMotors(LawConformance):
    law = Spring([2.0, 1.0, 3.0], [0.5, 0.2, 0.3], transmission="bend+lift")
    given = ("transmission",)


class TestGearsOfMotors(LawConformance):
    law = LoadFriction(THREE, 0.1, 0.2, transmission="bend+lift")
    given = ("velocity_scale", "transmission")


class TestDirectionalFriction(LawConformance):
    law = DirectionalFriction(THREE)


class TestCoulomb(LawConformance):
    law = Coulomb(THREE, 0.2)


class TestDryFrictionThatFalls(LawConformance):
    law = Stribeck(THREE, [0.7, 0.4, 0.9], 0.6, 0.2)


class TestGearFriction(LawConformance):
    law = GearFriction(THREE, 0.1, 0.2, [0.2, -0.05, 0.1], 0.0, 0.6, memory=False)
    given = ("memory", "breakaway", "stribeck_velocity")


class TestSpring(LawConformance):
    law = Spring([2.0, 1.0, 3.0], [0.5, 0.2, 0.3])


class TestHardeningSpring(LawConformance):
    law = HardeningSpring([1.0, 2.0, 0.5], [3.0, 1.0, 2.0])


class TestOffset(LawConformance):
    law = Offset(THREE)
    shows_at_rest = ("value",)


@dataclass(frozen=True, eq=False)
class Cable(JointLaw):
    """-k sin q + c: it pulls back to zero, and has a pull of its own."""

    pull: object = None
    constant: object = None
    coefficients = {"pull": Coefficient(), "constant": Coefficient(lowest=-float("inf"))}  # noqa: RUF012  # as users do

    def features(self, state):
        return (state.positions,)

    def amplitude(self, features, parameters):
        return parameters["constant"] - parameters["pull"] * torch.sin(features[0])


FORCES["cable"] = Cable


class TestCable(LawConformance):
    law = Cable([1.0, 2.0, 0.5], [0.3, -0.2, 0.1])
    shows_at_rest = ("constant",)


def test_a_law_of_ones_own_is_one_short_file(repository):
    text = (repository / "tests" / "forces" / "third_party_law.py").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 40
