"""URDFs that between them hold every kind of joint and link, for tests of any package."""

from pathlib import Path
from typing import Any

import numpy as np

from forcegp.robots import Robot
from forcegp.robots.inertia import physical_of_pseudo_inertia, pseudo_inertia
from forcegp.robots.urdf_file import replace_inertial
from forcegp.simulation import kuka_file

FOLDER = Path(__file__).parent
# Branches at two depths, joints scattered over the file, names not in alphabetical order, links fixed to moving links
# with inertias at turned origins, massless frames, a base that is offset from the root link.
TREE = (FOLDER / "tree.urdf").read_text(encoding="utf-8")

# Prismatic, continuous, skew-axis, fixed and revolute joints in series, with axes that are not of unit length.
CHAIN = (FOLDER / "chain.urdf").read_text(encoding="utf-8")


def iiwa() -> str:
    return kuka_file().read_text(encoding="utf-8")


MODELS = {"iiwa": iiwa, "tree": lambda: TREE, "chain": lambda: CHAIN}
FRAMES = {"iiwa": "lbr_iiwa_link_7", "tree": "right_hand", "chain": "tool"}  # a frame at the end of each


def with_link(robot: Robot, name: str, mass: float, center: Any, inertia: Any) -> Robot:
    """The robot whose link has these numbers in its file."""
    return robot.with_text(replace_inertial(robot.urdf_text, name, mass, center, inertia, source=robot.source))


def loaded(robot: Robot, *links: str, mass: float = 0.3) -> Robot:
    """The robot with other masses, centres and inertias of these links: each carries two more points."""
    for k, name in enumerate(links):
        link = robot.link(name)
        total = pseudo_inertia(link.mass, np.array(link.center_of_mass), np.array(link.inertia))
        for point in ((0.1, 0.05 + 0.01 * k, -0.02), (-0.04, 0.1, 0.07), (0.02, -0.03, 0.1)):
            total = total + pseudo_inertia(mass, np.array(point), np.diag([0.002, 0.003, 0.004]) * mass)
        robot = with_link(robot, name, *physical_of_pseudo_inertia(total))
    return robot
