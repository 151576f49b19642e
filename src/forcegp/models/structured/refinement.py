"""Hyper-parameters improved on all rows, from those that some rows gave: by the collapsed bound or mini-batches."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import torch

from forcegp.errors import NumericalError, NumericalWarning
from forcegp.inference import (
    Inducing,
    InducingPosterior,
    OptimizationResult,
    OptimizerOptions,
    Stochastic,
    minimize_objective,
)
from forcegp.inference.conjugate_gradients import Iteration
from forcegp.inference.engines import ENOUGH
from forcegp.inference.stochastic import stochastic_search
from forcegp.models.structured.objective import FitObjective
from forcegp.models.structured.posterior import StructuredPosterior

TOLERANCE = 1e-6
"""Fraction of the bound by which an iteration must lower it for the search to go on."""

NOISE = 1.0
"""Nats by which noisy steps may end above a start that was at the optimum, without a warning."""


def refined(posterior: StructuredPosterior, hyperprior: bool, report: Iteration | None = None) -> StructuredPosterior:
    """The posterior at hyper-parameters that its engine improves on all rows; itself where the engine does not.

    Where physical parameters were learned they and all others stay, for their standard errors belong together.
    """
    engine, latent = posterior.engine, posterior.latent
    if not isinstance(latent, InducingPosterior):
        return posterior
    if posterior.identification is not None:
        return _checked(posterior)
    noise, (_, fixed) = posterior.model.known_noise, posterior.model.split_noise
    held = {name: posterior.parameters[name] for name in fixed}
    start = {name: value for name, value in posterior.parameters.items() if name not in held}
    likelihood, kernels = posterior.likelihood, posterior.kernels
    objective = FitObjective(likelihood, kernels, noise, held, hyperprior, points=latent.features)
    if isinstance(engine, Inducing) and engine.refine and latent.left_out <= engine.tolerance:
        options = OptimizerOptions(iterations=engine.refine, tolerance=TOLERANCE)
        return _checked(_moved_to(posterior, minimize_objective(objective, start, options, report)))
    if isinstance(engine, Stochastic) and engine.steps:
        result = stochastic_search(
            kernels,
            latent,
            lambda parameters: likelihood.terms({**held, **parameters}),
            start,
            lambda parameters: -objective.log_prior(parameters),
            steps=engine.steps,
            batch=engine.batch,
            rate=engine.rate,
            seed=engine.seed,
            report=report,
        )
        with torch.no_grad():  # steps are noisy: the bound on all rows decides
            before = float(objective(start))
            try:
                after = float(objective(result.parameters))
            except NumericalError:  # steps so wide that no bound can be computed where they ended
                after = math.inf
        if not after <= before:
            outcome = f"{result.status} would raise the bound on all rows from {before:.1f} to {after:.1f} nats"
            if not after <= before + NOISE:
                remedy = f"give Stochastic a smaller rate ({engine.rate} now), a larger batch or more steps"
                warnings.warn(f"{outcome}, so that nothing was changed; {remedy}", NumericalWarning, stacklevel=3)
            return _checked(posterior.with_settings(refined=f"unchanged: {outcome}"))
        return _checked(_moved_to(posterior, replace(result, history=(before, after), value=after)))
    return _checked(posterior)


def _checked(posterior: StructuredPosterior) -> StructuredPosterior:
    """The posterior; a warning where its inducing points leave out so much that it is an approximation."""
    latent, engine = posterior.latent, posterior.engine
    assert isinstance(latent, InducingPosterior)
    if latent.left_out > max(ENOUGH, getattr(engine, "tolerance", 0.0)):
        warnings.warn(
            f"{latent.space.count} inducing points leave out {latent.left_out:.2g} of the noise variance of a row, so "
            "that the posterior is an approximation with wider intervals than the exact one; give more points, or take "
            "`engine='exact'` or `engine='iterative'`",
            NumericalWarning,
            stacklevel=4,
        )
    return posterior


def _moved_to(posterior: StructuredPosterior, result: OptimizationResult) -> StructuredPosterior:
    """The posterior at the parameters that a search on all rows found."""
    parameters = {**posterior.parameters, **result.parameters}
    change = f"{result.history[0]:.1f} -> {result.value:.1f}"
    note = f"on all rows, {result.evaluations} evaluations: {change} ({result.status})"
    spent = replace(posterior.result, cpu_seconds=posterior.result.cpu_seconds + result.cpu_seconds)
    latent = posterior.likelihood.condition(posterior.kernels, parameters, posterior.engine)
    return replace(posterior, parameters=parameters, result=spent, latent=latent).with_settings(refined=note)
