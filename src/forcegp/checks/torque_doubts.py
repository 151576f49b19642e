"""Doubts of torques beside those of the search: drift, elastic joints, delay, stops."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from forcegp.checks.check_input import QUICK_ROWS, CheckInput
from forcegp.checks.fits import EXPLAINED, RARELY
from forcegp.checks.search import DOUBTFUL, FEWEST_ROWS, HELD, SHORT, UNKNOWN, Explanation, held_at_rest
from forcegp.checks.torques import WIDTHS, Comparison, in_motion, regressor, stretch
from forcegp.data import Dataset, Delay, estimate_delay, with_strokes
from forcegp.data.delay import orthonormal
from forcegp.data.filters import shifted
from forcegp.data.views import consecutive, rests
from forcegp.doubts import Doubt, listed, look, ok, wrong
from forcegp.errors import DatasetError
from forcegp.fit.payloads import with_gravity
from forcegp.forces.presliding import after_strokes
from forcegp.model import Model
from forcegp.robots import Robot
from forcegp.summary import plain

LEAST_DELAY = 0.75  # time steps below which a delay is not reported
MUCH = 0.5  # a delay that leaves less of what was unexplained is wrong to leave in
BEYOND = 4.0  # of the frequency of the torque, from which on a resonance shows in none
BLOCKS = 8  # of time, every other of which is held out
SPRINGS, DAMPING = tuple(np.geomspace(1.0, 40.0, 24).tolist()), (0.02, 0.1, 0.3)
"""Resonances that are tried [Hz], and shares of critical damping."""
BELOW = 1.0 / 3.0  # of a resonance, where a robot is as good as rigid
MOST_ROWS = 2000  # on which that is judged
STIFFNESS = 50.0, 200.0, 800.0  # of what friction remembers, over the reciprocal deviation of positions
SURE, TELLS = 150.0, 30.0
"""Nats that a stretch of time in which something is touched explains: in all, or one of each row, and of a joint."""
TIMES = tuple(np.linspace(-0.45, 0.45, 37).tolist())  # shares of a log, from its middle, where friction may change
BRIEF = 0.05  # of the rows, the least for which a torque is another
ENDS = 5  # times that the ends of such a stretch are sought anew, as those that are most likely (Page 1954)
SEEN, WARMER = 1e-3, 0.1  # share of the largest direction of columns; logarithm of a ratio of friction that is told
PRESSED, IDLE = 0.1, 0.1
"""Of a joint's motion, where an end stop may hold it; of the deviation of its torque, below which its drive is off."""
RESTS = 0.05  # share of what the joints alone would move a point by, below which it stays where it is


def torque_doubts(inputs: CheckInput, found: Explanation) -> list[Doubt]:
    """Friction that drifts, and delay, of a log whose errors were corrected."""
    return [*_offsets(found, inputs), *_drift(found, inputs), *_delays(inputs, found.log)]


def _offsets(found: Explanation, inputs: CheckInput) -> Iterator[Doubt]:
    """Sliding joints whose mean force is not that of their weight, beyond dry friction."""
    rows, tau = found.log.rows, found.log.tau
    for joint in np.flatnonzero(~inputs.rotates & (np.ptp(rows.u, axis=0) > 0.0)):
        weight, missing = float(tau[:, joint].mean()), float((rows.u - tau)[:, joint].mean())
        spread = float((rows.u - tau)[:, joint].std())  # of dry friction, that of both directions
        if abs(missing) > max(spread, MUCH * abs(weight)):
            name = inputs.names[joint]
            what = f"the force of {name} is {missing:+.3g} N from that of its weight all the time: "
            more = missing * weight > 0.0
            what += "it holds a load" if more else "a gas spring or a counterweight carries it"
            what += ", or the sensor is off, or masses are wrong."
            do = (
                "See what forcegp payload finds."
                if more
                else "Give the robot's file the mass that is left, or subtract "
            )
            do += "" if more else "it from the column of u."
            yield look(about="offset", what=what, do=do, joints=(name,), numbers={"offset": missing, "weight": weight})


