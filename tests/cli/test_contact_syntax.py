"""`FRAME@x,y,z:SURFACE:numbers` reads as the contact that it looks like."""

import pytest

from forcegp.cli.robot_options import EXAMPLE, parse_contact, parse_contacts, parse_feet
from forcegp.errors import InvalidInput
from forcegp.mechanics import Contact, Plane, Sphere, fixed_frame, fixed_point


@pytest.mark.parametrize(
    ("text", "contact"),
    [
        (EXAMPLE, Contact("lbr_iiwa_link_7", (0.0, 0.0, 0.1), Plane((0.0, 0.0, 1.0), 0.055))),
        ("tool:plane:0,0,2,1", Contact("tool", (0.0, 0.0, 0.0), Plane((0.0, 0.0, 1.0), 0.5))),
        ("arm:tool@1,-2,3e-1:sphere:0,0,0,1", Contact("arm:tool", (1.0, -2.0, 0.3), Sphere((0.0, 0.0, 0.0), 1.0))),
        ("a@b@1,2,3:plane:1,0,0,0", Contact("a@b", (1.0, 2.0, 3.0), Plane((1.0, 0.0, 0.0), 0.0))),
    ],
)
def test_reads_as_written(text, contact):
    assert parse_contact(text) == (contact,)
    assert parse_contacts([text, text]) == (contact, contact)
    assert parse_contacts(["none"]) == ()


def test_feet_read_as_written():
    left, right = fixed_point("FL", switch="FL_stands"), fixed_point("a@b", (0.0, 0.1, -0.02), "a@b_stands")
    assert parse_feet(("FL", "a@b@0,.1,-2e-2")) == (*left, *right)
    assert parse_feet(("l_sole:flat",)) == fixed_frame("l_sole", "l_sole_stands")
    assert parse_feet(("FL:ball=.02",)) == fixed_point("FL", switch="FL_stands", radius=0.02)
    assert parse_feet(()) == ()


WRONG = (
    *("", "tool", "tool:plane", "plane:0,0,1,0", "tool:plan:0,0,1,0", "tool:plane:0,0,1", "tool:plane:0,0,1,x"),
    *("tool@1,2:plane:0,0,1,0", "tool@:plane:0,0,1,0", "tool:plane:0,0,0,1", "tool:sphere:0,0,0,-1"),
    *("tool:plane:0,0,nan,1", "tool:plane:"),
)
WRONG_FEET = ("", "@0,0,0", "FL@1,2", "FL@a,b,c", "FL@0,0,nan", ":flat", "FL@0,0,0:flat", "FL:ball=", "FL:ball=-1")
WRONG_FEET += ("FL:ball=.1:flat",)


@pytest.mark.parametrize(
    ("parse", "given", "message"),
    [
        *((parse_contact, text, ".") for text in WRONG), *((parse_feet, (text,), ".") for text in WRONG_FEET),
        (parse_feet, ("FL", "FL@0,0,1"), "twice"),
    ],
)  # fmt: skip
def test_anything_else_is_refused(parse, given, message):
    with pytest.raises(InvalidInput, match=message):
        parse(given)
