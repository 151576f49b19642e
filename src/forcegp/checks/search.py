"""One search over all causes: which of them, one after the other, leave of the torques what a good log leaves."""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
from jaxtyping import Bool

from forcegp.checks.causes import CLOSE, PREFIXES, SIGN, changed, like_units
from forcegp.checks.check_input import CheckInput
from forcegp.checks.explanations import candidates
from forcegp.checks.fits import EXPLAINED, FAR, FEWEST_ROWS, MUCH_MORE, NOISE, RESTS, WORSE, Explanation
from forcegp.checks.residuals import cogging, left_by_positions
from forcegp.checks.torques import LEAST, WIDTHS, Comparison, in_motion, positive_fit, stretch, torque_noise
from forcegp.data import Dataset
from forcegp.data.views import runs, white_noise
from forcegp.doubts import Doubt, listed, look, wrong
from forcegp.evidence import Torques, motion_residuals
from forcegp.fit import fit
from forcegp.forces import Actuation, Coulomb, Offset, RigidBodies, Rotor, Viscous
from forcegp.model import Model

UNKNOWN = "unknown cause"
BRAKED = 1e-3  # rad or m of a joint that no row moves
GAIN = np.log(4.0)  # by which the product over all joints of what remains must fall at least
LOADED = 5.0  # factor by which a load, too, changes what the motion needs
BEAM, DEPTH = 3, 3  # explanations that are continued, and causes of one
DOUBTFUL = 2e-3  # share above which causes are tried
HELD = 3.0  # of the dry friction and of what remains in motion, from which on no gear holds the joint
WIDER = 0.0, 0.02, 0.03, 0.05  # of the log: by which its ends are moved, one after the other
MOSTLY = 0.75  # share of what is left that sits somewhere
UNCHANGED = 0.8  # share of steps without any change of a position, from which on its encoder may be dead
SHORT = 2.0  # s, of what stays between pushes, which filters and splits have no use for; of rests at the ends of a log
AT_END, STOPPED = (0.01, 0.02, 0.05), 5  # of a joint's motion, within which a stop holds it; rows there, at least


def search(inputs: CheckInput) -> tuple[Explanation, list[Doubt]]:
    """The explanation that stands, or the log as it is; and what is to be said of it."""
    root = _root(inputs)
    few = len(root.log.rows) < FEWEST_ROWS
    if few or (root.shares <= np.maximum(NOISE * root.floor, DOUBTFUL)).all():
        return root, []
    every = frontier = [root.with_signs(), *([root] if root.with_signs().turned else [])]  # a spring looks like a sign
    for _ in range(DEPTH):
        grown: list[Explanation] = []
        for now in frontier:
            for cause, log in candidates(now.log, inputs, now.shares > DOUBTFUL, now.factors, not now.causes):
                before = {k for each in now.causes if "mix" in each.correction for k in each.joints}
                if "mix" in cause.correction and (now.turned or before & {*cause.joints}):
                    continue  # sums of torques that were turned before are others, and sums of sums may undo them
                order = cause.correction.get("order", {}).get("u", range(len(now.chosen)))
                turned = tuple(k for k, place in enumerate(order) if place in now.turned)
                made = Explanation(log, root.floor, (*now.causes, cause), turned).with_signs()
                before = now.value if cause.number else max(now.value, now.unscaled)  # mistakes first, factors then
                if made.value < before - 0.5 * GAIN:
                    grown.append(made)
        every, frontier = every + grown, sorted(grown, key=lambda each: each.value)[:BEAM]
        if not grown or (frontier[0].shares <= np.maximum(NOISE * root.floor, DOUBTFUL)).all():
            break
        if frontier[0].value > root.plain - GAIN and root.good.all():
            break  # of a good log, of which no cause explains much, two explain no more
    every.sort(key=lambda each: each.value)
    sticking = cache(lambda: (root.rough > EXPLAINED) & [_sticks(root, k) for k in range(len(root.floor))])
    for best in every:
        near = best.value < every[0].value + 2.0 * GAIN
        clear = (np.log(np.clip(root.shares, LEAST, 1.0) / np.maximum(best.exact, LEAST)) >= GAIN).any()
        scaled = all(x.number or "unit" in x.correction for x in best.causes)  # else it explains more than factors do
        gain = min(root.plain, np.inf if scaled else root.value) - best.value
        if near and clear and gain >= GAIN and best.stands(root, sticking()):
            return best, list(_said(best, root, inputs))
    signs = root.with_signs()
    sure = [k for k in signs.turned if signs.good[k]]
    if sure:
        factor = np.where(np.isin(np.arange(len(root.floor)), sure), -1.0, 1.0)
        root = replace(root, log=root.log.after(changed("u", factor=factor)), turned=tuple(sure))
    for cause, log in () if sure else cogging(root.log, inputs, root.shares > DOUBTFUL):  # of one joint, too
        if (best := Explanation(log, root.floor, (cause,))).shares[[*cause.joints]].max() <= EXPLAINED:
            return best, list(_said(best, root, inputs))
    said = [*_signs(root, inputs), *_factors(root, inputs, explained=False), *_unknown(root, inputs)]
    if said and not sure and (turned := _all_turned(root, inputs)):
        return turned
    return root, said


