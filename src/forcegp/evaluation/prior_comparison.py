"""Which prior on the unknown forces do the data support? Candidates fitted to the same rows, and rows left out.

The score is the log predictive density of stretches of time that are left out, in closed form (`posterior.leave_out`),
not the marginal likelihood: candidates differ in the number of parameters by a factor of thirty, and their searches end
at optima of different quality; the left-out density charges both where it hurts.
Differences between two candidates are paired, stretch by stretch: with the difference D_b of block b, its rows n_b and
d = sum D_b / sum n_b per row, the standard error of d over B blocks is

    sqrt(B / (B - 1) sum_b (D_b - n_b d)^2) / sum_b n_b

(the linearised standard error of a ratio; Cochran 1977, "Sampling techniques", chapter 6).
"""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from forcegp.data import Dataset, time_blocks
from forcegp.data.dataset_arguments import require_rows
from forcegp.errors import ForceGPError, InvalidInput, require_type
from forcegp.evaluation.doubts import unfinished_search
from forcegp.evaluation.evaluation import evaluate
from forcegp.inference import Exact, OptimizerOptions, ProblemSize
from forcegp.inference.memory import require_memory
from forcegp.mechanics import MechanicalSystem
from forcegp.models import Noise, StructuredGP, StructuredPosterior
from forcegp.models.search import training_rows
from forcegp.models.structured.marginal_likelihood import MarginalLikelihood, Mean
from forcegp.models.structured.prior_checks import check_prior
from forcegp.models.training_data import ACCELERATION, TrainingData
from forcegp.parallel import Backend, backend_for
from forcegp.priors import ForcePrior

BLOCKS = 20
"""Stretches of time that the recording is cut into by default."""
FEWEST_BLOCKS = 3
STANDARD_ERRORS = 2.0
"""Differences below this many standard errors are not significant."""

Progress = Callable[[str, int, int, float], None]
"""Called as progress(candidate, restart, iteration, objective)."""


@dataclass(frozen=True, kw_only=True)
class PriorScore:
    """One candidate. Densities are means per row in nats, the higher the better.

    Fields
    ------
    latents: unknown functions of one or more features.
    parameters: numbers that the search was free to choose.
    nll: negative log marginal likelihood of all rows, in nats, at the parameters found.
    leave_one_out, leave_block_out: log density of a row given all others, and of a stretch given all other stretches.
    difference, standard_error: of `leave_block_out` to that of the best candidate, paired over stretches.
    converged: whether the search for the parameters ended by itself.
    mae, nlpd: on the test Dataset: mean absolute error of the acceleration, and negative log density per row.
    """

    name: str
    latents: int
    parameters: int
    nll: float
    leave_one_out: float
    leave_block_out: float
    difference: float
    standard_error: float
    converged: bool
    mae: float | None = None
    nlpd: float | None = None

    @property
    def is_as_good_as_the_best(self) -> bool:
        """Whether the difference to the best is within two standard errors."""
        return self.difference >= -STANDARD_ERRORS * self.standard_error


COLUMNS: dict[str, Callable[[PriorScore], float | None]] = {
    "marginal likelihood (NLL)": lambda score: score.nll,
    "density of single rows left out": lambda score: -score.leave_one_out,
    "test MAE": lambda score: score.mae,
    "test NLPD": lambda score: score.nlpd,
}
"""Scores by which another candidate may be best, lower is better."""

CLEAR = 0.01
"""Relative difference below which two scores do not disagree."""


