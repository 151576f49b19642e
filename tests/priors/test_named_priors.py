"""Priors written as text: every name, options of every kind, sums, and errors that say what to write."""

import math
from dataclasses import dataclass

import pytest
import torch
from tests.models.arm import arm_system

from forcegp.errors import FileFormatError, InvalidInput, UnknownFrame, UnknownJoint
from forcegp.priors import (
    NAMED_PRIORS,
    AerodynamicForce,
    BaseWrench,
    ContactFriction,
    JointAccelerations,
    JointForces,
    JointFriction,
    NamedPrior,
    NoForces,
    Payload,
    PeriodicJointForces,
    SumPrior,
    ToolForces,
    named_prior,
    prior_from_dict,
)

SURFACE_FORCES = ToolForces(inputs=("velocity", "position"), kernel="squared-exponential")
NAMES = {
    "joint": JointForces(),
    "joint-friction": JointFriction(),
    "joint-ripple": PeriodicJointForces(),
    "tool-friction": ToolForces(),
    "tool-forces": SURFACE_FORCES,
    "contact-friction": ContactFriction(),
    "load-friction": ContactFriction(load=True),
    "foot-friction:contacts=0": ContactFriction(load=True),
    "friction-map": ContactFriction(viscous=True, inputs=("position",)),
    "payload:frame=hand": Payload("hand"),
    "base-wrench:frame=hand": BaseWrench("hand"),
    "aerodynamic:frame=hand,observe=0.2": AerodynamicForce("hand", observe=0.2),
    "joint-accelerations": JointAccelerations(),
    "none": NoForces(),
}
EXPRESSIONS = {
    "joint:inputs=v/q,angles=sin-cos": JointForces(("v", "q"), angles="sin-cos"),
    "joint:inputs=v": JointForces(("v",)),
    " joint-friction : joints = lift / pan ": JointFriction(("lift", "pan")),
    "joint-ripple:period=0.5,joints=pan": PeriodicJointForces(0.5, ("pan",)),
    "tool-forces:frame=hand,point=0/-0.1/2e-1,axes=world": ToolForces(
        "hand", (0.0, -0.1, 0.2), axes="world", inputs=SURFACE_FORCES.inputs, kernel=SURFACE_FORCES.kernel
    ),
    "tool-friction:torque=true,contact=0": ToolForces(torque=True),
    "load-friction:load=false": ContactFriction(),
    "payload:frame=hand,moments=false": Payload("hand", moments=False),
    "tool-friction:kernel=(linear + deep)": ToolForces(kernel="linear + deep"),
    "tool-friction:kernel=linear*deep": ToolForces(kernel="linear*deep"),
    "tool-friction:kernel=(linear + deep) * (linear + constant)": ToolForces(
        kernel="(linear + deep) * (linear + constant)"
    ),
    "joint-friction + load-friction": JointFriction() + ContactFriction(load=True),
    "tool-friction:kernel=(linear + deep),torque=true+payload:frame=hand + joint-friction:joints=pan": SumPrior(
        (ToolForces(kernel="linear + deep", torque=True), Payload("hand"), JointFriction(("pan",)))
    ),
}
MISTAKES = {
    "joint-fricton": "no prior 'joint-fricton' in 'joint-fricton'; did you mean 'joint-friction'? Valid priors: ",
    "joint + tool": "no prior 'tool' in 'joint + tool'",
    "": "no prior '' in ''",
    "joint + ": "no prior '' in 'joint + '",
    "joint:color=red": "prior 'joint' cannot take 'color=red'; write FIELD=VALUE with one of: inputs, kernel, angles",
    "joint:inptus=q": "did you mean 'inputs'",
    "joint:q": "prior 'joint' cannot take 'q'; write FIELD=VALUE",
    "joint:": "prior 'joint' cannot take ''; write FIELD=VALUE",
    "none:joints=pan": "prior 'none' cannot take 'joints=pan'; it has no options",
    "payload": "prior 'payload' needs frame: write payload:frame=...",
    "payload:moments=false": "prior 'payload' needs frame",
    "load-friction:load=yes": "prior 'load-friction' has load=yes; give true or false",
    "contact-friction:contact=first": "prior 'contact-friction' has contact=first; give a whole number",
    "contact-friction:contact=-1": "a contact's number from 0",
    "joint-ripple:period=fast": "prior 'joint-ripple' has period=fast; give a number",
    "joint-ripple:period=nan": "PeriodicJointForces period is nan; give a positive number",
    "tool-friction:point=0/0": "a point of three numbers",
    "tool-friction:point=0/0/x": r"prior 'tool-friction' has point=0/0/x; give numbers as in 0.0/0.0/0.0",
    "foot-friction:contacts=0.5/1": r"prior 'foot-friction' has contacts=0.5/1; give whole numbers as in 0/1/2/3",
    "tool-friction:axes=sideways": "give axes 'world' or 'tool' or 'surface'",
    "joint:inputs=q/torque": "give one or more of 'q', 'v', 'u', each once",
    "joint:angles=cos": "give 'plain' or 'sin-cos'",
    "joint-friction:kernel=frictoin": "did you mean 'friction'",
    "joint-friction:kernel=(linear + ": "a parenthesis is not closed|ends where a name is expected",
    "joint-friction:joints=pan/pan": "each once, or None for all",
    "joint:kernel=linear + deep": "is a kernel, not a prior; a '+' inside of a kernel needs parentheses",
    "joint + joint": "the sum has 'joint-forces' twice",
}


