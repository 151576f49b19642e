"""Which parts of gear friction a log shows, joint by joint, by stretches held out: memory, load, speed, breakaway."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from forcegp.data import Dataset, evenly, with_memory, with_strokes
from forcegp.data.views import tensors
from forcegp.evidence import Accelerations, Torques, motion_residuals
from forcegp.fit.equations import weights_of_rests
from forcegp.fit.physical import Solution, fit_physical
from forcegp.fit.transmission_choice import choose_transmission
from forcegp.forces import Coulomb, DirectionalFriction, DryFriction, GearFriction, LogNormal, Normal, Rotor, Viscous
from forcegp.forces.force import Force
from forcegp.forces.joint_law import JointLaw
from forcegp.forces.joint_laws import HIGHEST
from forcegp.forces.presliding import after_strokes
from forcegp.mechanics import State
from forcegp.model import Model
from forcegp.noise import Noise
from forcegp.posterior import Posterior

PARTS = "memory", "factor", "root", "direction", "breakaway"  # of `GearFriction`, and of the law beside it
BLOCKS = 10  # stretches of the log, each predicted from the others
CLEARLY, LIKELY = 1.5, 0.5
"""Standard errors over the stretches by which a part must lower the squared residual; and memory, which gears have."""
LEAST, LITTLE = 0.05, 0.007  # share of it by which a part must do so, and memory
FALLS = tuple(np.geomspace(0.04, 0.6, 7).tolist())
"""Of the root mean square velocity, what a breakaway may fall over here; a fit finds the rest."""
SIGNED = np.array([0, 1, 1, 1, 0, 0] + [1] * len(FALLS), dtype=bool)
"""Of each joint's columns: viscous, dry, load, root of speed, direction, a constant, and breakaways."""
REVERSALS = 2
"""Fewest reversals of a joint that can show memory: held-out stretches decide. With six, half of 48 short logs of LuGre
friction had none, and .9 of the rest stayed; with two .04, and none of 96 logs without memory was given one."""
WIDTHS = tuple(np.geomspace(0.003, 1.0, 11).tolist())  # of the smooth sign, over the root mean square velocity
SEEN, RIDGE = 0.003, 1e-7
"""Of the torque of bodies, the least that counts over the largest; and what is added to the normal equations."""
MOST_ROWS, MOST_EQUATIONS = 10_000, 70_000  # of the log that are asked, evenly spread: each knows its past
FIRST_ROWS = 2000  # of the first fit
STIFFNESS = tuple(np.geomspace(10.0, 10000.0, 13).tolist())
"""Of the memory, over the reciprocal root mean square position."""


@dataclass(frozen=True)
class FrictionChoice:
    """The parts of friction that joints have, and what held-out squared residuals say of each."""

    joints: tuple[str, ...]
    parts: tuple[tuple[str, ...], ...]
    ratios: tuple[float, ...]
    """Root mean square of what is left, over that without any of these parts at a joint."""
    few_reversals: tuple[str, ...]
    sigma: tuple[float, ...]
    """Stiffness of the memory of each joint in 1/rad or 1/m, roughly; 0 without."""
    falls: tuple[float, ...]
    """Velocity that a breakaway would fall over, roughly."""
    transmission: Float[np.ndarray, "nv nv"] | None = None
    """Of the motors whose friction it is; None: the joints."""

    def to_dict(self) -> dict[str, Any]:
        """For the settings of a fit."""
        found = {name: list(parts) for name, parts in zip(self.joints, self.parts, strict=True)}
        coupled = {} if self.transmission is None else {"transmission": self.transmission.tolist()}
        numbers = {"few_reversals": list(self.few_reversals), "sigma": list(self.sigma), "falls": list(self.falls)}
        return {"parts": found, "left": list(self.ratios)} | numbers | coupled

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "FrictionChoice":
        """Of the settings of a fit."""
        joints, parts = tuple(content["parts"]), tuple(map(tuple, content["parts"].values()))
        ratios, few, sigma, falls = (tuple(content[x]) for x in ("left", "few_reversals", "sigma", "falls"))
        coupled = np.array(content["transmission"]) if "transmission" in content else None
        return cls(joints, parts, ratios, few, sigma, falls, coupled)

    def has(self, part: str) -> Bool[np.ndarray, " nv"]:
        """By joint."""
        return np.array([part in each for each in self.parts])


