"""Which parts of gear friction a log shows, joint by joint, by stretches held out: memory, load, speed, breakaway."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from forcegp.data import Dataset, evenly, with_memory, with_strokes
from forcegp.data.views import tensors
from forcegp.evidence import Torques, motion_residuals
from forcegp.fit.physical import fit_physical
from forcegp.forces import Coulomb, DirectionalFriction, DryFriction, GearFriction, LogNormal, Normal, Viscous
from forcegp.forces.presliding import after_strokes
from forcegp.mechanics import State
from forcegp.model import Model

PARTS = "memory", "factor", "root", "direction", "breakaway"
"""Of `GearFriction`, and of the law beside it."""
BLOCKS = 10
"""Stretches of the log, each predicted from the others."""
CLEARLY, LIKELY = 1.5, 0.5
"""Standard errors over the stretches by which a part must lower the squared residual; and memory, which gears have."""
LEAST, LITTLE = 0.05, 0.007
"""Share of it by which a part must do so, and memory."""
FALLS = tuple(np.geomspace(0.04, 0.6, 7).tolist())
"""Of the root mean square velocity, what a breakaway may fall over here; a fit finds the rest."""
COLUMNS = 6 + len(FALLS)
"""Of each joint: viscous, dry, load, root of speed, direction, a constant, and breakaways."""
HIGHEST = 0.5
"""Largest share of the load that friction takes: beyond it something else is explained."""
REVERSALS = 6
"""Fewest reversals of a joint that can show memory."""
WIDTHS = tuple(np.geomspace(0.003, 1.0, 11).tolist())
"""Of the smooth sign, over the root mean square velocity."""
SEEN, RIDGE = 0.003, 1e-7
"""Of the torque of bodies, the least that counts over the largest; and what is added to the normal equations."""
FINER = 3
"""Times that the distance of widths, and of stiffnesses, is halved around the best one."""
PASSES = 2
"""Over the joints."""
MOST_ROWS = 10_000
"""Of the log that are asked, evenly spread: each knows its past."""
FIRST_ROWS = 2000
"""Rows of the first fit."""
STIFFNESS = tuple(np.geomspace(10.0, 10000.0, 13).tolist())
"""Of the memory, over the reciprocal root mean square position."""


@dataclass(frozen=True)
class FrictionChoice:
    """The parts of friction that joints have, and what held-out squared residuals say of each."""

    joints: tuple[str, ...]
    parts: tuple[tuple[str, ...], ...]
    ratios: tuple[float, ...]
    """Root mean square of what is left at a joint, over that without any of these parts."""
    few_reversals: tuple[str, ...]
    sigma: tuple[float, ...]
    """Stiffness of the memory of each joint in 1/rad or 1/m, roughly; 0 without."""
    falls: tuple[float, ...]
    """Velocity that a breakaway would fall over, roughly."""

    def to_dict(self) -> dict[str, Any]:
        """For the settings of a fit."""
        found = {name: list(parts) for name, parts in zip(self.joints, self.parts, strict=True)}
        return {"parts": found, "left": list(self.ratios), "few_reversals": list(self.few_reversals)}

    def has(self, part: str) -> Bool[np.ndarray, " nv"]:
        """By joint."""
        return np.array([part in each for each in self.parts])


def choose_friction(model: Model, log: Dataset, parts: Sequence[str] = PARTS) -> FrictionChoice:
    """The parts of friction by which held-out stretches of the log are predicted better, joint by joint.

    `model` is one whose other numbers are known; its friction is left out. The torque that is left is regressed on
    viscous and dry friction of all joints, on parameters of bodies, which may be off, and on the parts. At each joint
    the part that helps most is added while it helps by more than `CLEARLY` standard errors over the stretches.
    """
    log = with_strokes(log)
    log = log.rows(evenly(log, MOST_ROWS))
    friction = (Viscous, Coulomb, GearFriction, DirectionalFriction)
    bare = replace(model, forces=tuple(force for force in model.forces if not isinstance(force, friction)))
    torque = motion_residuals(replace(log, strokes=None), bare)[0]
    state = bare.state(*(torch.as_tensor(np.array(x), device=bare.robot.device) for x in (log.q, log.v, log.u)))
    strokes = log.strokes
    regression = _Regression(model, log, state, torque)
    single, few = np.isin(log.joint_names, bare.robot.single_joint_names), []
    moving = [j for j in np.flatnonzero(single).tolist() if log.v[:, j].any()]
    for j in moving:
        turns = 0 if strokes is None else int((np.diff(np.sign(strokes[:, j, 0])) != 0).sum())
        if strokes is not None and turns >= REVERSALS:
            spread = max(float(state.positions[:, j].std()), 1e-9)
            regression.remember(j, strokes[:, j], [each / spread for each in STIFFNESS])
        else:
            few.append(log.joint_names[j])
    for _ in range(PASSES):
        for j in moving:
            regression.choose(j, parts)
    chosen = [regression.parts.get(j, ()) for j in range(len(log.joint_names))]
    parts_found, ratios = tuple(chosen), tuple(regression.ratios)
    sigma, falls = regression.sigma, tuple((regression.speed * np.array(FALLS)[regression.fall]).tolist())
    return FrictionChoice(tuple(log.joint_names), parts_found, ratios, tuple(few), sigma, falls)


def _folds(log: Dataset) -> np.ndarray:
    """The stretch of every row: whole episodes where there are many, else equal parts of each."""
    if len(log.episodes) >= BLOCKS:
        return np.unique(log.episode, return_inverse=True)[1] % BLOCKS
    out = np.zeros(len(log), dtype=int)
    for episode in log.episodes:
        rows = np.flatnonzero(log.episode == episode)
        for number, part in enumerate(np.array_split(rows[np.argsort(log.time[rows])], BLOCKS)):
            out[part] = number
    return out


Sums = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Of a joint under one sign, by stretch: its columns times those of bodies, times themselves, and times the torque."""


