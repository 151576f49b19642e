"""Payloads that are to be found: where they are, what speaks against them, and what rests and misfits leave open."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

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

FEWEST = 10 * STRETCHES  # rows that a payload needs, but in a log of postures alone


def with_payloads_placed(model: Model, logs: Sequence[Dataset]) -> Model:
    """The model whose payload without a link is on a base that moves, else on the last link of the last joint.

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
    # of joints of several bodies, as of fingers, none counts, if there are others: what they hold moves with the hand
    layout = model.robot.layout
    drives, solid = [drive.joint for drive in layout.drives], {place.body for place in layout.links.values()}
    alone = [body for body, joint in enumerate(drives) if drives.count(joint) == 1 and body in solid]
    last = max(alone, default=len(layout.bodies) - 1)
    usual = [name for name, place in layout.links.items() if place.body == last][-1]
    placed = replace(open_ones[0], link=usual if model.robot.base == "fixed" else layout.moving[0])
    return replace(model, forces=tuple(placed if force is open_ones[0] else force for force in model.forces))


CLEARLY_MORE, NO_BODY = 10.0, 120.0
"""Nats of one number, and of nine that no body has: of clean logs of LuGre gears these explained up to 90."""
RIGHT = 0.01  # residuals over a payload's torques below which it is right as it is
LEAST = 0.05  # share of the squares that a payload leaves, which only numbers of no body explain


def doubts_of_payloads(space: ParameterSpace, fit: Fit, least: float) -> Iterator[Doubt]:
    """Ten free numbers in place of a payload's explain much more, than a cause of `least` nats, too: it is no body."""
    number, white = len(space.carried), fit.residual / fit.noise
    for body, each in enumerate(space.carried):
        if each.payload is None:
            continue
        own, one = space.bodies.slices[body], np.eye(10 * number)[10 * body : 10 * body + 10].reshape(10, 1, number, 10)
        slopes = space.bodies.chained(fit.x[: space.bodies.size], one)[:, 0, own]
        payload, others = fit.jacobian[..., own] @ np.linalg.inv(slopes), np.delete(fit.jacobian, np.r_[own], axis=-1)
        free = (np.concatenate([payload, others], axis=-1) / fit.noise[:, None]).reshape(white.size, -1)
        free = free / np.linalg.norm(free, axis=0).clip(1e-300)
        left = white.ravel() - free @ np.linalg.lstsq(free, white.ravel(), rcond=1e-10)[0]
        cost = 0.5 * float((white**2).sum())
        more, moves = cost - 0.5 * float((left**2).sum()), payload @ space.standard_parameters(fit.x)[body]
        clearly = max(NO_BODY, LEAST * cost, least + 4.5 * np.log(white.size))  # nine numbers more than one cause
        if np.linalg.norm(fit.residual) > RIGHT * np.linalg.norm(moves) and more > clearly:
            what = f"no body on {getattr(space.model.laws[each.payload], 'link', '')} explains the log: free numbers "
            what += f"in place of its mass, centre and inertia leave {more / cost:.0%} less. The payload is on another "
            what += "link, or links weigh less or otherwise than the URDF states."
            do = "Give link, or a baseline (a log without the payload), or identify all links."
            yield look(about="payload", what=what, do=do)


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