def _drift(found: Explanation, inputs: CheckInput) -> Iterator[Doubt]:
    """Friction that is another at the end of the log than at its beginning, in a robot of any masses.

    Blocks of time that are left out decide, of all joints together and the change in the median joint, or of each.
    Joints that mostly rest tell nothing: stiction holds any torque.
    """
    rows, count = found.log.rows, len(found.log.rows)
    if count < FEWEST_ROWS or found.log.drives is not None:  # which are joints once the log is corrected
        return
    bodies = regressor(found.log.robot, rows)
    time = (rows.time - rows.time.mean()) / max(float(np.ptp(rows.time)), 1e-300)
    block, changed, told, since = np.arange(count) * BLOCKS // count, *(dict[str, float]() for _ in range(3))
    friction_of = np.concatenate([found.log.friction, _remembered(found, inputs)], axis=-1)
    often = in_motion(rows).mean(axis=0) >= RARELY
    for joint in np.flatnonzero((found.chosen == 0) & (found.shares > DOUBTFUL) & often):
        u, friction, name = (rows.u - found.log.more)[:, joint], friction_of[:, joint], rows.joint_names[joint]
        steady, left = np.c_[bodies[:, joint], np.ones(count)], list[float]()
        for way in (ways := [0.0 * time, time, *(np.sign(time - x) / 2.0 for x in TIMES)]):
            if len(left) == 2 and left[1] >= MUCH * left[0] and found.rough[joint] <= EXPLAINED:
                break
            basis = orthonormal(np.c_[steady, friction, friction * way[:, None]], SEEN)
            numbers = [np.linalg.lstsq(basis[block != k], u[block != k])[0] for k in range(BLOCKS)]
            left.append(sum(np.square((u - basis @ x)[block == k]).sum() for k, x in enumerate(numbers)))
        most = min(MUCH * left[1], EXPLAINED**2 * count * u.var())  # what a step leaves, which explains all the rest
        if (best := int(np.argmin(left)) if min(left[2:], default=np.inf) < most else 1) > 1:
            since[name] = float(rows.time[np.argmax(ways[best] > 0.0)])
        moved = np.c_[friction, friction * ways[best][:, None]]
        told[name] = float(np.log(left[best] / max(left[0], 1e-300)))
        basis, size = orthonormal(steady, SEEN), np.linalg.norm(moved, axis=0) + 1e-300
        rest = (moved - basis @ (basis.T @ moved)) / size
        level, slope = np.split(np.linalg.lstsq(rest, u - basis @ (basis.T @ u), rcond=SEEN)[0] / size, 2)
        begin, end = (float(np.std(friction @ (level + x * slope))) for x in (-0.5, 0.5))
        changed[name] = end / max(begin, 1e-300)
    if sum(told.values()) >= np.log(MUCH) or abs(np.log(np.median([*changed.values()]))) <= WARMER:
        changed = {k: x for k, x in changed.items() if told[k] < np.log(MUCH) and abs(np.log(x)) > WARMER}
    if changed:
        when = {name: f", from about {since[name]:.3g} s on" for name in changed if name in since}
        each = ", ".join(f"{name} {ratio:.2g}{when.get(name, '')}" for name, ratio in changed.items())
        why = "as of a bearing, a gear or a brake" if when else "perhaps with temperature"
        what = f"friction changes, {why}: at the end it is so many times the first: {each}."
        do, span = "Record the warm robot; updates of a posterior follow the level of friction.", list[float]()
        for name in [*when][:1]:
            x, (begin, end) = since[name], inputs.log.time[[0, -1]].tolist()
            wide = np.ptp(rows.time).item() / len(TIMES)  # as far as it may be off
            span = [begin, x + wide] if x - begin < end - x else [x - wide, end]
            do = f"Leave a part out by forcegp import LOG --without {span[0]:.2f},{span[1]:.2f}, as forcegp auto does."
        numbers = {"ratio": changed, **({"seconds": span} if span else {})}
        yield look(about="drift", what=what, do=do, joints=tuple(changed), numbers=numbers)