class _Regression:
    """Weighted normal equations of all joints by stretch: bodies together, friction of each joint by itself."""

    def __init__(self, model: Model, log: Dataset, state: State, torque: Float[np.ndarray, "rows nv"]) -> None:
        self.nv, self.fold = torque.shape[1], _folds(log)
        self.count = int(self.fold.max()) + 1
        noise = np.sqrt((motion_residuals(log, model)[0] ** 2).mean(0))
        self.weight = 1.0 / np.maximum(noise, 1e-6 * max(float(noise.max()), 1e-12))
        self.v, self.load = np.asarray(log.v), np.abs(state.delivered.cpu().numpy() - torque)  # of the model
        a = torch.as_tensor(np.array(log.a), device=state.q.device)
        Y = state.kinematics.torque_regressor(a).flatten(2).cpu().numpy() * self.weight[:, None]
        sizes, vectors = np.linalg.eigh(np.tensordot(Y, Y, ((0, 1), (0, 1))))
        kept = sizes > SEEN**2 * sizes.max()
        self.bodies = Y @ (vectors[:, kept] / np.sqrt(sizes[kept] / len(Y)))
        self.torque = torque * self.weight
        rows = [self.fold == k for k in range(self.count)]
        self.inner = np.stack([np.einsum("nji,njk->jik", self.bodies[k], self.bodies[k]) for k in rows])
        self.target = np.stack([np.einsum("nji,nj->ji", self.bodies[k], self.torque[k]) for k in rows])
        self.squares = np.stack([(self.torque[k] ** 2).sum(0) for k in rows])
        self.rows = rows
        self.speed = np.maximum(np.sqrt((self.v**2).mean(0)), 1e-12)
        self.past: dict[int, torch.Tensor] = {}
        self.signs = [{-width: self._sums(j, -width) for width in WIDTHS} for j in range(self.nv)]
        self.at, self.fall = [-WIDTHS[1]] * self.nv, [len(FALLS) // 2] * self.nv
        """The sign of each joint: minus a width, or the stiffness of a memory; and which of `FALLS` it has."""
        self.parts: dict[int, tuple[str, ...]] = {}
        self.ratios = [1.0] * self.nv

    @property
    def sigma(self) -> tuple[float, ...]:
        """Of the memory of each joint; 0 where there is none."""
        return tuple(max(each, 0.0) for each in self.at)

    def remember(self, j: int, strokes: Float[np.ndarray, "rows strokes"], stiffness: Sequence[float]) -> None:
        """Let a joint have memory."""
        self.past[j] = torch.as_tensor(np.array(strokes))
        self.signs[j] |= {sigma: self._sums(j, sigma) for sigma in stiffness}

    def _sums(self, j: int, at: float) -> Sums:
        v = self.v[:, j]
        s = after_strokes(self.past[j], torch.tensor(at)).numpy() if at > 0.0 else np.tanh(v / (-at * self.speed[j]))
        slow = (np.exp(-((v / (fall * self.speed[j])) ** 2)) * s for fall in FALLS)
        columns = [v, s, self.load[:, j] * s, np.sqrt(np.abs(v)) * s, np.abs(v), np.ones_like(v), *slow]
        F, Z, y = np.stack(columns, axis=1) * self.weight[j], self.bodies[:, j], self.torque[:, j]
        return (
            np.stack([Z[k].T @ F[k] for k in self.rows]),
            np.stack([F[k].T @ F[k] for k in self.rows]),
            np.stack([F[k].T @ y[k] for k in self.rows]),
        )

    def choose(self, j: int, parts: Sequence[str]) -> None:
        """Parts of one joint, those of the others being as they are."""
        self.beside = self._beside(j)
        best, here = self._refined(j, ()), ()
        first = best
        both = [("memory", part) for part in ("root", "breakaway")]  # a level that changes with speed hides reversals
        steps = [(part,) for part in parts] + both
        while True:
            left = [(*here, *step) for step in steps if not set(step) & set(here)]
            left = [each for each in left if "memory" not in each or max(self.signs[j]) > 0.0]
            if not left:
                break
            tried = {each: self._fitted(j, each) for each in left}
            there = min(left, key=lambda each: tried[each][1].sum())
            if not self._clearly(best[1], tried[there][1], "memory" in {*there} - {*here}):
                break
            best, here = self._refined(j, there) if "memory" in {*there} - {*here} else tried[there], there
        rest = tuple(part for part in here if part != "root")  # which stands in for a breakaway that came later
        if rest != here and "breakaway" in here and not self._clearly((without := self._fitted(j, rest))[1], best[1]):
            best, here = without, rest
        self.at[j], self.fall[j], self.parts[j] = *best[0], here
        self.ratios[j] = float(np.sqrt(best[1].sum() / max(first[1].sum(), 1e-300)))

    def _clearly(self, without: np.ndarray, best: np.ndarray, memory: bool = False) -> bool:
        """Whether squared residuals of held-out stretches are lower by more than chance and by a share that counts."""
        gain = without - best
        if not np.isfinite(gain).all():
            return bool(np.isfinite(best).all())
        errors, share = (LIKELY, LITTLE) if memory else (CLEARLY, LEAST)
        noise = errors * np.sqrt(self.count) * gain.std(ddof=1) if self.count > 1 else 0.0
        return bool(gain.sum() > max(noise, share * without.sum()))

    def _refined(self, j: int, parts: tuple[str, ...]) -> tuple[tuple[float, int], Float[np.ndarray, " stretches"]]:
        """`_fitted`, with signs between those of the grid."""
        step = WIDTHS[1] / WIDTHS[0]
        for _ in range(FINER):
            step **= 0.5
            at = self._fitted(j, parts)[0][0]
            self.signs[j] |= {each: self._sums(j, each) for each in (at * step, at / step)}
        return self._fitted(j, parts)

    def _fitted(self, j: int, parts: tuple[str, ...]) -> tuple[tuple[float, int], Float[np.ndarray, " stretches"]]:
        """The sign and fall that fit all rows best, and squared residuals of the joint in every stretch by the others.

        The fall is sought at the sign that fits best under the usual one.
        """
        signs, at = [each for each in self.signs[j] if (each > 0.0) == ("memory" in parts)], self.fall[j]
        sign = min(signs, key=lambda sign: self._residuals(j, parts, (sign, at), False).sum())
        falls = range(len(FALLS)) if "breakaway" in parts else (at,)
        best = sign, min(falls, key=lambda fall: self._residuals(j, parts, (sign, fall), False).sum())
        return best, self._residuals(j, parts, best, True)

    def _residuals(self, j: int, parts: tuple[str, ...], sign: tuple[float, int], held_out: bool) -> np.ndarray:
        """Squared residuals of a joint in every stretch, by numbers from all rows or from the other stretches."""
        across, inner, right = self._open(j, parts, sign)
        (A, b), first = self.beside, across.shape[1]
        n, m = b.shape[1], b.shape[1] + right.shape[1]
        own, own_b = np.r_[0:first, n:m], np.concatenate([self.target[:, j], right], axis=1)
        own_A = np.block([[self.inner[:, j], across], [across.swapaxes(1, 2), inner]])

        def joined(rows: slice | list[int]) -> tuple[np.ndarray, np.ndarray]:
            normal, target = np.zeros((m, m)), np.zeros(m)
            normal[:n, :n], target[:n] = A[rows].sum(0), b[rows].sum(0)
            normal[np.ix_(own, own)] += own_A[rows].sum(0)
            target[own] += own_b[rows].sum(0)
            return normal, target

        whole, given = joined(slice(None))
        scale = np.sqrt(whole.diagonal().clip(1e-300))
        out, numbers = np.zeros(self.count), np.zeros(m)
        for k in range(self.count):
            if k == 0 or held_out:
                without = joined([k]) if held_out else (0.0, 0.0)
                normal = (whole - without[0]) / np.outer(scale, scale)
                numbers = np.linalg.solve(normal + RIDGE * np.eye(m), (given - without[1]) / scale) / scale
                loads = "factor" not in parts or 0.0 <= numbers[n + 2] <= HIGHEST
                if not loads or ("breakaway" in parts and numbers[-1] < 0.0):
                    return np.full(self.count, np.inf)
            x = numbers[own]
            out[k] = self.squares[k, j] - 2.0 * x @ own_b[k] + x @ own_A[k] @ x
        return out

    def _open(self, j: int, parts: tuple[str, ...], sign: tuple[float, int]) -> Sums:
        """Of the columns of a joint that these parts need."""
        across, inner, right = self.signs[j][sign[0]]
        breaks = ("breakaway" in parts and fall == sign[1] for fall in range(len(FALLS)))
        open_ = np.flatnonzero([True, True, *(part in parts for part in PARTS[1:-1]), True, *breaks])
        return across[..., open_], inner[:, open_][..., open_], right[:, open_]

    def _beside(self, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations of all other joints by stretch, in bodies and the columns that they need."""
        joints = [i for i in range(self.nv) if i != j]
        sums = [self._open(i, self.parts.get(i, ()), (self.at[i], self.fall[i])) for i in joints]
        first = self.inner.shape[-1]
        size = first + sum(right.shape[1] for *_, right in sums)
        A, b, end = np.zeros((self.count, size, size)), np.zeros((self.count, size)), first
        A[:, :first, :first], b[:, :first] = self.inner[:, joints].sum(1), self.target[:, joints].sum(1)
        for across, inner, right in sums:
            place = slice(end, end + right.shape[1])
            A[:, :first, place], A[:, place, place], b[:, place] = across, inner, right
            A[:, place, :first], end = across.swapaxes(1, 2), place.stop
        return A, b


def with_friction_chosen(model: Model, log: Dataset, evidence: Torques) -> tuple[Model, FrictionChoice | None]:
    """The model whose gear friction without a stated `memory` has the parts that the log shows; None for no such law.

    Loads and what friction has to explain are those of a first fit with dry friction alone.
    """
    gears = [force for force in model.laws if isinstance(force, GearFriction)]
    if not any(force.memory is None and force.level is None for force in gears):
        return model, None
    plain = tuple(Coulomb().bound_to(model.robot) if force in gears else force for force in model.laws)
    found = fit_physical(replace(model, forces=plain), [log], evidence, rows=FIRST_ROWS).model
    beside = any(isinstance(law, DirectionalFriction) and law.learned for law in model.laws)
    choice = choose_friction(found, log, [part for part in PARTS if beside or part != "direction"])
    return with_choice(model, choice), choice


def with_choice(model: Model, choice: FrictionChoice) -> Model:
    """The model whose gear friction and directions have the parts that were chosen, each to be estimated."""

    def only(part: str, start: float) -> Normal:
        has = choice.has(part)
        return Normal((start * has).tolist(), np.where(has, np.nan, 0.0).tolist())

    made = []
    for force in model.forces:
        if isinstance(force, GearFriction) and force.memory is None:
            names = tuple(name for name, has in zip(choice.joints, choice.has("memory"), strict=True) if has)
            stiffness = LogNormal([each or 1.0 for each in choice.sigma])
            falls = LogNormal([each or 1.0 for each in choice.falls], choice.has("breakaway").astype(float).tolist())
            force = replace(
                force, memory=names or False, factor=only("factor", 0.05), root=only("root", 0.0), sigma=stiffness,
                breakaway=only("breakaway", 0.0), stribeck_velocity=falls,
            )  # fmt: skip
        elif isinstance(force, DirectionalFriction) and force.difference is None:
            force = replace(force, difference=only("direction", 0.0))
        made.append(force)
    return replace(model, forces=tuple(made))


def friction_in_words(model: Model, log: Dataset, unit: str) -> str:
    """Dry friction of the joints at the speed and load of the log (root mean squares), near rest, and its memory."""
    [law] = [law for law in model.laws if isinstance(law, DryFriction)]
    state = model.state(*tensors(with_memory(log, model), model.robot.device)[:3])
    v, load = (x.square().mean(0).sqrt() for x in (state.v, state.delivered))
    numbers = (law.level_at((speed, load), law.values).expand(v.shape) for speed in (v, 0.0 * v))
    joints = [log.joint_names.index(name) for name in model.robot.single_joint_names]
    moving, rest = (each[joints] for each in numbers)
    text = f"{_listed(moving)} {unit}, near rest {_listed(rest - moving)} more"
    if not (remember := law.memory_joints(model.robot)):
        return text
    ways = 1e3 / law.values["sigma"].expand(v.shape)[remember]
    who = "all joints" if len(remember) == len(joints) else ", ".join(log.joint_names[j] for j in remember)
    return f"{text}; {who} remember reversals, over {_listed(ways)} mrad or mm"


def _listed(numbers: Tensor) -> str:
    return ", ".join(f"{each:.3g}" for each in numbers.tolist())
