"""What a fit has found: `Estimates` of numbers, `MotionIntervals`, and `Fitted`.

Covariances of estimates are a block jackknife over stretches of the log (Kuensch 1989), by one step of the search, so
that errors that last count, and what the prior leaves open of what the log does not show:

    (K - 1) / K sum_k d_k d_k^T + F^-1 G F^-1,    F = J^T J + G

with the prior's information G and the changes d_k about their mean. The half width of joint j at horizon h is
c_hj 1.96 sqrt(s_hj^2 + r_hj^2), with the spread s of sampled functions (0 without), the rms r of errors, and c_hj that
makes it hold 95 % of left-out motions (split conformal prediction: Lei et al. 2018, JASA 113); of one record,
what another friction level would change (`posterior.drift`) is added in squares.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from scipy.stats import t as student
from torch import Tensor
from typing_extensions import override

from forcegp.errors import UnknownName, require_known
from forcegp.evidence.likelihood import MarginalLikelihood, TrainingData
from forcegp.forces import IndependentAccelerations, JointAccelerations, JointForces
from forcegp.forces.force import plain
from forcegp.inference import Engine, Exact, LatentKernels, LatentPosterior, OptimizationResult, exact
from forcegp.model import Model
from forcegp.noise import ACCELERATION
from forcegp.posterior.drift import Drift
from forcegp.summary import Summary, listed, rounded

STRETCHES = 20  # of time; residuals of different ones count as independent
REACH = float(student.ppf(0.975, STRETCHES - 1))
"""Standard deviations from the estimate to the ends of its 95 % interval."""
HELD = 0.5
"""A number whose standard deviation is above this fraction of its prior's is one that the log does not decide."""
SEEN = 1.0
"""Information of the log about a coordinate, in that of its prior, below which the rows do not show it at all."""
NAMED = 0.3  # correlation from which on another number is named as one that does the same

Decider = Literal["log", "prior"]


@dataclass(frozen=True)
class Estimate:
    """One number: value and std in `unit`, its start and prior std, and what decides it, with the reason."""

    name: str
    unit: str
    value: float
    std: float
    start: float
    prior_std: float
    decided_by: Decider
    why: str

    @property
    def interval(self) -> tuple[float, float]:
        """Of 95 %, including what the log leaves open."""
        return self.value - REACH * self.std, self.value + REACH * self.std

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {**vars(self), "interval_95": list(self.interval)}

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        doubt = "" if self.decided_by == "log" else f" (the prior decides: {self.why})"
        return f"{self.value:.4g} ± {REACH * self.std:.2g}{unit}{doubt}"


