"""The link that carries a payload: the usual one, or the hand, foot or trunk that explains a log clearly better."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from forcegp.robots import Robot

CLEARLY = 10.0
"""Nats by which another link must explain more than the usual one."""


def _usual_link(robot: Robot) -> str:
    """A base that moves, else of the last joint the last link of the file.

    Joints that move several bodies, as those of fingers, count as none, if there are others: what fingers hold moves
    with the hand.
    """
    if robot.base != "fixed":
        return robot.layout.moving[0]
    last = max(_alone(robot), default=len(robot.layout.bodies) - 1)
    return [name for name, place in robot.layout.links.items() if place.body == last][-1]


def possible_links(robot: Robot) -> tuple[str, ...]:
    """The usual one, then those behind which chains of joints end or part: hands, feet, trunks."""
    usual, children = _usual_link(robot), np.bincount([body for body in robot.layout.parents if body >= 0])
    ends = [body for body in _alone(robot) if body >= len(children) or children[body] != 1]
    at_usual = robot.layout.links[usual].body
    return (usual, *(robot.layout.bodies[body].child for body in ends if body != at_usual))


def most_likely(
    payloads: Float[np.ndarray, "windows nv links 10"],
    residual: Float[np.ndarray, "windows nv"],
    others: Float[np.ndarray, "windows nv k"],
) -> int:
    """The place of the link whose payload, with the `others`, leaves least of the residual, if it weighs something.

    Joints are weighted by what payloads on all links together leave. The first link is taken but where another one
    explains `CLEARLY` more.
    """
    all_of_them = np.concatenate([others, payloads.reshape(*residual.shape, -1)], axis=-1)
    noise = np.ones(residual.shape[1])
    for _ in range(3):  # weights change what is left, a little
        left = left_by_least_squares(all_of_them / noise[:, None], residual / noise)[0] * noise
        noise = np.sqrt((left**2).mean(0)).clip(1e-9 * np.sqrt((residual**2).mean()) + 1e-300)
    costs = []
    for k in range(payloads.shape[2]):
        columns = np.concatenate([payloads[:, :, k], others], axis=-1)
        left, found = left_by_least_squares(columns / noise[:, None], residual / noise)
        costs.append(0.5 * float((left**2).sum()) if found[0] > 0.0 or k == 0 else np.inf)
    best = int(np.argmin(costs))
    return best if costs[best] < costs[0] - CLEARLY else 0


def left_by_least_squares(
    columns: Float[np.ndarray, "windows nv k"], residual: Float[np.ndarray, "windows nv"]
) -> tuple[Float[np.ndarray, "windows nv"], Float[np.ndarray, " k"]]:
    """What least squares leave of the residual, and by which numbers."""
    flat = columns.reshape(-1, columns.shape[-1])
    size = np.linalg.norm(flat, axis=0).clip(1e-300)
    found = np.linalg.lstsq(flat / size, -residual.ravel(), rcond=1e-10)[0] / size
    return residual + columns @ found, found


def _alone(robot: Robot) -> Sequence[int]:
    """Bodies with links whose joint moves no other one."""
    drives = [drive.joint for drive in robot.layout.drives]
    solid = {place.body for place in robot.layout.links.values()}
    return [body for body, joint in enumerate(drives) if drives.count(joint) == 1 and body in solid]