def _all_turned(root: Explanation, inputs: CheckInput) -> tuple[Explanation, list[Doubt]] | None:
    """Every torque turned, where bodies and friction that can exist then leave far less; None where they do not."""
    # masses of a robot's file may be too wrong for any single cause. Friction brakes and inertia resists in any robot
    log, left = root.log, list[np.ndarray]()
    moving = np.ptp(log.rows.u, axis=0) > 0.0
    least, turned = GAIN + SIGN * moving.sum(), np.maximum(root.turned_free[moving], LEAST)
    if turned.mean() > RESTS or np.log(root.shares[moving] / turned).sum() < least:
        return None  # not even masses that cannot exist explain the turned ones, or hardly better
    laws = Actuation(), RigidBodies("all"), *(Law() for Law in (Viscous, Coulomb, Offset, Rotor))
    for sign in (-1.0, 1.0):
        rows = replace(log.rows, u=sign * log.rows.u, model=Model(log.robot, (), laws), measured={})
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of numbers that these rows do not show
            found = fit(rows.model, rows, Torques())
        left.append(motion_residuals(rows, found.model)[0][:, moving].var(axis=0) / rows.u[:, moving].var(axis=0))
    after, before = (100.0 * each.mean() for each in left)
    if np.log(left[1] / left[0]).sum() < least or left[0].mean() > RESTS:
        return None
    what = "the torques of all joints have the opposite sign of what any robot of these lengths needs: bodies and "
    what += f"friction that can exist leave {before:.2g} % of a torque, and {after:.2g} % of the turned one (mean of "
    what += "joints). Masses of the robot's file are wrong as well."
    do = "Turn u; forcegp fit --forces bodies finds the masses."
    doubt = wrong(
        about="torque sign", what=what, do=do, joints=inputs.names, correction={"sign": {"u": (-1.0,) * log.rows.nv}}
    )
    return replace(root, log=log.with_torques(changed("u", factor=-1.0)), turned=tuple(range(log.rows.nv))), [doubt]


def moving(rows: Dataset) -> Dataset:
    """The rows in which some joint moves. All, where they are too few."""
    moves = np.flatnonzero(in_motion(rows).any(axis=1))
    return rows.rows(moves) if len(moves) >= FEWEST_ROWS else rows


def _root(inputs: CheckInput) -> Explanation:
    rows = moving(inputs.rows())
    rows = replace(rows, u=np.where(np.ptp(rows.q, axis=0) < BRAKED, 0.0, rows.u))  # no motor measures what brakes hold
    log = Comparison(robot=inputs.robot, laws=inputs.laws, rows=rows, given=rows).after(changed())
    seen = white_noise(inputs.mended, signal="u") if inputs.log.time_ordered else None
    noise = np.zeros(log.rows.nv) if seen is None else np.nan_to_num(seen)
    if np.isfinite(inputs.compared_cutoff):
        noise = noise * np.sqrt(min(1.0, 2.0 * inputs.compared_cutoff * float(np.median(np.diff(inputs.even.time)))))
    of_motion = 0.0 if inputs.compared_noise is None else torque_noise(inputs.robot, log.rows, inputs.compared_noise)
    power = np.maximum(np.square(log.rows.u - log.rows.u.mean(axis=0)).mean(axis=0), 1e-300)
    return Explanation(log, (np.square(noise) + np.square(of_motion)) / power)


def _said(best: Explanation, root: Explanation, inputs: CheckInput) -> Iterator[Doubt]:
    """A doubt for every cause, in the order in which they are to be corrected."""
    before, after = 100.0 * np.minimum(root.shares, 1.0), 100.0 * best.exact  # predicting nothing leaves all
    most = int(np.argmax(before - after))  # where they explain most
    then = f"; then {after[most]:.2g} % of the torque of {inputs.names[most]} remain, instead of {before[most]:.3g} %."
    for cause in best.causes:
        if cause.about != "delay":
            told = {"joints": inputs.named(cause.joints), "numbers": cause.numbers, "correction": cause.correction}
            yield Doubt(level=cause.level, about=cause.about, what=cause.what + then, do=cause.do, **told)
    yield from _signs(best, inputs)
    yield from _factors(best, inputs)


