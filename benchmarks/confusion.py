"""What `check` says of logs with planted faults: a table of what was planted against what was said first.

    python -m benchmarks.confusion [SEED] [WORDS]

Five robots; motions and torques by Pinocchio; dry and viscous friction, or LuGre friction; noise of encoders and
torques. A fault is right if the first doubt names it, and a wrong remedy if any doubt that is "wrong", or that states a
correction, names something else. WORDS are a part of the names of the faults that are looked at.
"""

from __future__ import annotations

import sys
import time as clock
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pinocchio as untyped

from forcegp import Dataset, Model, Robot, check

pin: Any = untyped
RATE, SECONDS, DEGREES = 200.0, 12.0, 180.0 / np.pi
ASIDE = {"excitation", "held joint", "acceleration"}  # of the motion, not of what was planted
NAMES = ("waist", "shoulder", "elbow", "roll", "bend", "flange", "tool")
#          axes, kinds, mass of the first link [kg], distance of joints [m]
ROBOTS = {
    "two": ("yy", "rr", 2.0, 0.4),
    "scara": ("zzzx", "rrpr", 4.0, 0.3),
    "three": ("zyy", "rrr", 3.0, 0.3),
    "six": ("zyyxyx", "rrrrrr", 8.0, 0.35),
    "seven": ("zyzyzyx", "rrrrrrr", 4.0, 0.25),
}
Arrays = dict[str, np.ndarray]
Fault = Callable[["Case"], Any]