@dataclass(frozen=True, kw_only=True)
class PriorComparison:
    """Candidates in the order given, their scores, and the fitted models by name."""

    scores: tuple[PriorScore, ...]
    points: int
    blocks: int
    block_seconds: float
    warnings: tuple[str, ...] = ()
    posteriors: Mapping[str, StructuredPosterior] = field(default_factory=dict, repr=False)

    @property
    def best(self) -> PriorScore:
        """The candidate whose left-out stretches are likeliest."""
        return max(self.scores, key=lambda score: score.leave_block_out)

    @property
    def supported(self) -> tuple[PriorScore, ...]:
        """The best candidate, and those that the data cannot distinguish from it, in the order given."""
        return tuple(score for score in self.scores if score.is_as_good_as_the_best)

    @property
    def preferred(self) -> PriorScore:
        """Of the supported ones that with the fewest latents, then parameters."""
        return min(self.supported, key=lambda score: (score.latents, score.parameters, -score.leave_block_out))

    @property
    def verdict(self) -> str:
        """Which prior the data support, in one sentence, and in another which columns of the table disagree."""
        found = {what: self._best_by(key) for what, key in COLUMNS.items()}
        named = "; ".join(f"{best.name} has the best {what}" for what, best in found.items() if best is not None)
        if not named:
            return self._supported
        return (
            f"{self._supported} Other columns disagree: {named}. The choice rests on left-out stretches, which "
            "are what a model has not seen; if errors of the acceleration are what counts, take the best test MAE."
        )

    def _best_by(self, key: Callable[[PriorScore], float | None]) -> PriorScore | None:
        """The candidate with the least value, if it is less than that of the preferred one by a hundredth of it."""
        known = [(value, score) for score in self.scores if (value := key(score)) is not None]
        mine = key(self.preferred)
        if mine is None or not known:
            return None
        value, best = min(known, key=lambda entry: entry[0])
        return best if value < mine - CLEAR * abs(mine) else None

    @property
    def _supported(self) -> str:
        names = [score.name for score in self.supported]
        preferred, stretches = self.preferred, f"left-out stretches of {self.block_seconds:.3g} s"
        if len(names) == 1:
            second = max((s for s in self.scores if s is not self.best), key=lambda score: score.leave_block_out)
            return (
                f"The data support {preferred.name}: it predicts {stretches} better than {second.name} does, by "
                f"{-second.difference:.3g} nats per row (standard error {second.standard_error:.2g})."
            )
        tied = f"{', '.join(names[:-1])} and {names[-1]} cannot be distinguished in {stretches}"
        if len({(score.latents, score.parameters) for score in self.supported}) == 1:
            return f"{tied}, and have equally many parameters; {preferred.name} did best by a little."
        if len({score.latents for score in self.supported}) == 1:
            return f"{tied}, and have equally many latent functions; {preferred.name} has the fewest parameters."
        noun = "function" if preferred.latents == 1 else "functions"
        return f"{tied}; {preferred.name} is the simplest, with {preferred.latents} latent {noun}."

    def to_dict(self) -> dict[str, Any]:
        """Everything but the models, as plain JSON values."""
        return {
            "candidates": [
                {**asdict(score), "supported": score.is_as_good_as_the_best, "best": score is self.best}
                for score in self.scores
            ],
            "preferred": self.preferred.name,
            "verdict": self.verdict,
            "points": self.points,
            "blocks": self.blocks,
            "block_seconds": self.block_seconds,
            "warnings": list(self.warnings),
        }


def compare_priors(
    dataset: Dataset,
    priors: Mapping[str, ForcePrior],
    *,
    points: int | None = None,
    system: MechanicalSystem | None = None,
    mean: Mean = "analytical",
    noise: Noise | None = None,
    restarts: int | None = None,
    seed: int = 0,
    jobs: int | None = None,
    backend: Backend | str | None = None,
    hyperprior: bool = True,
    options: OptimizerOptions | None = None,
    block_seconds: float | None = None,
    test: Dataset | None = None,
    progress: Progress | None = None,
) -> PriorComparison:
    """Fit a `StructuredGP` with each prior to the same rows, and compare how they predict stretches that are left out.

    All rows are conditioned on exactly, however many there are; beyond 1500 the parameters are found on 600 of them.

    Parameters
    ----------
    priors: candidates by name, two or more; a sum of priors is one candidate.
    points: rows to train on, far apart in (q, v, u); None takes all.
    system: what is known; None takes that of the dataset.
    block_seconds: length of the stretches of time that are left out; None cuts the recording into 20.
    test: another Dataset to score the candidates on as well.
    mean, noise, restarts, seed, jobs, backend, hyperprior, options: as in `StructuredGP` and its `fit`, for each of
        them.

    Raises
    ------
    InvalidInput: an argument is out of range, or the data cannot teach a candidate anything; it is named.
    FitError: no start of the search for a candidate could be evaluated.
    NotEnoughMemory: the exact covariances of the rows do not fit; give fewer points.
    """
    require_type("dataset", dataset, Dataset)
    require_type("priors", priors, Mapping, " from names to priors")
    workers = backend_for(backend, jobs)
    known = dataset.system if system is None else system
    if known is None:
        raise InvalidInput("the dataset does not carry its robot; give system=MechanicalSystem(robot, contacts)")
    if len(priors) < 2:
        raise InvalidInput(f"there is nothing to compare {', '.join(priors) or 'with'}; give two priors or more")
    if test is not None:
        require_rows("test", test, dataset.joint_names, "the training data")
    rows = training_rows(known.robot.joint_names, dataset, points)
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
    models = {name: _named(name, partial(StructuredGP, known, prior, mean, noise)) for name, prior in priors.items()}
    sizes = [_named(name, partial(_checked_size, model, rows)) for name, model in models.items()]
    needed = sum(8 * (size.rows * size.rank) ** 2 for size in sizes)  # all are kept
    needed += max(Exact().required_bytes(size) for size in sizes)
    what = f"{len(sizes)} exact posteriors of N={sizes[0].rows} rows"
    require_memory(needed, what, "give fewer `points`, or fewer candidates", known.robot.device)
    how: dict[str, Any] = {"restarts": restarts, "seed": seed, "backend": workers, "hyperprior": hyperprior}
    how |= {"options": options, "engine": "exact"}  # whatever the number of rows: no other engine can leave rows out
    posteriors = {}
    for name, model in models.items():
        note = None if progress is None else partial(progress, name)
        posteriors[name] = _named(name, partial(model.fit, rows, **how, progress=note))
    return _compared(posteriors, blocks, seconds, test)


