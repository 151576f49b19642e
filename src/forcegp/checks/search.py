"""One search over all causes: which of them, one after the other, leave of the torques what a good log leaves."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int

from forcegp.checks.check_input import CheckInput
from forcegp.checks.explanations import NUMBER, SIGN, Cause, candidates, changed
from forcegp.checks.residuals import left_by_positions
from forcegp.checks.torques import LEAST, WIDTHS, Comparison, positive_fit, positive_solution, stretch, torque_noise
from forcegp.data import Dataset
from forcegp.data.views import white_noise
from forcegp.doubts import Doubt, listed, look, wrong
from forcegp.evidence import Torques, motion_residuals
from forcegp.fit import fit
from forcegp.forces import Actuation, Coulomb, Offset, RigidBodies, Rotor, Viscous
from forcegp.model import Model

UNKNOWN = "unknown cause"
FEWEST_ROWS = 30
AT_REST = 0.1  # of the root mean square velocity of a joint
GAIN = np.log(4.0)  # by which the product over all joints of what remains must fall at least
NOISE = 3.0  # how much of the power of the noise is left to every explanation
BEAM, DEPTH = 3, 3  # explanations that are continued, and causes of one
WORSE = 1.05  # share from which on predicting nothing is better
BLOCKS, T_95 = 4, 3.18  # of the log, each of which is predicted from the others; Student's t of one less
ATTENUATED = 0.01  # of a factor: noise of accelerations makes it smaller
FREE = 4.0  # share that an explanation may leave, over what a robot with any masses and any friction would
GOOD = 0.03  # share that a good log may leave
DOUBTFUL = 2e-3  # share above which causes are tried
EXPLAINED = 0.1  # share that a robot with rough masses leaves
HELD = 3.0  # of the dry friction and of what remains in motion, from which on no gear holds the joint
RESTS = 0.5  # share of what friction leaves that a torque must explain, for a factor of it to mean something
MOSTLY = 0.75  # share of what is left that sits somewhere
ROUGH = 2.5  # factor either way that wrong masses make of a torque
CHOICES = np.array([0.0, SIGN, NUMBER, SIGN + NUMBER])
"""Cost of a torque as it is, turned, times a factor, and both."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """A log after all `causes`, and how it fits; `floor` (nv,) is the share of each torque that is noise."""

    log: Comparison
    floor: Float[np.ndarray, " nv"]
    causes: tuple[Cause, ...] = ()
    turned: tuple[int, ...] = ()

    @cached_property
    def _fits(self) -> tuple[np.ndarray, np.ndarray]:
        """Shares (nv, 4) that remain of every choice, NaN for a constant torque, and factors (nv,) of the chosen."""
        u, tau = (x - x.mean(axis=0) for x in (self.log.rows.u, self.log.tau))
        every = np.concatenate([self.log.friction, tau[..., None], u[..., None]], axis=-1)
        power = np.square(u).sum(axis=0)
        shares, factors = np.full((u.shape[1], 4), np.nan), np.full((u.shape[1], 2), np.nan)
        count = every.shape[-1] - 2
        plain, last = [*range(count), count + 1], np.eye(count + 1)[[-1]]
        sides = np.outer(*2 * (np.append(np.ones(count + 1), -1.0),))

        def less(products: np.ndarray) -> np.ndarray:
            """Of friction, and u less what is needed."""
            cross = products[plain][:, [count]] * last
            return products[plain][:, plain] - cross - cross.T + products[count, count] * last * last.T

        for k in np.flatnonzero(np.ptp(self.log.rows.u, axis=0) > 0.0):
            products = every[:, k].T @ every[:, k]
            shares[k, 0] = positive_solution(less(products))[1]
            shares[k, 1:], size = np.inf, np.sqrt(np.diag(products))
            size[size == 0.0] = 1.0
            scaled = products / np.outer(size, size)
            number = np.linalg.lstsq(scaled[:-1, :-1], scaled[-1, :-1], rcond=1e-10)[0]
            factors[k], bound = number[-1] * size[-1] / size[-2], power[k] * (1.0 - scaled[-1, :-1] @ number)
            if bound * np.exp(SIGN) > shares[k, 0] or shares[k, 0] < LEAST * power[k]:
                shares[k] /= power[k]
                continue  # neither sign nor factor is worth what it costs
            for turn, sign in enumerate((1.0, -1.0)):
                turned = products * sides if sign < 0.0 else products
                alone = positive_solution(turned[plain][:, plain])[1]
                found, left = positive_solution(turned)
                factors[k, turn] = found[-1]
                shares[k, turn + 2] = left + power[k] * (left > (1.0 - RESTS) * alone)  # not a multiple of tau
                shares[k, turn] = positive_solution(less(turned))[1]
            shares[k] /= power[k]
        return shares, factors

    @cached_property
    def chosen(self) -> Int[np.ndarray, " nv"]:
        """Which of CHOICES explains each torque best."""
        return np.argmin(np.nan_to_num(self._logarithms() + CHOICES), axis=1)

    def _logarithms(self) -> np.ndarray:
        return np.log(np.maximum(self._fits[0], np.maximum(LEAST, NOISE * self.floor)[:, None]))

    @cached_property
    def value(self) -> float:
        """Logarithm of what remains, over all joints, and the costs of what was assumed."""
        left = np.nansum((self._logarithms() + CHOICES)[np.arange(len(self.chosen)), self.chosen])
        return float(left) + sum(cause.cost for cause in self.causes) + SIGN * len(self.turned)

    @property
    def shares(self) -> Float[np.ndarray, " nv"]:
        """What remains of each torque if none is a multiple; 0 of a constant one."""
        return np.nan_to_num(self._fits[0][:, 0])

    @property
    def unexplained(self) -> Float[np.ndarray, " nv"]:
        """What remains of each torque, with a factor where that explains more; NaN of a constant one."""
        return self._fits[0][:, [0, 2]].min(axis=1)

    @property
    def unscaled(self) -> float:
        """The same if no torque is a multiple."""
        left = (self._logarithms() + CHOICES)[:, :2]
        return float(np.nansum(left.min(axis=1))) + sum(cause.cost for cause in self.causes) + SIGN * len(self.turned)

    @cached_property
    def factors(self) -> Float[np.ndarray, " nv"]:
        """Of u over what is needed, NaN where friction alone leaves little more."""
        shares, factors = self._fits
        turn = np.nanargmin(np.where(np.isnan(shares[:, 2:]), np.inf, shares[:, 2:]), axis=1)
        u = self.log.rows.u - self.log.rows.u.mean(axis=0)
        alone = [positive_fit(each, x)[1] for each, x in zip(self.log.friction.swapaxes(0, 1), u.T, strict=True)]
        told = shares.min(axis=1) * np.square(u).sum(axis=0) < RESTS * np.array(alone)
        return np.where(told, factors[np.arange(len(turn)), turn], np.nan)

    @property
    def plain(self) -> float:
        """The same as `value` of a log that nothing is assumed of."""
        return float(np.nansum(self._logarithms()[:, 0]))

    def with_signs(self) -> "Explanation":
        """With the torques turned whose other sign fits."""
        turned = np.flatnonzero(self.chosen % 2)
        if not len(turned):
            return self
        factor = np.ones(len(self.chosen))
        factor[turned] = -1.0
        both = tuple(sorted({*self.turned} ^ {*turned.tolist()}))
        return replace(self, log=self.log.with_torques(changed("u", factor=factor)), turned=both)

    @cached_property
    def rough(self) -> Float[np.ndarray, " nv"]:
        """Share that is left of each torque if masses may be roughly wrong; without what is noise."""
        left = np.array([self._held_out(k, rough=True) for k in range(len(self.floor))])
        needless = (left > 1.0 - EXPLAINED) & (self.shares > WORSE)  # noise where the motion needs a torque
        return np.where(needless, left, np.maximum(left - NOISE * self.floor, 0.0))

    @cached_property
    def exact(self) -> Float[np.ndarray, " nv"]:
        """Share that is left of each torque by what was assumed."""
        return np.array([self._held_out(k, rough=False) for k in range(len(self.floor))])

    def _held_out(self, joint: int, rough: bool) -> float:
        """What friction and tau, as the other blocks have them, leave of every block."""
        u, tau, friction = self.log.rows.u[:, joint], self.log.tau[:, joint], self.log.friction[:, joint]
        power, left = np.square(u - u.mean()).sum(), 0.0
        if not np.ptp(u) > 0.0:
            return 0.0
        scaled = rough or self.chosen[joint] >= 2
        for block in np.array_split(np.arange(len(u)), BLOCKS):
            rest = np.setdiff1d(np.arange(len(u)), block)
            middle = [x[rest].mean(axis=0) for x in (u, tau, friction)]
            factor = 1.0
            if scaled:
                found, _ = positive_fit(np.c_[tau[rest] - middle[1], friction[rest] - middle[2]], u[rest] - middle[0])
                factor = float(np.clip(found[0], 1.0 / ROUGH, ROUGH)) if rough and self.chosen[joint] < 2 else found[0]
            target = u - middle[0] - factor * (tau - middle[1])
            number, _ = positive_fit(friction[rest] - middle[2], target[rest])
            left += np.square(target[block] - (friction[block] - middle[2]) @ number).sum()
        return float(left / power)

    def error_of_factor(self, joint: int) -> float:
        """Half of its 95 % interval, by what each block of the log changes (jackknife)."""
        u, tau, friction = self.log.rows.u[:, joint], self.log.tau[:, joint], self.log.friction[:, joint]
        rows, columns = np.arange(len(u)), np.c_[tau, friction]
        rests = [np.setdiff1d(rows, block) for block in np.array_split(rows, BLOCKS)]
        found = [positive_fit(columns[x] - columns[x].mean(axis=0), u[x] - u[x].mean())[0][0] for x in rests]
        return float(np.hypot(T_95 * np.std(found) * (BLOCKS - 1) ** 0.5, ATTENUATED * np.mean(found)))

    @cached_property
    def of_any_masses(self) -> Float[np.ndarray, "rows nv"]:
        """What is left of each torque by a robot with any masses and friction."""
        return self.left_beside(np.ones((*self.log.rows.q.shape, 1)))

    def left_beside(self, more: Float[np.ndarray, "rows nv k"]) -> Float[np.ndarray, "rows nv"]:
        """The same with these columns of each joint, too."""
        rows, robot = self.log.rows, self.log.robot
        q, v, a = (torch.tensor(x, device=robot.device) for x in (rows.q, rows.v, rows.a))
        with torch.no_grad():
            regressor = robot.kinematics(q, v).torque_regressor(a).flatten(-2).cpu().numpy()
        left = []
        for k, u in enumerate(rows.u.T):
            columns = np.c_[regressor[:, k], self.log.friction[:, k], np.ones(len(u)), more[:, k]]
            size = np.linalg.norm(columns, axis=0)
            basis, values, _ = np.linalg.svd(columns[:, size > 0.0] / size[size > 0.0], full_matrices=False)
            basis = basis[:, values > 1e-8 * values[0]]
            left.append(u - basis @ (basis.T @ u))
        return np.stack(left, axis=1)

    @property
    def free(self) -> Float[np.ndarray, " nv"]:
        """The share that this is."""
        return np.square(self.of_any_masses).sum(0) / np.maximum(len(self.log.rows) * self.log.rows.u.var(0), 1e-300)

    @property
    def good(self) -> np.ndarray:
        """Whether each joint is left with what a good log leaves (nv,)."""
        noise = np.minimum(NOISE * self.floor, WORSE)
        return self.exact <= np.maximum(np.minimum(FREE * self.free, EXPLAINED), np.maximum(GOOD, noise))

    def stands(self, root: "Explanation") -> bool:
        """Whether all joints are left with what a good log leaves; with rough masses, if mistakes were corrected."""
        far = {
            *np.flatnonzero((self.chosen >= 2) & (np.abs(np.log(np.abs(self.factors) + 1e-300)) > np.log(MUCH_MORE)))
        }
        if far & {*self.turned, *(k for cause in self.causes for k in cause.joints)}:
            return False  # nothing else is known of a torque in unknown units
        if self.good.all():
            return True
        exactly = any(cause.number for cause in self.causes) or (self.chosen >= 2).any()
        return not exactly and root.rough.max() > EXPLAINED and bool((self.rough <= EXPLAINED).all())


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
                order = cause.correction.get("order", {}).get("u", range(len(now.chosen)))
                turned = tuple(k for k, place in enumerate(order) if place in now.turned)
                made = Explanation(log, root.floor, (*now.causes, cause), turned).with_signs()
                before = now.value if cause.number else max(now.value, now.unscaled)  # mistakes first, factors then
                if made.value < before - 0.5 * GAIN:
                    grown.append(made)
        every = every + grown
        frontier = sorted(grown, key=lambda each: each.value)[:BEAM]
        if not grown or (frontier[0].shares <= np.maximum(NOISE * root.floor, DOUBTFUL)).all():
            break
    every.sort(key=lambda each: each.value)
    for best in every:
        near = best.value < every[0].value + 2.0 * GAIN
        clear = (np.log(np.clip(root.shares, LEAST, 1.0) / np.maximum(best.exact, LEAST)) >= GAIN).any()
        if near and clear and root.plain - best.value >= GAIN and best.stands(root):
            return best, list(_said(best, root, inputs))
    signs = root.with_signs()
    sure = [k for k in signs.turned if signs.good[k]]
    if sure:
        factor = np.where(np.isin(np.arange(len(root.floor)), sure), -1.0, 1.0)
        root = replace(root, log=root.log.after(changed("u", factor=factor)), turned=tuple(sure))
    said = [*_signs(root, inputs), *_factors(root, inputs, explained=False), *_unknown(root, inputs)]
    if said and not sure and (turned := _all_turned(root, inputs)):
        return turned
    return root, said


def _all_turned(root: Explanation, inputs: CheckInput) -> tuple[Explanation, list[Doubt]] | None:
    """Every torque turned, where bodies and friction that can exist then leave far less; None where they do not.

    Masses of a robot's file may be too wrong for any single cause. Friction brakes and inertia resists in any robot.
    """
    log, left = root.log, list[np.ndarray]()
    moving = np.ptp(log.rows.u, axis=0) > 0.0
    if root.free[moving].mean() > RESTS:
        return None  # no masses explain them under any sign
    laws = Actuation(), RigidBodies("all"), *(Law() for Law in (Viscous, Coulomb, Offset, Rotor))
    for sign in (1.0, -1.0):
        rows = replace(log.rows, u=sign * log.rows.u, model=Model(log.robot, (), laws), measured={})
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of numbers that these rows do not show
            found = fit(rows.model, rows, Torques())
        residual = motion_residuals(rows, found.model)[0][:, moving]
        left.append(residual.var(axis=0) / rows.u[:, moving].var(axis=0))
    if np.log(left[0] / left[1]).sum() < GAIN + SIGN * moving.sum() or left[1].mean() > RESTS:
        return None
    before, after = (100.0 * each.mean() for each in left)
    doubt = wrong(
        about="torque sign",
        what="the torques of all joints have the opposite sign of what any robot of these lengths needs: bodies and "
        f"friction that can exist leave {before:.2g} % of a torque, and {after:.2g} % of the turned one (mean of "
        "joints). Masses of the robot's file are wrong as well.",
        do="Turn u; forcegp fit --forces bodies finds the masses.",
        joints=inputs.names,
        correction={"sign": {"u": (-1.0,) * log.rows.nv}},
    )
    turned = log.with_torques(changed("u", factor=-1.0))
    return replace(root, log=turned, turned=tuple(range(log.rows.nv))), [doubt]


def moving(rows: Dataset) -> Dataset:
    """The rows in which some joint moves: at rest, stiction holds any torque. All, where they are too few."""
    speed = np.abs(rows.v) / np.maximum(np.sqrt(np.square(rows.v).mean(axis=0)), 1e-300)
    moves = speed.max(axis=1) > AT_REST
    return rows.rows(moves) if moves.sum() >= FEWEST_ROWS else rows


def _root(inputs: CheckInput) -> Explanation:
    rows = moving(inputs.rows())
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


FAR, MUCH_MORE = 3.0, 30.0
"""Factors that wrong masses do not explain: less torque than bodies need cannot be; more may be a rotor's inertia."""