def choose_friction(
    model: Model, log: Dataset, parts: Sequence[str] = PARTS, noise: Noise | None = None
) -> FrictionChoice:
    """The parts of friction by which held-out stretches of the log are predicted better, joint by joint.

    `model` is one whose other numbers are known; its friction is left out. The torque that is left is regressed on
    viscous and dry friction of all joints, on parameters of bodies, which may be off, and on the parts. At each joint
    the part that helps most is added while it helps by more than `CLEARLY` standard errors over the stretches. All this
    is at the motors where its dry friction has a `transmission`. Residuals are weighted by the `noise` of accelerations
    and forces, None: by that of the forces of each joint.
    """
    law = next((law for law in model.laws if isinstance(law, DryFriction)), Coulomb())
    log = with_strokes(log, law.transmission)  # type: ignore[arg-type]  # a model binds it
    log = log.rows(evenly(log, min(MOST_ROWS, MOST_EQUATIONS // model.robot.nv)))
    bare = _without(model, Viscous, DryFriction, DirectionalFriction)
    torque = motion_residuals(replace(log, strokes=None), bare)[0]
    state = bare.state(*(torch.as_tensor(np.array(x), device=bare.robot.device) for x in (log.q, log.v, log.u)))
    regression, strokes = _Regression(_precision(model, log, noise), law, log, state, torque), log.strokes
    single, few = np.isin(log.joint_names, bare.robot.single_joint_names), []
    moving = [j for j in np.flatnonzero(single).tolist() if regression.v[:, j].any()]
    for j in moving:
        turns = 0 if strokes is None else int((np.diff(np.sign(strokes[:, j, 0])) != 0).sum())
        if strokes is not None and turns >= REVERSALS:
            spread = max(float(law.turning(state.positions)[:, j].std()), 1e-9)
            regression.remember(j, strokes[:, j], [each / spread for each in STIFFNESS])
        else:
            few.append(log.joint_names[j])
    for j in 2 * moving:  # again, beside what the others have now
        regression.choose(j, parts)
    slides = {name: bare.robot.joint(name).type == "prismatic" for name in bare.robot.single_joint_names}
    usual = [(slides[name], x) for name, x in zip(log.joint_names, regression.sigma, strict=True) if x]
    for name in few if 2 * len(usual) > len(moving) - len(few) else ():
        alike, j = [x for kind, x in usual if kind == slides[name]], log.joint_names.index(name)
        if strokes is not None and alike:  # gears are alike: what the others remember over may do here
            regression.remember(j, strokes[:, j], [float(np.median(alike))])
            regression.choose(j, parts)
    found = tuple(regression.parts.get(j, ()) for j in range(log.nv)), tuple(regression.ratios), tuple(few)
    falls = tuple((regression.speed * np.array(FALLS)[regression.fall]).tolist())
    return FrictionChoice(tuple(log.joint_names), *found, regression.sigma, falls, log.transmission)


def _precision(model: Model, log: Dataset, noise: Noise | None) -> Float[np.ndarray, "rows nv nv"]:
    """Inverse covariances of residual forces: M N_a M + N_f."""
    if noise is None or noise.force is None or noise.acceleration is None:
        left = motion_residuals(log, model)[0]
        weights = weights_of_rests([log], left)
        level = np.sqrt(np.square(weights * left).mean(0))
        return np.square(weights / np.maximum(level, 1e-6 * max(float(level.max()), 1e-12)))[..., None] * np.eye(log.nv)
    q, v, u, *_ = tensors(with_memory(log, model), model.robot.device)
    M = model.dynamics(q, v, u).M.cpu().numpy()
    return np.linalg.inv(M * np.square(noise.acceleration) @ M + np.diag(np.square(noise.force)))


def _without(model: Model, *laws: type[Force]) -> Model:
    return replace(model, forces=tuple(force for force in model.forces if not isinstance(force, laws)))


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


def _bordered(A: np.ndarray, across: np.ndarray, inner: np.ndarray) -> Float[np.ndarray, "k n n"]:
    rows = (A, across), (across.swapaxes(1, 2), inner)
    return np.concatenate([np.concatenate(row, axis=2) for row in rows], axis=1)


Sums = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Of a joint under one sign, by stretch: its columns times those of bodies, times themselves, and times the torque."""


class _Regression:
    """Weighted normal equations of all joints by stretch: bodies together, friction of each joint by itself."""

    def __init__(
        self, precision: np.ndarray, law: JointLaw, log: Dataset, state: State, torque: Float[np.ndarray, "rows nv"]
    ) -> None:
        def motors(forces: Tensor | np.ndarray) -> np.ndarray:
            return law.at_motors(torch.as_tensor(forces, device=state.q.device)).cpu().numpy()

        self.nv, fold = torque.shape[1], _folds(log)
        self.count = int(fold.max()) + 1
        numbers = [np.flatnonzero(fold == k) for k in range(self.count)]  # mostly rows that follow each other
        self.rows = [slice(at[0], at[-1] + 1) if at[-1] - at[0] < len(at) else at for at in numbers]
        torque, given = motors(torque), motors(state.delivered)
        v, turned = law.turning(state.v).cpu().numpy(), law.turning(torch.as_tensor(precision, device=state.q.device))
        self.precision = P = law.turning(turned.mT).cpu().numpy()
        self.coupled = bool((P * (1.0 - np.eye(self.nv))).any())
        load = np.abs(given if self.coupled else given - torque)  # by what has less noise: u, or the model
        a = torch.as_tensor(np.array(log.a), device=state.q.device)
        Y = motors(state.kinematics.torque_regressor(a).flatten(2).mT).swapaxes(1, 2)
        sizes, vectors = np.linalg.eigh(np.tensordot(Y, P @ Y, ((0, 1), (0, 1))))
        kept = sizes > SEEN**2 * sizes.max()
        Y = Y @ (vectors[:, kept] / np.sqrt(sizes[kept] / len(Y)))
        self.bodies, self.torque = np.ascontiguousarray((P @ Y).swapaxes(0, 1)).swapaxes(0, 1), P @ torque[..., None]
        each = [slice(None)] if self.coupled else range(self.nv)  # rows of joints, where these stand for themselves
        self.inner = np.stack([self._by(Y[:, j], self.bodies[:, j]) for j in each], axis=1)
        self.target = np.stack([self._by(Y[:, j], self.torque[:, j])[..., 0] for j in each], axis=1)
        self.squares = np.stack([self._by(torque[:, j, None], self.torque[:, j])[:, 0, 0] for j in each], axis=1)
        self.speed = np.maximum(np.sqrt((v**2).mean(0)), 1e-12)
        one, falls = np.ones_like(v), (np.exp(-((v / (fall * self.speed)) ** 2)) for fall in FALLS)
        self.v, self.shapes = v, np.stack([v, one, load, np.sqrt(np.abs(v)), np.abs(v), one, *falls], axis=-1)
        self.root = np.sqrt(np.abs(v)).mean(axis=0)  # where dry friction that falls with speed is still friction
        self.past: dict[int, torch.Tensor] = {}
        self.signs = [{-width: self._sums(j, -width) for width in WIDTHS} for j in range(self.nv)]
        self.at, self.fall = [-WIDTHS[1]] * self.nv, [len(FALLS) // 2] * self.nv
        """The sign of each joint: minus a width, or the stiffness of a memory; and which of `FALLS` it has."""
        self.parts: dict[int, tuple[str, ...]] = {}
        self.ratios = [1.0] * self.nv

    def _by(self, left: Float[np.ndarray, "rows *j n"], right: Float[np.ndarray, "rows *j m"]) -> np.ndarray:
        """Products of columns, summed in every stretch: (stretches, n, m)."""
        flat = [[x[k].reshape(-1, x.shape[-1]) for k in self.rows] for x in (left, right)]
        return np.stack([one.T @ other for one, other in zip(*flat, strict=True)])

    @property
    def sigma(self) -> tuple[float, ...]:
        """Of the memory of each joint; 0 where there is none."""
        return tuple(max(each, 0.0) for each in self.at)

    def remember(self, j: int, strokes: Float[np.ndarray, "rows strokes"], stiffness: Sequence[float]) -> None:
        """Let a joint have memory."""
        self.past[j] = torch.as_tensor(np.array(strokes))
        self.signs[j] |= {sigma: self._sums(j, sigma) for sigma in stiffness}

    def _columns(self, j: int, at: float) -> Float[np.ndarray, "rows k"]:
        v = self.v[:, j]
        s = after_strokes(self.past[j], torch.tensor(at)).numpy() if at > 0.0 else np.tanh(v / (-at * self.speed[j]))
        return self.shapes[:, j] * np.where(SIGNED, s[:, None], 1.0)

    def _sums(self, j: int, at: float) -> Sums:
        F = self._columns(j, at)
        weighted = self.precision[:, j, j, None] * F
        return self._by(self.bodies[:, j], F), self._by(weighted, F), self._by(F, self.torque[:, j])[..., 0]

    def choose(self, j: int, parts: Sequence[str]) -> None:
        """Parts of one joint, those of the others being as they are."""
        self.beside, self.across, self.left = self._beside(j), {}, cache(partial(self._residuals, j))
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
            more = {*there} - {*here}  # noise of accelerations in other joints may look like two parts, not like memory
            if not self._clearly(best[1], tried[there][1], more == {"memory"} if self.coupled else "memory" in more):
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
        return bool(gain.sum() > max(noise, share * without.sum() / (self.nv if self.coupled else 1)))

    def _refined(self, j: int, parts: tuple[str, ...]) -> tuple[tuple[float, int], Float[np.ndarray, " stretches"]]:
        """`_fitted`, with signs between those of the grid."""
        for part in (0.5, 0.25, 0.125):
            at, step = self._fitted(j, parts)[0][0], (WIDTHS[1] / WIDTHS[0]) ** part
            self.signs[j] |= {each: self._sums(j, each) for each in (at * step, at / step)}
        return self._fitted(j, parts)

    def _fitted(self, j: int, parts: tuple[str, ...]) -> tuple[tuple[float, int], Float[np.ndarray, " stretches"]]:
        """The sign and fall that fit all rows best; squared residuals of the joint in every stretch by the others."""
        # the fall is sought at the sign that fits best under the usual one
        signs, at = [each for each in self.signs[j] if (each > 0.0) == ("memory" in parts)], self.fall[j]
        sign = min(signs, key=lambda sign: self.left(parts, (sign, at), False).sum())
        falls = range(len(FALLS)) if "breakaway" in parts else (at,)
        best = sign, min(falls, key=lambda fall: self.left(parts, (sign, fall), False).sum())
        return best, self.left(parts, best, True)

    def _residuals(self, j: int, parts: tuple[str, ...], sign: tuple[float, int], held_out: bool) -> np.ndarray:
        """Squared residuals in every stretch, by numbers from the others; or their sum, by numbers from all."""
        # those of the joint, or of all joints where the noise of accelerations makes their forces resemble each other
        summed = np.asarray if held_out else partial(np.sum, axis=0, keepdims=True)
        (A, b), others = map(summed, self.beside[:2]), self.beside[2]
        across, inner, right = map(summed, self._open(j, parts, sign))
        if sign[0] not in self.across:
            nothing = np.zeros((self.count, others.shape[-1], len(SIGNED)))
            self.across[sign[0]] = self._by(others, self._columns(j, sign[0])) if self.coupled else nothing
        beside = summed(self.across[sign[0]][..., self._places(parts, sign[1])])
        A = _bordered(A, np.concatenate([across, beside], axis=1), inner)
        b, n = np.concatenate([b, right], axis=1), b.shape[1]
        own, own_A, own_b, squares = slice(None), A, b, summed(self.squares[:, 0])
        if not self.coupled:
            own, squares = np.r_[0 : self.inner.shape[-1], n : b.shape[1]], summed(self.squares[:, j])
            own_A = _bordered(summed(self.inner[:, j]), across, inner)
            own_b = np.concatenate([summed(self.target[:, j]), right], axis=1)
        whole, given = A.sum(0), b.sum(0)
        scale = np.sqrt(whole.diagonal().clip(1e-300))
        normal, right = (whole - A, given - b) if held_out else (A, b)
        normal = normal / np.outer(scale, scale) + RIDGE * np.eye(len(scale))
        x = np.linalg.solve(normal, (right / scale)[..., None])[..., 0].T / scale[:, None]
        loads = "factor" not in parts or ((x[n + 2] >= 0.0) & (x[n + 2] <= HIGHEST)).all()
        slows = "root" not in parts or (x[n + 1] + x[n + 2 + ("factor" in parts)] * self.root[j] >= 0.0).all()
        falls = "breakaway" not in parts or ((x[-1] >= 0.0) & (x[-1] <= x[n + 1])).all()  # by half at most
        if not (loads and slows and falls):
            return np.full(len(A), np.inf)
        x = x[own].T
        return squares + (x * ((own_A @ x[..., None])[..., 0] - 2.0 * own_b)).sum(axis=1)

    def _places(self, parts: tuple[str, ...], fall: int) -> Int[np.ndarray, " k"]:
        breaks = ("breakaway" in parts and each == fall for each in range(len(FALLS)))
        return np.flatnonzero([True, True, *(part in parts for part in PARTS[1:-1]), True, *breaks])

    def _open(self, j: int, parts: tuple[str, ...], sign: tuple[float, int]) -> Sums:
        (across, inner, right), open_ = self.signs[j][sign[0]], self._places(parts, sign[1])
        return across[..., open_], inner[:, open_][..., open_], right[:, open_]

    def _beside(self, j: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Normal equations of all other joints by stretch, in bodies and the columns that they need; and these."""
        # the latter are weighted as errors of joint j resemble theirs
        joints = [i for i in range(self.nv) if i != j]
        chosen = [(i, self.parts.get(i, ()), (self.at[i], self.fall[i])) for i in joints]
        sums, first = [self._open(*each) for each in chosen], self.inner.shape[-1]
        columns = [self._columns(i, at)[:, self._places(parts, fall)] for i, parts, (at, fall) in chosen]
        ends = np.cumsum([first, *(each.shape[1] for each in columns)])
        A, b = np.zeros((self.count, ends[-1], ends[-1])), np.zeros((self.count, ends[-1]))
        A[:, :first, :first], b[:, :first] = self.inner.sum(1), self.target.sum(1)
        places = [slice(*pair) for pair in pairwise(ends)]
        for k, (place, (across, inner, right)) in enumerate(zip(places, sums, strict=True)):
            A[:, :first, place], A[:, place, place], b[:, place] = across, inner, right
            A[:, place, :first] = across.swapaxes(1, 2)
            for m in range(k) if self.coupled else ():
                weighted = self.precision[:, joints[k], joints[m], None] * columns[k]
                A[:, place, places[m]] = self._by(weighted, columns[m])
                A[:, places[m], place] = A[:, place, places[m]].swapaxes(1, 2)
        weighted = [self.precision[:, j, i, None] * each for i, each in zip(joints, columns, strict=True)]
        return A, b, np.concatenate(weighted, axis=1) if weighted else np.zeros((len(self.v), 0))


def with_friction_chosen(
    model: Model, log: Dataset, evidence: Torques | Accelerations
) -> tuple[Model, FrictionChoice | None]:
    """The model whose gear friction without a stated `memory` has the parts that the log shows; None for no such law.

    Loads and what friction has to explain are those of a first fit with dry friction alone.
    """
    gears = [force for force in model.laws if isinstance(force, GearFriction)]
    if not any(force.memory is None and force.level is None for force in gears):
        return model, None
    [gear] = gears
    usual = Torques("both" if evidence.noisy_in_both or not model.robot.space.is_vector_space else "u")
    how = evidence if isinstance(evidence, Accelerations) and not model.unknown_forces else usual

    def first(transmission: Any) -> Solution:
        """The model with dry friction alone."""
        plain = tuple(Coulomb().bound_to(model.robot) if force is gear else force for force in model.laws)
        at_motors = _with_transmission(replace(model, forces=plain), transmission)
        return fit_physical(at_motors, [log], how, rows=FIRST_ROWS, roughly=True)

    found = first(gear.transmission)
    if gear.transmission is None:
        bare = _without(found.model, Viscous, DryFriction, DirectionalFriction, Rotor)
        some = log.rows(evenly(log, FIRST_ROWS))
        transmission = choose_transmission(found.model, bare, some, _folds(some))
        found = found if transmission is None else first(transmission)
    beside = any(isinstance(law, DirectionalFriction) and law.learned for law in model.laws)
    parts = [part for part in PARTS if beside or part != "direction"]
    choice = choose_friction(found.model, log, parts, found.noise if isinstance(how, Accelerations) else None)
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
    return _with_transmission(replace(model, forces=tuple(made)), choice.transmission)


def with_choice_of(model: Model, posterior: Posterior) -> Model:
    """The model whose friction has the parts that were chosen when this posterior was learned, if any were."""
    choice = posterior.settings.get("gear_friction")
    return with_choice(model, FrictionChoice.from_dict(choice)) if choice else model


def _with_transmission(model: Model, transmission: Any) -> Model:
    """With friction and rotors that are estimated, and state no other, at these motors."""
    kinds = (Viscous, DryFriction, DirectionalFriction, Rotor)
    forces = (
        replace(force, transmission=transmission)
        if isinstance(force, kinds) and force.learned and force.transmission is None
        else force
        for force in model.forces
    )
    return model if transmission is None else replace(model, forces=tuple(forces))