CAUSES = {
    "gravity": (0.3, "gravity of the base plus", ""),
    "gains": (0.2, "torques of the log times", "Check these drives; `gain` among the forces estimates them."),
    "lengths": (0.1, "lengths before the joints times", "Compare the URDF's lengths with the robot."),
    "masses": (0.2, "masses of the links times", "Give a baseline (a log without the payload), or identify all links."),
    "centres of mass": (0.1, "centres of mass of the links plus", "Correct the URDF, or identify all links."),
    "gear ratio": (0.2, "positions and velocities of the log times", "Correct it, as in forcegp import --q 'X * 1.2'."),
    "joint zero": (0.1, "positions of the log plus", "Correct it, or the URDF, as in forcegp import --q 'X + 0.1'."),
}
"""Usual deviations of the logarithms of factors (of zeros in rad or m, of centres in m, of gravity in g), what they are
of, and what to do. All factors of a cause are tried, and each alone; of centres those of each link. Of two the first is
named, unless the other explains a tenth more, or as much by fewer numbers, or more: what it explains less the half of
the logarithm of the rows for each factor (Schwarz 1978)."""
ADDED = {"joint zero": " rad", "centres of mass": " m", "gravity": " g"}
ALONE, MOSTLY = {"gear ratio": 0.1, "joint zero": 0.03}, 0.3
"""Of these no two are tried at once, and one is so large at least, and explains this share of what is left."""
NAMED = 0.5
"""Share of what is left that gains, lengths, masses and centres explain, to be named: in logs of LuGre gears with
rough masses, less was another cause than the true one, or none."""
DECIDED, FAR_BEHIND = 30.0, 3.0
"""Nats from which on one number of these is named as well, where no other cause has a third of them: in three logs
with one wrong torque constant, and in none of 81 others."""
STEP = 1e-4  # of lengths, ratios and zeros, for derivatives
WRONG = 0.03  # logarithm of the largest factor below which a cause is not worth a word
TURNED = 0.15  # of a g: by which one linear step may change the size of gravity that is turned
NO_STEP = 0.8  # logarithm of a factor from which on one linear step tells nothing of it


