"""Which contacts with a switch act in which rows: from the motion of what they hold, and from the forces that it needs.

What the rows ask of all contacts is lambda = argmin |L^-1 (M a - Q_K - A^T lambda)|, M = L L^T: Gauss' principle.
"""

from dataclasses import dataclass, replace
from warnings import warn

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

import forcegp.mechanics
from forcegp.data.dataset import Dataset
from forcegp.data.views import in_blocks
from forcegp.errors import ContactError, DatasetError, DataWarning
from forcegp.mechanics.gauss_principle import OPEN

WINDOW, BETWEEN, EDGE = 0.04, 0.1, 0.015
"""s: of the averages; of open rows that follow those around them; on either side of what is not sure."""
SLOW, DEVIATIONS, CLEARLY, LOUD = 0.01, 2.3, 2.0, 0.3
"""m/s that is rest, or root-mean-square noises (99.9 % of three normal numbers) if more; times that which moves; m/s
of noise beyond which slow and fast cannot be told apart."""
QUARTER = 0.3186
"""Of |x| of a normal number, in standard deviations: a quarter of the rows is quiet also where a foot moves much."""
FREE, LEAST, BEARS = 0.95, 0.02, 0.4
"""Quantile of the forces on feet that clearly move; shares of the force above and below which feet at rest carry half
of all that they carry: nothing, surely bearing."""
CERTAIN, APART = 20.0, 1.5
"""How much likelier one class of forces is than the other; distance of their means over the sum of their widths."""
FALLS, SURE = 0.2, 0.1
"""Of the weight: nothing bears this while a robot falls, something where it stands; noise up to which it decides."""
LIFTED, USUAL = 0.004, 0.75
"""m above or below the place where a foot stood last or stands next, from which on it does not drag, beside noise;
quantile of what the rows ask of feet that are lifted, above which one that is not may bear."""
FEW = 10
MANY_OPEN = 0.25  # share of open rows that more than changes of stance leave
OfSwitches = Float[np.ndarray, "rows switches"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Stance:
    """Flags (rows, switches) of the contacts called `names`: 1 acts, 0 does not, NaN where the rows leave it open.

    `speed` [m/s] is that of what the contact holds, averaged over 40 ms, `slow` (switches,) below which it rests;
    `force` [N] what the rows ask of it, `bearing` (2,) up to which nothing bears, from which it stands, or NaN.
    """

    names: tuple[str, ...]
    flags: OfSwitches
    speed: OfSwitches
    slow: Float[np.ndarray, " switches"]
    force: OfSwitches
    bearing: Float[np.ndarray, " 2"]

    @property
    def moves(self) -> Bool[np.ndarray, "rows switches"]:
        """Where a foot clearly moves."""
        return self.speed >= CLEARLY * self.slow

    def rows(self, index: Int[np.ndarray, " kept"]) -> "Stance":
        """The same for some of the rows."""
        return replace(self, **{name: getattr(self, name)[index] for name in ("flags", "speed", "force")})

    def filled(self, dataset: Dataset) -> Dataset:
        """All rows, where open ones have the flag of the nearest row that is decided. Raises DatasetError for none."""
        rows, decided = np.arange(len(self.flags)), np.isfinite(self.flags)
        if not decided.any(axis=0).all():
            raise self._open(len(rows))
        of_feet = zip(self.flags.T, decided.T, strict=True)
        nearest = [np.interp(rows, rows[known], own[known]) > 0.5 for own, known in of_feet]
        return replace(dataset, u=np.column_stack([dataset.u[:, : -len(self.names)], *nearest]))

    def written(self, dataset: Dataset) -> Dataset:
        """The rows with these flags in the last columns of u, open ones as `OPEN`. Raises DatasetError for no other.

        Whether a foot rests or slides, its force pushes at one point: open rows still show what joints need beside it.
        """
        flags = np.nan_to_num(self.flags, nan=OPEN)
        rows = replace(dataset, u=np.column_stack([dataset.u[:, : -len(self.names)], flags]))
        decided = np.isfinite(self.flags).all(axis=1)
        if not decided.any():
            raise self._open(len(rows))
        if decided.mean() < 1.0 - MANY_OPEN:
            seen = f"motion and forces leave the stance open in {1.0 - decided.mean():.0%} of the rows"
            why = "velocities are noisy (filter them: `cutoff='auto'`), stance is as short as what a filter smears"
            why = f"{why}, feet slip or lean, or touch at other points than those given"
            warn(f"{seen}, of which torques alone are used: {why}.", DataWarning, stacklevel=3)
        return rows

    def _open(self, rows: int) -> DatasetError:
        seen = f"motion and forces leave the stance open in all {rows} rows"
        advice = f"give the flags {', '.join(self.names)} in the last columns of u, or filter the velocities first."
        return DatasetError(f"{seen}; {advice}")


def estimate_stance(dataset: Dataset, model: forcegp.Model | None = None) -> Stance:
    """Flags of all contacts with a switch from q, v, u and a; those that u holds are not looked at.

    What clearly moves is free if it does not bear; what rests stands if it bears, and is free if it bears nothing. Up
    to 0.1 s in between follow decided rows on both sides that agree; all else is open (NaN), with 30 ms about it and
    about a change; so are rows in which what stands contradicts the weight that is borne, or in which what is free has
    the height, to 4 mm, at which it stood last or stands next, and is asked for more than three quarters of the rows
    of lifted feet: one that drags bears a little. Rest is slower than 1 cm/s or 2.3 times the noise of v. Raises
    ContactError without contacts that have a switch.
    """
    model = dataset.model if model is None else model
    if not (names := model.switches):
        seen = "no contact of the model has a switch, so there is no stance to find"
        raise ContactError(f"{seen}; give one, for example fixed_point('foot', switch='foot_stands').")
    order = np.argsort(dataset.time, kind="stable")
    episodes = [order[dataset.episode[order] == number] for number in dataset.episodes]
    motion, asked, height = _motion_and_force(dataset, model, names)
    drags = LIFTED + DEVIATIONS * np.array([_noise(z[:, None], episodes, [1] * len(episodes)) for z in height.T])
    speed, force = (np.empty((len(dataset), len(names))) for _ in range(2))
    noise, times = np.empty(len(names)), [dataset.time[rows] for rows in episodes]
    widths = [2 * int(0.5 * WINDOW / np.median(np.diff(t))) + 1 if len(t) > 1 else 1 for t in times]
    for k, (own, needed) in enumerate(zip(motion, asked, strict=True)):
        smooth = np.empty_like(own)
        for rows, width in zip(episodes, widths, strict=True):
            smooth[rows] = _mean(own[rows], width)
            force[rows, k] = np.linalg.norm(_mean(needed[rows], width), axis=1)
        speed[:, k] = np.linalg.norm(smooth, axis=1)
        noise[k] = max(_noise(smooth, episodes, [times * width for width in widths]) for times in (1, 2))
    slow = np.maximum(SLOW, DEVIATIONS * noise)
    rests, moves = (speed <= slow) & (slow <= LOUD), speed >= CLEARLY * slow
    bearing = _bearing(force, moves, quiet=bool((slow <= LOUD).all()))
    bears, unloaded = (force >= bearing[1], force <= bearing[0]) if np.isfinite(bearing).all() else (rests, moves)
    flags = np.full(force.shape, np.nan)
    flags[~moves & bears], flags[unloaded] = 1.0, 0.0
    low = np.zeros(force.shape, dtype=bool)
    for rows in episodes:
        flags[rows] = _between(flags[rows], dataset.time[rows])
        low[rows] = _as_low(flags[rows], height[rows], drags)
    for own, as_low, needed in zip(flags.T, low.T, force.T, strict=True):
        lifted = needed[(own == 0.0) & ~as_low]  # these bear nothing, whatever the rows ask of them
        own[(own == 0.0) & as_low & (needed > (np.quantile(lifted, USUAL) if len(lifted) else 0.0))] = np.nan
    flags[moves & bears] = np.nan
    robot, whole, weight = model.robot, np.sum(asked, axis=0), 0.0
    if robot.base == "floating" and all(contact.switch for contact in model.contacts):  # which alone hold the robot up
        weight = float(robot.gravity.norm()) * robot.mass
    sure = _noise(whole, episodes, [1] * len(episodes)) < SURE * weight * min(widths) ** 0.5
    for rows, width in zip(episodes, widths, strict=True):
        falls = np.linalg.norm(_mean(whole[rows], width), axis=1) < FALLS * weight
        stands = (flags[rows] == 1.0).any(axis=1)
        flags[rows[(falls & stands & sure) | (~falls & ~stands & (weight > 0.0))]] = np.nan
    return Stance(names=names, flags=flags, speed=speed, slow=slow, force=force, bearing=bearing)


def _mean(values: Float[np.ndarray, "rows k"], width: int) -> Float[np.ndarray, "rows k"]:
    """Over windows of `width` rows about each, an odd number; windows are shorter at the ends."""
    total, place = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)]), np.arange(len(values))
    first, last = np.maximum(place - width // 2, 0), np.minimum(place + width // 2 + 1, len(values))
    return (total[last] - total[first]) / (last - first)[:, None]


def _motion_and_force(
    dataset: Dataset, model: forcegp.Model, names: tuple[str, ...]
) -> tuple[list[Float[np.ndarray, "rows m"]], list[Float[np.ndarray, "rows 3"]], OfSwitches]:
    """A v of the contacts of every switch, the force that the rows ask of them, and how high they are."""
    of = [[k for k, contact in enumerate(model.contacts) if contact.switch == name] for name in names]
    places = [model.inputs.index(name) for name in names]
    up, at = -model.robot.gravity / model.robot.gravity.norm().clamp(min=1e-9), [model.contacts[own[0]] for own in of]
    held = [(each, torch.tensor([*each.point, 1.0]).to(up)) for each in at]

    def found(q: Tensor, v: Tensor, u: Tensor, a: Tensor) -> tuple[Tensor, ...]:
        u[:, places] = 1.0
        dynamics = model.dynamics(q, v, u)
        white = dynamics.inverse_lower @ (dynamics.M @ a[..., None] - dynamics.Q_K[..., None])
        forces, rates = dynamics.normals * (dynamics.pseudo_inverse.mT @ white), (dynamics.A @ v[..., None])[..., 0]
        poses = [dynamics.state.kinematics.frame_pose(each.frame) @ points[..., None] for each, points in held]
        high = torch.stack([pose[..., :3, 0] @ up for pose in poses], -1)
        return *(rates[:, rows] for rows in of), *(forces[:, rows].sum(1) for rows in of), high

    *both, height = in_blocks(dataset, found, model.robot.device)
    return both[: len(names)], both[len(names) :], height


def _noise(values: Float[np.ndarray, "rows m"], episodes: list[np.ndarray], strides: list[int]) -> float:
    """Root-mean-square noise by third differences over these strides, also of what a filter made alike nearby."""
    differences = [
        values[rows[3 * n :]] - 3.0 * values[rows[2 * n : -n]] + 3.0 * values[rows[n : -2 * n]] - values[rows[: -3 * n]]
        for rows, n in zip(episodes, strides, strict=True)
        if len(rows) > 3 * n
    ]
    if not differences:
        return 0.0
    return float(np.linalg.norm(np.quantile(np.abs(np.concatenate(differences)), 0.25, axis=0) / (QUARTER * 20.0**0.5)))


def _bearing(force: np.ndarray, moves: np.ndarray, quiet: bool = True) -> Float[np.ndarray, " 2"]:
    """Forces up to which nothing bears, and from which a foot stands [N]; NaN where they do not differ.

    Logarithms of forces in two normal classes, split with the least error (Kittler & Illingworth 1986); in between
    neither class is `CERTAIN` times as likely. Where hardly a foot moves, shares of what they carry.
    """
    carried = np.sort(force[~moves])  # by what they carry: of a foot that swings most of the time, rest is rare
    standing = float(carried[np.searchsorted(carried.cumsum(), 0.5 * carried.sum())]) if len(carried) else 0.0
    few = moves.sum() < FEW
    usual = np.array([LEAST, BEARS]) * standing if standing > 0.0 else np.full(2, np.nan)
    if few and quiet:
        return usual
    logs = np.sort(np.log(np.maximum(force.ravel(), 1e-3 * standing + 1e-12)))
    best, limits = np.inf, np.full(2, np.nan)
    for count in np.unique(np.linspace(0.02 * len(logs), 0.98 * len(logs), 99).astype(int)):
        if min(count, len(logs) - count) < FEW:
            continue
        parts = logs[:count], logs[count:]
        shares = np.array([count, len(logs) - count]) / len(logs)
        means, widths = (np.array([of(part) for part in parts]) for of in (np.mean, lambda part: np.std(part) + 1e-3))
        cost = 2.0 * (shares * np.log(widths / shares)).sum()
        if cost < best and means[1] - means[0] > APART * widths.sum():
            between = np.linspace(means[0], means[1], 200)
            density = np.log(shares / widths) - 0.5 * np.square((between[:, None] - means) / widths)
            likelier, sure = density[:, 1] - density[:, 0], np.log(CERTAIN)
            if (likelier < -sure).any() and (likelier > sure).any():
                best, limits = cost, np.exp([between[likelier < -sure][-1], between[likelier > sure][0]])
    if not (limits[0] <= BEARS * standing and (few or np.median(force[moves]) < limits[1])):
        return np.full(2, np.nan)
    return usual if few else np.array([min(limits[0], np.quantile(force[moves], FREE)), limits[1]])


def _beside(places: Int[np.ndarray, " k"], rows: Int[np.ndarray, " rows"]) -> tuple[np.ndarray, np.ndarray]:
    """Of these places the last up to each row and the first from it on; at the ends the nearest."""
    before = places[np.maximum(np.searchsorted(places, rows, side="right") - 1, 0)]
    return before, places[np.minimum(np.searchsorted(places, rows), len(places) - 1)]


def _as_low(flags: OfSwitches, height: OfSwitches, least: np.ndarray) -> Bool[np.ndarray, "rows switches"]:
    """Where a contact is hardly above or below where it acted last, or acts next."""
    rows, low = np.arange(len(flags)), np.zeros(flags.shape, bool)
    for own, z, out, lift in zip(flags.T, height.T, low.T, least, strict=True):
        stood = np.flatnonzero(own == 1.0)
        if len(stood):
            before, after = _beside(stood, rows)
            out[:] = np.minimum(np.abs(z - z[before]), np.abs(z - z[after])) < lift
    return low


def _between(flags: np.ndarray, time: Float[np.ndarray, " rows"]) -> np.ndarray:
    """Open rows with what was decided before and after them, where that is the same; rows near others are open."""
    rows, filled = np.arange(len(flags)), flags.copy()
    for own, out in zip(flags.T, filled.T, strict=True):
        decided = np.flatnonzero(np.isfinite(own))
        if len(decided):
            before, after = _beside(decided, rows)
            same = (own[before] == own[after]) & (time[after] - time[before] <= BETWEEN)
            out[same] = own[before[same]]
        unsure = np.isnan(out)
        unsure[:-1] |= np.diff(out) != 0.0
        if unsure.any():
            at = time[unsure]
            near = np.searchsorted(at, time).clip(1, len(at) - 1) if len(at) > 1 else np.zeros(len(time), int)
            out[np.minimum(np.abs(time - at[near - 1]), np.abs(time - at[near])) <= EDGE] = np.nan
    return filled
