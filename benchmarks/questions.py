"""What every benchmark answers, by question: key -> (bound, meaning). A question is a module with run() -> results."""

from __future__ import annotations

TITLES = {
    "likelihood": "The exact likelihood and its gradients",
    "rigid_body": "Rigid-body dynamics",
    "compiled_dynamics": "Compiled dynamics",
    "learning": "Learning from 100 points",
    "incremental": "Learning while the robot works",
    "prediction": "Predictions at control rates",
    "programs": "Models as programs",
    "searches": "Searches for hyper-parameters",
    "large_data": "Many rows",
    "scaling": "Cost against the number of rows",
    "backends": "Restarts in several processes",
    "importing": "Importing logs",
}
"""The questions in the order in which they are asked, and their headings in docs/performance.md."""

MEANINGS: dict[str, dict[str, tuple[str, str]]] = {
    "likelihood": {
        "nll_speedup_n400": (">= 4.5", "NLL + all gradients, N = 400, one contact: dense time / deflated time"),
        "nll_speedup_n1000": (">= 5", "the same at N = 1000"),
        "nll_speedup_n400_three_constraints": (">= 12", "the same at N = 400 with three constraints"),
        "nll_speedup_n400_tool_friction": (">= 40", "the same at N = 400, one contact, prior tool-friction (rank 2)"),
        "nll_memory_ratio_n1000": ("<= 0.333", "peak memory at N = 1000: deflated / dense"),
    },
    "rigid_body": {
        "mass_bias_vs_pinocchio_b1000": (
            "<= 4",
            "mass matrix + bias of 1000 states: our CPU time / a C++ Pinocchio loop",
        ),
        "forward_dynamics_single_ms": ("<= 1", "forward dynamics of a single state [ms]"),
    },
    "compiled_dynamics": {
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
    },
    "learning": {
        "mae_analytical_n100": (
            "<= 0.0865",
            "S-GP + analytical mean, N = 100: MAE on noisy test data, median [rad/s^2]",
        ),
        "mae_zero_n100": ("<= 0.13", "S-GP without mean, N = 100: the same"),
        "mae_noise_free_analytical_n100": ("", "S-GP + analytical mean: MAE against the noise-free acceleration"),
        "mae_noise_free_zero_n100": ("", "S-GP without mean: the same"),
        "constraint_error_n100": ("<= 1e-10", "largest mean |A a - b| over both models and all seeds"),
        "coverage_95_lowest_n100": (">= 0.90", "lowest coverage of the 95 % interval over both models and all seeds"),
        "coverage_95_highest_n100": ("<= 0.99", "highest of the same"),
    },
    "incremental": {
        "update_10_rows_speedup_n1000": (
            ">= 5",
            "10 rows more at N = 1000: time to condition on all / time of an update",
        ),
        "leave_20_rows_out_update_over_anew": ("", "20 of 220 rows left out: updating the factor / factorising anew"),
        "stream_mae_first_rows_b200": ("", "2000 rows of kuka-surface: noise-free MAE after the first 200 [rad/s^2]"),
        "stream_mae_newest_b200": ("", "the same after all, with a budget of 200: the newest rows kept"),
        "stream_mae_random_b200": ("", "the same: random rows kept"),
        "stream_mae_farthest_b200": ("", "the same: rows kept that lie far apart in (q, v, u)"),
        "stream_mae_information_b200": ("", "the same: rows kept that tell most beyond the others"),
        "stream_mae_divergence_b200": ("", "the same: rows kept that move the posterior most (the default)"),
        "stream_mae_hindsight_b200": (
            "",
            "the same: conditioned at once on the 200 of 2000 rows that lie farthest apart",
        ),
    },
    "prediction": {
        "predict_mean_ms": (
            "<= 0.3",
            "predictor, one state, N = 1000, 7 joints, one plane: mean, median [ms, wall-clock]",
        ),
        "predict_mean_p99_ms": ("", "the same: 99th percentile"),
        "predict_cov_ms": ("<= 1", "the same with covariance: median [ms, wall-clock]"),
        "predict_cov_p99_ms": ("", "the same: 99th percentile"),
        "predict_linearize_ms": ("", "the mean and its derivatives in q, v and u: median [ms, wall-clock]"),
        "predict_plain_mean_ms": ("", "what posterior.predict takes for the mean of one state: median [ms]"),
        "predict_plain_cov_ms": ("", "the same with covariance [ms]"),
        "predict_states_per_s_b10000": (">= 30000", "predictor, mean of 10,000 states at once [states/s]"),
        "predict_cov_states_per_s_b10000": ("", "the same with covariance [states/s]"),
        "predict_cov_inflation_median": (
            "",
            "compressed standard deviations over exact ones - 1, another seed: median",
        ),
        "predict_cov_inflation_p99": ("<= 0.02", "the same: 99th percentile"),
        "predict_rank": ("", "combinations of the data that the compressed covariance uses, of 6000"),
        "predict_prepare_s": ("", "making the predictor: tracing, compiling, compressing [s, wall-clock]"),
    },
    "programs": {
        "friction_predict_mean_ms": (
            "<= 0.10",
            "predictor, joint-friction+load-friction, one state, N = 100 or 400, the slower: mean [ms, wall-clock]",
        ),
        "friction_predict_cov_ms": ("<= 0.30", "the same with covariance [ms]"),
        "friction_linearize_ms": ("<= 0.40", "the same: mean and its derivatives in q, v and u [ms]"),
        "rollout_ms": (
            "",
            "512 motions of 25 steps, joint-friction, N = 100: predictor.rollouts, one thread [ms]",
        ),
        "rollout_vs_predictor_loop": (">= 100", "the same, calls of the predictor one by one: times as long"),
        "rollout_vs_predictor_batches": ("", "the same, calls of the predictor with all 512 states"),
        "rollout_vs_posterior_rollout": (">= 500", "the same, rollouts by torch one by one"),
        "rollout_vs_posterior_rollout_batches": ("", "the same, rollouts by torch with all 512 motions"),
        "rollout_functions_cost": (
            "<= 1.5",
            "the same under eight drawn functions, each: times as long as the mean",
        ),
        "rollout_two_threads": (">= 1.7", "the same: one thread / two"),
        "c_mean_us": ("<= 20", "exported C, joint prior, N = 100, gcc -O2, through ctypes: mean [us]"),
        "c_cov_us": ("<= 40", "the same with covariance [us]"),
        "c_compile_cpu_s": ("<= 10", "compiling that file [CPU s]"),
        "c_parity": ("<= 5e-12", "the same against predict at 10,000 states, relative to the largest value"),
        "c_parity_n1000": ("<= 1e-11", "the same, N = 1000"),
        "casadi_parity": ("<= 1e-12", "CasADi function of the first prior against predict"),
        "casadi_jacobian_parity": ("<= 1e-12", "its Jacobian against the predictor's"),
    },
    "searches": {
        "search_evaluations_n100": (
            "<= 360",
            "evaluations of a fit with four starts, N = 100: largest of the medians over five recordings of S-GP [38], "
            "S-GP without mean and S-GP + analytical mean",
        ),
    },
    "large_data": {
        "fit_seconds_n1000_coulomb": ("<= 400", "Coulomb friction in the joints, joint prior, N = 1000 [CPU s]"),
        "fit_n1000_cpu_s": ("<= 480", "fit to 1000 rows, joint prior, to convergence [CPU s]"),
        "fit_n1000_memory_mib": ("<= 400", "the same: peak memory above the data [MiB]"),
        "fit_n10000_cpu_s": ("<= 480", "hyper-parameters from 600 rows, posterior from 10,000, joint prior [CPU s]"),
        "fit_n10000_memory_mib": ("<= 8192", "the same: peak memory above the data [MiB]"),
        "fit_n1000_mae_noise_free": ("", "Coulomb friction in the joints, N = 1000: noise-free MAE [rad/s^2]"),
        "fit_n10000_mae_noise_free": ("", "the same at N = 10,000"),
        "mae_ratio_n10000_n1000": ("<= 0.75", "the second over the first"),
        "fit_n100000_cpu_s": (
            "<= 600",
            "fit to 100,000 rows, prior tool-friction, hyper-parameters from all of them [CPU s]",
        ),
        "fit_n100000_memory_mib": ("<= 12288", "the same: peak memory above the data [MiB]"),
        "fit_n100000_mae_noise_free": ("", "the same: noise-free MAE [rad/s^2]"),
        "fit_n1000_coverage_95": ("", "coverage of the 95 % interval of noisy test data, N = 1000"),
        "fit_n10000_coverage_95": ("", "the same at N = 10,000"),
        "fit_n100000_coverage_95": ("", "the same at N = 100,000, prior tool-friction"),
    },
    "scaling": {
        "slope_exact": ("", "exact engine: CPU time grows as N to this power (last three points)"),
        "slope_iterative": ("", "conjugate gradients: the same"),
        "slope_inducing": ("", "inducing points of the prior tool-friction: the same"),
        "slope_stochastic": ("", "mini-batches (100 steps), then one pass: the same"),
    },
    "backends": {
        "joblib_speedup_8_restarts": (
            ">= 1.6",
            "8 restarts, N = 200: wall-clock time in this process / in two warm processes (joblib)",
        ),
        "joblib_cold_seconds": ("", "what the first call takes longer, which starts the processes [s, wall-clock]"),
        "ray_overhead_seconds": ("", "the same on a Ray cluster of this machine: time beyond joblib's [s, wall-clock]"),
        "ray_cold_seconds": ("", "what its first call takes longer, which starts the cluster [s, wall-clock]"),
        "backends_identical": (">= 1", "1 if all parameters are the same to the last bit on all three backends"),
    },
    "importing": {
        "import_csv_1gb_s": (
            "<= 60",
            "a CSV log of 1 GB, 7 joints, uneven stamps: forcegp import, wall-clock [s], with the threads it takes",
        ),
        "import_csv_1gb_cpu_s": ("", "the same: CPU time of all threads [s]"),
        "import_csv_1gb_memory_mib": ("<= 1024", "the same: largest resident memory of the process [MiB]"),
        "import_csv_1gb_rows": ("", "the same: rows written"),
        "import_mcap_1gb_s": ("<= 60", "an MCAP file of 1 GB of JointState messages: the same [s]"),
        "import_mcap_1gb_cpu_s": ("", "the same: CPU time of all threads [s]"),
        "import_mcap_1gb_memory_mib": ("<= 1024", "the same: largest resident memory of the process [MiB]"),
        "import_mcap_1gb_rows": ("", "the same: rows written"),
    },
}
