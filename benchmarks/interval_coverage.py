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
import statistics

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from benchmarks.scores import scores_of
from forcegp import KukaSurfaceConfig, fit
from forcegp.data import Dataset
from forcegp.forces import parse_forces
from forcegp.inference.pathwise import draw_functions
from forcegp.posterior import Posterior
from forcegp.simulation import simulate_kuka_surface

SECONDS = 60.0
FUNCTIONS = 200


def recording(seed: int) -> Dataset:
    """A minute of `kuka-surface`."""
    return simulate_kuka_surface(KukaSurfaceConfig(seconds=SECONDS, seed=seed))


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
    as_fitted, widened, drawn, factors = [], [], [], []
    print("seed    N  inside 95 %  as fitted  drawn below 90 %  factor  MAE")
    for seed in given.seeds:
        train, test = recording(seed), recording(1000 + seed).rows(slice(None, None, 15))
        for points in given.points:
            model = train.model.with_forces(parse_forces(given.prior))
            posterior = fit(model, train, points=points)
            scores = [scores_of(each, test) for each in (posterior, posterior.with_settings(widening=1.0))]
            inside, plain = (score["coverage_95_noise_free"] for score in scores)
            widened.append(inside)
            as_fitted.append(plain)
            drawn.append(drawn_below(posterior))
            factors.append(posterior.widening)
            error = scores[0]["mae_noise_free"]
            numbers = f"{inside:11.3f}  {plain:9.3f}  {drawn[-1]:16.2f}  {factors[-1]:6.2f}  {error:.4f}"
            print(f"{seed:4d} {points:4d}  {numbers}", flush=True)
    for name, values in (("as fitted", as_fitted), ("widened", widened)):
        below = float((np.array(values) < 0.9).mean())
        print(
            f"{name}: lowest {min(values):.3f}, mean {np.mean(values):.3f}, {below:.1%} of {len(values)} fits below .90"
        )
    print(f"median factor {statistics.median(factors):.2f}; drawn from itself {np.mean(drawn):.1%} below .90")


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
