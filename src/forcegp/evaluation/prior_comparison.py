"""Which unknown force do the data support? Candidates fitted to the same rows, and stretches of time left out.

The score is the log predictive density of stretches that are left out, in closed form (`posterior.leave_out`), not the
marginal likelihood: candidates differ in the number of parameters by a factor of thirty, and their searches end at
optima of different quality; the left-out density charges both where it hurts.
Differences between two candidates are paired, stretch by stretch: with the difference D_b of block b, its rows n_b and
d = sum D_b / sum n_b per row, the standard error of d over B blocks is

    sqrt(B / (B - 1) sum_b (D_b - n_b d)^2) / sum_b n_b

(the linearised standard error of a ratio; Cochran 1977, "Sampling techniques", chapter 6). `forcegp validate` compares
models on time that they were not fitted to, with motions and paired tests; this takes one fit of each.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float
from typing_extensions import override

from forcegp.data import Dataset, farthest_rows, time_blocks
from forcegp.data.dataset import require_rows
from forcegp.errors import ForceGPError, InvalidInput, require_type
from forcegp.fit import fit
from forcegp.forces import Force
from forcegp.model import Model
from forcegp.posterior import Posterior
from forcegp.robots.arguments import whole_number
from forcegp.summary import Summary

BLOCKS = 20
"""Stretches of time that the recording is cut into by default."""
FEWEST_BLOCKS = 3
STANDARD_ERRORS = 2.0
"""Differences below this many standard errors are not significant."""


@dataclass(frozen=True, kw_only=True)
class PriorScore:
    """One candidate. Densities are means per row in nats, the higher the better.

    Fields
    ------
    latents: unknown functions of one or more features.
    parameters: numbers that the search was free to choose.
    density: log density of a stretch given all other stretches.
    difference, standard_error: of the density to that of the best candidate, paired over stretches.
    converged: whether the search for the parameters ended by itself.
    """

    latents: int
    parameters: int
    density: float
    difference: float
    standard_error: float
    converged: bool


@dataclass(frozen=True, kw_only=True, repr=False)
class PriorComparison(Summary):
    """Scores and fitted models of the candidates by name, in the order given."""

    scores: Mapping[str, PriorScore]
    points: int
    blocks: int
    block_seconds: float
    posteriors: Mapping[str, Posterior] = field(default_factory=dict)

    @property
    def supported(self) -> tuple[str, ...]:
        """The best candidate, and those that are within two standard errors of it."""
        within = {name: each.difference >= -STANDARD_ERRORS * each.standard_error for name, each in self.scores.items()}
        return tuple(name for name, close in within.items() if close)

    @property
    def preferred(self) -> str:
        """Of the supported ones that with the fewest latents, then parameters."""
        each = self.scores
        return min(self.supported, key=lambda name: (each[name].latents, each[name].parameters, -each[name].density))

    @property
    def verdict(self) -> str:
        """Which forces the data support, in one sentence."""
        names, preferred, stretches = (
            self.supported,
            self.preferred,
            f"left-out stretches of {self.block_seconds:.3g} s",
        )
        if len(names) > 1:
            tied = f"{', '.join(names[:-1])} and {names[-1]} cannot be distinguished in {stretches}"
            return f"{tied}; {preferred} is the simplest."
        second = max((name for name in self.scores if name != preferred), key=lambda name: self.scores[name].density)
        other = self.scores[second]
        return (
            f"The data support {preferred}: it predicts {stretches} better than {second} does, by "
            f"{-other.difference:.3g} nats per row (standard error {other.standard_error:.2g})."
        )

    @override
    def facts(self) -> dict[str, object]:
        """The verdict and the density of each candidate."""
        densities = {name: f"{score.density:.3f} nats per row" for name, score in self.scores.items()}
        return {"verdict": self.verdict, **densities, "rows": self.points}

    def to_dict(self) -> dict[str, Any]:
        """Everything but the models, as plain JSON values."""
        scores = {name: asdict(score) for name, score in self.scores.items()}
        sizes = {name: getattr(self, name) for name in ("points", "blocks", "block_seconds", "preferred", "verdict")}
        return {"candidates": scores, **sizes}


def compare_priors(
    dataset: Dataset,
    candidates: Mapping[str, Force | Sequence[Force]],
    *,
    points: int | None = None,
    model: Model | None = None,
    block_seconds: float | None = None,
    **search: Any,
) -> PriorComparison:
    """Fit the model with each candidate to the same rows, and compare how they predict stretches that are left out.

    Parameters
    ----------
    candidates: unknown forces by name, two or more; several that act together are one candidate.
    points: rows to train on, far apart in (q, v, u); None takes all. All are conditioned on exactly.
    model: what is known; None takes that of the dataset.
    block_seconds: length of the stretches of time that are left out; None cuts the recording into 20.
    search: restarts, seed, jobs, hyperprior, options and progress as for `fit`, for each of them.

    Raises
    ------
    InvalidInput: an argument is out of range, or the data cannot teach a candidate anything; it is named.
    FitError: no start of the search for a candidate could be evaluated.
    NotEnoughMemory: the exact covariances of the rows do not fit; give fewer points.
    """
    require_type("dataset", dataset, Dataset)
    require_type("candidates", candidates, Mapping, " from names to forces")
    known = dataset.model if model is None else model
    if known is None:
        raise InvalidInput("the dataset does not carry its robot; give model=Model(robot, contacts)")
    if len(candidates) < 2:
        raise InvalidInput(f"there is nothing to compare {', '.join(candidates) or 'with'}; give two forces or more")
    require_rows("dataset", dataset, known.robot.joint_names, "the robot")
    rows = dataset
    if points is not None and whole_number("points", points, 2, len(dataset), "the rows of the dataset") < len(dataset):
        rows = farthest_rows(dataset, points)
    seconds = block_seconds
    if seconds is None:
        seconds = sum(float(np.ptp(rows.time[rows.episode == episode])) for episode in rows.episodes) / BLOCKS
        if not seconds > 0.0:
            raise InvalidInput("every episode has one training row, so there are no stretches of time to leave out")
    blocks = time_blocks(rows.time, rows.episode, seconds)
    if len(blocks) < FEWEST_BLOCKS:
        raise InvalidInput(
            f"the training rows fall into {len(blocks)} stretches of {seconds:.3g} s, too few to compare by; give "
            "shorter ones, or a longer recording"
        )
    models = {name: _named(name, partial(known.with_forces, own)) for name, own in candidates.items()}
    # whatever the number of rows: no other engine can leave rows out
    posteriors = {
        name: _named(name, partial(fit, each, rows, engine="exact", **search)) for name, each in models.items()
    }
    sizes = np.array([len(block) for block in blocks], dtype=np.float64)
    densities = {name: posterior.leave_out(blocks).log_density.numpy() for name, posterior in posteriors.items()}
    best = max(densities.values(), key=lambda density: float(density.sum()))
    scores = {}
    for name, posterior in posteriors.items():
        difference, error = paired_difference(densities[name], best, sizes)
        scores[name] = PriorScore(
            latents=len(posterior.model.unknown.latent_names(posterior.model.robot)),
            parameters=sum(value.numel() for value in posterior.result.parameters.values()),
            density=float(densities[name].sum() / sizes.sum()),
            difference=difference,
            standard_error=error,
            converged=posterior.result.converged,
        )
    size: dict[str, Any] = {"points": len(rows), "blocks": len(blocks), "block_seconds": float(seconds)}
    return PriorComparison(scores=scores, **size, posteriors=posteriors)


def paired_difference(
    one: Float[np.ndarray, " blocks"], other: Float[np.ndarray, " blocks"], sizes: Float[np.ndarray, " blocks"]
) -> tuple[float, float]:
    """Mean difference per row of two log densities by block, and its standard error (two blocks or more)."""
    gain, rows, count = one - other, float(sizes.sum()), len(sizes)
    mean = float(gain.sum()) / rows
    return mean, math.sqrt(count / (count - 1) * float(np.square(gain - sizes * mean).sum())) / rows


def _named(name: str, make: Callable[[], Any]) -> Any:
    """What `make` returns; an error names the candidate."""
    try:
        return make()
    except ForceGPError as error:
        raise type(error)(f"forces {name!r}: {error}") from error
