"""Scores of one model by one name each, as the experiments keep and tabulate them."""

from typing import Any

from forcegp import Dataset, Posterior, score

QUANTITIES = {
    "acceleration": "{}",
    "true acceleration": "{}_noise_free",
    "true force": "force_{}",
    "unknown force": "unknown_force_{}",
    "contact force": "multiplier_{}",
    "constraint": "constraint_error",
}
KEPT = ("mae", "rmse", "coverage_95", "known_physics_mae", "noise_floor", "noise_std")


def scores_of(posterior: Posterior, test: Dataset) -> dict[str, Any]:
    """`mae`, `mae_noise_free`, `coverage_95`, `nlpd`, `multiplier_mae` and the like, over all joints.

    With `_per_joint` at its end, by joint. None for what the test data or the model cannot say.
    """
    scores = score(posterior, test)
    held, out = scores.quantities(), {"rows": len(test), "warnings": list(scores.warnings)}
    for quantity, pattern in QUANTITIES.items():
        for name in KEPT if quantity != "constraint" else ("mae",):
            known = name in held.get(quantity, ())
            key = pattern.format(name)
            out[key] = scores.value(name, quantity) if known else None
            out[f"{key}_per_joint"] = scores.columns(name, quantity) if known else None
    out |= {"nlpd": scores.value("nlpd", "all joints"), "nlpd_per_joint": scores.columns("nlpd")}
    largest = [each or 0.0 for each in scores.columns("largest", "constraint")]
    contact = {"normal_force_error": "relative_rmse", "normal_force_coverage": "coverage_95"}
    contact = {key: scores.value(name, "contact force") for key, name in contact.items() if "contact force" in held}
    return out | {"constraint_error_max": max(largest, default=0.0)} | contact
