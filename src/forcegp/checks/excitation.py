"""Does the motion show what is to be learned, and what does noise hide of it."""

from collections.abc import Iterator

import numpy as np

from forcegp.checks.check_input import CheckInput
from forcegp.data.views import white_noise
from forcegp.doubts import Doubt, listed, look, ok
from forcegp.errors import InvalidInput
from forcegp.evidence.identifiability import base_parameters, excitation
from forcegp.summary import plain

MUCH = 0.2  # noise relative to the spread of the signal from which a filter is worth its name


STATED_OFF = 3.0  # factor either way between stated and seen noise of the acceleration that is reported
FAR_OFF = 10.0


def stated_noise_doubts(inputs: CheckInput) -> Iterator[Doubt]:
    """`noise_std` against the noise that the acceleration of successive rows shows."""
    log = inputs.log
    stated, seen = log.noise_level, white_noise(log)
    if stated is None or seen is None:
        return
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = seen / stated
    off = np.flatnonzero((ratio > STATED_OFF) | (ratio < 1.0 / STATED_OFF))
    if not len(off):
        return
    joint = int(off[np.argmax(np.abs(np.log(ratio[off])))])
    small = ratio[joint] > 1.0
    yield Doubt(
        level="wrong" if ratio[joint] > FAR_OFF else "look",
        about="noise_std",
        what=f"noise_std states {stated[joint]:.3g} for the acceleration of {inputs.names[joint]}; successive rows "
        f"show noise of {seen[joint]:.3g}: {ratio[joint] if small else 1.0 / ratio[joint]:.3g} times as "
        f"{'much' if small else 'little'}.",
        do="Learn it (forcegp fit --noise learned), or state what was measured."
        + ("" if small else " Noise that a filter made smooth does not show between rows: then leave it."),
        joints=inputs.named(off),
        numbers={"stated": plain(stated), "seen": plain(seen)},
    )


def noise_doubts(inputs: CheckInput) -> Iterator[Doubt]:
    """Noise of the acceleration before and after the filter, in rad/s^2 and, with the mass matrix, in Nm."""
    if inputs.prepared is None:
        return
    report = inputs.price
    cutoff = report.get("cutoff")
    measured = report.get("acceleration_noise", {})
    if cutoff is None or any(len(measured.get(when, ())) != len(inputs.names) for when in ("before", "after")):
        yield ok(about="noise", what="the positions show no noise worth a filter.")
        return
    before, after = (np.array(measured[when], float) for when in ("before", "after"))
    spread = np.std(inputs.prepared.a, axis=0)
    if np.isfinite(after).any():
        when = " when this dataset was prepared" if inputs.cutoff is None else ""
        worst = int(np.nanargmax(after / np.maximum(spread, 1e-300)))
        unit = "rad/s²" if inputs.rotates[worst] else "m/s²"
        yield ok(
            about="noise",
            what=f"a filter at {cutoff:.3g} Hz{when} takes the noise of the acceleration of "
            f"{inputs.names[worst]}, the worst, from {before[worst]:.3g} to {after[worst]:.2g} {unit}.",
            numbers={"cutoff": cutoff, "before": plain(before), "after": plain(after)},
        )
    raw = "preparation" not in inputs.log.metadata
    with np.errstate(invalid="ignore"):
        loud = np.flatnonzero(before > MUCH * spread)
        left = np.flatnonzero(after > MUCH * spread)
    # a log may hold better accelerations than differences
    if raw and (np.std(inputs.log.a, axis=0)[loud] > np.hypot(1.0, MUCH) * spread[loud]).any():
        yield look(
            about="noise",
            what=f"the acceleration in this dataset is not filtered: its noise is up to "
            f"{np.max(before[loud] / spread[loud]):.2g} times the acceleration itself.",
            do=f"forcegp import DATA --cutoff {cutoff:.3g} --out prepared.h5 before learning from it.",
            joints=inputs.named(loud),
        )
    if len(left):
        names = inputs.named(left)
        yield look(
            about="noise",
            what=f"even filtered, noise makes up more than {100 * MUCH:.0f} % of the acceleration of "
            f"{', '.join(names)}.",
            do="Move faster, filter lower, or learn from torques instead of accelerations.",
            joints=names,
        )


