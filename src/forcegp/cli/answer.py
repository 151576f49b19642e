"""What `forcegp auto` says of what it found: ten lines, and a verdict."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import forcegp
import forcegp.scores
from forcegp.cli.logs import stance_text
from forcegp.cli.payload import drives_of, other_causes
from forcegp.cli.terminal import shown
from forcegp.summary import within

LEAST_COVERAGE = 0.8  # of 95 % intervals that is no reason to doubt them


def short_name(name: str) -> str:
    """What a model is called in the answer."""
    forces = {"gp:joint-friction": "friction", "gp:aerodynamic": "air forces"}
    forces |= {"gp:joint-position": "forces of position", "gp:joint:inputs=q": "forces of positions"}
    learned = " and ".join(what for force, what in forces.items() if force in name)
    plain = {"given": "the URDF", "identified@accelerations": "identified by accelerations"}
    plain |= {"identified@torques:both": "identified by torques and accelerations"}
    return f"{learned} learned" if learned else plain.get(name, name)


FIRST = {"unknown cause", "joint zero", "gear ratio", "torque constant", "torque unit", "force sensor", "lengths"}
FIRST |= {"gravity", "clock"}
"""Subjects of doubts that change all that follows."""
TOLD = FIRST | {"stop", "push", "spring", "drift", "elastic joint", "velocity", "sensor delay", "torque sensor", "imu"}
TOLD |= {"constant channel", "pull", "load", "offset", "cogging"}
"""Those that the answer repeats, and what is wrong but accepted; of what is right only what a force sensor carries."""


def answer_lines(
    content: Mapping[str, Any],
    dataset: forcegp.Dataset,
    recording: forcegp.Dataset,
    identified: Any,
    held: str,
    scores: forcegp.scores.Scores,
    still: Sequence[str],
) -> list[tuple[str, str]]:
    """What was found, in ten lines."""
    from forcegp.fit.friction_in_words import friction_in_words  # PyTorch is not needed for a page of help

    values, robot, best = identified.estimates, identified.model.robot, scores.recommended
    assert best is not None, "a model was scored"
    done, prepared, seconds, out = content["import"], content["preparation"], content["seconds"], content["out"]
    deviation = max(each["largest_deviation_of_a_step"] for each in done["recordings"])
    jitter = f", steps up to {deviation:.0%} off (evened out)" if done["resampled_to_step"] is not None else ""
    seen = seen_in([*done["stops"], *(x for x in content["check"]["doubts"] if not is_explained(x, scores, best))])
    unsettled = FIRST & {*seen}
    held += "; settle what is said above first" if unsettled else ""
    flags = dict.fromkeys(x["command"].removeprefix("forcegp import ") or x["about"] for x in content["mistakes"])
    mistakes = ", ".join(x.replace("--unit ", "").replace("--", "") for x in flags) or "nothing"
    late, lag, rate = prepared["delay"], prepared["lag"], (len(dataset) - len(dataset.episodes)) / seconds
    early = "early: a controller that holds u is half a time step" if -late * rate < 1.0 else "early, or q and v late"
    why = prepared["why"].get("delay", "u is taken to be on time").partition(";")[0].rstrip(".")
    on_time = why if why.startswith("u is") else f"delay of u: {why}"
    late *= lag >= 0.0  # else it is part of a filter, of which `why` speaks
    shifted = f"u was logged {1e3 * abs(late):.1f} ms {'late' if late > 0.0 else early} (shifted)" if late else on_time
    shifted += f", rotors follow within {1e3 * lag:.0f} ms" if lag > 0.0 else ""
    filtered = "no filter" if prepared["cutoff"] is None else f"filter at {prepared['cutoff']:.3g} Hz"
    joints, moving = robot.single_joint_names, robot.base != "fixed"
    filtered += f", every {prepared['every']}. row" if prepared["every"] > 1 else ", all rows"
    freedoms = f"a base that moves and {len(joints)} joints" if moving else f"{len(dataset.joint_names)} joints"
    q, force, inertia = (
        " or ".join(dict.fromkeys(two[robot.joint(name).type == "prismatic"] for name in joints))
        for two in (("rad", "m"), ("Nm", "N"), ("kg m²", "kg"))
    )

    rested, still = still, scores.not_known("identified", still)

    def but_for(names: Sequence[str]) -> str:
        return f"; of {', '.join(names)} not known from this log" if names else ""

    def each(field: str, unit: str, lines: Mapping[str, tuple[float, float]] = {}) -> str:
        own = {x: values[f"{field}.{x}"] for x in joints}
        numbers = {x: lines.get(x, (each.value, each.value - each.interval[0])) for x, each in own.items()}
        lost = [x for x, (value, half) in numbers.items() if x in still or value <= half]
        told = ", ".join("–" if x in lost else within(*both) for x, both in numbers.items())
        return f"{told} {unit}{but_for(lost)}" if len(lost) < len(own) else "not known from this log"

    dry, lines = friction_in_words(identified, recording, force, still) if joints else ("", {})
    bent = {name for name in joints if f"gear.root.{name}" in values}
    of_joints = [
        ("dry friction", dry + but_for(still)),
        ("viscous", each("viscous", f"{force} per {q}/s", {x: lines[x] for x in bent})),
        ("rotors", each("rotor", inertia)),
        *(("springs", each(x, f"{force} per {q}")) for x in ["spring.stiffness"] if f"{x}.{joints[0]}" in values),
    ] if joints else []  # fmt: skip
    (mass, error), causes = values.total_mass, {} if unsettled else other_causes(content["payload"] or {})
    if "gains" in causes:  # what it changes of a payload, it changes of all
        error = math.hypot(error, content["payload"]["parameters"]["payload.mass"]["std"])
    links, holds = robot.layout.links, (content["payload"] or {}).get("link")
    loaded = [name for name, each in links.items() if holds in links and each.body == links[holds].body]
    weight = f"{mass:.4g} ± {1.96 * error:.1g} kg, if {drives_of(identified.model)} are right"
    shares = {name: _of_moving(scores, "nrmse", name, rested) for name in scores.models}
    number = forcegp.scores.number
    ends = {name: "> 1" if (share or 0.0) > 1.0 else number(share) for name, share in shares.items()}
    errors = "; ".join(f"{short_name(name)} {number(_motion(scores, name))} / {end}" for name, end in ends.items())
    ahead = (f" after {scores.horizons[-1]:g} s" if scores.horizons else "") + f" [{'rad or m' if moving else q}]"
    covered = _of_moving(scores, "coverage_95", best, rested)
    intervals = "" if covered is None else f"; its 95 % intervals hold {100.0 * covered:.0f} % of unseen rows"
    weak = ", ".join(list(values.by_body or {})[:3])
    command = f"forcegp excite {out}/model --seconds 10 --out next.csv"
    command = "faster and larger motions, also of what hardly moved" if moving else command
    return [
        ("log", f"{len(dataset)} rows, {seconds:.3g} s at {rate:.4g} Hz, {freedoms}{jitter}"),
        *(("by name", each) for each in ["; ".join(done["guessed"])] if each),
        ("corrected", mistakes),
        *seen.items(),
        ("timing", f"{shifted}; {filtered}"),
        *([("stance", stance_text(prepared))] if "stance" in prepared else []),
        *of_joints,
        *([("whole mass", weight)] if moving else []),
        ("payload", held),
        *([("heavy links", heavy)] if (heavy := heavy_links(values, loaded)) else []),
        *causes.items(),
        ("models", f"error of q{ahead} / nRMSE of the acceleration (1: that of its mean), on unseen time: {errors}"),
        *left_of_torques(scores, best),
        ("best", f"{short_name(best)}{intervals}"),
        ("record next", command + (f" (least is known of {weak})" if weak else "")),
        ("wrote", f"{out}/report.html, {out}/model, {out}/identified.urdf, {out}/validation/report.md"),
    ]  # fmt: skip


HEAVY, SURELY = 2.5, 1.5  # times a link's mass in the URDF, and of its interval, from which more than the link is in it


def heavy_links(values: Mapping[str, Any], loaded: Collection[str]) -> str:
    """Links that the log makes far heavier than the URDF has them, but for those of the body that holds a payload."""
    found = list[str]()
    for name, each in values.items():
        link, dot, what = name.rpartition(".")
        if dot and what == "mass" and link not in loaded and each.decided_by == "log" and (each.start or 0.0) > 0.0:
            times, least = each.value / each.start, each.interval[0] / each.start
            found += [f"{link} {each.value:.3g} kg, {times:.2g} times the URDF's"] * (times > HEAVY and least > SURELY)
    return f"{'; '.join(found)}: wrong there, or a balancer, a gas spring or a cable pulls" if found else ""


def seen_in(doubts: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """What the answer repeats of doubts, by subject: what passes is called a push, a force sensor that is right so."""
    seen = dict[str, str]()
    told = (x for x in doubts if x["about"] in TOLD and (x["level"] != "ok" or x["about"] == "force sensor"))
    for x in (*told, *(x for x in doubts if x["level"] == "wrong" and x["about"] not in {*TOLD, "delay"})):
        passes = "seconds" in x["numbers"] and x["about"] in FIRST
        comes = "stop" if {"stands", "stops"} & {*x["numbers"]} else "push"
        about = comes if passes else "sensor" if x["level"] == "ok" else x["about"]
        seen[about] = f"{seen.get(about, '')} {x['what']} {x['do']}".strip()
    return seen


def is_explained(doubt: Mapping[str, Any], scores: forcegp.scores.Scores, best: str) -> bool:
    """Whether the best model explains on unseen time what no cause did all over the log."""
    from forcegp.checks.search import EXPLAINED, UNKNOWN  # PyTorch, too

    quantity, left = scores.left(best)
    shares = [left.get(name) for name in doubt["joints"]]
    everywhere = doubt["about"] == UNKNOWN and "seconds" not in doubt["numbers"]
    most = EXPLAINED if "positions" in doubt["numbers"] else EXPLAINED**0.5  # a cable is worth a word sooner
    return everywhere and quantity == forcegp.scores.TORQUE and all(x is not None and x <= most for x in shares)


def left_of_torques(scores: forcegp.scores.Scores, best: str) -> list[tuple[str, str]]:
    """The line on what each model leaves of the recorded torques of the joints; none where u has other columns."""
    shares = {}
    for name in dict.fromkeys(("given", "identified", best)):
        quantity, left = scores.left(name) if name in scores.models else (forcegp.scores.ACCELERATION, {})
        if quantity == forcegp.scores.TORQUE:
            numbers = (shown(x, "{:.2g}" if x and x < 0.1 else "{:.0f}", 100.0) for x in left.values())
            shares[short_name(name)] = " ".join(numbers)
    told = "; ".join(f"{name} {numbers}" for name, numbers in shares.items())
    return [("torque left", f"on unseen time, % of the recorded one of each joint: {told}")] if told else []


def verdict(scores: forcegp.scores.Scores, dataset: forcegp.Dataset, still: Sequence[str] = ()) -> str:
    """Use it, use it for these joints, or do not use it; what it was measured by, and against the URDF alone."""
    best = scores.recommended
    assert best is not None, "a model was scored"
    quantity, shares = scores.left(best)
    left = {name: math.inf if x is None else x for name, x in shares.items()}
    good = [name for name, x in left.items() if x <= forcegp.scores.USABLE]
    lost = [f"{name} {100.0 * x:.0f} %" if math.isfinite(x) else f"{name} not known from this log"
            for name, x in left.items() if x > forcegp.scores.USABLE]  # fmt: skip
    use = f"“{short_name(best)}”"
    if not good:
        return (
            f"Do not use any of these models: on unseen time the best one, {use}, leaves of the {quantity} of "
            f"{', '.join(lost)}. Forces, flags of stance, units or the robot's file are wrong, or it hardly moves."
        )
    ends = dict.fromkeys(f"{100.0 * x:.2g}" for x in (min(left.values()), max(left[name] for name in good)))
    told = f"on unseen time it leaves {' to '.join(ends)} % of each {quantity}"
    motion, urdf = _motion(scores, best), _motion(scores, "given")
    if motion is not None:
        unit = dataset.units["q"] if isinstance(dataset.units["q"], str) else "rad or m"
        against = "they diverge" if urdf is None else f"by {urdf:.2g}"
        against = f"; with the URDF alone {against}" if "given" in scores.models and best != "given" else ""
        ahead = f"positions {scores.horizons[-1]:g} s ahead are wrong by {motion:.2g} {unit}{against}"
        still_as_good = motion >= dataset.q.var(axis=0).mean() ** 0.5  # as the middle of the log
        lost_there = still_as_good or (_of_moving(scores, "nrmse", best, still) or 0.0) >= 1.0  # as of light wrists
        told += f", but it is for torques: do not predict motions, {ahead}" if lost_there else f", and {ahead}"
    elif scores.horizons:
        told += ", but its motions diverge: do not simulate with it"
    covered = _of_moving(scores, "coverage_95", best, still)
    doubt = "" if covered is None or covered >= LEAST_COVERAGE else (
        f" Do not trust its intervals: those of 95 % hold {100.0 * covered:.0f} %."
    )  # fmt: skip
    if not lost:
        return f"Use {use}: {told}.{doubt}"
    others = f"Not for the others, of whose {quantity} is left: {', '.join(lost)}."
    return f"Use {use} for {', '.join(good)}: {told}. {others}{doubt}"


def _motion(scores: forcegp.scores.Scores, model: str) -> float | None:
    """Error of q at the longest horizon; None where all motions diverge, or none was scored."""
    return _known(scores, "rmse", f"position after {scores.horizons[-1]:g} s" if scores.horizons else "", model)


def _of_moving(scores: forcegp.scores.Scores, score: str, model: str, still: Sequence[str]) -> float | None:
    """A score of accelerations, the mean over joints that did not stand still, or all; None where there is none."""
    if forcegp.scores.ACCELERATION not in (scores.quantities(model) if model in scores.models else ()):
        return None
    each = dict(zip(scores.joint_names, scores.columns(score, model=model), strict=True))
    known = [x for name, x in each.items() if x is not None and (name not in still or {*each} <= {*still})]
    return sum(known) / len(known) if known else None


def _known(scores: forcegp.scores.Scores, score: str, quantity: str, model: str) -> float | None:
    there = model in scores.models and quantity in scores.quantities(model)
    return scores.value(score, quantity, model) if there else None
