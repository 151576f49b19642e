"""How well are mass and centre of mass of the tool found, and do the standard errors tell the truth?

One line per seed: errors of the mass (g) and of the centre of mass (mm), each also in standard errors; how the search
ended; and the decrement, by how many standard errors a Newton step would still move the estimates. Intervals count
where the standard error is finite.

    python benchmarks/identification.py --points 100 --seeds 11 12 13
"""

from __future__ import annotations

import argparse
import time
import warnings

import numpy as np
import torch

from forcegp import KukaSurfaceConfig, fit, simulate_kuka_surface
from forcegp.errors import NumericalWarning
from forcegp.forces import Body, JointForces, RigidBodies
from forcegp.inference import OptimizerOptions
from forcegp.simulation.kuka_surface import TOOL_LINK

F64 = torch.float64
TOO_HEAVY = 0.5
"""kg"""
TOO_FAR = (0.05, 0.05, -0.03)
"""m"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=300)
    parser.add_argument("--seeds", type=int, nargs="+", default=[11])
    parser.add_argument("--iterations", type=int, default=60)
    parser.add_argument("--tolerance", type=float, default=OptimizerOptions.tolerance)
    parser.add_argument("--start", choices=["wrong", "true"], default="wrong", help="values of the given model")
    parser.add_argument("--mean", choices=["analytical", "zero"], default="analytical")
    given = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("always", NumericalWarning)
    covered, count = torch.zeros(4), torch.zeros(4)
    for seed in given.seeds:
        data = simulate_kuka_surface(KukaSurfaceConfig(seconds=100, seed=seed))
        assert data.model is not None
        link = data.model.robot.link(TOOL_LINK)
        off = float(given.start == "wrong")
        center = np.array(link.center_of_mass) + off * np.array(TOO_FAR)
        robot = data.model.robot.with_link(TOOL_LINK, link.mass + off * TOO_HEAVY, center, link.inertia)
        begin = time.process_time()
        body = RigidBodies({TOOL_LINK: Body(0.01, ("mass", "center_of_mass"))})
        model = data.model.with_robot(robot).with_forces(JointForces(), body)
        posterior = fit(
            model if given.mean == "analytical" else model.without_mean(),
            data,
            points=given.points,
            restarts=1,
            options=OptimizerOptions(iterations=given.iterations, tolerance=given.tolerance),
        )
        fitted = time.process_time()
        found = posterior.identification
        assert found is not None
        standard = torch.tensor(list(found.standard_errors.values()), dtype=F64)
        known = time.process_time()
        error = torch.tensor(list(found.values.values()), dtype=F64) - torch.tensor(
            [link.mass, *link.center_of_mass], dtype=F64
        )
        known_at_all = torch.isfinite(standard)
        covered = covered + (known_at_all & ((error / standard).abs() <= 1.96))
        count = count + known_at_all
        shown = " ".join(
            f"{1e3 * e:+.4f} ({f'{e / s:+.2f}' if s.isfinite() else 'unknown'})"
            for e, s in zip(error, standard, strict=True)
        )
        print(
            f"seed {seed}: {shown}; {len(found.history) - 1} iterations, {fitted - begin:.1f} s CPU, "
            f"standard errors {known - fitted:.1f} s, decrement {found.decrement:.2g}, "
            f"{'converged' if posterior.result.converged else 'not converged'}, objective {posterior.result.value:.2f}",
            flush=True,
        )
    print("in the 95 % interval:", ", ".join(f"{int(c)} of {int(n)}" for c, n in zip(covered, count, strict=True)))


if __name__ == "__main__":
    main()
