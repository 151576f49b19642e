"""Payloads that are to be found: where they are, what speaks against them, and what rests in postures leave open."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from forcegp.data import Dataset
from forcegp.data.views import at_rest
from forcegp.doubts import Doubt
from forcegp.errors import DatasetError, InvalidInput
from forcegp.evidence.least_squares import Fit, Residual
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.fit.doubts import doubts_of_no_body, doubts_of_offsets
from forcegp.forces import Payload
from forcegp.model import Model
from forcegp.posterior.fitted import STRETCHES
from forcegp.robots import Robot

FEWEST = 10 * STRETCHES
"""Rows that a payload needs, but in a log of postures alone."""


def _usual_link(robot: Robot) -> str:
    """A base that moves, else of the last joint the last link of the file.

    Joints that move several bodies, as those of fingers, count as none, if there are others: what fingers hold moves
    with the hand.
    """
    if robot.base != "fixed":
        return robot.layout.moving[0]
    drives = [drive.joint for drive in robot.layout.drives]
    solid = {place.body for place in robot.layout.links.values()}
    alone = [body for body, joint in enumerate(drives) if drives.count(joint) == 1 and body in solid]
    last = max(alone, default=len(robot.layout.bodies) - 1)
    return [name for name, place in robot.layout.links.items() if place.body == last][-1]


def with_payloads_placed(model: Model, logs: Sequence[Dataset]) -> Model:
    """The model whose payload without a link is on the usual one.

    Raises DatasetError for logs too short for a payload.
    """
    unknown = [law for law in model.laws if isinstance(law, Payload) and not law.known]
    for name, log in zip(("the log", "the baseline"), logs, strict=False):
        if unknown and len(log) < FEWEST and not at_rest(log):
            raise DatasetError(f"{name} has {len(log)} rows; a payload needs {FEWEST} or more.")
    open_ones = [law for law in unknown if law.link is None]
    if len(open_ones) > 1:
        raise InvalidInput("forces list two payloads without a link, which no log tells apart; name their links.")
    named = [law.link for law in unknown if law.link is not None]
    bodies = [model.robot.layout.links[model.robot.link(link).name].body for link in named]
    if len(set(bodies)) < len(bodies):
        raise InvalidInput(
            f"forces list two payloads on one body ({', '.join(named)}), which no log tells apart; leave one out."
        )
    if not open_ones:
        return model
    placed = replace(open_ones[0], link=_usual_link(model.robot))
    return replace(model, forces=tuple(placed if force is open_ones[0] else force for force in model.forces))


def doubts_of_payloads(space: ParameterSpace, fit: Fit, averaged: bool) -> Iterator[Doubt]:
    """Offsets that look like its weight, and a link on which no body explains the log, where that is `averaged`."""
    for body, each in enumerate(space.carried):
        if each.payload is None:
            continue
        own, column = space.bodies.slices[body], space.names.index(f"{each.name}.mass")
        slope = space.number_slopes(fit.x)[column, own]
        laws = [type(space.model.laws[term.law]).__name__ for term in space.terms for _ in term.size]
        offsets = np.array([law == "Offset" for law in laws], dtype=bool)
        yield from doubts_of_offsets(fit, offsets, slope, own)
        if averaged:  # noise of single rows hides what is left
            number = len(space.carried)
            one = np.eye(10 * number)[10 * body : 10 * body + 10].reshape(10, 1, number, 10)
            slopes = space.bodies.chained(fit.x[: space.bodies.size], one)[:, 0, own]
            link = getattr(space.model.laws[each.payload], "link", "")
            yield from doubts_of_no_body(fit, space.standard_parameters(fit.x)[body], slopes, own, link)


def changes_without_rests(
    search: Callable[..., Fit],
    residual: Residual,
    space: ParameterSpace,
    x: Float[np.ndarray, " k"],
    rests: Sequence[np.ndarray],
) -> Float[np.ndarray, "rests k"]:
    """What leads from x to the end of a search without each of the rests, whose numbers of equations are given.

    Levels of noise are found anew in each, since those of few rests are as unsure as the numbers: with the levels of
    all rests, intervals of four postures held half of the loads.
    """
    changes = []
    for at in rests:

        def others(x: np.ndarray, at: np.ndarray = at) -> tuple[np.ndarray, np.ndarray]:
            r, jacobian = residual(x)
            kept = np.ones(len(r), dtype=bool)
            kept[at // r.shape[1]] = False
            return r[kept], np.asarray(jacobian)[kept]

        changes.append(space.change(x, search(others, start=x).x))
    return np.stack(changes)