def _factors(best: Explanation, inputs: CheckInput, *, explained: bool = True) -> Iterator[Doubt]:
    """Torques that are a multiple of what the motion needs; of a log that is not `explained` those of several joints.

    Friction may hide those of the others, as where u is a current.
    """
    # far less than bodies need is wrong, whatever rotors and friction may hide of it
    factors = np.where(best.shares > WORSE, best._fits[1][np.arange(len(best.chosen)), best.chosen % 2], best.factors)
    off = np.flatnonzero((best.chosen >= 2) & np.isfinite(factors))
    if not explained:
        off = off[(best.exact[off] <= EXPLAINED) & (best.shares[off] > RESTS)]
    if len(off) < (1 if explained else 2):
        return
    joints, factors, errors = inputs.named(off), factors[off], [*map(best.error_of_factor, off.tolist())]
    each = ", ".join(f"{name} {x:.4g} ± {error:.1g}" for name, x, error in zip(joints, factors, errors, strict=True))
    yield Doubt(
        level="wrong" if not explained or factors.min() < 1.0 / FAR or factors.max() > MUCH_MORE else "look",
        about="torque constant" if len(off) == 1 else "torque unit",
        what=f"the measured torque is a multiple of what the motion needs, if masses are right: {each}.",
        do="Such factors point to torque before the gears (multiply by the gear ratio), motor current (multiply by the "
        "torque constant), a rotor inertia that is missing, or wrong masses; compare with the data sheet, or let "
        "forcegp payload --forces gain,viscous,gear,offset,rotor estimate the constants of all joints.",
        joints=joints,
        numbers={"factor": dict(zip(joints, factors.tolist(), strict=True)), "error_95": errors},
    )


