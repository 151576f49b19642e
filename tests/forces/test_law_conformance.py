"""Every law passes the suite of all laws; so does one that forcegp does not bring."""

from tests.forces.law_conformance import LawConformance
from tests.forces.third_party_law import HardeningSpring

from forcegp.forces import Coulomb, DirectionalFriction, Spring, Stribeck, Viscous

THREE = [0.5, 0.4, 0.3]


class TestViscous(LawConformance):
    law = Viscous(THREE)


class TestDirectionalFriction(LawConformance):
    law = DirectionalFriction(THREE)


class TestCoulomb(LawConformance):
    law = Coulomb(THREE, 0.2)


class TestDryFrictionThatFalls(LawConformance):
    law = Stribeck(THREE, [0.7, 0.4, 0.9], 0.6, 0.2)


class TestSpring(LawConformance):
    law = Spring([2.0, 1.0, 3.0], [0.5, 0.2, 0.3])


class TestHardeningSpring(LawConformance):
    law = HardeningSpring([1.0, 2.0, 0.5], [3.0, 1.0, 2.0])


def test_a_law_of_ones_own_is_one_short_file(repository):
    text = (repository / "tests" / "forces" / "third_party_law.py").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 40
