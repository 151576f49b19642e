"""Every law passes the suite of all laws; so does one that forcegp does not bring."""

from dataclasses import dataclass

import torch
from tests.forces.law_conformance import LawConformance
from tests.forces.third_party_law import HardeningSpring

from forcegp import Coulomb, LoadFriction, Offset, Spring
from forcegp.forces import FORCES, Coefficient, DirectionalFriction, GearFriction, JointLaw, Pull, Stribeck, Viscous

THREE = [0.5, 0.4, 0.3]
PLAIN = {
    "Viscous": Viscous(THREE), "DirectionalFriction": DirectionalFriction(THREE), "Coulomb": Coulomb(THREE, 0.2),
    "DryFrictionThatFalls": Stribeck(THREE, [0.7, 0.4, 0.9], 0.6, 0.2),
    "Spring": Spring([2.0, 1.0, 3.0], [0.5, 0.2, 0.3]),
    "HardeningSpring": HardeningSpring([1.0, 2.0, 0.5], [3.0, 1.0, 2.0]),
}  # fmt: skip
for name, law in PLAIN.items():
    globals()[f"Test{name}"] = type(f"Test{name}", (LawConformance,), {"law": law, "__module__": __name__})


class TestSprungMotors(LawConformance):
    law = Spring([2.0, 1.0, 3.0], [0.5, 0.2, 0.3], transmission="bend+lift")
    given = ("transmission",)
    shows_at_rest = ("rest",)  # of k q0, which is a constant at q = 0


class TestGearsOfMotors(LawConformance):
    law = LoadFriction(THREE, 0.1, 0.2, transmission="bend+lift")
    given = ("velocity_scale", "transmission")


class TestGearFriction(LawConformance):
    law = GearFriction(THREE, 0.1, 0.2, [0.2, -0.05, 0.1], 0.0, 0.6, memory=False)
    given = ("memory", "breakaway", "stribeck_velocity")


class TestPull(LawConformance):
    law = Pull("hand", 3.0, -2.0, 5.0, point=(0.1, 0.02, -0.05))
    given = ("frame", "point")
    shows_at_rest = ("x", "y", "z")


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
    assert len((repository / "tests" / "forces" / "third_party_law.py").read_text(encoding="utf-8").splitlines()) <= 40
