"""A posterior made ready for control rates: its programs, and its covariance, compressed at states around the data."""

import time
import warnings
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput, NumericalWarning
from forcegp.evidence.likelihood import TrainingData
from forcegp.forces import ObservedWrench
from forcegp.inference.posterior import ExactPosterior
from forcegp.inference.prepared_kernels import Sample, compress
from forcegp.model import Model
from forcegp.posterior.predictor import Predictor
from forcegp.posterior.programs import Physics
from forcegp.robots.manifold import ConfigurationSpace

COVARIANCES = ("auto", "compressed", "exact", "none")
SAMPLES, CHECKS = 300, 150  # states that choose the compressed covariance, and others that show how good it is
STEP = 0.3  # length of a step away from a training state, in differences of two others

TOLERANCE, LARGEST_RANK = 0.01, 1536
"""By how much standard deviations of a compressed covariance exceed the exact ones at most, where the rank suffices."""


def prepared_predictor(posterior: Any, covariance: str, compile: bool) -> Predictor:
    """What `Posterior.predictor` documents."""
    if not isinstance(covariance, str) or covariance not in COVARIANCES:
        raise InvalidInput(f"covariance is {covariance!r}; give one of {', '.join(map(repr, COVARIANCES))}.")
    begin, latent, model = time.perf_counter(), posterior.latent, posterior.model
    physics, training = Physics.of(posterior, model), rows_for(posterior.training, posterior.trained, model)
    if covariance == "auto":
        covariance = "compressed" if isinstance(latent, ExactPosterior) else "exact"
    compressed = None
    if covariance == "compressed" and len(latent.kernels.dense):
        if not isinstance(latent, ExactPosterior):
            seen = "covariance='compressed' needs the factorised covariance of all rows"
            why = f"which a model with a {type(latent).__name__} does not have"
            advice = f"give covariance='exact', which is the one that it has, 'none', or {latent.remedy}."
            raise InvalidInput(f"{seen}, {why}; {advice}")
        # functions of one input are rough: between two training values, what is uncertain hangs on these two alone
        rough = any(z.shape[-1] == 1 for z in latent.features)

        def sample(count: int, seed: int, rows: int) -> Sample:
            with torch.no_grad():
                W, features = physics.mixing(*sample_states(training, model.robot.space, count, seed, rows))
            usable = torch.isfinite(W).flatten(1).all(1)  # no state of its own has a surface without a normal
            return Sample([z[usable] for z in features], W[usable])

        chosen, check = sample(SAMPLES, 0, len(training.q) if rough else SAMPLES // 3), sample(CHECKS, 1, CHECKS // 3)
        compressed = compress(latent, chosen, check, tolerance=TOLERANCE, largest=LARGEST_RANK)
        reached = float(compressed.inflation.max()) if len(compressed.inflation) else 0.0
        if reached > TOLERANCE:
            seen = f"rank {compressed.rank} makes standard deviations up to {reached:.2g} (relative) too large"
            advice = "give covariance='exact' where that matters."
            warnings.warn(f"{seen}, more than {TOLERANCE:.2g}; {advice}", NumericalWarning, stacklevel=3)
    code = posterior.programs(compressed=compressed) if compile else None
    made = Predictor(posterior, model.robot.space, model.sizes, training.q.device, code, covariance, compressed)
    made.compiled("mean" if compressed is None else "covariance")
    return replace(made, prepare_seconds=time.perf_counter() - begin)


def rows_for(training: TrainingData, trained: Model, model: Model) -> TrainingData:
    """The training rows with another model's inputs, 0 for an observed wrench; InvalidInput for others."""
    had = trained.inputs
    if model.inputs == had:
        return training
    reported = [name for force in model.forces if isinstance(force, ObservedWrench) for name in force.names]
    if new := [name for name in model.inputs if name not in (*had, *reported)]:
        seen = f"the training rows lack inputs ({', '.join(new)}), so no predictor can be checked"
        raise InvalidInput(f"{seen}; call predict.")
    with_zero = torch.nn.functional.pad(training.u, (0, 1))
    return replace(training, u=with_zero[..., [had.index(name) if name in had else -1 for name in model.inputs]])


def sample_states(
    training: TrainingData, space: ConfigurationSpace, count: int, seed: int, rows: int
) -> list[Float[Tensor, "_ size"]]:
    """q, v, u: `rows` training rows, and a third of `count` each of two other kinds of states around them.

    Rows moved by a fraction of the difference of two others; and positions, velocities and forces of different rows.
    """
    generator, states = torch.Generator().manual_seed(seed), [training.q, training.v, training.u]

    def some(number: int) -> Tensor:
        return torch.randint(len(training.q), (number,), generator=generator)

    own, third = torch.randperm(len(training.q), generator=generator)[:rows], count // 3
    i, j, k = some(third), some(third), some(third)
    mixed, moved = [some(count - 2 * third) for _ in states], [x[i] + STEP * (x[j] - x[k]) for x in states]
    if not space.is_vector_space:
        q = states[0]
        moved[0] = space.integrate(q[i], STEP * space.difference(q[k], q[j]))
    return [torch.cat([x[own], between, x[other]]) for x, between, other in zip(states, moved, mixed, strict=True)]
