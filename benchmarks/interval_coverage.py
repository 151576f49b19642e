"""Do the 95 % intervals of one fit hold the true acceleration? Fits of `kuka-surface` by number of points and seed.

python -m benchmarks.interval_coverage                       tool-friction, N = 10, 20, 100, seeds 501 to 514
python -m benchmarks.interval_coverage --seeds 401 402 --points 20 --prior gp:joint

Every fit learns from the rows of a minute that lie farthest apart, and is scored on another minute (every 15th row),
without noise. "as fitted" is the posterior at the fitted hyper-parameters alone; "drawn" is the share of functions
drawn from that posterior itself that have less than 90 % of their training states inside: what a perfectly calibrated
fit would have.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from benchmarks.scores import scores_of
from forcegp import KukaSurfaceConfig, fit
from forcegp.forces import parse_forces
from forcegp.inference.pathwise import draw_functions
from forcegp.posterior import Posterior
from forcegp.simulation import simulate_kuka_surface

FUNCTIONS = 200


def drawn_below(posterior: Posterior) -> float:
    """Share of the functions drawn from the posterior as fitted of which less than 90 % lie in its 95 % intervals."""
    training = posterior.training
    with torch.no_grad():
        dynamics = posterior.dynamics(training.q, training.v, training.u)
        features = posterior.likelihood.standardization(posterior.model.unknown.features(dynamics))
        values = draw_functions(posterior.latent, FUNCTIONS, 0)([z.expand(FUNCTIONS, *z.shape) for z in features])
        W = dynamics.H @ posterior.model.unknown.direction(dynamics)
        away = torch.einsum("nkc,snc->snk", W, values - posterior.latent.mean(features))
        std = (W @ posterior.latent.covariance(features) @ W.mT).diagonal(dim1=-2, dim2=-1).sqrt()
        inside = (away.abs() <= 1.96 * std).double().mean((1, 2))
    return float((inside < 0.9).double().mean())


def main() -> None:
    """Fit, score and print a line per fit and the summary."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--prior", default="gp:tool-friction")
    parser.add_argument("--points", type=int, nargs="+", default=[10, 20, 100])
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(501, 515)))
    given = parser.parse_args()
    rows = []
    print("seed    N  inside 95 %  as fitted  drawn below 90 %  factor")
    for seed in given.seeds:
        train, test = (simulate_kuka_surface(KukaSurfaceConfig(seconds=60.0, seed=k)) for k in (seed, 1000 + seed))
        for points in given.points:
            posterior = fit(train.model.with_forces(parse_forces(given.prior)), train, points=points)
            both = posterior, posterior.with_settings(widening=1.0)
            inside, plain = (
                scores_of(each, test.rows(slice(None, None, 15)))["coverage_95_noise_free"] for each in both
            )
            rows.append((inside, plain, drawn_below(posterior), posterior.widening))
            told = f"{inside:11.3f}  {plain:9.3f}  {rows[-1][2]:16.2f}  {rows[-1][3]:6.2f}"
            print(f"{seed:4d} {points:4d}  {told}", flush=True)
    widened, as_fitted, drawn, factors = np.array(rows).T
    for name, values in (("as fitted", as_fitted), ("widened", widened)):
        below = f"{(values < 0.9).mean():.1%} of {len(values)} fits below .90"
        print(f"{name}: lowest {values.min():.3f}, mean {values.mean():.3f}, {below}")
    print(f"median factor {np.median(factors):.2f}; drawn from itself {drawn.mean():.1%} below .90")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
