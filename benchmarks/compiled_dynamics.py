"""What does the dynamics that is compiled for one robot cost, against Pinocchio in C++ and the C that CasADi generates?

One process, one thread, all sides in turn, CPU seconds, medians; the robot is the KUKA iiwa, 1,000 and 10,000 random
states. All sides are first checked to agree. CasADi's is in `benchmarks.casadi_dynamics`, and the stronger of the two.
The Pinocchio side is a C++ loop over the states (see `benchmarks.rigid_body`).

"Cold" is the time to compile into an empty folder, "warm" the time in a new process from ``robot.compile(folder)`` to
the first result of forward dynamics, with torch and the robot loaded (wall-clock time both).

    python -m benchmarks.compiled_dynamics
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pinocchio as pin
import torch
from threadpoolctl import threadpool_limits

from benchmarks.casadi_dynamics import QUANTITIES, CasadiLoops
from benchmarks.rigid_body import URDF, Loops, Ours, States, agreement, in_turn, largest_error
from forcegp.robots import Robot

BATCH, REPETITIONS, EAGER_REPETITIONS = 10_000, 50, 5


def against_casadi(states: States, mine: Ours, folder: Path) -> dict[str, float]:
    """Our time over that of CasADi's C for each quantity, after a check that both agree."""
    folder.mkdir()
    loops, count = CasadiLoops(states.robot, folder, states.q, states.v, states.tau), len(states.q)
    mass, bias = mine.mass_and_bias()
    M, h = loops.mass_bias()
    errors = [largest_error(mass.flatten(1), M), largest_error(bias, h), largest_error(mine.forward(), loops.fd()[0])]
    assert max(errors) < 1e-9, errors
    found = {}
    pairs = zip((mine.mass_and_bias, mine.forward), QUANTITIES, strict=True)
    for ours, quantity in pairs:
        own, theirs = in_turn(
            ours, getattr(loops, quantity), repetitions=20 * REPETITIONS if count < BATCH else REPETITIONS
        )
        found[f"compiled_{quantity}_vs_casadi_b{count}"] = own / theirs
        times = f"{1e6 * own:8.0f} us, CasADi's C {1e6 * theirs:8.0f} us, {own / theirs:.2f}"
        print(f"{quantity:20s}{count:7d} states: {times}")
    return found


def seconds(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def cold(robot: Robot, folder: Path) -> dict[str, float]:
    """Wall-clock seconds to compile each of what is measured here, into an empty folder."""
    compiled_robot, (q, v, tau) = robot.compile(folder), torch.zeros(3, 2, robot.nv, dtype=torch.float64)
    return {
        "mass matrix + bias": seconds(lambda: compiled_robot.mass_matrix_and_bias(q, v)),
        "forward dynamics": seconds(lambda: compiled_robot.forward_dynamics(q, v, tau)),
    }


def run() -> dict[str, float]:
    """Measure and print; nothing where there is no C++ loop to compare with."""
    torch.empty(30 * 2**20, dtype=torch.uint8)  # freed at once: see benchmarks.rigid_body
    states = States(BATCH)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        taken = cold(states.robot, folder / "dynamics")
        command = [sys.executable, "-m", "benchmarks.compiled_dynamics", "warm", str(folder / "dynamics")]
        fresh = subprocess.run(command, check=True, capture_output=True, text=True, cwd=Path(__file__).parents[1])
        print("".join(f"compiling {what}: {duration:.2f} s\n" for what, duration in taken.items()), end="")
        print(f"first forward dynamics of another process: {1e3 * float(fresh.stdout):.1f} ms")
        results = {
            "compiled_cold_seconds_fd": taken["forward dynamics"],
            "compiled_warm_seconds_fd": float(fresh.stdout),
        }
        try:
            loops = Loops(states, folder)
        except (OSError, subprocess.CalledProcessError) as error:
            why = getattr(error, "stderr", None)
            print(f"no C++ loop to compare with ({error}); {why.decode()[-500:] if why else ''}")
            return results
        mine, eager = (Ours(states, of) for of in (states.robot.compile(folder / "dynamics"), states.robot))
        results["compiled_error_vs_pinocchio"] = agreement(mine, loops)
        rows = []
        for key, label, ours, uncompiled, theirs in (
            ("mass_bias", "mass matrix + bias", mine.mass_and_bias, eager.mass_and_bias, loops.mass_and_bias),
            ("fd", "forward dynamics", mine.forward, eager.forward, [loops.forward]),
        ):
            own, *others = in_turn(ours, *theirs, repetitions=REPETITIONS)
            (slow,) = in_turn(uncompiled, repetitions=EAGER_REPETITIONS)
            results[f"compiled_{key}_vs_pinocchio_b10000"] = own / min(others)
            rows.append((label, own, slow, others))
        one = tuple(x[0] for x in states.tensors)
        single, alone = in_turn(
            lambda: mine.of.forward_dynamics(*one),
            lambda: pin.aba(states.model, states.data, states.q[0], states.v[0], states.tau[0]),
            repetitions=1000,
        )
        results["compiled_fd_single_us"] = 1e6 * single
        for count in (1000, BATCH):
            fewer = States(count)
            own = Ours(fewer, mine.of)
            results |= against_casadi(fewer, own, folder / str(count))
    print(f"\n{f'CPU ms, medians, {BATCH} states':56s}{'compiled':>10s}{'eager':>10s}{'C++ loops':>18s}{'ratio':>8s}")
    for label, own, slow, others in rows:
        listed = " / ".join(f"{1e3 * other:.1f}" for other in others)
        print(f"{label:56s}{1e3 * own:10.2f}{1e3 * slow:10.1f}{listed:>18s}{own / min(others):8.3f}")
    print(f"{'forward dynamics, 1 state (pin.aba)':56s}{1e3 * single:10.4f}{1e3 * alone:28.4f}")
    return results


def main(arguments: list[str]) -> None:
    torch.set_num_threads(1)
    if arguments[:1] == ["warm"]:
        robot = Robot.from_urdf(URDF)
        q, v, tau = torch.zeros(3, robot.nv, dtype=torch.float64)
        print(seconds(lambda: robot.compile(arguments[1]).forward_dynamics(q, v, tau)))
        return
    with threadpool_limits(1):
        for key, value in run().items():
            print(f"{key}: {value:.3g}")


if __name__ == "__main__":
    main(sys.argv[1:])
