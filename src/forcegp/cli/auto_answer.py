"""What `forcegp auto` found, in ten lines and in one sentence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import forcegp
import forcegp.data
from forcegp.cli.import_log import stance_text
from forcegp.cli.payload import DRY, LAWS
from forcegp.cli.terminal import number

INERTIA = {"rad": "kg m²", "m": "kg"}  # by the unit of q
SURE, LEAST_PAYLOAD = 3.0, 0.02  # standard errors from zero, and kg, from which a payload is reported


def short_name(name: str) -> str:
    """What a model is called in the answer."""
    laws, air = "gp:joint-friction" in name, "gp:aerodynamic" in name
    learned = " and ".join(what for what, has in (("friction", laws), ("air forces", air)) if has)
    return f"{learned} learned" if learned else {"given": "the URDF"}.get(name, name)


def identification(model: forcegp.Model) -> str:
    """What is found of the robot by itself, as `forcegp score --identification` takes it."""
    laws = f"+{'+'.join(LAWS)}" if model.robot.single_joint_names else ""
    return f"bodies{laws}@{'torques' if model.robot.space.is_vector_space else 'torques:both'}"


def default_models(model: forcegp.Model) -> tuple[str, ...]:
    """What is compared: what thrusters fly through shows in no regression, so it is learned on the robot as given."""
    friction = bool(model.robot.single_joint_names)
    if forcegp.data.thruster_columns(model):
        return "given", "identified", "gp:joint-friction+gp:aerodynamic" if friction else "gp:aerodynamic"
    return "given", "identified", *(["identified+gp:joint-friction"] if friction else [])


def answer_lines(
    content: Mapping[str, Any], dataset: forcegp.Dataset, identified: Any, held: str, scores: forcegp.Scores
) -> list[tuple[str, str]]:
    """What was found, in ten lines."""
    names, values, robot = dataset.joint_names, identified.estimates, identified.model.robot
    import_, prepared = content["import"], content["preparation"]
    deviation = max(each["largest_deviation_of_a_step"] for each in import_["recordings"])
    jitter = f", steps up to {deviation:.0%} off (evened out)" if import_["resampled_to_step"] is not None else ""
    seconds = content["seconds"]
    rate = (len(dataset) - len(dataset.episodes)) / seconds
    # `q=deg`, `sign u=1,-1`, or what was wrong where an order was corrected
    flags = ((each["command"].removeprefix("forcegp import "), each["about"]) for each in content["mistakes"])
    mistakes = ", ".join(text.replace("--unit ", "").replace("--", "") or wrong for text, wrong in flags) or "nothing"
    late = prepared["delay"][0]
    when = "late" if late > 0.0 else "early: a controller that holds u is half a time step"
    on_time = "u shows no delay" if "delay" in prepared["why"] else "u is taken to be on time"
    shifted = f"u was logged {1e3 * abs(late):.1f} ms {when} (shifted)" if late else on_time
    lag = max(prepared["lag"])
    shifted += f", rotors follow within {1e3 * lag:.0f} ms" if lag else ""
    filtered = "no filter" if prepared["cutoff"] is None else f"filter at {prepared['cutoff']:g} Hz"

    def each(field: str, pattern: str = "{:.3g}") -> str:
        return ", ".join(pattern.format(values[f"{field}.{name}"].value) for name in joints)

    joints, moving = robot.single_joint_names, robot.base != "fixed"
    freedoms = f"a base that moves and {len(joints)} joints" if moving else f"{len(names)} joints"
    kinds = [robot.joint(name).type == "prismatic" for name in joints]
    q, force = (" or ".join(dict.fromkeys(two[kind] for kind in kinds)) for two in (("rad", "m"), ("Nm", "N")))
    of_joints = [
        ("dry friction", f"{each(f'{DRY}.level')} {force}, near rest {each(f'{DRY}.breakaway')} more"),
        ("viscous", f"{each('viscous')} {force} per {q}/s"),
        ("rotors", f"{each('rotor')} {INERTIA.get(q, 'kg m² or kg')}"),
    ]
    mass, error = values.total_mass
    by = ", if thrust coefficients are right" if forcegp.data.thruster_columns(identified.model) else ""
    q = "rad or m" if moving else q
    errors = "; ".join(
        f"{short_name(name)} {number(_motion(scores, name))} / {number(_acceleration(scores, name))}"
        for name in scores.models
    )
    best = scores.recommended
    assert best is not None, "a model was scored"
    covered = scores.value("coverage_95", model=best)
    intervals = "" if covered is None else f"; its 95 % intervals hold {100.0 * covered:.0f} % of unseen rows"
    weak = ", ".join(list(values.by_body or {})[:3])
    out = content["out"]
    command = f"forcegp excite {out}/model --seconds 10 --out next.csv"
    command = "faster and larger motions, also of what hardly moved" if moving else command
    return [
        ("log", f"{len(dataset)} rows, {seconds:.3g} s at {rate:.4g} Hz, {freedoms}{jitter}"),
        ("corrected", mistakes),
        ("timing", f"{shifted}; {filtered}, every {prepared['every']}. row"),
        *([("stance", stance_text(prepared))] if "stance" in prepared else []),
        *(of_joints if joints else []),
        *([("whole mass", f"{mass:.4g} ± {1.96 * error:.1g} kg{by}")] if moving else []),
        ("payload", held + by),
        ("models", f"error of q after 1 s [{q}] / nRMSE of the acceleration, on unseen time: {errors}"),
        ("trust", f"{short_name(best)}{intervals}"),
        ("record next", command + (f" (least is known of {weak})" if weak else "")),
        ("wrote", f"{out}/report.html, {out}/model, {out}/identified.urdf, {out}/validation/report.md"),
    ]


def best_sentence(scores: forcegp.Scores, dataset: forcegp.Dataset) -> str:
    """Which model to trust, and how much better than the URDF it is on unseen time."""
    best = scores.recommended
    assert best is not None, "a model was scored"
    name, motion, error = short_name(best), _motion(scores, best), _acceleration(scores, best)
    wrong = "" if error is None else f"wrong by {error:.2g} of their standard deviation"
    poor = error is not None and error >= 1.0  # no better than a = 0
    if motion is None and poor:
        return (
            f"Trust none of these models: on unseen time, accelerations of the best one, “{name}”, are {wrong}. "
            "Forces, flags of stance, units or the robot's file are wrong."
        )
    if motion is None:
        urdf = _acceleration(scores, "given")
        against = "" if urdf is None or best == "given" else f", with the URDF alone by {urdf:.2g}"
        trust = f": on unseen time, accelerations are {wrong}{against}" if wrong else ""
        return f"Trust the model “{name}”{trust}."
    urdf = _motion(scores, "given")
    against = "" if urdf is None or best == "given" else f", with the URDF alone by {urdf:.2g}"
    if urdf is None and "given" in scores.models:
        against = "; with the URDF alone they diverge"
    unit = dataset.units["q"] if isinstance(dataset.units["q"], str) else "rad or m"
    ahead = f"positions {scores.horizons[-1]:g} s ahead are wrong by {motion:.2g} {unit}{against}"
    doubt = f" But its accelerations are {wrong}." if poor else ""
    return f"Trust the model “{name}”: on unseen time, {ahead}.{doubt}"


def _motion(scores: forcegp.Scores, model: str) -> float | None:
    """Error of q at the longest horizon; None where all motions diverge, or none was scored."""
    if model not in scores.models or not scores.finished(model) or not scores.horizons:
        return None
    return scores.value("rmse", f"position after {scores.horizons[-1]:g} s", model)


def _acceleration(scores: forcegp.Scores, model: str) -> float | None:
    if model not in scores.models or not scores.finished(model):
        return None
    return scores.value("nrmse", model=model)


def payload_text(found: Any) -> str:
    """Mass with its 95 % interval and place; or that there is none."""
    parts = {name: found.estimates[f"payload.{name}"] for name in ("mass", *(f"center_of_mass.{x}" for x in "xyz"))}
    mass, *center = parts.values()
    error = 0.5 * (mass.interval[1] - mass.interval[0])
    if mass.value < max(SURE * mass.std, LEAST_PAYLOAD):
        return f"none ({mass.value:.2g} ± {error:.1g} kg)"
    place = ", ".join(f"{1e3 * each.value:.0f}" for each in center)
    [held] = [law for law in found.model.laws if isinstance(law, forcegp.Payload)]
    return f"{mass.value:.3g} ± {error:.1g} kg at ({place}) mm of {held.link}, if the URDF's links are right"