@dataclass(frozen=True, eq=False, repr=False)
class Estimates(Summary, Mapping[str, Estimate]):
    """The numbers that a fit estimated, by name: `estimates["payload.mass"].value`; `settled` if the search converged.

    `covariance` (n, n) is that of all values, in SI units.
    """

    entries: tuple[Estimate, ...] = ()
    covariance: Float[np.ndarray, "n n"] | None = None
    by_body: Mapping[str, int] | None = None
    """Of ten directions of each body, how many the prior decides, where it decides any."""
    evidence: str = ""
    rows: int = 0
    evaluations: int = 0
    settled: bool = True
    thickened: tuple[str, ...] = ()
    """Links that were lines, plates or points, and got some thickness."""

    @override
    def __getitem__(self, name: str) -> Estimate:
        require_known("parameter", name, "this fit", list(self), UnknownName)
        return self._by_name[name]

    @override
    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    @override
    def __len__(self) -> int:
        return len(self.entries)

    @cached_property
    def _by_name(self) -> dict[str, Estimate]:
        return {each.name: each for each in self.entries}

    @override
    def facts(self) -> dict[str, object]:
        """The first estimates, and what the log leaves open."""
        return {
            "estimated": listed([f"{each.name} {each}" for each in self.entries], most=6),
            "from": f"{self.rows} rows, {self.evidence}",
            "decided by the prior": listed(each.name for each in self.entries if each.decided_by == "prior"),
            "converged": self.settled,
        }

    @property
    def total_mass(self) -> tuple[float, float]:
        """Of all bodies that were estimated, and its standard deviation in kg."""
        own = [k for k, each in enumerate(self.entries) if each.name.endswith(".mass")]
        assert self.covariance is not None, "there are estimates"
        return sum(self.entries[k].value for k in own), max(float(self.covariance[np.ix_(own, own)].sum()), 0.0) ** 0.5

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain JSON values."""
        more = {item.name: plain(getattr(self, item.name)) for item in fields(self) if item.name != "entries"}
        return {"parameters": {each.name: each.to_dict() for each in self.entries}, **more}

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> "Estimates":
        """What `to_dict` gave."""
        known = Estimate.__dataclass_fields__
        entries = tuple(Estimate(**{k: v for k, v in x.items() if k in known}) for x in stored["parameters"].values())
        covariance = None if stored["covariance"] is None else np.array(stored["covariance"], dtype=np.float64)
        kept: Any = {name: stored[name] for name in ("by_body", "evidence", "rows", "evaluations", "settled")}
        return cls(entries, covariance, thickened=tuple(stored["thickened"]), **kept)

    @classmethod
    def of_search(
        cls,
        parameters: Sequence[Any],
        values: Float[np.ndarray, " n"],
        slopes: Float[np.ndarray, "n k"],
        white: Float[np.ndarray, "N k+1"],
        stretches: Sequence[np.ndarray],
        prior: Float[np.ndarray, "entries k"],
        changes: Float[np.ndarray, "stretches k"] | None = None,
        move: Float[np.ndarray, " k"] | None = None,
        **more: Any,
    ) -> "Estimates":
        """From the Jacobian of whitened residuals, with them as last column, rows by stretches, and of the prior.

        `slopes` are derivatives of the values in the coordinates, `changes` those of the coordinates without each
        stretch, if not by one step; `move` what a cause that explains more would change. Without stretches it is F^-1.
        """
        J, r, G = white[:, :-1], white[:, -1], prior.T @ prior
        whole, root = J.T @ J + G, np.linalg.inv(np.linalg.cholesky(G)).T
        moved = [] if changes is None else list(changes)
        for at in stretches if changes is None else ():
            own = J[at]
            # in coordinates in which the prior is the identity, what is left has eigenvalues of 1 at least
            sizes, vectors = np.linalg.eigh(root.T @ (whole - own.T @ own) @ root)
            turned = root @ vectors
            moved.append(turned @ ((turned.T @ (own.T @ r[at])) / np.maximum(sizes, 1.0)))
        covariance = None
        if moved:
            apart, count = np.stack(moved) - np.mean(moved, axis=0), len(moved)
            unseen = np.linalg.solve(whole, np.linalg.solve(whole, G).T)
            reach = float(student.ppf(0.975, max(count - 1, 1))) / REACH  # of fewer stretches, such as postures
            covariance = reach**2 * (count - 1) / count * apart.T @ apart + unseen
            covariance = covariance if move is None else covariance + np.outer(move, move)
        return cls.of_covariance(parameters, values, slopes, np.linalg.inv(whole), prior, covariance, **more)

    @classmethod
    def of_covariance(
        cls,
        parameters: Sequence[Any],
        values: Float[np.ndarray, " n"],
        slopes: Float[np.ndarray, "n k"],
        inverse: Float[np.ndarray, "k k"],
        prior: Float[np.ndarray, "entries k"],
        covariance: Float[np.ndarray, "k k"] | None = None,
        **more: Any,
    ) -> "Estimates":
        """From F^-1, the inverse of all information; `covariance` is that of the coordinates, if another."""
        G = prior.T @ prior
        information = np.linalg.inv(inverse) - G
        spread = slopes @ (inverse if covariance is None else covariance) @ slopes.T
        std = np.sqrt(np.maximum(spread.diagonal(), 0.0))
        prior_std = np.sqrt(np.maximum((slopes @ np.linalg.solve(G, slopes.T)).diagonal(), 0.0))
        posterior = slopes @ inverse @ slopes.T
        size = np.sqrt(np.maximum(posterior.diagonal(), 1e-300))
        alike = abs(posterior / np.outer(size, size))
        np.fill_diagonal(alike, 0.0)
        shown = (slopes @ np.linalg.solve(G, information @ np.linalg.solve(G, slopes.T))).diagonal()
        names, entries = [each.name for each in parameters], []
        for k, each in enumerate(parameters):
            held = size[k] > HELD * prior_std[k]
            other = int(alike[k].argmax()) if len(alike) > 1 else k
            if not held:
                why = "its rows show it"
            elif shown[k] < SEEN * prior_std[k] ** 2:
                why = "no row shows it"
            elif alike[k, other] >= NAMED:
                why = f"rows show it only together with {names[other]}"
            else:
                why = "rows show it only together with others"
            numbers = float(values[k]), float(std[k]), each.start, float(prior_std[k])
            entries.append(Estimate(each.name, each.unit, *numbers, "prior" if held else "log", why))
        return cls(tuple(entries), spread, **more)


HORIZONS = (0.1, 0.25, 0.5, 1.0)  # s, by default
DEVIATIONS = 1.959963984540054  # of a normal distribution, which hold 95 % of it


@dataclass(frozen=True, eq=False)
class MotionIntervals:
    """Widths by horizon [s] of q (or steps from it) and v: `rms`, and `factors` with samples and without."""

    horizons: Float[np.ndarray, " H"]
    rms: Float[np.ndarray, "H 2 nv"]
    factors: Float[np.ndarray, "2 H 2 nv"]
    inputs: tuple[str, ...] = ()
    drift: Float[np.ndarray, "2 H 2 nv"] | tuple[()] = ()
    """What one deviation of dry and of viscous friction between records changes, where all motions are of one."""

    def half_width(self, quantity: str, time: Tensor, spread: Tensor | None) -> Float[Tensor, "*batch rows nv"]:
        """Of the 95 % interval; `spread` is the standard deviation of samples (..., T+1, nv)."""
        kind = ("q", "v").index(quantity)
        rms, factor = self.rms[:, kind], self.factors[int(spread is None), :, kind]
        at, ends = time.cpu().numpy(), np.array([0.0, *self.horizons])
        beyond = np.maximum(at / self.horizons[-1], 1.0)[:, None]  # the last horizon errors go on as they grew
        r = beyond * _between(at, ends, rms)
        c = np.stack([np.interp(at, self.horizons, each) for each in factor.T], axis=-1)
        moved = sum((np.square(beyond * _between(at, ends, x[:, kind])) for x in self.drift), np.zeros_like(r))
        r, c, d = (torch.as_tensor(x, device=time.device) for x in (r, c, moved))
        within = c * (r if spread is None else (spread.square() + r.square()).sqrt())
        return DEVIATIONS * (within.square() + d).sqrt()

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {name: x.tolist() if isinstance(x, np.ndarray) else x for name, x in vars(self).items()}

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> "MotionIntervals":
        """What `to_dict` gave."""
        made: dict[str, Any] = {name: np.array(x) if len(x) else () for name, x in stored.items() if name != "inputs"}
        return cls(**made, inputs=tuple(stored["inputs"]))


def _between(at: np.ndarray, ends: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(at, ends, [0.0, *each]) for each in values.T], axis=-1)


AnyFitted = TypeVar("AnyFitted", bound="Fitted")  # beartype cannot check Self where a module is hooked


@dataclass(frozen=True, eq=False, repr=False)
class Fitted(Summary):
    """a = M^-1 Q_b + H (Q_K + B f) + noise, f ~ GP (Rath et al. 2021, eqs. 6-7), conditioned on a log by `forcegp.fit`.

    `trained` is the model with the numbers that were found, `hyperparameters` those of kernels and noise by name,
    `estimates` those of laws and bodies; `settings` is the resolved configuration (JSON values; `points`, `seed`,
    `data`); `result` the history of the search.
    """

    trained: Model
    likelihood: MarginalLikelihood
    hyperparameters: Mapping[str, Tensor]
    result: OptimizationResult
    settings: Mapping[str, Any]
    latent: LatentPosterior
    """The posterior of the latent functions."""
    engine: Engine
    """What computed `latent`."""
    estimates: Estimates = field(default_factory=Estimates)
    target: Model | None = None
    """The model that predictions are for, where it is not the one that was trained (`with_model`)."""

    @property
    def model(self) -> Model:
        """What predictions are for: robot, contacts and forces."""
        return self.trained if self.target is None else self.target

    @property
    def parameters(self) -> Estimates:
        """Numbers of laws and bodies that the fit estimated, with intervals, and whether the log decides them."""
        return self.estimates

    @classmethod
    def conditioned(
        cls: type[AnyFitted],
        model: Model,
        training: TrainingData,
        hyperparameters: Mapping[str, Tensor],
        result: OptimizationResult,
        settings: Mapping[str, Any],
        engine: Engine | None = None,
        estimates: Estimates | None = None,
        near: LatentPosterior | None = None,
    ) -> AnyFitted:
        """The posterior at given hyper-parameters, without a search; sooner where another one at these is `near`."""
        likelihood = MarginalLikelihood(model, replace(training, correlated_rows=settings.get("correlated_rows", 1.0)))
        engine = engine or Exact()
        # now: a failure belongs to the fit, not to the first prediction
        latent = likelihood.condition(likelihood.kernels, hyperparameters, engine, near=near)
        found = dict(hyperparameters), result, dict(settings), latent, engine, estimates or Estimates()
        return cls(model, likelihood, *found)

    @property
    def kernels(self) -> LatentKernels:
        """Of the latent functions, at their start values."""
        return self.likelihood.kernels

    @property
    def training(self) -> TrainingData:
        """The rows that the model was trained on."""
        return self.likelihood.training

    @property
    def noise_std(self) -> Float[Tensor, "nv"]:
        """Standard deviation of the acceleration noise per joint, given, learned or estimated."""
        return self.hyperparameters[ACCELERATION].exp()

    @cached_property
    def negative_log_likelihood(self) -> float:
        """-log p(a | q, v, u) of the training data in nats, without hyperpriors; InvalidInput for inducing points."""
        exact(self.latent, "the likelihood of all rows")
        with torch.no_grad():
            return float(self.likelihood(self.kernels, self.hyperparameters))

    @override
    def facts(self) -> dict[str, object]:
        """Model, robot, training rows, and how the search ended."""
        rows, result, drift = self.training, self.result, self.settings.get("drift")
        level: dict[str, object] = {} if drift is None else {"friction level": str(Drift(**drift))}
        return {
            "model": self.description,
            "robot": f"{self.model.robot.name!r}, {self.model.robot.nv} joints, {len(self.model.contacts)} contacts",
            "learned from": f"{len(rows)} rows",
            "noise std": rounded(self.noise_std.tolist()),
            "search": f"{'converged' if result.converged else 'not converged'}, {result.status}",
        } | level

    @property
    def description(self) -> str:
        """What kind of model it is, in a few words, for titles and tables."""
        forces = self.trained.unknown
        mean = "zero mean" if self.carries_known_forces else "analytical mean"
        if not forces.terms:
            return "identified model" if self.estimates else "analytical model"
        if self.is_black_box:
            return "independent GP"
        if isinstance(forces.terms[0], JointAccelerations):
            return f"unconstrained accelerations, {mean}"
        names = list(forces.term_names)
        shown = "" if names == [JointForces().title] else f"{' + '.join(names)}, "
        return f"{shown}{mean}"

    @property
    def is_black_box(self) -> bool:
        """Whether it learned accelerations, whatever the forces are, and predicts nothing else."""
        return any(isinstance(force, IndependentAccelerations) for force in self.trained.unknown_forces)

    @property
    def carries_known_forces(self) -> bool:
        """Whether the predicted `unknown_force` holds the known forces, too."""
        return self.trained.carries_known_forces

    @property
    def motion_intervals(self) -> MotionIntervals | None:
        """Widths of the intervals of motions, where they were `calibrated`; a rollout has them."""
        stored = self.settings.get("motion_intervals")
        found = None if stored is None else MotionIntervals.from_dict(stored)
        if found is not None and len(found.drift):
            found = replace(found, drift=Drift(**self.settings["drift"]).shares * found.drift)
        # widths of motions that an observer's columns were part of are not those of motions without
        return None if found is None or found.inputs not in ((), self.model.inputs) else found

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The joints in the order of every last dimension."""
        return self.model.robot.joint_names

    @property
    def latent_names(self) -> tuple[str, ...]:
        """The processes that the prior is made of."""
        return self.trained.unknown.latent_names(self.trained.robot)

    @property
    def widening(self) -> float:
        """How many times as wide intervals are as at known hyper-parameters (`fit/widening.py`); 1.0 does without."""
        return float(self.settings.get("widening", 1.0))
