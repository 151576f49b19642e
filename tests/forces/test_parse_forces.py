"""Forces written as text: every name, options of every kind, several, and errors that say what to write."""

import math
from dataclasses import dataclass

import pytest
from tests.posterior.arm import arm_model

from forcegp import forces
from forcegp.errors import FileFormatError, InvalidInput, UnknownName
from forcegp.forces.registry import SHORT, force_to_dict, is_unknown

BUILT_IN = tuple(name for name, where in forces.FORCES.items() if isinstance(where, str))
SURFACE_FORCES = forces.ToolForces(inputs=("velocity", "position"), kernel="squared-exponential")
NAMES = {
    "bodies": forces.RigidBodies("all"), "gp:joint": forces.JointForces(),
    "gp:joint-position:joints=pan": forces.JointPositionForces(("pan",)), "gp:tool-friction": forces.ToolForces(),
    "gp:tool-forces": SURFACE_FORCES, "gp:load-friction": forces.ContactFriction(load=True),
    "rigid-bodies": forces.RigidBodies(),
    "gain": forces.Actuation(gain=None), "payload:hand": forces.Payload("hand"), "viscous": forces.Viscous(),
    "direction": forces.DirectionalFriction(), "coulomb": forces.Coulomb(), "stribeck": forces.Stribeck(),
    "load": forces.LoadFriction(),
    "gear": forces.GearFriction(), "offset": forces.Offset(), "spring": forces.Spring(), "rotor": forces.Rotor(),
    "pull:hand:point=.1/0/0": forces.Pull("hand", point=(0.1, 0.0, 0.0)),
    "gp:joint-forces": forces.JointForces(), "gp:joint-accelerations": forces.JointAccelerations(),
    "gp:independent": forces.IndependentAccelerations(), "gp:joint-friction": forces.JointFriction(),
    "gp:contact-friction": forces.ContactFriction(),
    "gp:aerodynamic:frame=hand:observe=0.2": forces.AerodynamicForce("hand", observe=0.2),
}  # fmt: skip
EXPRESSIONS = {
    "gp:joint:inputs=v/q,kernel=matern-3/2": forces.JointForces(("v", "q"), "matern-3/2"),
    "gp:joint:v": forces.JointForces(("v",)),
    "viscous:transmission=lift+pan/pan-0.5*lift": forces.Viscous(transmission="lift+pan/pan-0.5*lift"),
    "gp: joint-friction : joints = lift / pan ": forces.JointFriction(("lift", "pan")),
    "gp:tool-friction:inputs=position:contact=2": forces.ToolForces(2, ("position",)),
    "gp:aerodynamic:hand:wind=0/-0.1/2e-1": forces.AerodynamicForce("hand", wind=(0.0, -0.1, 0.2)),
    "gp:load-friction:load=false": forces.ContactFriction(),
    "gp:tool-friction:kernel=(linear + matern-3/2)": forces.ToolForces(kernel="linear + matern-3/2"),
    "viscous:0.3": forces.Viscous(0.3), "coulomb:level=0.3/0.4/0.5": forces.Coulomb((0.3, 0.4, 0.5)),
    "gear:memory": forces.GearFriction(memory=True),
    "coulomb:0.5:memory=lift/bend": forces.Coulomb(0.5, memory=("lift", "bend")),
    "payload:hand:mass=1.5": forces.Payload("hand", 1.5),
    "rigid-bodies:learn=upper/hand": forces.RigidBodies(("upper", "hand")),
}  # fmt: skip
MISTAKES = {
    "gp:joint-fricton": "no force 'joint-fricton' in 'gp:joint-fricton'; did you mean 'joint-friction'? Valid force",
    "viscos": "did you mean 'viscous'", "viscous,tool": "no force 'tool' in 'viscous,tool'", "": "no force '' in ''",
    "viscous, ": "no force '' in 'viscous, '",
    "joint-friction": "'joint-friction' in 'joint-friction' is an unknown force; write gp:joint-friction",
    "gp:viscous": "'viscous' in 'gp:viscous' is a law with coefficients; write viscous",
    "gp:joint:color=red": "force 'joint' cannot take 'color=red'; write FIELD=VALUE with one of: inputs, ",
    "gp:joint:inptus=q": "did you mean 'inputs'",
    "gp:joint:kernel=matern-3/2:q": "force 'joint' cannot take 'q'; write FIELD=VALUE",
    "gp:joint:": "force 'joint' cannot take ''; write FIELD=VALUE",
    "gp:load-friction:load=yes": "force 'load-friction' has load=yes; give true or false",
    "gp:contact-friction:contact=first": "force 'contact-friction' has contact=first; give a whole number",
    "gp:contact-friction:contact=-1": "a contact's number from 0", "gp:aerodynamic:wind=0/0": "give 3 finite numbers",
    "gp:aerodynamic:wind=0/0/x": r"force 'aerodynamic' has wind=0/0/x; give numbers as in 0.0/0.0/0.0",
    "gp:joint:inputs=q/torque": "give one or more of 'q', 'v', 'u', each once",
    "gp:joint-friction:kernel=frictoin": "did you mean 'friction'",
    "gp:joint-friction:joints=pan/pan": "each once, or None for all", "gp:tool-friction:kernel=(linear": "'(linear'",
    "gp:tool-friction:kernel=linear)": "'linear)'",
    "gp:matern-3/2": "'matern-3/2' in 'gp:matern-3/2' is a kernel, not a force; write it as an option",
}  # fmt: skip