def misfit(
    model: Model,
    rows: Sequence[RecordedRows],
    a: Sequence[Float[np.ndarray, "rows nv"]],
    left: Sequence[Float[np.ndarray, "rows nv"]],
    white: Callable[[Sequence[np.ndarray]], np.ndarray],
    fit: Fit,
) -> tuple[Doubt | None, Float[np.ndarray, " k"], float] | None:
    """The cause that explains most, if far more than `model`; how far the coordinates move with it; and nats.

    It has no doubt where less than `NAMED` is explained: what gears do beside a model is never one cause alone.

    `model` has the numbers of the fit, of torques of rows with accelerations `a` it leaves `left`, and `white` makes
    residuals of the fit of such torques. At x, causes c with columns C lower the whitened residual r (Frisch & Waugh
    1933): c = -(C' C - C' J F^-1 J' C + S^-2)^-1 C' (r - J F^-1 g) with F = J' J + prior, and x moves by -F^-1 J' C c.
    The gradient g is not 0 where a search ends before what cannot be, such as a payload that weighs less than nothing.
    """
    [actuation] = [law for law in model.laws if isinstance(law, Actuation)]
    r, J = fit.white.ravel(), fit.white_jacobian.reshape(fit.white.size, -1)
    inverse, cost = np.linalg.inv(fit.information + fit.prior_information), 0.5 * float(r @ r)
    beyond = r - J @ (inverse @ (J.T @ r + fit.prior_gradient))
    best, least, found, moving = 0.0, max(CLEARLY_MORE, LEAST * cost), None, model.robot.base != "fixed"
    scales = [10 * k for k, each in enumerate(rows[0].space.carried) if each.payload is not None]
    if np.linalg.norm(fit.residual) <= RIGHT * np.linalg.norm(0.5 * fit.jacobian[..., scales]):
        return None  # of the torques of payloads, next to nothing is left
    options = dict[str, tuple[Any, ...]]()
    for cause, (usual, _, _) in CAUSES.items():
        of_bodies = cause in ("masses", "centres of mass")
        if ((cause == "gains" or of_bodies) and not actuation.is_exact) or (cause != "gains" and moving):
            continue  # a factor of all masses is one of the gains that are estimated, or of all those of a base
        names, columns = zip(*(_columns(cause, model, *each) for each in zip(rows, a, left, strict=True)), strict=True)
        C = white(columns).reshape(r.size, -1)
        if not C.shape[1]:
            continue
        across, every = J.T @ C, np.arange(C.shape[1])
        own, slope = C.T @ C - across.T @ inverse @ across + np.eye(len(every)) / usual**2, C.T @ beyond
        tried = list[tuple[float, float, np.ndarray, np.ndarray]]()
        single = every.reshape(-1, 3 if cause in ("centres of mass", "gravity") else 1)
        for some in (*([] if moving or cause in (*ALONE, *ADDED) else [every]), *single):
            change = np.zeros(len(every))
            change[some] = -np.linalg.solve(own[np.ix_(some, some)], slope[some])
            more = -0.5 * float(slope @ change)
            tried.append((more - 0.5 * len(some) * np.log(r.size), more, change, -inverse @ (across @ change)))
        options[cause] = names[0], C, *max(tried, key=lambda each: each[0])
    most, fewest = max((more for _, _, _, more, *_ in options.values()), default=0.0), (0, 0.0)
    singly = {x: _instead(rows[0].space, fit, C, CAUSES[x][0], least, most) for x, (_, C, *_) in options.items()}
    others = max((nats for cause, (nats, _) in singly.items() if cause != "gains"), default=0.0)
    for cause, (names, _, worth, more, *changes) in options.items():
        _, said, do = CAUSES[cause]
        instead = singly[cause][1] if cause == "gains" and singly[cause][0] > FAR_BEHIND * others else None
        change, move = instead or changes
        # beside a payload that leaves nothing, a column is the torque as logged, and linear in the factor itself
        factors = 1.0 + change if instead else 1.0 / (1.0 - change) if cause == "gains" else np.exp(change)
        off, count = abs(change) > WRONG, int((change != 0.0).sum())
        fewer = cause not in ALONE and count < fewest[0]
        better = worth > best or (fewer and (more > fewest[1] or 1.1 * worth > best))
        clearly = instead is not None or (better and more > max(least, MOSTLY * cost * (cause in ALONE)))
        if cause == "gravity":  # it is turned, and no other
            down = model.robot.gravity.cpu().numpy() / 9.81
            size, along = float(np.linalg.norm(down + change)), 9.81 * (down + change)
            clearly &= abs(size - 1.0) < TURNED
            do = f"If the base is tilted: forcegp auto --gravity {','.join(f'{x / size:.2f}' for x in along)}."
        if cause in ALONE:
            at = int(np.argmax(abs(change)))
            do = do.replace("X * 1.2", f"X * {factors[at]:.3g}").replace("X + 0.1", f"X {change[at]:+.3g}")
        if clearly and off.any() and ALONE.get(cause, 0.0) < abs(change).max() < NO_STEP:
            factors, unit = (change, ADDED[cause]) if cause in ADDED else (factors, "")
            told = ", ".join(f"{factors[k]:.3g}{unit} ({names[k]})" for k in np.flatnonzero(off))
            less = f"leave {more / cost:.0%} less unexplained" if more < cost else "explain nearly all of it"
            less = less if instead is None else "do as well as any payload"
            doubt = look(
                about="payload",
                what=f"{said} {told} would {less}. The intervals hold what that would change.",
                do=do,
                joints=tuple(np.array(names)[off].tolist()),
                numbers={cause: {names[k]: float(factors[k]) for k in np.flatnonzero(change)}},
            )
            next_best = max((option[2] for name, option in options.items() if name != cause), default=0.0)
            alone = count == 1 and worth >= max(DECIDED, FAR_BEHIND * next_best)
            named = instead is not None or cause in ALONE or more >= NAMED * cost or alone
            best, fewest, found = 1.1 * worth, (count, more), (doubt if named else None, move, more)
            if instead is not None:
                break
    return found