def _unknown(root: Explanation, inputs: CheckInput) -> Iterator[Doubt]:
    """That something is wrong which is none of the causes, and where it sits."""
    bad = np.flatnonzero(root.rough > EXPLAINED)
    if sticky := [k for k in bad.tolist() if _sticks(root, k)]:
        names = inputs.named(sticky)
        yield look(
            about="dry friction",
            what=f"what stays of the torque of {listed(names)} is near rest and no more than dry friction holds: gears "
            "that stick, or give way before they slip.",
            do="Friction that remembers explains it; forcegp auto and forcegp fit --forces gear choose it.",
            joints=names,
        )
    if not len(bad := np.setdiff1d(bad, sticky)):
        return
    rows, tau, friction = root.log.rows, root.log.tau, root.log.friction
    shares = ", ".join(f"{inputs.names[k]} {100.0 * root.rough[k]:.0f} %" for k in bad)
    numbers: dict[str, object] = {"unexplained": root.rough[bad].tolist(), "rows": len(rows)}
    do = "Look at these joints there: contacts, brakes, cables, another robot, or a channel that is not a torque."
    where, seconds, left = _where(root, int(bad[np.argmax(root.rough[bad])]), inputs)
    if left <= EXPLAINED:
        where += f", and elsewhere at most {100.0 * left:.2g} % stays: a contact, or a load, in these seconds"
        numbers["seconds"] = [float(x) for x in seconds.split(",")]
        do = f"Leave them out by forcegp import --without {seconds}, as forcegp auto does."
    else:
        fits = ((k, left_by_positions(rows.q, np.c_[tau[:, k], friction[:, k]], rows.u[:, k])) for k in bad.tolist())
        if names := inputs.named([k for k, (alone, beside) in fits if beside < EXPLAINED < alone]):
            where += f"; positions alone explain that of {listed(names)}: a cable, a hose, a balancer, or a spring"
            do = "Give the robot what pulls there, or learn it: forcegp score --forces identified,gp:joint:inputs=q."
            numbers["positions"] = names
    yield look(
        about=UNKNOWN,
        what="something is wrong that is none of the causes that were tried (signs, units, orders, zeros, gears, "
        f"gravity, masses, payload, springs, delay): unexplained stay of the torque of {shares}{where}.",
        do=do,
        joints=inputs.named(bad),
        numbers=numbers,
    )


