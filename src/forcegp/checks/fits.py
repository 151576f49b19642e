"""How well a log fits its robot once some causes are taken off it: shares of every torque that stay."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from forcegp.checks.causes import NUMBER, SIGN, Cause, changed
from forcegp.checks.torques import LEAST, Comparison, in_motion, positive_fit, positive_solution, regressor

NOISE = 3.0  # how much of the power of the noise is left to every explanation
WORSE = 1.05  # share from which on predicting nothing is better
FEWEST_ROWS = 30  # that are compared
RARELY = 0.5  # share of rows in which a joint moves, below which these are what is divided
BLOCKS, T_95 = 4, 3.18  # of the log, each of which is predicted from the others; Student's t of one less
ATTENUATED = 0.01  # of a factor: noise of accelerations makes it smaller
FREE = 4.0  # share that an explanation may leave, over what a robot with any masses and any friction would
GOOD = 0.03  # share that a good log may leave
EXPLAINED = 0.1  # share that a robot with rough masses leaves
RESTS = 0.5  # share of what friction leaves that a torque must explain, for a factor of it to mean something
ROUGH = 2.5  # factor either way that wrong masses make of a torque
FAR, MUCH_MORE = 3.0, 30.0
"""Factors that wrong masses do not explain: less torque than bodies need cannot be; more may be a rotor's inertia."""
CHOICES = np.array([0.0, SIGN, NUMBER, SIGN + NUMBER])  # cost of a torque as it is, turned, times a factor, and both


