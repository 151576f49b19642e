"""Run every benchmark in one process on one thread, print, and write `results.json` and the table of `README.md`.

make bench                              all questions
python -m benchmarks likelihood         some of them (the others keep their stored results)
"""

from __future__ import annotations

import json
import os
import platform
import sys
from datetime import UTC, datetime
from importlib import import_module, metadata
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
RESULTS = FOLDER / "results.json"
README = FOLDER / "README.md"
BEGIN, END = "<!-- table: written by `make bench` -->", "<!-- end of table -->"

# Each question is a module with run() -> {key: number}; each key has a bound and a meaning.
QUESTIONS = ("likelihood", "rigid_body", "compiled_dynamics", "learning", "incremental", "prediction")
MEANINGS = {
    "nll_speedup_n400": (">= 4.5", "NLL + all gradients, N = 400, one contact: dense time / deflated time"),
    "nll_speedup_n1000": (">= 5", "the same at N = 1000"),
    "nll_speedup_n400_three_constraints": (">= 12", "the same at N = 400 with three constraints"),
    "nll_speedup_n400_tool_friction": (">= 40", "the same at N = 400, one contact, prior tool-friction (rank 2)"),
    "nll_memory_ratio_n1000": ("<= 0.333", "peak memory at N = 1000: deflated / dense"),
    "mass_bias_vs_pinocchio_b1000": ("<= 4", "mass matrix + bias of 1000 states: our CPU time / a C++ Pinocchio loop"),
    "forward_dynamics_single_ms": ("<= 1", "forward dynamics of a single state [ms]"),
    "compiled_mass_bias_vs_pinocchio_b10000": (
        "<= 0.5",
        "mass matrix + bias of 10,000 states, compiled for the robot: our CPU time / a C++ Pinocchio loop",
    ),
    "compiled_fd_vs_pinocchio_b10000": ("<= 0.5", "forward dynamics: the same"),
    "compiled_inertial_gradient_vs_pinocchio_b10000": (
        "<= 0.3",
        "forward dynamics and the gradient of a weighted sum of it to all inertial parameters: the same",
    ),
    "compiled_error_vs_pinocchio": ("<= 1e-9", "largest error of these three, relative to the largest value"),
    "compiled_fd_single_ms": ("", "compiled forward dynamics of a single state [ms]"),
    "compiled_cold_seconds_fd": ("<= 60", "compiling forward dynamics [s, wall-clock]"),
    "compiled_cold_seconds_inertial_gradient": ("<= 60", "compiling it and its gradient to the inertials [s]"),
    "compiled_warm_seconds_fd": ("", "robot.compile() to the first result in a new process, from the folder [s]"),
    "mae_analytical_n100": ("<= 0.0865", "S-GP + analytical mean, N = 100: MAE on noisy test data, median [rad/s^2]"),
    "mae_zero_n100": ("<= 0.13", "S-GP without mean, N = 100: the same"),
    "mae_noise_free_analytical_n100": ("", "S-GP + analytical mean: MAE against the noise-free acceleration"),
    "mae_noise_free_zero_n100": ("", "S-GP without mean: the same"),
    "constraint_error_n100": ("<= 1e-10", "largest mean |A a - b| over both models and all seeds"),
    "coverage_95_lowest_n100": (">= 0.90", "lowest coverage of the 95 % interval over both models and all seeds"),
    "coverage_95_highest_n100": ("<= 0.99", "highest of the same"),
    "update_10_rows_speedup_n1000": (">= 5", "10 rows more at N = 1000: time to condition on all / time of an update"),
    "leave_20_rows_out_update_over_anew": ("", "20 of 220 rows left out: updating the factor / factorising anew"),
    "stream_mae_first_rows_b200": ("", "2000 rows of kuka-surface: noise-free MAE after the first 200 [rad/s^2]"),
    "stream_mae_newest_b200": ("", "the same after all, with a budget of 200: the newest rows kept"),
    "stream_mae_random_b200": ("", "the same: random rows kept"),
    "stream_mae_farthest_b200": ("", "the same: rows kept that lie far apart in (q, v, u)"),
    "stream_mae_information_b200": ("", "the same: rows kept that tell most beyond the others"),
    "stream_mae_divergence_b200": ("", "the same: rows kept that move the posterior most (the default)"),
    "stream_mae_hindsight_b200": ("", "the same: conditioned at once on the 200 of 2000 rows that lie farthest apart"),
    "predict_mean_ms": ("<= 0.3", "predictor, one state, N = 1000, 7 joints, one plane: mean, median [ms, wall-clock]"),
    "predict_mean_p99_ms": ("", "the same: 99th percentile"),
    "predict_cov_ms": ("<= 1", "the same with covariance: median [ms, wall-clock]"),
    "predict_cov_p99_ms": ("", "the same: 99th percentile"),
    "predict_linearize_ms": ("", "the mean and its derivatives in q, v and u: median [ms, wall-clock]"),
    "predict_plain_mean_ms": ("", "what posterior.predict takes for the mean of one state: median [ms]"),
    "predict_plain_cov_ms": ("", "the same with covariance [ms]"),
    "predict_states_per_s_b10000": (">= 30000", "predictor, mean of 10,000 states at once [states/s]"),
    "predict_cov_states_per_s_b10000": ("", "the same with covariance [states/s]"),
    "predict_cov_inflation_median": ("", "compressed standard deviations over exact ones - 1, another seed: median"),
    "predict_cov_inflation_p99": ("<= 0.02", "the same: 99th percentile"),
    "predict_rank": ("", "combinations of the data that the compressed covariance uses, of 6000"),
    "predict_prepare_s": ("", "making the predictor: tracing, compiling, compressing [s, wall-clock]"),
}