def _signs(best: Explanation, inputs: CheckInput) -> Iterator[Doubt]:
    if best.turned:
        joints, nv = inputs.named(best.turned), len(inputs.names)
        yield Doubt(
            level="wrong",
            about="torque sign",
            what=f"the torque of {'all joints' if len(joints) == nv else listed(joints)} has the opposite sign of what "
            f"the motion needs (then at most {100.0 * float(best.exact[[*best.turned]].max()):.2g} % of it remains).",
            do="Turn the joint's whole motion if its axis in the URDF points the other way.",
            joints=joints,
            correction={"sign": {"u": tuple(-1.0 if k in best.turned else 1.0 for k in range(nv))}},
        )


def _factors(best: Explanation, inputs: CheckInput, *, explained: bool = True) -> Iterator[Doubt]:
    """Torques that are a multiple of what the motion needs; of a log that is not `explained` those of several joints.

    Friction may hide those of the others, as where u is a current.
    """
    # far less than bodies need is wrong, whatever rotors and friction may hide of it
    factors = np.where(best.shares > WORSE, best._fits[1][np.arange(len(best.chosen)), best.chosen % 2], best.factors)
    off = np.flatnonzero((best.chosen >= 2) & np.isfinite(factors))
    like: Sequence[str] = ()
    if not explained:
        off = off[(best.exact[off] <= EXPLAINED) & (best.shares[off] > RESTS)]
        off, like = (off, like) if len(off) > 1 else _alike(best, inputs)
    if len(off) < (1 if explained else 2):
        return
    less = next((u for u, s in PREFIXES if all(1.0 / LOADED < abs(x) / s < LOADED for x in factors[off])), "")
    units = [less * (k in off) + si for k, si in enumerate(inputs.unit_of_each("u"))]
    unit = units[0] if len({*units}) == 1 else ",".join(units)
    loaded = f"With a load it may be in {unit}: forcegp import --unit u={unit}. " if less and not like else ""
    joints, errors = inputs.named(off), np.array([*map(best.error_of_factor, off.tolist())])
    most = best.log.rows.u[:, off].std(axis=0) / best.log.tau[:, off].std(axis=0)  # where friction hides any factor
    factors, errors = (np.where(factors[off] > 0.0, x, most) for x in (factors[off], errors))
    each = ", ".join(f"{name} {x:.4g} ± {error:.1g}" for name, x, error in zip(joints, factors, errors, strict=True))
    yield Doubt(
        level="wrong" if not explained or factors.min() < 1.0 / FAR or factors.max() > MUCH_MORE else "look",
        about="torque constant" if len(off) == 1 else "torque unit",
        what=f"the measured torque is a multiple of what the motion needs, if masses are right: {each}"
        f"{f': it looks like {listed(like)}' if like else ''}.",
        do=f"{loaded}Such factors point to torque before the gears (multiply by the gear ratio), motor current "
        f"(multiply by the torque constant), % of rated torques ({', '.join(f'{100 / x:.3g}' for x in factors)}), "
        "a missing rotor inertia, or wrong masses; compare with the data sheet, or let forcegp payload --forces "
        "gain,viscous,gear,offset,rotor estimate the constants of all joints.",
        joints=joints,
        numbers={"factor": dict(zip(joints, factors.tolist(), strict=True)), "error_95": errors.tolist()},
        correction={"unit": {"u": like}} if like else {},
    )


def _alike(root: Explanation, inputs: CheckInput) -> tuple[np.ndarray, tuple[str, ...]]:
    """Joints whose factors, such as they are known beside friction, are those of one other unit; and this unit."""
    off = np.flatnonzero(np.isfinite(root.factors))
    factors, errors = root.factors[off], np.array([root.error_of_factor(k) for k in off.tolist()])
    if len(off) < 2 or not (factors > 0.0).all():
        return off[:0], ()
    sure = float(factors[np.argmin(errors / factors)])
    unit, size = like_units(sure, inputs.unit_of_each("u"))
    alike = (np.abs(factors - size) <= errors + CLOSE * size).all() and errors.min() < CLOSE * size
    return (off, unit) if unit and alike and not 1.0 / FAR < sure < FAR else (off[:0], ())