def _sticks(root: Explanation, joint: int) -> bool:
    """Whether in motion nothing stays of a torque, and near rest no more than `HELD` times what dry friction holds."""
    rows, tau, friction = root.log.rows, root.log.tau[:, joint], root.log.friction[:, joint]
    speed, u, ones = np.abs(rows.v[:, joint]), rows.u[:, joint], np.ones(len(tau))
    moves = speed > AT_REST * np.sqrt(np.square(speed).mean())
    if moves.sum() < FEWEST_ROWS or moves.all():
        return False
    moving = replace(root, log=replace(root.log, rows=rows.rows(np.flatnonzero(moves))))
    columns = np.c_[tau, friction, ones, -ones]
    number, _ = positive_fit(columns[moves], u[moves])
    left = np.abs(u - columns @ number)
    holds = number[-2 - len(WIDTHS) : -2].sum() + np.sqrt(np.square(left[moves]).mean())
    return bool(moving.rough[joint] <= EXPLAINED and left[~moves].max() <= HELD * holds)


def _where(root: Explanation, joint: int, inputs: CheckInput) -> tuple[str, str, float]:
    """Where in time, q or v most of what is left of a torque sits; of time the ends, and what stays elsewhere at most.

    Time is enough where little stays elsewhere: what touches a robot also stops it, so that v shows it as well.
    """
    rows, best, found = root.log.rows, 0.0, ("", "", np.inf)
    level = np.ones(len(rows))
    signals = np.c_[root.log.friction[:, joint], level, -level, rows.u[:, joint] - root.log.tau[:, joint]]
    for name, values, unit in (("time", rows.time, "s"), ("q", rows.q[:, joint], inputs.unit_of_each("q")[joint]),
                               ("v", rows.v[:, joint], inputs.unit_of_each("v")[joint])):  # fmt: skip
        order = np.argsort(values, kind="stable")
        gain, share, first, last = stretch(signals[order])
        if gain > best and share > MOSTLY and found[2] > EXPLAINED:
            ends = values[order[[max(first - 1, 0), min(last, len(rows) - 1)]]]
            text = f"; {100.0 * share:.0f} % of it at {inputs.names[joint]} for {name} between {ends[0]:.3g} and "
            others = rows.rows(np.sort(np.r_[order[:first], order[last:]]))
            left = replace(root, log=replace(root.log, rows=others)).rough.max() if name == "time" else np.inf
            best, found = gain, (f"{text}{ends[1]:.3g} {unit}", f"{ends[0]:.2f},{ends[1]:.2f}", float(left))
    return found