def test_every_name_that_needs_no_columns_of_u_is_here():
    told = {name.removeprefix("gp:").partition(":")[0] for name in NAMES}
    assert told == {*SHORT, *BUILT_IN} - {"actuation", "thrusters", "observed-wrench", "observed-wind"}
    assert all(is_unknown(name.removeprefix("gp:").partition(":")[0]) == name.startswith("gp:") for name in NAMES)


@pytest.mark.parametrize("expression", [*NAMES, *EXPRESSIONS])
def test_expressions(expression):
    (found,) = forces.parse_forces(expression)
    assert force_to_dict(found) == force_to_dict({**NAMES, **EXPRESSIONS}[expression])


def test_several_are_written_with_commas():
    several = forces.parse_forces(
        "viscous, coulomb:0.1,gp:tool-friction:kernel=(linear + matern-3/2),contact=1, payload:hand"
    )
    wanted = (
        forces.Viscous(), forces.Coulomb(0.1), forces.ToolForces(1, kernel="linear + matern-3/2"),
        forces.Payload("hand"),
    )  # fmt: skip
    assert list(map(force_to_dict, several)) == list(map(force_to_dict, wanted))
    several = forces.parse_forces(["viscous", "gp:joint-friction"])
    assert [force.title for force in several] == ["viscous", "joint-friction"]


@pytest.mark.parametrize("expression", MISTAKES)
def test_mistakes_are_explained(expression):
    with pytest.raises(InvalidInput) as caught:
        forces.parse_forces(expression)
    assert any(piece in str(caught.value) for piece in MISTAKES[expression].split("|")), str(caught.value)


@pytest.mark.parametrize(
    ("expression", "error", "message"),
    [
        ("gp:joint-friction:joints=elbow", UnknownName, "no joint 'elbow' in arm"),
        ("payload:hnad", UnknownName, "did you mean 'hand'"),
        ("gp:tool-friction:contact=1", InvalidInput, "contact 1, but the model has only contact 0"),
        ("gp:joint,gp:joint", InvalidInput, "'joint-forces' twice"),
    ],
)
def test_a_model_checks_them(expression, error, message):
    with pytest.raises(error, match=message):
        arm_model().with_forces(*forces.parse_forces(expression))


def test_people_add_their_own(monkeypatch):
    @dataclass(frozen=True)
    class Slow(forces.JointForces):
        limits: tuple[float, float] = (0.0, 1.0)
        count: int = 3

    def rough(nu: int = 3, joints: tuple[str, ...] | None = None) -> forces.JointPositionForces:
        return forces.JointPositionForces(joints, f"matern-{nu}/2")

    monkeypatch.setitem(forces.FORCES, "slow", Slow)
    monkeypatch.setitem(forces.FORCES, "rough", rough)
    assert forces.parse_forces("gp:slow:v:limits=-1/2.5:count=4") == (Slow(("v",), limits=(-1.0, 2.5), count=4),)
    assert forces.parse_forces("gp:rough:nu=5:joints=pan/lift") == (
        forces.JointPositionForces(("pan", "lift"), "matern-5/2"),
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: forces.JointForces("force"), "JointForces inputs are 'force'"),
        (lambda: forces.JointForces(None), "JointForces inputs are None"), (lambda: forces.JointForces(kernel=3),
        "kernel .*3"),
        (lambda: forces.JointFriction(()), r"joints are \(\)"), (lambda: forces.JointFriction(7), "joints are 7"),
        (lambda: forces.JointFriction((1, 2)), r"joints are \(1, 2\)"),
        (lambda: forces.AerodynamicForce(wind=None), "wind is None"),
        (lambda: forces.AerodynamicForce(wind="top"), "wind is 'top'"),
        (lambda: forces.AerodynamicForce(wind=(0.0, 0.0, math.inf)), r"wind is \(0.0, 0.0, inf\)"),
        (lambda: forces.AerodynamicForce(frame=3), "frame is 3"), (lambda: forces.ToolForces(contact="0"),
        "contact '0'"),
        (lambda: forces.ContactFriction(contact=True), "contact True"),
        (lambda: forces.Payload(mass=2.0), "no link; name the link that carries it"),
        (lambda: forces.Payload("hand", -1.0), "mass is -1.0"),
    ],
)  # fmt: skip
def test_wrong_arguments_of_constructors(make, message):
    with pytest.raises(InvalidInput, match=message):
        make()


@pytest.mark.parametrize(
    "stored",
    [
        {"type": "magic"}, {"type": 3}, {"type": "joint-forces", "more": 1},
        {"type": "joint-friction", "joints": []}, "sum",
    ],
    ids=str,
)  # fmt: skip
def test_damaged_files_are_refused(stored):
    with pytest.raises((FileFormatError, InvalidInput)):
        forces.force_from_dict(stored)