def _unknown(root: Explanation, inputs: CheckInput) -> Iterator[Doubt]:
    """That something is wrong which is none of the causes, and where it sits."""
    if not len(bad := np.flatnonzero(root.rough > EXPLAINED)):
        return
    where, seconds, left = _where(root, int(bad[np.argmax(root.rough[bad])]), inputs)
    sticky = [k for k in bad.tolist() if _sticks(root, k)]
    if sticky and (left > EXPLAINED or len(sticky) == len(bad)):  # what passes stops a joint as well
        names = inputs.named(sticky)
        what = f"what stays of the torque of {listed(names)} is near rest and no more than dry friction holds: gears "
        what += "that stick, or give way before they slip."
        do = "Friction that remembers explains it; forcegp auto and forcegp fit --forces gear choose it."
        yield look(about="dry friction", what=what, do=do, joints=names)
        if not len(bad := np.setdiff1d(bad, sticky)):
            return
        where, seconds, left = _where(root, int(bad[np.argmax(root.rough[bad])]), inputs)
    rows, tau, friction = root.log.rows, root.log.tau, root.log.friction
    shares = ", ".join(f"{inputs.names[k]} {100.0 * root.rough[k]:.0f} %" for k in bad)
    numbers: dict[str, object] = {"unexplained": root.rough[bad].tolist(), "rows": len(rows)}
    do = "Look at these joints there: contacts, brakes, cables, another robot, or a channel that is not a torque."
    stops = {k: end for k in bad.tolist() if (end := _stop(root, k)) is not None}
    time, smeared, q = inputs.log.time, 1.5 / inputs.compared_cutoff, inputs.log.q
    there = np.any([np.abs(q[:, k] - end) <= wide for k, (end, wide) in stops.items()], axis=0) & np.ones(len(q), bool)
    begin, end = time[runs(there) - np.array([0, 1])].T + np.array([[-smeared], [smeared]])
    apart = np.insert(begin[1:] - end[:-1] > SHORT, 0, True)[: len(begin)]  # what stays between them is of no use
    if stops and (apart.sum() > 1 or len(stops) == len(bad)):  # a link that is pushed once is felt by several joints
        units = inputs.unit_of_each("q")
        each = ", ".join(f"{inputs.names[k]} at {end:.3g} {units[k]}" for k, (end, _) in stops.items())
        where = f"; next to nothing stays but at an end of the joint's motion ({each}): an end stop, or a contact"
        numbers["stops"] = {inputs.names[k]: end for k, (end, _) in stops.items()}
        ends = np.stack([begin[apart], np.maximum.reduceat(end, np.flatnonzero(apart))], axis=1)
        numbers["seconds"] = seconds = ends.ravel().tolist()
    elif left <= min(EXPLAINED, (1.0 - MOSTLY) * root.rough.max()):  # far less than there
        steps = np.diff(inputs.log.q[(inputs.log.time >= seconds[0]) & (inputs.log.time <= seconds[1])], axis=0)
        still = inputs.named([k for k in bad.tolist() if (steps[:, k] == 0.0).mean() > UNCHANGED])
        why = f"the position of {listed(still)} stands still, as of a dead encoder or a brake" if still else ""
        where += f", elsewhere at most {100.0 * left:.2g} % stays: {why or 'a contact, or a load'}, in these seconds"
        numbers |= {"seconds": seconds, **({"stands": still} if still else {})}
    else:
        numbers |= {"where": seconds} if left <= EXPLAINED else {}  # of time; a wider stretch shows no more
        fits = ((k, left_by_positions(rows.q, np.c_[tau[:, k], friction[:, k]], rows.u[:, k])) for k in bad.tolist())
        if names := inputs.named([k for k, (alone, beside) in fits if beside < EXPLAINED < alone]):
            where += f"; positions alone explain that of {listed(names)}: a cable, a hose, a balancer, or a spring"
            do = "Give the robot what pulls there, or learn it: "
            do += "forcegp score LOG.h5 --forces identified,gp:joint:inputs=q --out scores."
            numbers["positions"] = names
    if "seconds" in numbers:
        ends = ",".join(f"{x:.2f}" for x in seconds)
        do = f"Leave them out by forcegp import LOG --without {ends}, as forcegp auto does."
    what = "something is wrong that is none of the causes that were tried (signs, units, orders, zeros, gears, "
    what += f"gravity, masses, payload, springs, delay): unexplained stay of the torque of {shares}{where}."
    yield look(about=UNKNOWN, what=what, do=do, joints=inputs.named(bad), numbers=numbers)