def test_every_name_stands_for_its_prior():
    built_in = [name for name in NAMED_PRIORS if name != "air-drag"]  # another test registers that one
    assert [name.partition(":")[0] for name in NAMES] == built_in
    assert all(NAMED_PRIORS[name].summary for name in built_in)


@pytest.mark.parametrize("expression", [*NAMES, *EXPRESSIONS])
def test_expressions(expression):
    assert named_prior(expression) == {**NAMES, **EXPRESSIONS}[expression]
    assert named_prior(expression, arm_system()) == named_prior(expression)


@pytest.mark.parametrize("expression", MISTAKES)
def test_mistakes_are_explained(expression):
    with pytest.raises(InvalidInput) as caught:
        named_prior(expression)
    pieces = MISTAKES[expression].split("|")
    assert any(piece in str(caught.value) for piece in pieces), str(caught.value)


@pytest.mark.parametrize(
    ("expression", "error", "message"),
    [
        ("joint-friction:joints=elbow", UnknownJoint, "no joint 'elbow' in arm"),
        ("joint-ripple:joints=pna", UnknownJoint, "did you mean 'pan'"),
        ("payload:frame=hnad", UnknownFrame, "did you mean 'hand'"),
        ("payload:frame=base", InvalidInput, "fixed in the world .* give a frame of a moving link: upper, fore, hand"),
        ("tool-friction:contact=1", InvalidInput, "contact 1, but the system has only contact 0"),
    ],
)
def test_with_a_system_they_are_checked_against_it(expression, error, message):
    named_prior(expression)
    with pytest.raises(error, match=message):
        named_prior(expression, arm_system())


