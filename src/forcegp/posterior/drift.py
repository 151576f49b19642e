"""Friction whose level drifts: a random walk d of each joint's dry friction, relative to what a fit found.

    M (a - a^) = d f + noise,    dd = rate dW,    d ~ N(0, between^2) at the beginning of another record

with f the force of all laws of dry friction. Deviations are found from blocks of a log by restricted maximum likelihood
of a local-level model (Harvey, "Forecasting, structural time series models and the Kalman filter", 1989, section 4.3).
A Kalman filter follows the level through other rows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from scipy.linalg import solve_triangular
from torch import Tensor

from forcegp.data import Dataset, with_memory
from forcegp.data.views import consecutive, in_blocks
from forcegp.forces.joint_law import JointLaw
from forcegp.forces.joint_laws import DryFriction
from forcegp.forces.registry import force_name
from forcegp.model import Model
from forcegp.summary import listed

Posterior = Any
"""A `Posterior`, whose module imports this one."""

BETWEEN = 0.03
"""Deviation of a friction level between records, relative, where a log has one: 2.9 % on an axis recorded twice (EMPS).
Of several it counts as much as one of them."""
BLOCKS, FEWEST = 80, 8  # of a log; of those that show a joint's friction, fewer tell no drift
ROWS = 10_000
SHOWN = 3.84
"""Twice the nats that a drift must explain: without any it is in 2.5 % of joints (Self & Liang 1987, at a bound)."""
LASTING = 2.0
"""Seconds for which errors of a model may resemble each other, as those of a posture do: longer ones are drift."""
SEEN = 0.02  # information about a level in a block, relative to the best one, below which the joint rests in it

REACH = 1.96  # deviations in a 95 % interval

EXACT = 1e-12  # noise of a log without any, relative to squares of friction
NAMES = "rate", "noise", "between", "level", "bias"
PerJoint = list[float]


@dataclass(frozen=True)
class Drift:
    """Per joint, relative to its dry friction; zeros where it has none, or too few rows show it."""

    between: PerJoint
    """Standard deviation of the level of another record."""
    rate: PerJoint
    """The same per root second within a record; 0 where the log shows none."""
    noise: list[PerJoint]
    """Intensity of the forces that else are missed, (nv, nv) in (Nm)^2 s or N^2 s."""
    bias: PerJoint
    """The level that forces of the log itself show: motions that a fit was refined on weigh its rows otherwise."""
    level: PerJoint
    """Of the laws now, over that of the fit, less 1."""
    std: PerJoint
    """What is unknown of it."""
    records: int
    seconds: float
    """How long they last."""
    until: float
    """Time of the last row."""
    here: Literal["unknown", "fit", "another"] = "unknown"
    """The record whose motions are predicted; `update` tells it."""

    def goes_on(self, begins: float) -> bool:
        """Whether rows that begin at this time are of the record of the last row."""
        return self.until < begins < self.until + self.seconds

    @property
    def shares(self) -> Float[np.ndarray, "2 1 1 1"]:
        """What is unknown now of one deviation of dry and of viscous friction."""
        # A level that was followed is that of their sum, alike in size: their difference is left, half of the variance
        dry = max((s / b for s, b in zip(self.std, self.between, strict=True) if b > 0.0), default=0.0)
        return np.array([dry, {"unknown": 1.0, "another": 0.5**0.5, "fit": 0.0}[self.here]])[:, None, None, None]

    def __str__(self) -> str:
        source = "assumed" if self.records == 1 else f"{self.records} records"
        walk = f", {max(self.rate):.2g} per root second within one" if any(self.rate) else ""
        now = [f"{x:+.1%} ± {REACH * s:.1%}" for x, s in zip(self.level, self.std, strict=True)]
        seen = "" if self.here == "unknown" else f"; now {listed(now)}"
        return f"± {REACH * max(self.between):.1%} between records ({source}){walk}{seen}"


def scaled(model: Model, factor: Float[Tensor, "*nv"], kind: type[JointLaw] = DryFriction) -> Model:
    """The model with this many times the dry friction in every joint, or the viscous one; widths and shapes stay."""
    forces = []
    for law in model.forces:
        if isinstance(law, kind):
            sizes = {name: x for name, x in law.values.items() if not law.coefficients[name].logarithm}
            law = law.with_values({name: x * factor.to(x) for name, x in sizes.items()})
        forces.append(law)
    return replace(model, forces=tuple(forces))


def with_drift(posterior: Posterior, log: Dataset) -> Posterior:
    """The posterior with its `Drift` in `settings`; as it is without dry friction, with contacts or a base that moves.

    `log` are the rows that it learned from, in the order of time.
    """
    model, tells = posterior.model, log.time_ordered and not posterior.is_black_box
    dry = any(isinstance(law, DryFriction) for law in model.laws) and not posterior.carries_known_forces
    if not (dry and tells) or model.contacts or not model.robot.space.is_vector_space:
        return posterior
    log = log.rows(slice(None, None, -(-len(log) // ROWS)))
    missed, friction, dt = _missed(posterior, log)
    since = np.concatenate([log.time[log.episode == k] - log.time[log.episode == k][0] for k in log.episodes])
    seconds = max(float(sum(since[log.episode == k].max() for k in log.episodes)) / BLOCKS, dt)
    starts = np.flatnonzero(np.r_[True, (np.diff(np.stack([log.episode, np.floor(since / seconds)])) != 0).any(axis=0)])
    covariance = missed.T @ missed / len(missed)
    weight = np.linalg.pinv(covariance, hermitian=True)
    information = dt * np.add.reduceat(np.einsum("ni,ij,nj->nij", friction, weight, friction), starts, axis=0)
    shown = dt * np.add.reduceat(friction * (missed @ weight), starts, axis=0)
    lasting = float(np.mean([since[log.episode == k].max() for k in log.episodes]))
    spread = np.linalg.pinv(information, hermitian=True)
    levels, found = (spread @ shown[..., None])[..., 0], []
    for joint, variance in enumerate(spread.diagonal(axis1=1, axis2=2).T):
        own = np.divide(1.0, variance, out=np.zeros_like(variance), where=variance > 0.0)
        kept = own > SEEN * own.max()
        if kept.sum() < FEWEST:
            found.append((0.0, 0.0, 0.0, 0.0))
            continue
        at = starts[kept]
        walk = random_walk(levels[kept, joint], own[kept], since[at] + 0.5 * seconds, log.episode[at], seconds)
        several = (BETWEEN**2 + (len(log.episodes) - 1) * walk[1]) / len(log.episodes)
        bias = np.average(levels[kept, joint], weights=own[kept])
        found.append((max(several, walk[0] * lasting) ** 0.5, walk[0] ** 0.5, walk[2], bias))
    between, rate, each, bias = np.array(found).T
    noise, until = covariance * np.sqrt(each * each[:, None]), float(log.time[log.episode == log.episodes[-1]].max())
    arrays = {"rate": rate, "noise": noise, "between": between, "level": 0.0 * rate, "bias": bias, "std": between}
    lists: dict[str, Any] = {name: values.tolist() for name, values in arrays.items()}
    drift = Drift(**lists, records=len(log.episodes), seconds=lasting, until=until)
    return posterior.with_settings(drift=asdict(drift))


def restricted_likelihood(y: Float[np.ndarray, " n"], covariance: Float[np.ndarray, "n n"]) -> tuple[float, float]:
    """log density of what y holds beside its mean, but for a constant, and c, where c `covariance` maximises it."""
    lower = np.linalg.cholesky(covariance)
    both = solve_triangular(lower, np.stack([np.ones_like(y), y], axis=1), lower=True, check_finite=False)
    ones, white = both[:, 0], both[:, 1]
    left = white - ones * (ones @ white) / (ones @ ones)
    c = max(float(left @ left) / (len(y) - 1), 1e-300)
    return float(-0.5 * ((len(y) - 1) * np.log(c) + np.log(ones @ ones)) - np.log(lower.diagonal()).sum()), c


def random_walk(
    y: Float[np.ndarray, " n"], information: Float[np.ndarray, " n"], time: np.ndarray, record: np.ndarray, width: float
) -> tuple[float, float, float]:
    """Variances of levels y per second and between records, and `noise`, for the variance noise / information of y.

    `time` is in s since the beginning of each record, and y are means over `width` s. What a model lacks lasts as well:
    y has such errors, too, which `noise` holds as they are at low frequencies. Hidden by them, the first variance is 0.
    """
    same, size = record[:, None] == record, 1.0 / float(np.median(information))
    lag, walked = abs(np.subtract.outer(time, time)), same * np.minimum.outer(time, time)
    found: dict[tuple[float, ...], tuple[float, float]] = {}
    grids = (
        [0.0, *np.geomspace(1e-4, 1e4, 49) * size / time.max()],
        [0.0, *np.geomspace(1e-2, 1e4, 25) * size] if len(np.unique(record)) > 1 else [0.0],
        [0.0, *np.geomspace(1e-2, 1e2, 17) * size],
        [k * width for k in (1.0, 2.0, 4.0, 8.0) if k * width <= max(width, LASTING)],
    )

    lasts = {seconds: same * np.exp(-lag / seconds) for seconds in grids[-1]}

    def nats(at: tuple[float, ...]) -> float:
        if at not in found:
            rate, between, lasting, seconds = at
            of_record = between * same + lasting * lasts[seconds]
            found[at] = restricted_likelihood(y, np.diag(1.0 / information) + rate * walked + of_record)
        return found[at][0]

    def best(at: tuple[float, ...], places: Sequence[int]) -> tuple[float, ...]:
        """One number after the other, until none changes."""
        before = None
        while before != at:
            before = at
            for k in places:
                at = max(((*at[:k], value, *at[k + 1 :]) for value in grids[k]), key=nats)
        return at

    nothing = 0.0, 0.0, 0.0, width
    steady = max((best(nothing, order) for order in ((1, 2, 3), (2, 3, 1))), key=nats)
    drifting = max((best(start, (0, 1, 2, 3)) for start in (nothing, steady)), key=nats)
    chosen = drifting if 2.0 * (nats(drifting) - nats(steady)) > SHOWN else steady
    noise, (rate, between, lasting, seconds) = found[chosen][1], chosen
    return rate * noise, between * noise, noise * (1.0 + 2.0 * lasting * seconds / (size * width))


def in_its_record(posterior: Posterior, begins: Sequence[float]) -> Posterior:
    """The posterior of motions in the record of the fit, whose level is known, if all begin soon after it."""
    stored: Mapping[str, Any] | None = posterior.settings.get("drift")
    if stored is None or stored["here"] != "unknown" or not all(map(Drift(**stored).goes_on, begins)):
        return posterior
    std = (max(begins) - stored["until"]) ** 0.5 * np.array(stored["rate"])
    return posterior.with_settings(drift={**stored, "here": "fit", "std": std.tolist()})


def followed(posterior: Posterior, rows: Dataset) -> Posterior:
    """What `Posterior.update` says of laws without unknown forces beside them."""
    stored: Mapping[str, Any] | None = posterior.settings.get("drift")
    if stored is None or posterior.trained.unknown_forces or not rows.time_ordered:
        return posterior
    drift = Drift(**stored)
    rate, noise, between, level, bias = (np.array(getattr(drift, name)) for name in NAMES)
    missed, friction, dt = _missed(posterior, rows)
    own = np.flatnonzero(between)
    missed, friction, noise = missed[:, own], friction[:, own], noise[np.ix_(own, own)] / dt
    noise += EXACT * np.diag(np.square(friction).mean(0))
    d, P, here = np.zeros_like(own, dtype=float), np.diag(np.square(drift.std)[own]), drift.here
    for number in rows.episodes:
        record = np.flatnonzero(rows.episode == number)
        begins = float(rows.time[record][0])
        ages = np.diff(rows.time[record], prepend=begins)
        if number == rows.episodes[0] and drift.goes_on(begins):
            here, ages[0] = ("fit" if here == "unknown" else here), begins - drift.until
            P = P if drift.here == "another" else 0.0 * P
        else:  # its level is about that of the fit
            here, d, P = "another", -level[own] / (1.0 + level[own]), np.diag(between[own] ** 2)
        for row, age in zip(record, ages, strict=True):
            P, f = P + age * np.diag(rate[own] ** 2), friction[row]
            gain = np.linalg.solve(f[:, None] * P * f + noise, f[:, None] * P).T
            d, P = d + gain @ (missed[row] - (bias[own] + d) * f), P - gain @ (f[:, None] * P)
    moved, std = np.zeros_like(level), np.zeros_like(level)
    moved[own], std[own] = np.maximum(d, -1.0), np.sqrt(P.diagonal())  # friction never pushes
    level, until = (1.0 + level) * (1.0 + moved) - 1.0, float(rows.time[rows.episode == rows.episodes[-1]].max())
    drift = replace(drift, level=level.tolist(), std=std.tolist(), until=until, here=here)
    louder = scaled(posterior.model, torch.as_tensor(1.0 + moved))
    laws = [law for law in posterior.trained.laws if isinstance(law, DryFriction)]
    names = [f"{force_name(law)}.{x}" for law in laws for x, of in law.coefficients.items() if not of.logarithm]
    place = {f"{name}.{joint}": j for name in names for j, joint in enumerate(posterior.joint_names)}
    entries = list(posterior.estimates.entries)
    for k, each in enumerate(entries):  # at the new level, with what is unknown of that
        if (j := place.get(each.name)) is not None:
            value, spread = float(each.value * (1.0 + moved[j])), float(np.hypot(each.std, std[j] * each.value))
            entries[k] = replace(each, value=value, std=spread)
    estimates = replace(posterior.estimates, entries=tuple(entries))
    return replace(posterior, target=louder, estimates=estimates).with_settings(drift=asdict(drift))


def _missed(posterior: Posterior, rows: Dataset) -> tuple[np.ndarray, np.ndarray, float]:
    """Forces that the mean lacks, and of dry friction, at its motors or joints (rows, nv); the step of time in s."""
    model = posterior.model
    rows = with_memory(rows, model)

    def of(q: Tensor, v: Tensor, u: Tensor, a: Tensor) -> tuple[Tensor, ...]:
        away = a - posterior.predict_rows(q, v, u, False).mean
        state, M = model.state(q, v, u), posterior.dynamics(q, v, u).M
        laws = [law for law in model.laws if isinstance(law, DryFriction)]
        dry = torch.stack([law.force(state) for law in laws]).sum(0)
        return laws[0].at_motors((M @ away[..., None])[..., 0]), laws[0].at_motors(dry)

    missed, friction = in_blocks(rows, of, model.robot.device)
    steps = np.diff(rows.time)[consecutive(rows)[:-1]]
    return missed, friction, float(np.median(steps)) if len(steps) else 1.0