def elastic_doubts(inputs: CheckInput, log: Comparison) -> list[Doubt]:
    """Joints whose torque shows a gear that gives way, beyond what rigid links and a delay tell.

    With a stiffness k between rotor J and link, u = tau + J a + (J / k) tau'' where the encoder is at the link (Spong
    1987, J. Dyn. Sys. Meas. Control 109). Where it is at the motor, the spring passes on tau as `_behind_spring`.
    """
    rows = inputs.sharper or inputs.compared  # the cut-off that a rigid robot asks for lies below the resonance
    if rows is None or not rows.time_ordered or np.unique(rows.episode, return_counts=True)[1].min() < FEWEST_ROWS:
        return []  # without an order, or too short to be differentiated
    log = replace(log, rows=log.changed(rows))
    rows, found = log.rows, dict[str, float]()
    slopes, bends = np.zeros_like(log.tau), np.zeros_like(log.tau)
    for own in (rows.episode == number for number in rows.episodes):
        slopes[own] = np.gradient(log.tau[own], rows.time[own], axis=0)
        bends[own] = np.gradient(slopes[own], rows.time[own], axis=0)
    some = slice(None, None, max(1, len(rows) // MOST_ROWS))
    passed = {(f, d): _behind_spring(log.tau, rows, f, d)[some] for f in SPRINGS for d in DAMPING}
    smooth = [_behind_spring(log.tau, rows, f, both_ways=True)[some] for f in SPRINGS]  # of less noise, and rigid
    tau, slopes, bends, friction, every = log.tau[some], slopes[some], bends[some], log.friction[some], rows.u[some]
    fitted = np.arange(len(tau)) * BLOCKS // len(tau) % 2 == 0

    def left(u: np.ndarray, *columns: np.ndarray) -> tuple[float, np.ndarray]:
        """What every other block leaves of the others, and the numbers."""
        each, missed, number = np.c_[*columns, np.ones(len(u))], 0.0, np.zeros(0)
        each = each / (np.linalg.norm(each, axis=0) + 1e-300)
        for part in (fitted, ~fitted):
            number = np.linalg.lstsq(each[part], u[part], rcond=1e-9)[0]
            missed += np.square(u[~part] - each[~part] @ number).sum()
        return missed, number

    for j, name in enumerate(inputs.names):
        u, rigid = every[:, j], (tau[:, j], slopes[:, j], friction[:, j])
        least = MUCH * min(left(u, *rigid)[0], *(left(u, x[:, j], friction[:, j])[0] for x in smooth))
        if least <= MUCH * DOUBTFUL * np.square(u - u.mean()).sum():
            continue
        missed, number = left(u, bends[:, j], *rigid)
        beyond = np.sqrt(max(number[1], 0.0) / max(number[0], 1e-300))
        at_motor = {spring: left(u, x[:, j], friction[:, j])[0] for spring, x in passed.items()}
        hertz = min(at_motor, key=at_motor.__getitem__)[0]
        if missed < least and 0.0 < beyond < BEYOND:
            moved = np.sqrt(np.linalg.norm(bends[:, j]) / (np.linalg.norm(tau[:, j]) + 1e-300))  # rad/s
            found[name] = float(beyond * moved) / (2.0 * np.pi)
        elif min(at_motor.values()) < least and SPRINGS[0] < hertz < SPRINGS[-1]:
            found[name] = hertz
    if not found:
        return []
    cutoff = BELOW * min(found.values())
    what = "the torque grows with the frequency as behind an elastic gear, with a resonance near "
    what += f"{', '.join(f'{hertz:.2g} Hz ({name})' for name, hertz in found.items())}."
    do = f"No rigid model predicts motions near it: filter by forcegp import --cutoff {cutoff:.2g}."
    return [
        look(
            about="elastic joint", what=what, do=do, joints=tuple(found), numbers={"resonance": found, "cutoff": cutoff}
        )
    ]


def _behind_spring(
    tau: np.ndarray, rows: Dataset, hertz: float, damping: float = 0.7, both_ways: bool = False
) -> np.ndarray:
    """What reaches the motor of the torque that its motion asks for: x'' + 2 d w x' + w^2 x = w^2 tau, by Tustin."""
    # `both_ways` it is no spring, but a filter without delay
    from scipy.signal import bilinear, filtfilt, lfilter, lfilter_zi  # half a second, which only few logs should cost

    passed, rate = tau.copy(), 1.0 / float(np.median(np.diff(rows.time)))
    w = 2.0 * rate * np.tan(np.pi * min(hertz / rate, 0.4))
    b, a = bilinear([w * w], [1.0, 2.0 * damping * w, w * w], rate)
    for own in (rows.episode == number for number in rows.episodes):
        x, start = tau[own], lfilter_zi(b, a)[:, None] * tau[own][:1]
        passed[own] = filtfilt(b, a, x, axis=0) if both_ways else lfilter(b, a, x, axis=0, zi=start)[0]
    return passed


def _delays(inputs: CheckInput, log: Comparison) -> Iterator[Doubt]:
    if inputs.prepared is None:
        return  # without an order
    quick = inputs.most_rows == QUICK_ROWS
    delay = _delay(log.changed(inputs.even if quick else inputs.prepared), log.robot, None if quick else inputs.cutoff)
    if delay is None:
        return
    seconds, remains, lag = delay.significant, delay.remains, delay.lag
    how = f"{1e3 * abs(seconds):.1f} ms ± {1e3 * delay.common_std:.1f} ms {'later' if seconds > 0.0 else 'earlier'} "
    how = f"{delay.behind} ({1e3 * lag:.3g} ms); without it" if lag else f"{how}than the motion needs it; shifted"
    if lag or abs(seconds) > LEAST_DELAY * float(np.median(np.diff(inputs.even.time))):
        numbers = {"delay": seconds, "std": delay.common_std, "remains": remains, "per_joint": plain(delay.seconds)}
        yield Doubt(
            level="wrong" if remains < MUCH else "look", about="delay",
            what=f"the torque of all joints is logged {how}, {100.0 * remains:.2g} % of what was unexplained remains.",
            do="forcegp import --delay auto; a filter of the robot's own, of the torque or of the motion, does this.",
            joints=inputs.names, numbers=numbers | ({"lag": lag} if lag else {}),
        )  # fmt: skip


def _delay(data: Dataset, robot: Robot, cutoff: float | None = None) -> Delay | None:
    """That of a log of torques; None where it is too short."""
    with contextlib.suppress(DatasetError):
        return estimate_delay(replace(data, model=Model(robot)), cutoff)
    return None


def push(found: Explanation, inputs: CheckInput, since: float, until: float) -> Iterator[Doubt]:
    """A stretch between two times, or up to those known, in which torques of several joints fit no masses at all."""
    rows, place = found.log.rows, np.arange(len(found.log.rows))
    ones, smeared = np.ones((len(rows), 1)), 1.5 / inputs.compared_cutoff
    if len(rows) < FEWEST_ROWS:
        return
    more = _remembered(found, inputs)  # friction that remembers looks like a push where a joint hardly moves
    held = np.stack([held_at_rest(found, joint) for joint in range(rows.nv)], axis=1)

    def left_of(told: np.ndarray | None = None) -> np.ndarray:
        left = found.left_beside(more, told)
        others = np.square(left).mean(axis=0, where=~held | held.all(axis=0))
        return np.where(held, np.sqrt(others), left)  # stiction holds anything: such rows tell neither for nor against

    left, tried = left_of(), list[tuple[float, int, int, np.ndarray, np.ndarray]]()
    for own in left.T[left.any(axis=0)]:
        *_, first, last = stretch(np.hstack([ones, -ones, own[:, None]]))
        # in the middle of the log, a quarter of it at most, and longer than what a filter makes of a turn
        short = 4 * (last - first) <= len(rows)
        if short and first > 0 and last < len(rows) and rows.time[last - 1] - rows.time[first] > smeared:
            inside = (place >= first) & (place < last)
            power = np.stack([np.square(left[each]).mean(0) + 1e-300 for each in (inside, ~inside, slice(None))])
            told = inside.sum() * np.log(power[2] / power[0]) + (~inside).sum() * np.log(power[2] / power[1])
            gains = told * (power[0] > power[1])
            tried.append((float(gains.sum()), first, last, gains, np.sqrt(power[0] / power[1])))
    most, first, last, gains, times = max(tried, key=lambda each: each[0], default=(0.0, 0, 0, ones, ones))
    joints = np.flatnonzero(gains > TELLS)
    if most <= min(SURE, len(rows)) or len(joints) < 2 or rows.time[last - 1] < since or rows.time[first] > until:
        return
    for _ in range(ENDS):  # what is touched tells no masses, and hides behind those that fit it as well
        inside = (place >= first) & (place < last)
        left = np.square(left_of(~inside)[:, joints])
        power = np.stack([left[each].mean(0) + 1e-300 for each in (inside, ~inside)])
        likely = left * (1.0 / power[1] - 1.0 / power[0]) - np.log(power[0] / power[1])
        total = np.append(0.0, np.cumsum((likely * ~held[:, joints]).sum(axis=1)))
        end = len(rows) - int(np.argmax((total - np.minimum.accumulate(total))[::-1]))  # the last, after rows at rest
        begin = int(np.argmin(total[: end + 1]))
        if (begin, end) == (first, last) or not 1 < end - begin <= len(rows) // 4:
            break
        first, last = begin, end
    begin, end = rows.time[first] - smeared, rows.time[last - 1] + smeared
    begin, end = (y if np.isfinite(y) else x for x, y in zip((begin, end), (since, until), strict=True))
    yield look(
        about="push",
        what=f"from {begin:.4g} to {end:.4g} s the torques of {listed(inputs.named(joints))} are up to "
        f"{times[joints].max():.2g} times as far from any masses and friction as elsewhere: a contact or a load.",
        do=f"Leave them out by forcegp import LOG --without {begin:.2f},{end:.2f}, as forcegp auto does.",
        joints=inputs.named(joints),
        numbers={"seconds": [float(begin), float(end)], "gains": gains[joints].tolist()},
    )


def jump(found: Explanation, inputs: CheckInput) -> Iterator[Doubt]:
    """The torque of one joint that is another by a constant from some time on, beside any masses and friction."""
    rows, place = found.log.rows, np.arange(len(found.log.rows))[:, None]
    if len(rows) < FEWEST_ROWS or len(rows.episodes) > 1:
        return
    left = found.left_beside(more := _remembered(found, inputs))
    after = np.cumsum(left[::-1], axis=0)[::-1]  # of all rows from each on
    spread = place * (1.0 - place / len(rows))  # a few rows at an end show what friction was at before the log
    begins = np.argmax(np.square(after) / np.maximum(spread, 1.0) * (spread > BRIEF * len(rows)), axis=0)
    step = place >= begins
    beside = found.left_beside(np.concatenate([more, step[..., None]], axis=-1))
    powers = [np.square(x).sum(axis=0) + 1e-300 for x in (left, beside)]
    nats = 0.5 * len(rows) * np.log(powers[0] / powers[1])
    joint = int(np.argmax(nats))
    if nats[joint] <= SURE or (np.delete(nats, joint) > TELLS).any():  # a load that is let go shows in several joints
        return
    size = float((powers[0] - powers[1])[joint] / (left * step).sum(axis=0)[joint])
    name, time, smeared = inputs.names[joint], rows.time[begins[joint]], 1.5 / inputs.compared_cutoff
    begin, end = inputs.log.time[[0, -1]]
    begin, end = (begin, time + smeared) if 2 * begins[joint] < len(rows) else (time - smeared, end)
    yield look(
        about="offset",
        what=f"the torque of {name} is {size:+.3g} {inputs.unit_of_each('u')[joint]} from what it was before, from "
        f"{time:.4g} s on: its sensor or amplifier has another zero{'' if inputs.rotates[joint] else ', or a load'}.",
        do=f"Leave the shorter part out by forcegp import LOG --without {begin:.2f},{end:.2f}, as forcegp auto does.",
        joints=(name,),
        numbers={"offset": size, "seconds": [float(begin), float(end)], "nats": float(nats[joint])},
    )


def _remembered(found: Explanation, inputs: CheckInput) -> Float[np.ndarray, "rows nv k"]:
    """What dry friction of each joint remembers, under each of `STIFFNESS`."""
    assert inputs.compared is not None
    rows, dense = found.log.rows, with_strokes(found.log.changed(inputs.compared))
    if dense.strokes is None:
        return np.zeros((*rows.q.shape, 0))
    long = float(np.ptp(dense.time)) + 1.0  # a delay that was corrected moves rows in time
    at = np.searchsorted(dense.time + long * dense.episode, rows.time + long * rows.episode)
    past, spread = torch.tensor(dense.strokes[at.clip(0, len(dense) - 1)]), np.maximum(rows.q.std(axis=0), 1e-9)
    return np.stack([after_strokes(past, torch.tensor(each / spread)).numpy() for each in STIFFNESS], axis=-1)


def held_points(inputs: CheckInput) -> list[Doubt]:
    """The link that stays where it is although joints move that carry it: something holds it, and no model says so."""
    rows, robot = inputs.rows(), inputs.robot
    q, moved = torch.tensor(rows.q, device=robot.device), rows.q - rows.q.mean(axis=0)
    moved = np.where(inputs.rotates, moved.clip(-1.0, 1.0), moved)  # rad: a lever moves nothing farther than its length
    kinematics, found = robot.kinematics(q), list[tuple[float, str, np.ndarray]]()
    for link in robot.layout.links:
        position = kinematics.frame_pose(link)[:, :3, 3].cpu().numpy()
        J = kinematics.frame_jacobian(link)[:, :3].cpu().numpy()
        alone = np.sqrt(np.square(J * moved[:, None]).sum(axis=1).mean(axis=0))  # m, what each joint would move it by
        carried = float(np.sqrt(np.square(alone).sum()))
        if (alone > MUCH * alone.max()).sum() > 1 and carried > 0.0:
            found.append((float(np.sqrt(position.var(axis=0).sum())) / carried, link, alone))
    share, link, alone = min(found, key=lambda each: each[0], default=(np.inf, "", np.zeros(0)))
    if share > RESTS:
        return []
    joints = inputs.named(np.flatnonzero(alone > MUCH * alone.max()))
    what = f"{link} stays where it is, within {1e3 * share * np.sqrt(np.square(alone).sum()):.2g} mm, although "
    what += f"{listed(joints)} would move it by up to {1e3 * alone.max():.3g} mm each: something holds it, and "
    what += "its force is missing beside the torques."
    do = f"Free motion needs no contact. Of this log: forcegp fit --contact {link}:held, with columns of a force "
    do += f"sensor there by forcegp import --force {link}=fx,fy,fz."
    return [wrong(about="contact", what=what, do=do, joints=joints, numbers={"share": share})]


TOUCHES = ok(
    about="torque",
    what="not compared with inverse dynamics: the robot touches something, and the forces of contacts are not known. "
    "Check free motion, too.",
)


def without_stops(log: Dataset, model: Model | None = None, late: bool = True) -> tuple[Dataset, list[Doubt]]:
    """The log without rests whose torques are not those of this posture, and what is said of them.

    Torques in motion say what a posture needs, under any gravity and with any masses, also where they are `late`.
    """
    model = log.model if model is None else model
    plain = log.time_ordered and not model.robot.layout.groups and not model.contacts and log.u.shape == log.v.shape
    found = rests(log) if plain else []
    if not found or sum(map(len, found)) > len(log) // 2:
        return log, []
    still = np.unique(np.concatenate(found))
    inputs, at = CheckInput.quick(_cut(log, still), model), log.rows(still)
    held = np.zeros(at.v.shape, dtype=bool)
    compared = inputs.mended if inputs.compared is None else inputs.compared
    rows = replace(inputs, compared=compared, most_rows=1000).rows()
    columns, standing = _needs(inputs.robot, rows), _needs(inputs.robot, at)
    ends = [np.flatnonzero(log.episode == log.episode[rest[0]])[[0, -1]] for rest in found]
    long = (np.ptp(log.time[rest]) > SHORT for rest in found)
    outer = [np.abs(x[[0, -1]] - y).min() < FEWEST_ROWS and z for x, y, z in zip(found, ends, long, strict=True)]
    idle = np.isin(still, np.concatenate([still[:0], *(x for x, at_end in zip(found, outer, strict=True) if at_end)]))
    places = [np.searchsorted(still, x) for x in found]
    for k, (u, v, a, moves) in enumerate(zip(rows.u.T, rows.v.T, rows.a.T, in_motion(rows).T, strict=True)):
        slow = np.sqrt(np.square(v).mean()) + 1e-300
        if slow < 1e-9 * np.abs(rows.v).max():  # but for rounding it never moves: what holds it bears what it must
            continue
        dry = np.stack([np.tanh(v / (width * slow)) for width in WIDTHS], axis=1)
        both = np.c_[columns[:, k], a, v, dry]
        slides = moves | (moves.sum() < both.shape[1])  # elsewhere stiction holds it, which may be less than friction
        size = np.linalg.norm(both[slides], axis=0) + 1e-300
        basis, sizes, turn = np.linalg.svd(both[slides] / size, full_matrices=False)
        seen, count = sizes > 1e-6 * sizes[0], columns.shape[-1]
        inverse = turn[seen].T / sizes[seen]
        number = inverse @ (basis[:, seen].T @ u[slides]) / size
        far = np.square(standing[:, k] / size[:count] @ inverse[:count]).sum(axis=1)  # a posture unlike those of motion
        most = np.abs(dry @ number[-len(WIDTHS) :]).max() + np.std((u - both @ number)[slides])
        unsure = np.where(idle, 1.0, np.sqrt(1.0 + far))  # but before and behind all motion, of which none is lost
        away = np.abs(at.u[:, k] - standing[:, k] @ number[:count]) / (most * unsure)
        usual = float(np.median([np.median(away[rest]) for rest in places]))  # of filters, and of motors that hold on
        held[:, k] = away > HELD * (max(usual, 1.0) if usual < HELD else 1.0)
        for rest in places:  # in one posture, once it has settled, where stiction of both ways changes less
            settled = rest[min(len(rest) // 5, 2 * FEWEST_ROWS) :]
            u = at.u[settled, k]
            ends = np.median(u[:FEWEST_ROWS]), np.median(u[-FEWEST_ROWS:])
            held[settled, k] |= (np.abs(np.subtract.outer(u, ends)) > HELD * most).any(axis=1)
    stops = [each for each, rest in zip(found, places, strict=True) if held[rest].any(axis=1).mean() > 0.5]
    if not stops:
        return log, []
    delay = _delay(inputs.even, model.robot) if late else None
    if delay and delay.significant and not without_stops(shifted(log, delay.significant), model, late=False)[1]:
        return log, []
    out = np.unique(np.concatenate(stops))
    why = "brakes hold the robot, its drives are off, or they bear what stiction holds"
    for k in np.flatnonzero((alone := held[np.isin(still, out)].mean(axis=0) > 0.5) & (alone.sum() == 1)):
        for end in (log.q[:, k].min(), log.q[:, k].max()):
            there = np.abs(log.q[:, k] - end) <= PRESSED * np.ptp(log.q[:, k])
            pressed = there[out].all() and not there.all()  # elsewhere it was, too
            if pressed and np.abs(log.u[out, k]).mean() > IDLE * log.u[:, k].std():
                out = np.union1d(out, np.flatnonzero(there))
                why = f"{inputs.names[k]} is held at an end of its motion, {end:.3g} {inputs.unit_of_each('q')[k]}, as "
                why += "by an end stop or a contact; all rows near that end are left out"
    pieces = np.split(kept := np.setdiff1d(np.arange(len(log)), out), np.flatnonzero(np.diff(kept) > 1) + 1)
    out = np.unique(np.concatenate([out, *(each for each in pieces if len(each) < FEWEST_ROWS)]))  # none to learn from
    apart = (np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) for rows in (out, np.unique(np.concatenate(stops))))
    spans, rested = ([log.time[each[[0, -1]]].tolist() for each in some] for some in apart)
    what = f"all joints stand still from {', '.join(f'{x:.4g} to {y:.4g}' for x, y in rested)} s, and their torques "
    what += f"are not those that this posture needs by what the motion tells: {why}."
    do = "These rows are left out of all checks, and of forcegp auto; of other fits leave them out yourself."
    return _cut(log, out), [look(about="stop", what=what, do=do, numbers={"seconds": spans})]


def without_pushes(log: Dataset, doubts: Sequence[Doubt]) -> Dataset:
    """The log without the seconds of pushes and loads; where times of episodes repeat, as it is."""
    kinds = "push", "load", "offset", "drift", UNKNOWN
    seen = [each for each in doubts if each.about in kinds and "seconds" in each.numbers]
    spans = np.array([x for each in seen if (np.diff(log.time) > 0.0).all() for x in each.numbers["seconds"]])
    touched = [np.flatnonzero((log.time >= begin) & (log.time <= end)) for begin, end in spans.reshape(-1, 2)]
    if not touched:
        return log
    left = _cut(log, np.concatenate(touched))
    long = [each for each in left.episodes if np.ptp(left.time[left.episode == each]) > SHORT]
    return left.rows(np.isin(left.episode, long)) if long else left


def _cut(log: Dataset, rows: np.ndarray) -> Dataset:
    """Without these rows; what was before and behind them are episodes."""
    kept = ~np.isin(np.arange(len(log)), rows)
    begins = np.diff(kept, prepend=True) | ~np.insert(consecutive(log)[:-1], 0, True)
    return replace(log.rows(kept), episode=np.cumsum(begins)[kept])


def _needs(robot: Robot, rows: Dataset) -> np.ndarray:
    """What bodies of any mass need under any gravity, and an offset (rows, nv, k)."""
    q, v, a = (torch.tensor(x, device=robot.device) for x in (rows.q, rows.v, rows.a))
    bases = [with_gravity(robot, each).kinematics(q, v) for each in (np.zeros(3), *np.eye(3))]
    parts = [each.torque_regressor(a).flatten(-2).detach().cpu().numpy() for each in bases]
    return np.concatenate([*parts, np.ones((*rows.v.shape, 1))], axis=-1)
