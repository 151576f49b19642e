"""Payloads that are to be found: where they are, what speaks against them, and what rests and misfits leave open."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from forcegp.data import Dataset
from forcegp.data.views import at_rest
from forcegp.doubts import Doubt, look
from forcegp.errors import DatasetError, InvalidInput
from forcegp.evidence.least_squares import Fit, Residual
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.evidence.recorded_rows import RecordedRows
from forcegp.forces import Actuation, Payload, Thrusters
from forcegp.model import Model
from forcegp.posterior.fitted import STRETCHES
from forcegp.robots import Robot

FEWEST = 10 * STRETCHES
"""Rows that a payload needs, but in a log of postures alone."""


def _usual_link(robot: Robot) -> str:
    """A base that moves, else of the last joint the last link of the file.

    Joints of several bodies, as of fingers, count as none, if there are others: what fingers hold moves with the hand.
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
    bodies = [model.robot.frame(link)[0] for link in named]
    if len(set(bodies)) < len(bodies):
        raise InvalidInput(
            f"forces list two payloads on one body ({', '.join(named)}), which no log tells apart; leave one out."
        )
    if not open_ones:
        return model
    placed = replace(open_ones[0], link=_usual_link(model.robot))
    return replace(model, forces=tuple(placed if force is open_ones[0] else force for force in model.forces))


CLEARLY_MORE = 10.0  # nats
RIGHT = 0.01  # residuals over a payload's torques below which it is right as it is
LEAST = 0.05  # share of the squares that a payload leaves, which only numbers of no body explain


def doubts_of_payloads(space: ParameterSpace, fit: Fit) -> Iterator[Doubt]:
    """Ten free numbers in place of a payload's explain much more: no body on its link explains the log."""
    number, white = len(space.carried), fit.residual / fit.noise
    for body, each in enumerate(space.carried):
        if each.payload is None:
            continue
        own, one = space.bodies.slices[body], np.eye(10 * number)[10 * body : 10 * body + 10].reshape(10, 1, number, 10)
        slopes = space.bodies.chained(fit.x[: space.bodies.size], one)[:, 0, own]
        payload = fit.jacobian[..., own] @ np.linalg.inv(slopes)
        others = np.delete(fit.jacobian, np.r_[own], axis=-1)
        free = (np.concatenate([payload, others], axis=-1) / fit.noise[:, None]).reshape(white.size, -1)
        free = free / np.linalg.norm(free, axis=0).clip(1e-300)
        left = white.ravel() - free @ np.linalg.lstsq(free, white.ravel(), rcond=1e-10)[0]
        cost = 0.5 * float((white**2).sum())
        more = cost - 0.5 * float((left**2).sum())
        moves = payload @ space.standard_parameters(fit.x)[body]
        if np.linalg.norm(fit.residual) > RIGHT * np.linalg.norm(moves) and more > max(CLEARLY_MORE, LEAST * cost):
            yield look(
                about="payload",
                what=f"no body on {getattr(space.model.laws[each.payload], 'link', '')} explains the log: free numbers "
                f"in place of its mass, centre and inertia leave {more / cost:.0%} less. The payload is on another "
                "link, or links weigh less or otherwise than the URDF states.",
                do="Give link, or a baseline (a log without the payload), or identify all links.",
            )


def changes_without_rests(
    search: Callable[..., Fit],
    residual: Residual,
    space: ParameterSpace,
    x: Float[np.ndarray, " k"],
    rests: Sequence[np.ndarray],
) -> Float[np.ndarray, "rests k"]:
    """What leads from x to the end of a search without each of the rests, whose numbers of rows are given.

    Levels of noise are found anew in each, since those of few rests are as unsure as the numbers: with the levels of
    all rests, intervals of four postures held half of the loads.
    """
    changes = []
    for at in rests:

        def others(x: np.ndarray, at: np.ndarray = at) -> tuple[np.ndarray, np.ndarray]:
            r, jacobian = residual(x)
            kept = np.ones(len(r), dtype=bool)
            kept[at] = False
            return r[kept], np.asarray(jacobian)[kept]

        other, size = search(others, start=x).x, space.bodies.size
        step = space.standard_parameters(other) - space.standard_parameters(x)  # straight in parameters of bodies
        of_bodies = np.linalg.solve(space.bodies.slopes(x[:size]), step.ravel()) if size else x[:0]
        changes.append(np.append(of_bodies, (other - x)[size:]))
    return np.stack(changes)