def test_people_add_their_own(monkeypatch):
    @dataclass(frozen=True)
    class Slow(JointForces):
        limits: tuple[float, float] = (0.0, 1.0)
        count: int = 3

    def faster(period: float = 1.0, joints: tuple[str, ...] | None = None) -> PeriodicJointForces:
        return PeriodicJointForces(0.5 * period, joints)

    monkeypatch.setitem(NAMED_PRIORS, "slow", NamedPrior("slow", Slow, (("inputs", ("v",)),)))
    monkeypatch.setitem(NAMED_PRIORS, "faster", NamedPrior("a function will do", faster))
    assert named_prior("slow:limits=-1/2.5,count=4") == Slow(("v",), limits=(-1.0, 2.5), count=4)
    assert named_prior("faster:period=3,joints=pan/lift") == PeriodicJointForces(1.5, ("pan", "lift"))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: JointForces("force"), "JointForces inputs are 'force'"),
        (lambda: JointForces(None), "JointForces inputs are None"),
        (lambda: JointForces(kernel=3), "kernel .*3"),
        (lambda: JointFriction(()), r"joints are \(\)"),
        (lambda: JointFriction(7), "joints are 7"),
        (lambda: JointFriction((1, 2)), r"joints are \(1, 2\)"),
        (lambda: ToolForces(point=None), "point None"),
        (lambda: ToolForces(point="top"), "point 'top'"),
        (lambda: ToolForces(point=(0.0, 0.0, math.inf)), r"point \(0.0, 0.0, inf\)"),
        (lambda: ToolForces(frame=3), "frame is 3"),
        (lambda: ToolForces(contact="0"), "contact '0'"),
        (lambda: ContactFriction(contact=True), "contact True"),
        (lambda: ContactFriction(axes="three"), "axes 'three'"),
        (lambda: PeriodicJointForces(-1.0), "period is -1.0"),
        (lambda: PeriodicJointForces("long"), "period is 'long'"),
        (lambda: Payload(None), "frame is None"),
        (lambda: SumPrior((JointForces(),)), "has 1 terms; give two or more"),
        (lambda: SumPrior(()), "has 0 terms"),
        (lambda: SumPrior(JointForces()), "has 1 terms"),
        (lambda: SumPrior((JointForces(), "friction")), "terms of a SumPrior are JointForces, str; give priors"),
        (lambda: JointForces() + "friction", "terms of a SumPrior are JointForces, str; give priors"),
        (lambda: JointFriction() + Payload("hand") + JointFriction(), "the sum has 'joint-friction' twice"),
    ],
)
def test_wrong_arguments_of_constructors(make, message):
    with pytest.raises(InvalidInput, match=message):
        make()


@pytest.mark.parametrize(
    "stored",
    [
        {"type": "sum"},
        {"type": "sum", "terms": "many"},
        {"type": "sum", "terms": [], "more": 1},
        {"type": "sum", "terms": [{"type": "joint-forces"}, {"type": "magic"}]},
        {"type": "sum", "terms": [3, 4]},
        {"type": "sum", "terms": [{"type": "joint-forces"}]},
        {"type": "joint-friction", "joints": []},
        "sum",
    ],
    ids=str,
)
def test_damaged_files_are_refused(stored):
    with pytest.raises((FileFormatError, InvalidInput)):
        prior_from_dict(stored)


def test_units_are_those_of_the_joints():
    from tests.priors.prior_conformance import bent_arm

    robot = bent_arm().robot  # its last joint slides
    assert JointForces().latent_units(robot) == ("Nm", "Nm", "N")
    assert JointFriction(("bend",)).latent_units(robot) == ("N",)
    assert PeriodicJointForces().latent_units(robot) == ("Nm", "Nm", "N")
    assert JointAccelerations().latent_units(robot) == ("rad/s^2", "rad/s^2", "m/s^2")
    assert ContactFriction().latent_units(robot) == ("N",)
    assert ContactFriction(load=True, axes="two-axis").latent_units(robot) == ("", "")
    assert ContactFriction(viscous=True, axes="two-axis").latent_units(robot) == ("N/(m/s)", "N/(m/s)")
    assert ContactFriction(viscous=True, load=True).latent_units(robot) == ("s/m",)
    assert ToolForces(torque=True, axes="tool").latent_units(robot) == ("N",) * 3 + ("Nm",) * 3
    assert JointFriction().feature_names(robot)[1:] == (("velocity of lift [rad/s]",), ("velocity of bend [m/s]",))
    assert PeriodicJointForces().feature_names(robot)[2] == ("position of bend [m]",)
    names = JointForces(angles="sin-cos").feature_names(robot)[0]
    assert names == (
        *("q of bend [m]", "sin q of pan", "sin q of lift", "cos q of pan", "cos q of lift"),
        *(
            "v of pan [rad/s]",
            "v of lift [rad/s]",
            "v of bend [m/s]",
            "u of pan [Nm]",
            "u of lift [Nm]",
            "u of bend [N]",
        ),
    )
    tool = ToolForces(inputs=("velocity", "u")).feature_names(robot)[0]
    assert tool[1:] == ("tool velocity along tangent-2 [m/s]", "u of pan [Nm]", "u of lift [Nm]", "u of bend [N]")
    total = JointFriction() + NoForces()
    assert total.feature_names(robot) == JointFriction().feature_names(robot)
    assert torch.tensor(total.slices(robot)[0].stop) == 3