def _instead(
    space: ParameterSpace, fit: Fit, C: Float[np.ndarray, "equations causes"], usual: float, least: float, most: float
) -> tuple[float, tuple[Float[np.ndarray, " causes"], Float[np.ndarray, " k"]] | None]:
    """Nats that one number explains without a payload; its change, and the move of x, where it does as well as one."""
    # so many numbers are no better than one that explains hardly less: `most` nats less than the best cause beside it
    r, J = fit.white.ravel(), fit.white_jacobian.reshape(fit.white.size, -1)
    none, slopes = np.zeros_like(fit.x), space.bodies.slopes(fit.x[: space.bodies.size])
    unknown = [k for k, law in enumerate(space.model.laws) if isinstance(law, Payload) and law.mass is None]
    for body in (k for k, each in enumerate(space.carried) if each.payload in unknown):
        own, rows = np.r_[space.bodies.slices[body]], slice(10 * body, 10 * body + 10)
        none[own] = -np.linalg.solve(slopes[rows, own], space.standard_parameters(fit.x)[body])
    free, left = np.flatnonzero(none == 0.0), r + J @ none
    curvature = (fit.information + fit.prior_information)[np.ix_(free, free)]
    slope, across = J[:, free].T @ (left - r), J[:, free].T @ C
    inner = np.linalg.solve(curvature, np.c_[slope, across])
    size = np.square(C).sum(0) - (across * inner[:, 1:]).sum(0) + usual**-2
    change = -(C.T @ left - across.T @ inner[:, 0]) / size
    explained = 0.5 * change**2 * size  # nats
    k = int(np.argmax(explained))
    more = explained[k] + 0.5 * (r @ r - left @ left + slope @ inner[:, 0])
    enough = max(least, MOSTLY * 0.5 * float(left @ left))  # of what is left without the payload
    if not none.any() or explained[k] < enough or more < max(-CLEARLY_MORE, most - least):
        return float(explained[k]), None
    none[free] -= inner[:, 0] + inner[:, 1 + k] * change[k]
    return float(explained[k]), (np.where(np.arange(len(change)) == k, change, 0.0), none)


def with_gravity(robot: Robot, gravity: Float[np.ndarray, "3"]) -> Robot:
    """The same robot under other gravity [m/s^2]."""
    along = torch.as_tensor(gravity, dtype=robot.tree.gravity.dtype, device=robot.device)
    fall = torch.zeros_like(robot.tree.fall)
    fall[:, 3, 0] = along
    return replace(robot, tree=replace(robot.tree, gravity=along, fall=fall))


def with_length(robot: Robot, body: int, factor: float) -> Robot:
    """The robot with this factor of what leads to the joint of a body."""
    rest = robot.tree.rest.clone()
    rest[body, :3, 3] *= factor
    return replace(robot, tree=replace(robot.tree, rest=rest))


def _columns(
    cause: str, model: Model, rows: RecordedRows, a: Float[np.ndarray, "rows nv"], left: Float[np.ndarray, "rows nv"]
) -> tuple[list[str], Float[np.ndarray, "rows nv causes"]]:
    """Names of joints or links, and derivatives of torques needed less those measured in logarithms of factors.

    Of gains they are as the log has them, which is linear in the factor's inverse: what is needed would vanish, too.
    """
    robot = model.loaded_robot if rows.loaded else model.robot
    if cause == "gains":
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
    if cause == "centres of mass":
        return [f"{body.child} along {axis}" for body in robot.layout.bodies for axis in "xyz"], rows.by_center(a)
    q, v, at = (torch.as_tensor(np.array(x), device=robot.device) for x in (rows.q, rows.v, a))
    if cause == "gravity":
        pulls = [with_gravity(robot, 9.81 * axis).gravity_forces(q).cpu().numpy() for axis in np.eye(3)]
        return [*"xyz"], np.stack(pulls, axis=-1)
    names, columns = [], []
    for joint, name in enumerate(robot.joint_names if cause in ALONE and robot.space.is_vector_space else ()):
        if cause == "joint zero" and robot.joint(name).type == "prismatic":
            continue
        one = STEP * torch.eye(robot.nv, dtype=q.dtype, device=q.device)[joint]
        there = (q + one, v, at) if cause == "joint zero" else (x + one * x for x in (q, v, at))
        names.append(name)
        columns.append((robot.inverse_dynamics(*there) - robot.inverse_dynamics(q, v, at)).cpu().numpy() / STEP)
    for body, drive in enumerate(() if cause in ALONE else robot.layout.drives):
        if robot.layout.parents[body] >= 0 and bool(robot.tree.rest[body, :3, 3].any()):
            change = with_length(robot, body, 1.0 + STEP).inverse_dynamics(q, v, at) - robot.inverse_dynamics(q, v, at)
            names.append(robot.joint_names[drive.joint])
            columns.append(change.cpu().numpy() / STEP)
    return names, np.stack(columns, axis=-1) if columns else np.zeros((*a.shape, 0))
