"""Doubts of the comparison of torques with inverse dynamics: factor, unit, delay, what is left."""

from collections.abc import Iterator

import numpy as np

from forcegp.checks.check_input import QUICK_ROWS, CheckInput
from forcegp.checks.hypotheses import Hypothesis
from forcegp.data import estimate_delay
from forcegp.doubts import Doubt, listed, look, ok, wrong
from forcegp.errors import DatasetError
from forcegp.summary import plain

NO_WORSE = 2.0  # factor by which more may remain without a rotor inertia
ROUGHLY = 1.5  # factor either way that wrong inertias explain
FAR, MUCH_MORE = 3.0, 30.0  # that they do not: less torque than bodies need cannot be; more may be a rotor's inertia
SAME = 0.1  # spread of factors of joints that share a unit
UNEXPLAINED = 0.5
LEAST_DELAY = 0.75  # time steps below which a delay is not reported
MUCH = 0.5  # a delay that leaves less of what was unexplained is wrong to leave in


def torque_doubts(inputs: CheckInput, log: Hypothesis) -> Iterator[Doubt]:
    """Factor and unit, delay, and what remains unexplained, of a log with the errors corrected that were found."""
    for doubts in (_factors, _passive, _unexplained, _delays):
        yield from doubts(inputs, log)


def _factors(inputs: CheckInput, log: Hypothesis) -> Iterator[Doubt]:
    """Torques that are a multiple of what the motion needs."""
    fit = log.fit
    with np.errstate(invalid="ignore"):
        no_rotor = fit.plain < NO_WORSE * fit.unexplained + 0.02  # else a rotor inertia is missing, not a factor
        means = fit.rests_on_robot & no_rotor
        ratio = np.where(means, np.maximum(fit.factor, 1.0 / np.maximum(fit.factor, 1e-300)), 1.0)
    off = np.flatnonzero(ratio > ROUGHLY)
    if not len(off):
        return
    joints = inputs.named(off)
    factors = fit.factor[off]
    common = float(np.exp(np.log(factors).mean()))
    alike = len(off) == int(means.sum()) and len(off) > 1 and np.ptp(np.log(factors)) < SAME
    each = ", ".join(f"{name} {value:.4g}" for name, value in zip(joints, factors, strict=True))
    seen = f"the measured torque is a multiple of what the motion needs: {each}."
    remedy = (
        "One factor for all joints points to the unit of u or to wrong masses; compare with the data sheet."
        if alike
        else "A factor that differs between joints points to torque before the gears (multiply by the gear ratio), "
        "motor current (multiply by the torque constant), a rotor inertia that is missing, or wrong masses; "
        "compare with the data sheet."
    )
    correction: dict[str, dict[str, tuple[str, ...]]] = {}
    for unit, size in (("kNm", 1e-3), ("mNm", 1e3)):
        if np.abs(np.log(factors / size)).max() < np.log(ROUGHLY):
            what = f"the measured torque of {listed(joints)} is {common:.4g} times what the motion needs"
            seen = f"{what}: it looks like {unit}."
            remedy = "Use a factor." if alike else f"forcegp import --unit u={unit}, or a factor."
            correction = {"unit": {"u": (unit,)}} if alike else {}
    yield Doubt(
        level="wrong" if factors.min() < 1.0 / FAR or factors.max() > MUCH_MORE else "look",
        about="torque unit",
        what=seen,
        do=remedy,
        joints=joints,
        numbers={"factor": dict(zip(joints, factors.tolist(), strict=True))},
        correction=correction,
    )


def _passive(inputs: CheckInput, log: Hypothesis) -> Iterator[Doubt]:
    """Joints whose torque is zero throughout although the motion needs one."""
    for joint, name in enumerate(inputs.names):
        u, tau = log.rows.u[:, joint], log.tau[:, joint]
        if np.ptp(inputs.log.u[:, joint]) > 0.0 or not inputs.log.u.any():
            continue
        others = [np.std(log.tau[:, other]) for other in range(len(inputs.names)) if np.ptp(log.rows.u[:, other]) > 0]
        if np.std(tau) > 0.1 * max(others, default=np.inf):
            yield wrong(
                about="dead torque",
                what=f"the torque of {name} is {u[0]:.4g} in every row, but the motion needs one of "
                f"{np.std(tau):.3g} {'Nm' if inputs.rotates[joint] else 'N'} rms.",
                do="The channel is dead, unless the joint has no motor and the URDF is wrong.",
                joints=(name,),
                numbers={"needed": float(np.std(tau))},
            )


def _unexplained(inputs: CheckInput, log: Hypothesis) -> Iterator[Doubt]:
    """How well the torques fit at all."""
    left = log.fit.unexplained
    known = np.isfinite(left)
    if not known.any():
        return
    worst = int(np.nanargmax(left))
    bad = np.flatnonzero(known & (left > UNEXPLAINED))
    if not len(bad):
        seen = (
            f"inverse dynamics with a factor and friction leaves at most {100.0 * left[worst]:.2g} % of the variance "
        )
        yield ok(about="torque", what=f"{seen}of a torque unexplained ({inputs.names[worst]}).")
        return
    shares = ", ".join(f"{inputs.names[k]} {100.0 * left[k]:.0f} %" for k in bad)
    yield look(
        about="torque",
        what=f"most of some torques is not what inverse dynamics with a factor and friction gives: {shares} of "
        "their variance.",
        do="The channel, unit or zero may be wrong, the joint may be held or touch something, or its torque is "
        "nearly all friction or noise.",
        joints=inputs.named(bad),
        numbers={"unexplained": plain(left[bad])},
    )


def _delays(inputs: CheckInput, log: Hypothesis) -> Iterator[Doubt]:
    assert inputs.compared is not None
    if inputs.prepared is None:
        return  # without an order
    data = log.without_laws(log.applied(inputs.even if inputs.most_rows == QUICK_ROWS else inputs.prepared))
    try:
        delay = estimate_delay(data, log.robot)
    except DatasetError:
        return  # too short
    step = float(np.median(np.diff(inputs.even.time)))
    seconds, remains = delay.significant, delay.remains
    if abs(seconds) > LEAST_DELAY * step:
        late = "later" if seconds > 0.0 else "earlier"
        yield Doubt(
            level="wrong" if remains < MUCH else "look",
            about="delay",
            what=f"the torque of all joints is logged {1e3 * abs(seconds):.1f} ms ± {1e3 * delay.common_std:.1f} ms "
            f"{late} than the motion needs it; shifted, {100.0 * remains:.0f} % of what was unexplained remains.",
            do="forcegp import --delay auto; a filter of the robot's own, of the torque or of the motion, does this.",
            joints=inputs.names,
            numbers={"delay": seconds, "std": delay.common_std, "remains": remains, "per_joint": plain(delay.seconds)},
        )


def not_compared(inputs: CheckInput) -> Doubt:
    """The doubt where torques cannot be compared."""
    if inputs.contacts:
        return ok(
            about="torque",
            what="not compared with inverse dynamics: the robot touches something, and the forces of contacts are not "
            "known. Check a log of free motion, too.",
        )
    seen = "not compared with inverse dynamics: no robot was given."
    return look(about="torque", what=seen, do="Give the robot: `model`.")