@dataclass(frozen=True, eq=False)
class Explanation:
    """A log after all `causes`, and how it fits; `floor` (nv,) is the share of each torque that is noise."""

    log: Comparison
    floor: Float[np.ndarray, " nv"]
    causes: tuple[Cause, ...] = ()
    turned: tuple[int, ...] = ()

    @cached_property
    def _fits(self) -> tuple[np.ndarray, np.ndarray]:
        """Shares (nv, 4) that remain of every choice, NaN for a constant torque, and factors (nv, 2) of both signs."""
        u, tau = (x - x.mean(axis=0) for x in (self.log.rows.u, self.log.tau))
        every = np.concatenate([self.log.friction, tau[..., None], u[..., None]], axis=-1).swapaxes(0, 1)
        products, power, count = every.mT @ every, np.square(u).sum(axis=0), every.shape[-1]
        alone = np.delete(np.eye(count), -2, axis=1)  # friction, and u
        less = alone - np.eye(count)[:, [-2]] * np.eye(count - 1)[-1]  # and u less what is needed
        turns = np.stack([np.eye(count), np.diag(np.append(np.ones(count - 1), -1.0))])
        size = np.sqrt(np.diagonal(products, axis1=1, axis2=2))
        size = np.where(size > 0.0, size, 1.0)
        scaled = products / (size[..., None] * size[:, None])
        number = np.linalg.pinv(scaled[:, :-1, :-1], rcond=1e-10, hermitian=True) @ scaled[:, :-1, -1:]
        bound, shares = power * (1.0 - (scaled[:, -1:, :-1] @ number)[:, 0, 0]), np.full((len(power), 4), np.inf)
        factors = np.repeat(number[:, -1] * (size[:, -1:] / size[:, -2:-1]), 2, axis=1)
        shares[:, 0] = positive_solution(less.T @ products @ less)[1]
        worth = np.flatnonzero((bound * np.exp(SIGN) <= shares[:, 0]) & (shares[:, 0] >= LEAST * power))
        if len(worth):  # elsewhere neither sign nor factor is worth what it costs
            turned = turns.mT @ products[worth, None] @ turns
            found, left = positive_solution(turned)
            multiple = left > (1.0 - RESTS) * positive_solution(alone.T @ turned @ alone)[1]
            factors[worth], shares[worth, :2] = found[..., -1], positive_solution(less.T @ turned @ less)[1]
            shares[worth, 2:] = left + power[worth, None] * multiple  # which is not one of tau
        constant = np.ptp(self.log.rows.u, axis=0) <= 0.0
        shares[constant], factors[constant] = np.nan, np.nan
        return shares / np.where(constant, 1.0, power)[:, None], factors

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
        alone = positive_fit(self.log.friction.swapaxes(0, 1), u.T)[1]
        told = shares.min(axis=1) * np.square(u).sum(axis=0) < RESTS * alone
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
        for block in self._blocks(joint):
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

    def _blocks(self, joint: int) -> list[np.ndarray]:
        """Successive rows, as many in each, or with as much of the motion of a joint that mostly rests."""
        # what rests alone teaches no friction
        moves, rows = in_motion(self.log.rows)[:, joint], np.arange(len(self.log.rows))
        own = np.flatnonzero(moves) if BLOCKS <= moves.sum() < RARELY * len(moves) else rows
        return np.split(rows, [part[0] for part in np.array_split(own, BLOCKS)[1:]])

    def error_of_factor(self, joint: int) -> float:
        """Half of its 95 % interval, by what each block of the log changes (jackknife)."""
        u, tau, friction = self.log.rows.u[:, joint], self.log.tau[:, joint], self.log.friction[:, joint]
        columns = np.c_[tau, friction]
        rests = [np.setdiff1d(np.arange(len(u)), block) for block in self._blocks(joint)]
        found = [positive_fit(columns[x] - columns[x].mean(axis=0), u[x] - u[x].mean())[0][0] for x in rests]
        return float(np.hypot(T_95 * np.std(found) * (BLOCKS - 1) ** 0.5, ATTENUATED * np.mean(found)))

    def left_beside(
        self, more: Float[np.ndarray, "rows nv k"], told: Bool[np.ndarray, " rows"] | None = None
    ) -> Float[np.ndarray, "rows nv"]:
        """What any masses, friction and these columns leave of each torque, by numbers that the rows `told` tell."""
        rows, bodies = self.log.rows, regressor(self.log.robot, self.log.rows)
        if self.log.drives is not None:
            bodies = np.einsum("rmp,mk->rkp", bodies, np.linalg.inv(self.log.drives))
        left = []
        for k, u in enumerate((rows.u - self.log.more).T):  # a load that is taken up is no mass of a link
            columns = np.c_[bodies[:, k], self.log.friction[:, k], np.ones(len(u)), more[:, k]]
            size = np.linalg.norm(columns, axis=0)
            columns = columns[:, size > 0.0] / size[size > 0.0]
            own = slice(None) if told is None else told
            left.append(u - columns @ np.linalg.lstsq(columns[own], u[own], rcond=1e-8)[0])
        return np.stack(left, axis=1)

    @cached_property
    def free(self) -> Float[np.ndarray, " nv"]:
        """The share of each torque that a robot with any masses and friction leaves."""
        left = np.square(self.left_beside(np.ones((*self.log.rows.q.shape, 1)))).sum(0)
        return left / np.maximum(len(self.log.rows) * self.log.rows.u.var(0), 1e-300)

    @property
    def turned_free(self) -> Float[np.ndarray, " nv"]:
        """The same of the turned torques, where friction brakes."""
        rows, shares = self.log.rows, np.zeros(self.log.rows.nv)
        for k, bodies in enumerate(regressor(self.log.robot, rows).swapaxes(0, 1)):
            masses, both = np.c_[bodies, np.ones(len(rows))], np.c_[self.log.friction[:, k], -rows.u[:, k]]
            left = both - masses @ np.linalg.lstsq(masses, both, rcond=1e-8)[0]
            shares[k] = positive_fit(left[:, :-1], left[:, -1])[1] / max(len(rows) * rows.u[:, k].var(), 1e-300)
        return shares

    @property
    def good(self) -> np.ndarray:
        """Whether each joint is left with what a good log leaves (nv,)."""
        noise = np.minimum(NOISE * self.floor, WORSE)
        return self.exact <= np.maximum(np.minimum(FREE * self.free, EXPLAINED), np.maximum(GOOD, noise))

    def stands(self, root: "Explanation", gears: Bool[np.ndarray, " nv"]) -> bool:
        """Whether all joints but those of `gears` that stick are left with what a good log leaves.

        With rough masses, if mistakes were corrected.
        """
        far = {*np.flatnonzero((self.chosen >= 2) & (abs(np.log(np.abs(self.factors) + 1e-300)) > np.log(MUCH_MORE)))}
        if far & {*self.turned, *(k for cause in self.causes for k in cause.joints)}:
            return False  # nothing else is known of a torque in unknown units
        if (self.good | gears & (self.exact <= WORSE * root.exact)).all():
            return True
        exactly = any(cause.number for cause in self.causes) or (self.chosen >= 2).any()
        return not exactly and root.rough.max() > EXPLAINED and bool((self.rough <= EXPLAINED).all())
