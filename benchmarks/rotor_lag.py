"""How well `estimate_thruster_lag` finds the lag of rotors, and whether its deviation is honest.

Flights of `simulate quadrotor` of 20, 40 or 60 s in wind of 0, 4, 8 or 12 m/s have lags of 40 to 100 ms, all drawn.
Prints the error of each flight in ms and in deviations, then medians and shares.

    python -m benchmarks.rotor_lag [--flights 26]
"""

import argparse

import numpy as np

from forcegp.data import estimate_thruster_lag
from forcegp.simulation import QuadrotorConfig, simulate_quadrotor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=26)
    rng, errors = np.random.default_rng(5), []
    for seed in range(parser.parse_args().flights):
        lag, seconds, wind = rng.uniform(0.04, 0.1), rng.choice([20.0, 40.0, 60.0]), rng.choice([0.0, 4.0, 8.0, 12.0])
        flight = simulate_quadrotor(
            QuadrotorConfig(seconds=float(seconds), seed=seed, lag=float(lag), wind=float(wind))
        )
        found, std = estimate_thruster_lag(flight)
        errors.append((1e3 * (found - lag), (found - lag) / std))
        print(
            f"{seconds:.0f} s, {wind:2.0f} m/s: {1e3 * lag:5.1f} ms, off by {errors[-1][0]:5.1f} ms, "
            f"{errors[-1][1]:4.1f} deviations",
            flush=True,
        )
    size, share = np.abs(errors).T
    print(f"median of errors {np.median(size):.1f} ms, root mean square {np.sqrt(np.square(size).mean()):.1f} ms")
    print(f"within two deviations: {(share < 2.0).sum()} of {len(share)}")


if __name__ == "__main__":
    main()