def machine() -> str:
    """Processor, cores and the versions that decide the numbers."""
    model = platform.processor() or platform.machine()
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else ():
        if line.startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("torch", "scipy", "numpy"))
    return f"{model}, {os.cpu_count()} cores, one thread used; Python {platform.python_version()}, {versions}"


def write_whole(path: Path, text: str) -> None:
    """Write under a temporary name, then rename."""
    temporary = path.with_suffix(path.suffix + ".tmp")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)


def table(results: dict[str, float]) -> str:
    """The Markdown table of all results that have a meaning."""
    rows = ["| measured | bound | key | what |", "|---:|:---|:---|:---|"]
    for key, (bound, meaning) in MEANINGS.items():
        if key in results:
            rows.append(f"| {results[key]:.3g} | {bound} | `{key}` | {meaning} |")
    return "\n".join(rows)


def main(questions: list[str]) -> None:
    """Run the questions named (all by default) and store what they answer."""
    unknown = [name for name in questions if name not in QUESTIONS]
    if unknown:
        raise SystemExit(f"no benchmark {unknown[0]!r}; there are: {', '.join(QUESTIONS)}")
    import torch
    from threadpoolctl import threadpool_limits

    stored = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    torch.set_num_threads(1)
    for name in questions or QUESTIONS:
        print(f"\n== {name}", flush=True)
        module = import_module(f"benchmarks.{name}")
        with threadpool_limits(1):  # entered after the libraries are loaded, or it would miss them
            stored |= module.run()
        stored["machine"] = machine()
        stored["date"] = datetime.now(UTC).date().isoformat()
        write_whole(RESULTS, json.dumps(stored, indent=1, sort_keys=True) + "\n")
    text = README.read_text(encoding="utf-8")
    before, after = text[: text.index(BEGIN) + len(BEGIN)], text[text.index(END) :]
    write_whole(README, f"{before}\n{table(stored)}\n\n{stored['machine']}, {stored['date']}.\n{after}")
    print(f"\n{table(stored)}\n\n{stored['machine']}")


if __name__ == "__main__":
    main(sys.argv[1:])