def _compared(
    posteriors: Mapping[str, StructuredPosterior], blocks: Sequence[Sequence[int]], seconds: float, test: Dataset | None
) -> PriorComparison:
    sizes = np.array([len(block) for block in blocks], dtype=np.float64)
    densities = {name: posterior.leave_out(blocks).log_density.numpy() for name, posterior in posteriors.items()}
    best = max(densities.values(), key=lambda density: float(density.sum()))
    scores, notes = [], []
    for name, posterior in posteriors.items():
        difference, error = paired_difference(densities[name], best, sizes)
        evaluation = None if test is None else evaluate(posterior, test)
        of_it = unfinished_search(posterior) if evaluation is None else evaluation.warnings
        notes += [(sentence, name) for sentence in of_it]
        scores.append(
            PriorScore(
                name=name,
                latents=len(posterior.model.prior.latent_names(posterior.system.robot)),
                parameters=sum(value.numel() for value in posterior.result.parameters.values()),
                nll=posterior.negative_log_likelihood,
                leave_one_out=posterior.leave_out().total / float(sizes.sum()),
                leave_block_out=float(densities[name].sum() / sizes.sum()),
                difference=difference,
                standard_error=error,
                converged=posterior.result.converged,
                mae=None if evaluation is None else evaluation.mae,
                nlpd=None if evaluation is None else evaluation.nlpd,
            )
        )
    return PriorComparison(
        scores=tuple(scores),
        points=int(sizes.sum()),
        blocks=len(blocks),
        block_seconds=float(seconds),
        warnings=_told_once(notes, len(posteriors)),
        posteriors=dict(posteriors),
    )


def _told_once(notes: Sequence[tuple[str, str]], candidates: int) -> tuple[str, ...]:
    """Sentences, with the candidates that they are about where these are not all."""
    whose: dict[str, list[str]] = {}
    for sentence, name in notes:
        whose.setdefault(sentence, []).append(name)
    return tuple(
        sentence if len(names) == candidates else f"{', '.join(names)}: {sentence}" for sentence, names in whose.items()
    )


def paired_difference(
    one: Float[np.ndarray, " blocks"], other: Float[np.ndarray, " blocks"], sizes: Float[np.ndarray, " blocks"]
) -> tuple[float, float]:
    """Mean difference per row of two log densities by block, and its standard error (two blocks or more)."""
    gain, rows, count = one - other, float(sizes.sum()), len(sizes)
    mean = float(gain.sum()) / rows
    return mean, math.sqrt(count / (count - 1) * float(np.square(gain - sizes * mean).sum())) / rows


def _checked_size(model: StructuredGP, rows: Dataset) -> ProblemSize:
    """Refuse now what the fit would refuse, before hours are spent on another candidate; the fit warns."""
    training = TrainingData.of(rows, model.system.robot.device)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        likelihood = MarginalLikelihood(model.system, model.prior, model.mean, training)
        check_prior(likelihood)
        with torch.no_grad():
            return ProblemSize.of(likelihood.terms({ACCELERATION: torch.zeros_like(training.a[0])}))


def _named(name: str, make: Callable[[], Any]) -> Any:
    """What `make` returns; an error names the candidate."""
    try:
        return make()
    except ForceGPError as error:
        raise type(error)(f"prior {name!r}: {error}") from error