GAINS = (
    0.2,
    "torques of the log times",
    "Check these drives; `gain` among the forces estimates them.",
)
CAUSES = {
    "gain": GAINS,
    "gains": GAINS,
    "lengths": (0.1, "lengths before the joints times", "Correct the URDF's lengths."),
    "masses": (0.2, "masses of the links times", "Give a baseline (a log without the payload), or identify all links."),
}
"""Usual deviations of the logarithms of factors, what they are of, and what to do; `gain` is that of one joint. Of two
causes the first is named, unless the other explains a tenth more, or half as much again where the first is one number.
"""
ALONE = 1.5
STEP = 1e-4
"""Of a length, for its derivative."""
WRONG = 0.03
"""Logarithm of the largest factor below which a cause is not worth a word."""
NO_STEP = 0.8
"""Logarithm of a factor from which on one linear step tells nothing of it."""


def misfit(
    model: Model,
    rows: Sequence[RecordedRows],
    a: Sequence[Float[np.ndarray, "rows nv"]],
    left: Sequence[Float[np.ndarray, "rows nv"]],
    white: Callable[[Sequence[np.ndarray]], np.ndarray],
    fit: Fit,
) -> tuple[Doubt, Float[np.ndarray, " k"]] | None:
    """The cause that explains most, if far more than `model`, and how far the coordinates move with it.

    `model` has the numbers of the fit, of torques of rows with accelerations `a` it leaves `left`, and `white` makes
    residuals of the fit of such torques. At the best x, causes c with columns C lower the whitened residual r (Frisch &
    Waugh 1933): c = -(C' C - C' J F^-1 J' C + S^-2)^-1 C' r with F = J' J + prior, and x moves by -F^-1 J' C c.
    """
    [actuation] = [law for law in model.laws if isinstance(law, Actuation)]
    r, J = fit.white.ravel(), fit.white_jacobian.reshape(fit.white.size, -1)
    inverse, cost = np.linalg.inv(fit.information + fit.prior_information), 0.5 * float(r @ r)
    best, found = max(CLEARLY_MORE, LEAST * cost), None
    scales = [10 * k for k, each in enumerate(rows[0].space.carried) if each.payload is not None]
    if np.linalg.norm(fit.residual) <= RIGHT * np.linalg.norm(0.5 * fit.jacobian[..., scales]):
        return None  # of the torques of payloads, next to nothing is left
    for cause, (usual, said, do) in CAUSES.items():
        if (cause != "lengths" and not actuation.is_exact) or (cause != "gain" and model.robot.base != "fixed"):
            continue  # a factor of all masses is one of the gains that are estimated, or of all those of a base
        names, columns = zip(*(_columns(cause, model, *each) for each in zip(rows, a, left, strict=True)), strict=True)
        C = white(columns).reshape(r.size, -1)
        across, instead = J.T @ C, False
        if cause == "gain":
            more, instead, change, move = _of_one(rows[0].space, fit, C, usual, best)
        else:
            own = C.T @ C - across.T @ inverse @ across
            change = -np.linalg.solve(own + np.eye(C.shape[1]) / usual**2, C.T @ r)
            more, move = -0.5 * float(r @ C @ change), -inverse @ (across @ change)
        off, factors = abs(change) > WRONG, np.exp(change)
        if cause == "gain":  # what is needed is g u, and without the payload another torque than `left` has
            factors = 1.0 + change if instead else 1.0 / (1.0 - change)
        if (instead or more > best) and off.any() and abs(change).max() < NO_STEP:
            told = ", ".join(f"{names[0][k]} {factors[k]:.3g}" for k in np.flatnonzero(off))
            less = (
                "explain the log as well, without a payload" if instead else f"leave {more / cost:.0%} less of the log"
            )
            doubt = look(
                about="payload",
                what=f"{said} these factors would {less}: {told}. The intervals hold what that would change.",
                do=do,
                joints=tuple(np.array(names[0])[off].tolist()),
                numbers={cause: dict(zip(names[0], factors.tolist(), strict=True))},
            )
            best, found = (ALONE if cause == "gain" else 1.1) * more, (doubt, move)
            if instead:
                break
    return found


