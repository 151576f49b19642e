"""IMUs on links: what they measure of a motion, and whether a log bears it out.

An accelerometer measures the specific force f = R^T (J a + Jdot v - g) (Titterton & Weston, "Strapdown inertial
navigation technology", 2004, section 3.5), which is affine in the acceleration.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

import forcegp.model
from forcegp.data.dataset import IMU, Dataset, imu_place
from forcegp.data.delay import LEAST_DELAY, lowest
from forcegp.data.views import median_step, tensors, whole_windows, window_means
from forcegp.doubts import Doubt, look, ok, wrong
from forcegp.mechanics import AffineMap
from forcegp.robots import Kinematics
from forcegp.robots.inertia import rpy_from_rotation

Measured = Float[np.ndarray, "rows k"]
STANDARD = 9.80665  # m/s^2 in a g
AGREES, WRONG = 0.02, 0.05
"""Of what an IMU measures: the disagreement with the log that is none, and from which on it is wrong."""
EXPLAINS, SMALL = 0.3, 0.35  # of the disagreement: what another reading may leave; rad that are still no other axes
SECONDS, MOST_ROWS = 0.1, 4000
"""Over which both are averaged, since a derived acceleration is noisy; rows on which a delay is sought."""
SHIFTS, LATE = np.linspace(-0.05, 0.05, 101), 0.8
"""Seconds by which an IMU may be late, and what a shift leaves of the disagreement at most."""


def specific_force(kinematics: Kinematics, name: str) -> AffineMap:
    """What the IMU of this name measures (..., 3) [m/s^2], as a function of the acceleration."""
    frame, point, turned = imu_place(name)
    robot = kinematics.robot
    pose, J, bias = kinematics.frame_motion(frame, torch.tensor(point, dtype=torch.float64, device=robot.device))
    R = (pose[..., :3, :3] @ torch.as_tensor(turned).to(pose)).mT
    return AffineMap((R @ (bias[..., :3] - robot.tree.gravity)[..., None])[..., 0], R @ J[..., :3, :])


def expected(dataset: Dataset, model: forcegp.model.Model, name: str) -> Float[np.ndarray, "rows 3"]:
    """What an IMU should have measured by the accelerations of the log."""
    q, v, _, a = tensors(dataset, model.robot.device)
    with torch.no_grad():
        return specific_force(model.robot.kinematics(q, v), name)(a).cpu().numpy()


def short_means(dataset: Dataset, *values: Measured) -> list[Float[np.ndarray, "windows k"]]:
    """Over a tenth of a second each."""
    width = int(max(1.0, SECONDS / median_step(dataset))) if dataset.time_ordered else 1
    first = whole_windows(dataset, width)
    return [window_means(x, first, width) for x in values]


def delay_doubts(dataset: Dataset, which: str, f: Measured, p: Measured) -> Iterator[Doubt]:
    """A sensor whose values f, those of the first episode, fit what was expected, p, far better at other times."""
    first = dataset.episode == dataset.episodes[0]
    time, f, p = dataset.time[first], f[first], p[first]
    inner = np.flatnonzero((time >= time[0] + SHIFTS[-1]) & (time <= time[-1] + SHIFTS[0]))[:MOST_ROWS]
    if not dataset.time_ordered or len(inner) < len(SHIFTS):
        return
    moved = (np.stack([np.interp(time[inner] + s, time, x) for x in f.T], 1) for s in SHIFTS)
    yield from late_doubts(which, [_rms(each - p[inner]) for each in moved], float(np.median(np.diff(time))))


def late_doubts(which: str, left: Sequence[float], step: float) -> Iterator[Doubt]:
    """A sensor that leaves so much at each of `SHIFTS`, and its delay if that is far less at another than 0."""
    late = lowest(np.array(left), SHIFTS)
    if abs(late) > max(LEAST_DELAY, step) and min(left) < LATE * left[len(SHIFTS) // 2]:
        when = f"{1e3 * abs(late):.1f} ms {'later' if late > 0.0 else 'earlier'} than the motion that it measures"
        what = f"the {which} is logged {when}."
        yield look(about="sensor delay", what=what, do="Shift its columns before an import.", numbers={"delay": late})


def _rms(values: Measured) -> float:
    return float(np.sqrt(np.square(values).sum(1).mean()))


@dataclass(frozen=True, eq=False)
class BesideMotion:
    """An IMU beside the accelerations of a log: its size and by how much both differ [m/s^2], also without gravity.

    `Q`, by an `angle` [rad], and `factor` are those of least squares in measured = factor Q expected, `share` what they
    leave (Schoenemann, Psychometrika 1966). Q may be a reflection; `whole` tells whether the rows show all of it.
    """

    name: str
    size: float
    off: float
    off_without_gravity: float
    Q: Float[np.ndarray, "3 3"]
    angle: float
    factor: float
    share: float
    whole: bool

    @classmethod
    def of(cls, dataset: Dataset, model: forcegp.model.Model, name: str) -> "BesideMotion":
        """That of a log, of means over short windows."""
        rest = replace(dataset, v=0.0 * dataset.v, a=0.0 * dataset.a)
        both = expected(dataset, model, name), dataset.measured[name], expected(rest, model, name)
        p, f, still = short_means(dataset, *both)
        left, s, right = np.linalg.svd(f.T @ p)
        if s[2] < AGREES**2 * s[0] and np.linalg.det(left @ right) < 0.0:  # in a plane nothing shows a reflection
            left[:, 2] *= -1.0
        own, size = max(float(np.square(p).sum()), 1e-300), max(float(np.square(f).sum()), 1e-300)
        Q, share = left @ right, float(np.sqrt(max(0.0, 1.0 - s.sum() ** 2 / (own * size))))
        angle = float(np.arccos(np.clip((np.trace(Q) - 1.0) / 2.0, -1.0, 1.0)))
        shown = Q, angle, float(s.sum()) / own, share, bool(s[1] > AGREES**2 * s[0])
        return cls(name, _rms(f), _rms(f - p), _rms(f - p + still), *shown)

    @property
    def turned(self) -> str:
        """The name with the mounting that the motion shows."""
        frame, point, axes = imu_place(self.name)
        return f"{IMU}{frame}@{','.join(f'{x:.5g}' for x in (*point, *rpy_from_rotation(axes @ self.Q.T)))}"

    def doubt(self) -> Doubt:
        """What is seen of sign, axes, unit, gravity and mounting."""
        own, off, kind = self.name.removeprefix(IMU), self.off, wrong if self.off > WRONG * self.size else look
        says, do, correction = list[str](), "", dict[str, dict[str, tuple[str, ...]]]()
        near, in_g = np.round(self.Q), abs(self.factor * STANDARD - 1.0) < WRONG
        named = bool((near != np.eye(3)).any()) and np.linalg.norm(self.Q - near) < SMALL
        explained = self.whole and self.share * self.size < EXPLAINS * off and (in_g or abs(self.factor - 1.0) < WRONG)
        axes = ",".join(f"{'-' * bool(x.sum() < 0.0)}{'xyz'[int(abs(x).argmax())]}" for x in near.T)
        if off <= AGREES * self.size:
            kind = ok
        elif self.off_without_gravity < EXPLAINS * min(off, self.size):
            says, do = ["without gravity"], "Log what the sensor measures: at rest 9.81 m/s^2 upwards."
        elif explained and (named or np.linalg.det(self.Q) > 0.0):
            says, correction = (["in g"], {"unit": {"imu": ("g",)}}) if in_g else ([], {})
            if named:
                says += [f"{axes} of its frame's x,y,z"]
                do = f"Name the columns in this order: forcegp import --force imu:{own}={axes}."
            elif self.angle > AGREES:
                says += [f"turned by {np.degrees(self.angle):.2g} degrees"]
                do = f"State it: forcegp import --force imu:{self.turned.removeprefix(IMU)}=x,y,z."
        else:
            do = "Compare its frame, point, axes and unit with the robot, or leave it out."
            kind = wrong if off > EXPLAINS * self.size else look  # accelerations of single rows may be as noisy
        what = f"the IMU at {imu_place(own)[0]} differs by {off:.2g} m/s^2 from the motion, of {self.size:.3g}"
        what += f"{': it is ' * bool(says)}{' and '.join(says)}{'' if self.whole else '; it hardly turns'}."
        return kind(about="imu", what=what, do=do, numbers={"error": off, "size": self.size}, correction=correction)


def imu_doubts(dataset: Dataset, model: forcegp.model.Model) -> Iterator[Doubt]:
    """Each IMU of a log beside its accelerations: sign, axes, unit, gravity, mounting, and delay."""
    for name in (name for name in dataset.measured if name.startswith(IMU)):
        beside = BesideMotion.of(dataset, model, name)
        yield beside.doubt()
        f, p = dataset.measured[name], beside.factor * expected(dataset, model, name) @ beside.Q.T
        yield from delay_doubts(dataset, f"IMU at {imu_place(name)[0]}", f, p)
