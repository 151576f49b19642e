"""IMUs on links: what they measure of a motion, and whether a log bears it out.

An accelerometer measures the specific force f = R^T (J a + Jdot v - g) (Titterton & Weston, "Strapdown inertial
navigation technology", 2004, section 3.5), which is affine in the acceleration.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

import forcegp.model
from forcegp.data.dataset import IMU, Dataset, imu_place
from forcegp.data.delay import LEAST_DELAY, lowest
from forcegp.data.views import consecutive, tensors, whole_windows, window_means
from forcegp.doubts import Doubt, look, ok, wrong
from forcegp.errors import InvalidInput
from forcegp.mechanics import AffineMap
from forcegp.robots import Kinematics
from forcegp.robots.inertia import rpy_from_rotation

STANDARD = 9.80665  # m/s^2 in a g
AGREES, WRONG = 0.02, 0.1
"""Of what an IMU measures: the disagreement with the log that is none, and from which on it is wrong."""
EXPLAINS = 0.3
"""Of the disagreement: what another reading may leave."""
SMALL = 0.35  # rad: a larger turn is one of the axes
SECONDS, MOST_ROWS = 0.1, 4000
"""Over which both are averaged, since a derived acceleration is noisy; rows that are looked at."""
SHIFTS = np.linspace(-0.05, 0.05, 101)  # s
LATE = 0.8  # of the disagreement: what a shift leaves at most


def specific_force(kinematics: Kinematics, name: str) -> AffineMap:
    """What the IMU of this name measures (..., 3) [m/s^2], as a function of the acceleration."""
    frame, point, turned = imu_place(name)
    robot = kinematics.robot
    pose, J, bias = kinematics.frame_motion(frame, torch.tensor(point, dtype=torch.float64, device=robot.device))
    R = (pose[..., :3, :3] @ torch.as_tensor(turned).to(pose)).mT
    falls = bias[..., :3] - robot.tree.gravity
    return AffineMap((R @ falls[..., None])[..., 0], R @ J[..., :3, :])


@dataclass(frozen=True, eq=False)
class BesideMotion:
    """What an IMU measured and should have, as means over short windows, and `still`, what gravity alone makes of it.

    `Q` and `factor` are those of least squares in measured = factor Q expected (Schoenemann, Psychometrika 1966), and
    `share` what they leave. Q may be a reflection; `whole` tells whether the rows show it.
    """

    name: str
    expected: Float[np.ndarray, "rows 3"]
    measured: Float[np.ndarray, "rows 3"]
    still: Float[np.ndarray, "rows 3"]
    Q: Float[np.ndarray, "3 3"]
    factor: float
    share: float
    whole: bool

    @classmethod
    def of(cls, dataset: Dataset, model: forcegp.model.Model, name: str) -> BesideMotion:
        """That of a log."""
        steps = np.diff(dataset.time)[consecutive(dataset)[:-1]]
        width = int(max(1.0, SECONDS / np.median(steps))) if dataset.time_ordered and len(steps) else 1
        first = whole_windows(dataset, width)
        first = first[:: max(1, len(first) // MOST_ROWS)]
        rest = replace(dataset, v=0.0 * dataset.v, a=0.0 * dataset.a)
        both = expected_by(dataset, model, name), dataset.measured[name], expected_by(rest, model, name)
        p, f, still = (window_means(x, first, width) for x in both)
        left, s, right = np.linalg.svd(f.T @ p)
        if s[2] < AGREES**2 * s[0] and np.linalg.det(left @ right) < 0.0:  # in a plane nothing shows a reflection
            left[:, 2] *= -1.0
        product = max(float(np.square(p).sum() * np.square(f).sum()), 1e-300)
        share = float(np.sqrt(max(0.0, 1.0 - s.sum() ** 2 / product)))
        factor = float(s.sum() / max(np.square(p).sum(), 1e-300))
        return cls(name, p, f, still, left @ right, factor, share, bool(s[1] > AGREES**2 * s[0]))

    @property
    def angle(self) -> float:
        """Of Q [rad]; more than half a turn for a reflection."""
        return float(np.arccos(np.clip((np.trace(self.Q) - 1.0) / 2.0, -1.0, 1.0))) + 4.0 * (np.linalg.det(self.Q) < 0)

    @property
    def as_turned(self) -> str:
        """The name with the mounting that the motion shows."""
        frame, point, turned = imu_place(self.name)
        pose = [*point, *rpy_from_rotation(turned @ self.Q.T)]
        return f"{IMU}{frame}@{','.join(f'{x:.5g}' for x in pose)}"

    def mounted(self) -> str:
        """The same where that is a small turn. Raises InvalidInput, with the misfit, for another one."""
        if self.whole and self.share < WRONG and self.angle < SMALL and abs(self.factor - 1.0) < WRONG:
            return self.as_turned
        raise InvalidInput(
            f"the mounting of {self.name!r} is not found: turned by {np.degrees(self.angle):.3g} degrees and times "
            f"{self.factor:.3g} the log leaves {self.share:.1%} of it"
            f"{'' if self.whole else ', and the link hardly turns'}; name its axes (forcegp check)."
        )

    def doubt(self) -> Doubt:
        """What is seen of sign, axes, unit, gravity and mounting."""

        def rms(x: np.ndarray) -> float:
            return float(np.sqrt(np.square(x).sum(1).mean()))

        own, size, off = self.name.removeprefix(IMU), rms(self.measured), rms(self.measured - self.expected)
        seen = f"the IMU at {own} and the accelerations of the log differ by {off:.2g} m/s^2, of {size:.3g}"
        numbers, kind = {"error": off, "size": size}, wrong if off > WRONG * size else look
        if off <= AGREES * size:
            return ok(about="imu", what=f"{seen}.", numbers=numbers)
        free = rms(self.measured - self.expected + self.still)
        if free < EXPLAINS * off:
            what, do = f"{seen}: gravity was taken off, without it {free:.2g} remain.", "Log what the sensor measures"
            return wrong(about="imu", what=what, do=f"{do}: at rest 9.81 m/s^2 upwards.", numbers=numbers)
        if not self.whole or self.share * size > EXPLAINS * off:
            what = f"{seen}{'' if self.whole else ', and it hardly turns, so that its axes do not show'}."
            do = "Compare its frame, point, axes and unit (g?) with the robot, or leave it out."
            return kind(about="imu", what=what, do=do, numbers=numbers)
        correction = {"unit": {"imu": ("g",)}} if abs(self.factor * STANDARD - 1.0) < WRONG else {}
        says = [f"{self.factor:.3g} times as large"] * (abs(self.factor - 1.0) > AGREES)
        says = ["in g"] if correction else says
        near, do = np.round(self.Q), ""
        if (abs(near).sum(0) == 1.0).all() and (near != np.eye(3)).any():
            axes = [f"{'-' * bool(axis.sum() < 0.0)}{'xyz'[int(abs(axis).argmax())]}" for axis in near.T]
            says += [f"of axes {', '.join(axes)} for those of its frame"]
            do = f"Name the columns in this order: forcegp import --force imu:{own}={','.join(axes)}."
        elif self.angle > AGREES:
            says += [f"turned by {np.degrees(self.angle):.2g} degrees"]
            do = f"State it: forcegp import --force imu:{self.as_turned.removeprefix(IMU)}=x,y,z."
        what = f"{seen}: it is {' and '.join(says) or 'noisy'}, with which {self.share * size:.2g} remain."
        return kind(about="imu", what=what, do=do, numbers=numbers, correction=correction)


def expected_by(dataset: Dataset, model: forcegp.model.Model, name: str) -> Float[np.ndarray, "rows 3"]:
    """What an IMU should have measured by the accelerations of the log."""
    q, v, _, a = tensors(dataset, model.robot.device)
    with torch.no_grad():
        found = specific_force(model.robot.kinematics(q, v), name)
        return (found.offset + (found.matrix @ a[..., None])[..., 0]).cpu().numpy()


def imu_doubts(dataset: Dataset, model: forcegp.model.Model) -> Iterator[Doubt]:
    """Each IMU of a log beside its accelerations: sign, axes, unit, gravity, mounting, and delay."""
    for name in (name for name in dataset.measured if name.startswith(IMU)):
        beside = BesideMotion.of(dataset, model, name)
        yield beside.doubt()
        if not dataset.time_ordered or not beside.whole:
            continue
        episode = dataset.select_episodes(dataset.episodes[:1])
        expected, time = beside.factor * expected_by(episode, model, name) @ beside.Q.T, episode.time
        inner = (time >= time[0] + SHIFTS[-1]) & (time <= time[-1] + SHIFTS[0])
        inner = np.flatnonzero(inner)[:MOST_ROWS]
        if len(inner) < MOST_ROWS // 100:
            continue
        columns = list(zip(episode.measured[name].T, expected[inner].T, strict=True))
        left = [sum(np.square(np.interp(time[inner] + s, time, f) - p).sum() for f, p in columns) for s in SHIFTS]
        late, zero = lowest(np.array(left), SHIFTS), len(SHIFTS) // 2
        if abs(late) > max(LEAST_DELAY, 0.75 * float(np.median(np.diff(time)))) and min(left) < LATE * left[zero]:
            what = f"the IMU at {name.removeprefix(IMU)} is logged {1e3 * abs(late):.1f} ms "
            what += f"{'later' if late > 0.0 else 'earlier'} than the motion that it measures."
            do = "Shift its columns by that before the log is imported."
            yield look(about="imu delay", what=what, do=do, numbers={"delay": late})