class Case:
    """A robot, as it is and as its file states it, and a log of it."""

    def __init__(self, name: str, seed: int) -> None:
        self.axes, self.kinds, mass, self.distance = ROBOTS[name]
        self.rng, self.n = np.random.default_rng([seed, list(ROBOTS).index(name)]), len(self.axes)
        self.masses = mass * 0.75 ** np.arange(self.n) * self.rng.uniform(0.8, 1.2, self.n)
        self.lengths, self.zero = np.full(self.n, self.distance), np.zeros(self.n)
        self.stated = Robot.from_urdf_text(self.urdf())
        self.gravity, self.spring, self.lurch = np.array([0.0, 0.0, -9.81]), np.zeros(self.n), 0.0
        self.time, self.after = np.arange(int(RATE * SECONDS)) / RATE, list[Callable[[Arrays], None]]()
        self.payload = 0.0
        self.joint = int(self.rng.integers(self.n))

    def urdf(self) -> str:
        """The robot, with a payload where it holds one."""
        text = '<robot name="r"><link name="base"/>'
        for k, (axis, kind) in enumerate(zip(self.axes, self.kinds, strict=True)):
            m, d = self.masses[k], self.distance
            parent, joint = f"l{k - 1}" if k else "base", "prismatic" if kind == "p" else "revolute"
            along, turning = " ".join(str(int(axis == x)) for x in "xyz"), 0.1 * m * d**2
            text += (
                f'<joint name="{NAMES[k]}" type="{joint}"><parent link="{parent}"/><child link="l{k}"/><origin xyz="'
                f'{0.2 * self.lengths[k]} 0 {self.lengths[k]}"/><axis xyz="{along}"/><limit lower="-99" upper="99" '
                f'effort="9e9" velocity="9e9"/></joint><link name="l{k}"><inertial><origin xyz="{0.1 * d} {0.05 * d} '
                f'{0.4 * d}"/><mass value="{m}"/> <inertia ixx="{turning}" iyy="{turning}" izz="{0.3 * turning}" '
                'ixy="0" ixz="0" iyz="0"/></inertial></link>'
            )
        return text + "</robot>"

    def needed(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Torques by Pinocchio, on a base that may lurch, with a payload at the end."""
        model = pin.buildModelFromXML(self.urdf())
        data, tau = model.createData(), []
        if self.payload:
            held = pin.Inertia(self.payload, np.array([0.05, -0.03, 0.5 * self.distance]), 1e-3 * np.eye(3))
            model.inertias[model.njoints - 1] = model.inertias[model.njoints - 1] + held
        for row, second in zip(zip(q, v, a, strict=True), self.time, strict=True):
            tilt = self.lurch * np.sin(0.9 * second)
            model.gravity.linear = pin.rpy.rpyToMatrix(0.7 * tilt, tilt, 0.0) @ self.gravity
            tau.append(pin.rnea(model, data, *row).copy())
        return np.array(tau)

    def friction(self, v: np.ndarray, size: np.ndarray) -> np.ndarray:
        """Dry and viscous, or a bristle that remembers (LuGre)."""
        dry, viscous, rest = 0.12 * size, 0.06 * size, np.zeros_like(v)
        if self.rng.uniform() < 0.5:
            return dry * np.tanh(v / 0.02) + viscous * v
        z = np.zeros(self.n)
        for k, speed in enumerate(v):
            for _ in range(10):
                z = z + (speed - np.abs(speed) * z / 2e-3) / (10 * RATE)
            rest[k] = dry * z / 2e-3 * (1.0 + 0.4 * np.exp(-np.square(speed / 0.05))) + viscous * speed
        return rest

    def log(self) -> Dataset:
        """The log, after all that was planted."""
        t, n = self.time[:, None], self.n
        omega = 2.0 * np.pi * self.rng.uniform(0.08, 0.9, (5, 1, n))
        size = self.rng.uniform(0.1, 0.35, (5, 1, n)) * np.array([0.3 if kind == "p" else 1.0 for kind in self.kinds])
        phase = omega * t + self.rng.uniform(0.0, 2.0 * np.pi, (5, 1, n))
        q, v, a = ((size * omega**k * f(phase)).sum(0) for k, f in enumerate((np.sin, np.cos, lambda x: -np.sin(x))))
        q = q + self.rng.uniform(-0.4, 0.4, n)
        tau = self.needed(q, v, a)
        scale = np.maximum(tau.std(0), 0.05 * tau.std(0).max())
        u = tau + self.friction(v, scale) + self.spring * scale * q
        q = np.round((q - self.zero + 1e-5 * self.rng.normal(size=q.shape)) / 1e-5) * 1e-5
        u = u + 0.01 * scale * self.rng.normal(size=u.shape)
        v = np.gradient(q, self.time, axis=0)
        x = {"q": q, "v": v, "u": u, "time": self.time.copy(), "scale": scale}
        for change in self.after:
            change(x)
        a = np.gradient(x["v"], x["time"], axis=0)
        return Dataset(q=x["q"], v=x["v"], a=a, u=x["u"], time=x["time"], model=Model(self.stated))


def later(change: Callable[[Case, Arrays], Any]) -> Fault:
    """A fault of the log."""
    return lambda case: case.after.append(lambda x: change(case, x))


def times(names: str, factor: Callable[[Case], Any]) -> Fault:
    return later(lambda case, x: x.update({name: x[name] * factor(case) for name in names}))


def ordered(names: str, order: Callable[[Case], Any]) -> Fault:
    return later(lambda case, x: x.update({name: x[name][:, order(case)] for name in names}))


def state(**changes: Callable[[Case], Any]) -> Fault:
    """A robot that is another than its file says."""
    return lambda case: [setattr(case, name, change(case)) for name, change in changes.items()]


def one(value: float, rest: float = 1.0) -> Callable[[Case], np.ndarray]:
    """One value for the joint that was drawn, another for the rest."""
    return lambda case: np.where(np.arange(case.n) == case.joint, value, rest)


def pair(case: Case) -> np.ndarray:
    order, other = np.arange(case.n), (case.joint + 1) % case.n
    order[[case.joint, other]] = other, case.joint
    return order


def turns(factor: float) -> Callable[[Case], np.ndarray]:
    return lambda case: np.where([kind == "r" for kind in case.kinds], factor, 1.0)


def registers(wrapped: bool) -> Fault:
    def change(case: Case, x: Arrays) -> None:
        step = np.abs(x["u"]).max() / 900.0
        raw = np.round(x["u"] / step)
        x["u"] = step * (raw % 65536.0 if wrapped else np.where(raw < 0.0, 1024.0 - raw, raw))

    return later(change)


def shifted(signal: str, by: int) -> Fault:
    return later(lambda case, x: x.update(u=np.take(x[signal], np.arange(len(x["u"])) - by, axis=0, mode="clip")))


def held(signal: str) -> Fault:
    return later(lambda case, x: x[signal][800:1000, case.joint].fill(x[signal][800, case.joint]))


def clipped(case: Case, x: Arrays) -> None:
    x["u"][:, case.joint] = np.clip(x["u"][:, case.joint], *np.quantile(x["u"][:, case.joint], [0.15, 0.85]))


def smooth(case: Case, _: Arrays) -> np.ndarray:
    phase, pace = case.rng.uniform(0.0, 2.0 * np.pi, (4, 1, case.n)), case.rng.uniform(0.1, 0.8, (4, 1, case.n))
    return np.sin(2.0 * np.pi * pace * case.time[:, None] + phase).sum(0)


def strange(part: Callable[[Case, Arrays], np.ndarray], keep: float = 1.0, rest: float = 0.0) -> tuple[Fault, ...]:
    """Something that no cause explains beside a share of the torque, in one joint; in all with rest=1."""
    added = later(lambda case, x: x.update(u=x["u"] + x["scale"] * part(case, x) * one(1.0, rest)(case)))
    return times("u", one(keep, keep if rest else 1.0)), added


def pushes(case: Case, x: Arrays) -> np.ndarray:
    return 3.0 * smooth(case, x) * (np.abs(case.time[:, None] - 6.0) < 2.0)


def tilted(degrees: float) -> Fault:
    angle = np.deg2rad(degrees)
    return state(gravity=lambda _: 9.81 * np.array([np.sin(angle) * 0.6, np.sin(angle) * 0.8, -np.cos(angle)]))


def touched(case: Case, x: Arrays) -> None:
    """A force on the last link for one or two seconds, of .3 to 1 deviation of a torque."""
    model = pin.buildModelFromXML(case.urdf())
    data, last = model.createData(), model.getFrameId(f"l{case.n - 1}")
    J = [pin.computeFrameJacobian(model, data, q, last, pin.LOCAL_WORLD_ALIGNED)[:3] for q in x["q"]]
    begin, lasts = case.rng.uniform(2.0, 8.0), case.rng.uniform(0.8, 2.5)
    there = np.clip(np.minimum(x["time"] - begin, begin + lasts - x["time"]) / 0.15, 0.0, 1.0)
    push = np.einsum("rij,i->rj", np.array(J), case.rng.normal(size=3)) * there[:, None]
    x["u"] = x["u"] - case.rng.uniform(0.3, 1.0) * push / (np.abs(push).max(0) / x["u"].std(0)).max()


SIGN, MNM, ORDER = times("u", one(-1.0)), times("u", lambda _: 1000.0), ordered("u", pair)
LATE, ZERO, TILT, DEG = shifted("u", 6), state(zero=one(0.5, 0.0)), tilted(40.0), times("qv", turns(DEGREES))
LOAD = state(payload=lambda case: 0.6 * case.masses[-1])
FAULTS: dict[str, tuple[str, tuple[Fault, ...]]] = {
    "clean": ("", ()),
    "sign of one": ("torque sign", (SIGN,)),
    "sign of all": ("torque sign", (times("u", lambda _: -1.0),)),
    "sign of every other": ("torque sign", (times("u", lambda case: (-1.0) ** np.arange(case.n)),)),
    "mNm": ("torque unit", (MNM,)),
    "kNm": ("torque unit", (times("u", lambda _: 1e-3),)),
    "gears": ("torque unit|torque constant", (times("u", lambda case: 1.0 / case.rng.uniform(30, 120, case.n)),)),
    "torque constant": ("torque constant|torque unit", (times("u", one(1.7)),)),
    "per cent": ("torque unit|torque constant", (times("u", lambda case: case.rng.uniform(0.5, 3.0, case.n)),)),
    "torques exchanged": ("joints exchanged", (ORDER,)),
    "torques reversed": ("joints exchanged", (ordered("u", lambda case: np.arange(case.n)[::-1]),)),
    "torques permuted": ("joints exchanged", (ordered("u", lambda case: case.rng.permutation(case.n)),)),
    "late": ("delay", (LATE,)),
    "sign and magnitude": ("registers", (registers(False),)),
    "wrapped": ("registers", (registers(True),)),
    "targets": ("targets", (shifted("q", -20),)),
    "no torque": ("constant channel", (times("u", lambda _: 0.0),)),
    "no torque of one": ("constant channel", (times("u", one(0.0)),)),
    "degrees": ("degrees", (DEG,)),
    "degrees, v rad/s": ("velocity|degrees|jumps", (times("q", turns(DEGREES)),)),
    "turns": ("turns|degrees", (times("qv", turns(0.5 / np.pi)),)),
    "v in degrees": ("velocity", (times("v", turns(DEGREES)),)),
    "sign of v": ("velocity", (times("v", one(-1.0)),)),
    "milliseconds": ("time unit", (times("v", lambda _: 1e-3), later(lambda _, x: x.update(time=1e3 * x["time"])))),
    "motion of one turned": ("motion sign", (times("qv", one(-1.0)),)),
    "a joint turned": ("motion sign", (times("qvu", one(-1.0)),)),
    "motions exchanged": ("joints exchanged", (ordered("qv", pair),)),
    "joints exchanged": ("joints exchanged", (ordered("qvu", pair),)),
    "joints reversed": ("joints exchanged", (ordered("qvu", lambda case: np.arange(case.n)[::-1]),)),
    "by name": ("joints exchanged", (ordered("qvu", lambda case: np.argsort(NAMES[: case.n])),)),
    "zero": ("joint zero", (ZERO,)),
    "small zero": ("joint zero", (state(zero=one(-0.25, 0.0)),)),
    "gear ratio": ("gear ratio", (times("qv", one(0.625)),)),
    "gear ratio of both": ("gear ratio", (times("qv", one(0.625)), times("u", one(1.6)))),
    "wall": ("gravity", (state(gravity=lambda _: np.array([9.81, 0.0, 0.0])),)),
    "ceiling": ("gravity", (state(gravity=lambda _: np.array([0.0, 0.0, 9.81])),)),
    "tilted by 40": ("gravity", (TILT,)),
    "tilted by 15": ("gravity", (tilted(15.0),)),
    "weightless": ("gravity", (state(gravity=lambda _: np.zeros(3)),)),
    "payload": ("payload|masses", (LOAD,)),
    "heavy link": ("masses|payload", (state(masses=lambda case: case.masses * one(2.0)(case)),)),
    "all masses": ("masses|torque unit", (state(masses=lambda case: 1.6 * case.masses),)),
    "length": ("lengths", (state(lengths=lambda case: case.lengths * one(1.5)(case)),)),
    "spring": ("spring", (state(spring=one(3.0, 0.0)),)),
    "saturation": ("saturation", (later(clipped),)),
    "frozen q": ("frozen channel|velocity", (held("q"),)),
    "frozen u": ("frozen channel", (held("u"),)),
    "sign, late": ("torque sign|delay", (SIGN, LATE)),
    "sign, mNm": ("torque sign|torque unit", (SIGN, MNM)),
    "sign, degrees": ("torque sign|degrees", (SIGN, DEG)),
    "exchanged, sign": ("torque sign|joints exchanged", (ORDER, SIGN)),
    "exchanged, mNm": ("torque unit|joints exchanged", (ORDER, MNM)),
    "tilted, sign": ("torque sign|gravity", (TILT, SIGN)),
    "tilted, mNm": ("torque unit|gravity", (TILT, MNM)),
    "payload, sign": ("torque sign|payload|masses", (LOAD, SIGN)),
    "zero, sign": ("torque sign|joint zero", (ZERO, SIGN)),
    "degrees, mNm": ("degrees|torque unit", (DEG, MNM)),
    "zero, exchanged": ("joint zero|joints exchanged", (ZERO, ORDER)),
    "touched": ("push|unknown cause", (later(touched),)),
    "none: pushed": ("none", strange(pushes, rest=1.0)),
    "none: another log": ("none", strange(smooth, keep=0.0)),
    "none: all other": ("none", strange(smooth, keep=0.0, rest=1.0)),
    "none: lurching": ("none", (state(lurch=lambda _: 0.6),)),
    "none: noise": ("none", strange(lambda case, x: case.rng.normal(size=x["u"].shape), keep=0.0)),
    "cogging": ("cogging|unknown cause", strange(lambda case, x: 1.5 * np.sin(14.0 * x["q"]))),
    "none: squares": ("none", (later(lambda case, x: x.update(u=x["u"] * np.abs(x["u"]) / x["scale"])),)),
    "none: fades": ("none", (times("u", lambda case: 1.0 + 2.0 * np.sin(0.5 * case.time)[:, None]),)),
}


def said(case: Case, log: Dataset, right: str) -> tuple[bool, bool, str]:
    """Whether the first doubt is right, whether anything wrong has a remedy, and what was said."""
    doubts = [each for each in check(log).doubts if each.level != "ok" and each.about not in ASIDE]
    causes = set(right.split("|")) if right else set()
    first = doubts[0].about if doubts else ""
    misled = [x for x in doubts if x.about not in causes | {UNKNOWN} and (x.level == "wrong" or x.correction)]
    hit = first == UNKNOWN if right == "none" else first in causes if right else not misled
    return hit, bool(misled), ", ".join(f"{x.about}{'!' * (x.level == 'wrong')}" for x in doubts) or "nothing"


UNKNOWN = "unknown cause"


def planted(fault: str, robot: str, seed: int) -> tuple[Case, Dataset] | None:
    """The first joint of which the torques show the fault; None where there is none."""
    for shift in range(len(ROBOTS[robot][0])):
        case = Case(robot, seed)
        case.joint = (case.joint + shift) % case.n
        for plant in FAULTS[fault][1]:
            plant(case)
        log, bare = case.log(), Case(robot, seed)
        bare.time = log.time
        off = np.abs(log.u - bare.needed(log.q, log.v, log.a)).mean(0)
        if not FAULTS[fault][0] or fault == "touched" or (off > 0.35 * np.abs(log.u - log.u.mean(0)).mean(0)).any():
            return case, log
    return None


def rows(seed: int, words: str = "") -> Iterator[tuple[str, str, bool, bool, str]]:
    """Every fault on every robot."""
    for fault in (each for each in FAULTS if words in each):
        for robot in ROBOTS:
            if (found := planted(fault, robot, seed)) is not None:
                begin = clock.process_time()
                hit, misled, text = said(*found, FAULTS[fault][0])
                yield fault, robot, hit, misled, f"{text} ({clock.process_time() - begin:.1f} s)"


def main(seed: str = "0", words: str = "") -> None:
    """The table, and the shares of every kind."""
    kinds: dict[str, list[tuple[bool, bool]]] = {}
    for fault, robot, hit, misled, text in rows(int(seed), words):
        print(f"{'ok ' if hit else '-- '}{'MISLED ' if misled else ''}{fault} | {robot}: {text}", flush=True)
        kind = "none" if fault[:5] == "none:" else "pair" if "," in fault else "clean" if fault == "clean" else "one"
        kinds.setdefault(kind, []).append((hit, misled))
    for kind, each in kinds.items():
        right, wrong = np.mean(each, axis=0)
        print(f"{kind}: {len(each)} logs, right cause first {right:.1%}, wrong cause with a remedy {wrong:.1%}")


if __name__ == "__main__":
    main(*sys.argv[1:])