WELL = 100.0  # condition number up to which identification is commonly called well excited (Gautier & Khalil 1992)
BADLY = 1000.0
HYSTERESIS = 0.1  # of the root mean square velocity, beyond which a sign counts
FEWEST_CHANGES = 2
HELD = 0.02  # range of a joint in one stretch, relative to its largest, below which it was held there
STILL = {True: 0.02, False: 0.002}  # range in rad or m below which a joint does not move


def excitation_doubts(inputs: CheckInput) -> Iterator[Doubt]:
    """Joints that hardly move or never turn back, and how well base parameters are determined."""
    if inputs.prepared is None:
        return
    rows = inputs.prepared
    still, one_way, motions = [], [], []
    for joint, name in enumerate(inputs.names):
        v = rows.v[:, joint]
        size = float(np.sqrt(np.square(v).mean()))
        signs = np.sign(v[np.abs(v) > HYSTERESIS * size])
        changes = int((np.diff(signs) != 0).sum())
        span = float(np.ptp(rows.q[:, joint]))
        motions.append({"joint": name, "range": span, "rms_velocity": size, "sign_changes": changes})
        if span < STILL[bool(inputs.rotates[joint])]:
            still.append(name)
        elif changes < FEWEST_CHANGES:
            one_way.append(name)
    whose = "its" if len(still) == 1 else "their"
    idle = f"moved less than 0.02 rad (2 mm): {whose} friction and inertia do not show."
    turned = "changed direction less than twice: friction of both directions cannot be separated from gravity."
    for joints, what, remedy in (
        (still, idle, "Move every joint that is to be learned, or lock it in the robot (`locked`)."),
        (one_way, turned, "Record motion to and fro."),
    ):
        if joints:
            about = {"joints": tuple(joints), "numbers": {"joints": motions}}
            yield look(about="excitation", what=f"{listed(joints)} {what}", do=remedy, **about)
    yield from _held(inputs, still)
    yield from _base_parameters(inputs)


def _held(inputs: CheckInput, still: list[str]) -> Iterator[Doubt]:
    """Joints that stand still in whole stretches although they move in others."""
    rows = inputs.prepared
    if rows is None or len(rows.episodes) < 2:
        return
    spans = np.stack([np.ptp(rows.q[rows.episode == number], axis=0) for number in rows.episodes])
    for joint in (joint for joint, name in enumerate(inputs.names) if name not in still):
        own, unit = spans[:, joint], "rad" if inputs.rotates[joint] else "m"
        held = np.flatnonzero((own < HELD * own.max()) & (spans.max(axis=1) > 5.0 * own))
        if 0 < len(held) <= len(spans) // 2:
            first = int(held[0])
            begin = float(rows.time[rows.episode == rows.episodes[first]][0])
            yield look(
                about="held joint",
                what=f"{inputs.names[joint]} stays within {own[first]:.2g} {unit} in {len(held)} of {len(spans)} "
                f"stretches while other joints move (the first: number {first}, counted from 0, at {begin:.3f} s); "
                f"elsewhere it moves {own.max():.2g}.",
                do="It was held, or sticks: leave the stretch out, or describe it as a constraint or another robot "
                "(`locked`).",
                joints=(inputs.names[joint],),
                numbers={"stretches": held.tolist(), "range": float(own[first])},
            )


def _base_parameters(inputs: CheckInput) -> Iterator[Doubt]:
    if inputs.robot is None:
        return
    rows = inputs.rows()
    try:
        seen = excitation(inputs.robot, rows.q, rows.v, rows.a)
    except InvalidInput:  # nothing moves and nothing weighs
        return
    every = base_parameters(inputs.robot)
    numbers = {"condition": seen.condition, "seen": seen.rank, "base_parameters": every.rank}
    size = f"condition number {seen.condition:.3g} of {seen.rank} base parameters"
    quality = "well excited" if seen.condition <= WELL else "usable" if seen.condition <= BADLY else "poorly excited"
    size_and_quality, remedy = f"{size}: {quality} (below {WELL:g} is good).", ""
    if seen.rank < every.rank:
        size_and_quality = f"{size}; {every.rank - seen.rank} more of this robot never show in this motion."
        remedy = "Identify few parameters, or record a motion of all joints at once."
    elif seen.condition > BADLY:
        remedy = (
            "Inertias of single links will be uncertain; record faster motion of all joints at once, and keep the "
            "URDF's values where the data are not informative."
        )
    kind = look if remedy else ok
    yield kind(about="excitation", what=size_and_quality, do=remedy, numbers=numbers)