def _stop(root: Explanation, joint: int) -> tuple[float, float] | None:
    """The end of a joint's motion, and how wide, at which alone something is left of its torque; None where none is."""
    rows, ones = root.log.rows, np.ones((len(root.log.rows), 1))
    q, u = rows.q[:, joint], rows.u[:, joint]
    columns = np.c_[root.log.tau[:, joint], root.log.friction[:, joint], ones, -ones]
    for wide, end in product(AT_END, (float(q.min()), float(q.max()))):
        there = np.abs(q - end) <= wide * np.ptp(q)
        if STOPPED <= there.sum() < 0.5 * len(q):
            left = np.square(u - columns @ positive_fit(columns[~there], u[~there])[0])
            if left[~there].sum() <= (1.0 - MOSTLY) * left.sum() and left[~there].mean() <= EXPLAINED**2 * u.var():
                return end, wide * float(np.ptp(q))
    return None


def _sticks(root: Explanation, joint: int) -> bool:
    """Whether in motion nothing stays of a torque, and near rest no more than dry friction holds."""
    rows, held, moves = root.log.rows, held_at_rest(root, joint), in_motion(root.log.rows)[:, joint]
    moving = replace(root, log=replace(root.log, rows=rows.rows(np.flatnonzero(moves))))
    return bool(held.any() and held[~moves].all() and moving.rough[joint] <= EXPLAINED)


def held_at_rest(root: Explanation, joint: int) -> Bool[np.ndarray, " rows"]:
    """Rows near rest in which no more stays of a torque than `HELD` times what dry friction holds."""
    rows, tau, friction = root.log.rows, root.log.tau[:, joint], root.log.friction[:, joint]
    moves, u, ones = in_motion(rows)[:, joint], rows.u[:, joint], np.ones(len(tau))
    if moves.sum() < FEWEST_ROWS:
        return np.zeros(len(tau), dtype=bool)
    columns = np.c_[tau, friction, ones, -ones]
    number, _ = positive_fit(columns[moves], u[moves])
    left = np.abs(u - columns @ number)
    return ~moves & (left <= HELD * (number[-2 - len(WIDTHS) : -2].sum() + np.sqrt(np.square(left[moves]).mean())))


def _where(root: Explanation, joint: int, inputs: CheckInput) -> tuple[str, list[float], float]:
    """Where in time, q or v most of what is left of a torque sits; of time its ends, and what stays elsewhere."""
    # time is enough where little stays elsewhere: what touches a robot also stops it, so that v shows it as well
    rows, best, found = root.log.rows, 0.0, ("", list[float](), np.inf)
    level = np.ones(len(rows))
    signals = np.c_[root.log.friction[:, joint], level, -level, rows.u[:, joint] - root.log.tau[:, joint]]
    for name, values, unit in (("time", rows.time, "s"), ("q", rows.q[:, joint], inputs.unit_of_each("q")[joint]),
                               ("v", rows.v[:, joint], inputs.unit_of_each("v")[joint])):  # fmt: skip
        order = np.argsort(values, kind="stable")
        gain, share, first, last = stretch(signals[order])
        if gain > best and share > MOSTLY and found[2] > EXPLAINED:
            left = np.inf
            for more in WIDER if name == "time" else (0.0,):
                first, last = max(first - int(more * len(rows)), 0), min(last + int(more * len(rows)), len(rows))
                others = rows.rows(np.sort(np.r_[order[:first], order[last:]]))
                enough = name == "time" and len(others) >= FEWEST_ROWS
                left = float(replace(root, log=replace(root.log, rows=others)).rough.max()) if enough else np.inf
                if left <= EXPLAINED:
                    break
            ends = values[order[[max(first - 1, 0), min(last, len(rows) - 1)]]]
            if name == "time":  # what is left at an end of the log is too short for filters
                outer = np.array([inputs.log.time.min(), inputs.log.time.max()])  # times of episodes may begin anew
                ends = np.where(np.abs(ends - outer) < SHORT, outer, ends)
            text = f"; {100.0 * share:.0f} % of it at {inputs.names[joint]} for {name} between {ends[0]:.3g} and "
            edge = name == "q" and (first == 0 or last == len(rows))
            unit += ", an end of its motion, as of an end stop that gives way" if edge else ""
            best, found = gain, (f"{text}{ends[1]:.3g} {unit}", [round(float(x), 2) for x in ends], left)
    return found