def _of_one(
    space: ParameterSpace, fit: Fit, C: Float[np.ndarray, "equations causes"], usual: float, least: float
) -> tuple[float, bool, Float[np.ndarray, " causes"], Float[np.ndarray, " k"]]:
    """Nats that the best of the causes explains alone, whether instead of the payload, its change, and the move of x.

    Without the payload they are nats beyond what that explains: where they are hardly fewer, so many numbers are no
    better than one.
    """
    r, J = fit.white.ravel(), fit.white_jacobian.reshape(fit.white.size, -1)
    curvature, found = fit.information + fit.prior_information, []
    none, slopes = np.zeros_like(fit.x), space.bodies.slopes(fit.x[: space.bodies.size])
    for body in (k for k, each in enumerate(space.carried) if each.payload is not None):
        own, rows = np.r_[space.bodies.slices[body]], slice(10 * body, 10 * body + 10)
        none[own] = -np.linalg.solve(slopes[rows, own], space.standard_parameters(fit.x)[body])
    for out in (False, True)[: 1 + bool(none.any())]:
        free = np.flatnonzero(none == 0.0) if out else np.arange(len(none))
        beyond = J @ none * out
        left, slope, across = r + beyond, J[:, free].T @ beyond, J[:, free].T @ C
        inner = np.linalg.solve(curvature[np.ix_(free, free)], np.c_[slope, across])
        size = np.square(C).sum(0) - (across * inner[:, 1:]).sum(0) + usual**-2
        change = -(C.T @ left - across.T @ inner[:, 0]) / size
        own = 0.5 * change**2 * size
        more = own + 0.5 * (r @ r - left @ left + slope @ inner[:, 0])
        k, move = int(np.argmax(more)), none * out
        move[free] -= inner[:, 0] + inner[:, 1 + k] * change[k]
        found.append((float(more[k]), out and own[k] > least, np.where(np.arange(len(change)) == k, change, 0.0), move))
    (beside, *_), (without, clear, *_) = found[0], found[-1]
    return found[-1] if clear and without > max(-CLEARLY_MORE, beside - least) else found[0]


def _columns(
    cause: str, model: Model, rows: RecordedRows, a: Float[np.ndarray, "rows nv"], left: Float[np.ndarray, "rows nv"]
) -> tuple[list[str], Float[np.ndarray, "rows nv causes"]]:
    """Names of joints or links, and derivatives of torques needed less those measured in logarithms of factors.

    Of gains they are as the log has them: with the torques, what is needed would vanish, too.
    """
    robot = model.loaded_robot if rows.loaded else model.robot
    if cause[:4] == "gain":
        names, columns = list[str](), list[np.ndarray]()
        for law in (each for each in model.laws if isinstance(each, Actuation | Thrusters) and each.known):
            for name in law.names:
                here = torch.zeros_like(rows.state.u)
                here[:, model.inputs.index(name)] = rows.state.u[:, model.inputs.index(name)]
                torque = law.delivered(replace(rows.state, u=here)).cpu().numpy()
                along = torque / np.linalg.norm(torque, axis=1, keepdims=True).clip(1e-300)
                columns.append(torque + along * (along * left).sum(axis=1, keepdims=True))
                names.append(name)
        return names, -np.stack(columns, axis=-1) if columns else np.zeros((*a.shape, 0))
    if cause == "masses":
        return [body.child for body in robot.layout.bodies], rows.by_body(a)
    q, v, at = (torch.as_tensor(np.array(x), device=robot.device) for x in (rows.q, rows.v, a))
    names, columns = [], []
    for body, drive in enumerate(robot.layout.drives):
        if robot.layout.parents[body] >= 0 and bool(robot.tree.rest[body, :3, 3].any()):
            rest = robot.tree.rest.clone()
            rest[body, :3, 3] *= 1.0 + STEP
            longer = replace(robot, tree=replace(robot.tree, rest=rest))
            change = longer.inverse_dynamics(q, v, at) - robot.inverse_dynamics(q, v, at)
            names.append(robot.joint_names[drive.joint])
            columns.append(change.cpu().numpy() / STEP)
    return names, np.stack(columns, axis=-1) if columns else np.zeros((*a.shape, 0))
