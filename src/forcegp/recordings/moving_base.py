"""Logs of bases that move: their orientations, velocities and accelerations, turned into those of a Dataset."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from forcegp.data import differentiate
from forcegp.data.configurations import following, in_base
from forcegp.data.dataset_fields import ROTATION, TRANSLATION
from forcegp.errors import DatasetError, InvalidInput
from forcegp.model import Model
from forcegp.recordings.mapping import ORIENTATIONS, SIGNALS, ColumnMapping
from forcegp.recordings.source import Source
from forcegp.robots import Robot
from forcegp.robots.layout import WORLD
from forcegp.robots.manifold import POSITIONS, TURN, ConfigurationSpace, Group

ANGLES = ("roll", "pitch", "yaw")
TURNED = ("y", "z", "qy", "qz", "sin", "ry", "rz", "pitch", "yaw")
"""What changes sign by half a turn of world and base about x: north, east, down becomes north, west, up."""
LARGEST_ERROR = 0.01  # of the length of a quaternion: more is no rounding
ROUNDED = 1e-9  # differences from length 1 beyond this are reported


def position_columns(robot: Robot, joints: Sequence[str], orientation: str) -> tuple[str, ...]:
    """Names of the columns of q in a log: `joints` are those of one degree of freedom, in its order."""
    names = list(joints)
    for group, span in spans(robot.space, orientation):
        names[span.start : span.start] = [f"{group.name}.{part}" for part in _written(orientation)]
    return tuple(names)


def spans(space: ConfigurationSpace, orientation: str) -> Iterator[tuple[Group, slice]]:
    """Every base and its columns among those of q in a log."""
    more = 0
    for group in space.groups:
        start, size = group.place + more, len(_written(orientation))
        more += size - len(POSITIONS)
        yield group, slice(start, start + size)


def _written(orientation: str) -> tuple[str, ...]:
    place, turn = POSITIONS[: TURN.start], POSITIONS[TURN]
    return place + (ANGLES if orientation == "angles" else turn[-1:] + turn[:-1] if orientation == "wxyz" else turn)


def bases(robot: Robot) -> tuple[Group, ...]:
    """The joints of several degrees of freedom whose parent is the world: their axes are its."""
    return tuple(group for group in robot.space.groups if robot.layout.parents[group.body] == WORLD)


def columns_of(
    mapping: ColumnMapping, model: Model | None, joints: tuple[str, ...]
) -> tuple[dict[str, dict[str, str | None]], dict[str, tuple[str, ...]]]:
    """By signal: name and SI unit of its columns in the order of the log, and names in the order of the Dataset.

    Unit None: whatever the actuator takes.
    """
    if model is None:
        return {signal: dict.fromkeys(joints) for signal in SIGNALS}, dict.fromkeys(SIGNALS, joints)
    robot, own = model.robot, model.robot.single_joint_names
    kinds = {joint.name: TRANSLATION if joint.type == "prismatic" else ROTATION for joint in robot.joints}
    of_log = dict(zip(own, joints, strict=True))
    driven = tuple(model.actuation.names) == own
    switches = model.inputs[len(model.actuators) :]

    def unit(signal: str, name: str) -> str | None:
        if signal == "u" and not (driven and name in own):
            return "1" if name in switches else None
        return kinds[name][signal] if name in kinds else "rad" if name.endswith(ANGLES) else "1"

    written = mapping.orientation or ORIENTATIONS[0]
    velocities = tuple(of_log.get(name, name) for name in robot.joint_names)
    inputs = tuple(of_log.get(name, name) if driven else name for name in model.inputs)
    log = {"q": position_columns(robot, joints, written), "v": velocities, "u": inputs, "a": velocities}
    stored = position_columns(robot, own, "angles" if written == "angles" else ORIENTATIONS[0])
    order = {"q": stored, "v": robot.joint_names, "u": model.inputs, "a": robot.joint_names}
    return {signal: {name: unit(signal, name) for name in names} for signal, names in log.items()}, order


Jumps = tuple[Int[np.ndarray, " jumps"], str, str]
"""Rows before which something moves too far, what was seen, and what to do."""


def read_poses(
    space: ConfigurationSpace,
    orientation: str,
    source: Source,
    table: Float[np.ndarray, "rows columns"],
    begins: Int[np.ndarray, " episodes"],
) -> tuple[Float[np.ndarray, "rows nq"], list[Jumps], list[str]]:
    """Positions as the log writes them, as q: turns of length 1, quaternions whose sign never jumps.

    And rows before which a base turns by more than a quarter of a turn, `begins` of episodes left out; and what people
    should know. Raises DatasetError, naming the row, where a turn is more than 1 % longer or shorter than 1.
    """
    turned = list(spans(space, orientation))
    q = np.delete(table, [column for _, span in turned for column in range(span.start, span.stop)], axis=1)
    jumps, notes = list[Jumps](), list[str]()
    for group, span in turned:
        given, first = table[:, span], TURN.start
        if orientation == "angles":
            turn = np.array(Rotation.from_euler("xyz", given[:, first:]).as_quat())
        else:
            length = np.linalg.norm(given[:, first:], axis=1, keepdims=True)
            error = np.abs(length[:, 0] - 1.0)
            row = int(error.argmax())
            if error[row] > LARGEST_ERROR:
                names = ", ".join(POSITIONS[TURN])
                raise DatasetError(
                    f"{source.path}: the orientation of {group.name!r} ({names}) has the length {length[row, 0]:.4g} "
                    f"at {source.place(row)}; a turn has length 1. Map its columns, give `orientation` angles if they "
                    "are roll, pitch and yaw, or repair or remove these rows."
                )
            if error[row] > ROUNDED:
                notes.append(f"orientations divided by their length, which differs from 1 by up to {error[row]:.2g}")
            turn = given[:, first:] / length
        turn, jumped = following(turn, turn[0])
        jumped[begins] = False
        seen = f"{group.name!r} turns by more than a quarter of a turn"
        remedy = (
            "give the order of its columns (`orientation`), the unit of its angles (`unit` q=deg), or leave it out."
        )
        jumps.append((np.flatnonzero(jumped), seen, remedy))
        q = np.hstack([q[:, : group.place], given[:, :first], turn, q[:, group.place :]])
    return q, jumps, notes


@dataclass(frozen=True)
class Layout:
    """What is left to do about signals once they are read: those of a base are turned, what lacks is differentiated.

    Fields
    ------
    space: of the positions.
    bases: joints of several degrees of freedom whose parent is the world.
    axes: of v and a, those of the linear and of the angular part.
    gravity: (3,) [m/s^2], for accelerometers.
    derived: entries of v and a that the log lacks.
    held: columns of u that hold from row to row.
    """

    space: ConfigurationSpace
    bases: tuple[Group, ...] = ()
    axes: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    gravity: tuple[float, ...] = (0.0, 0.0, 0.0)
    derived: Mapping[str, list[int]] = field(default_factory=dict)
    held: tuple[int, ...] = ()

    def signals(self, logged: Mapping[str, np.ndarray], time: Float[np.ndarray, " rows"]) -> dict[str, np.ndarray]:
        """q, v, u and a, with differences (second order) for what was not logged."""
        found = dict(logged)
        if not self.space.is_vector_space:  # a spline through quaternions does not end on the sphere
            found["q"] = self.space.normalized(torch.tensor(found["q"])).numpy()
        for name, source in (("v", "q"), ("a", "v")):
            lacking = self.derived.get(name, [])
            if name in found:
                found[name] = self._in_body(name, found[name], found["q"], found["v"])
            if name not in found or lacking:
                made = differentiate(found[source], time, self.space if name == "v" else None)
                own = np.isin(np.arange(self.space.nv), lacking) | (not lacking)
                found[name] = np.where(own, made, found.get(name, made))
        return found

    def _in_body(self, signal: str, values: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """v or a (rows, nv) as a Dataset has them; `v` in body axes where a is asked for."""
        if signal not in self.axes:
            return values
        found, moving, at = (torch.tensor(x) for x in (values, v, q))
        more = {"gravity": torch.tensor(self.gravity, dtype=torch.float64)} if signal == "a" else {}
        for group in self.bases:
            own = {**more, "v": moving[:, group.rows]} if more else {}
            found[:, group.rows] = in_base(at[:, group.places], found[:, group.rows], self.axes[signal], **own)
        return found.numpy()


def layout_of(mapping: ColumnMapping, model: Model | None, lacking: Mapping[str, Sequence[bool]], nv: int) -> Layout:
    """What is left to do once positions are those of a Dataset.

    `lacking`: of each logged signal, which of its entries the log lacks. Raises InvalidInput for vectors that are half
    there where their axes turn.
    """
    groups = () if model is None else bases(model.robot)
    derived = {name: [row for row, lacks in enumerate(own) if lacks] for name, own in lacking.items()}
    axes = {name: (own[0], own[-1] if own[-1] != "imu" else "body") for name, own in mapping.axes.items()}
    for name in axes.keys() - lacking.keys():
        raise InvalidInput(
            f"axes of {name} are stated, but the log has no {name}; name its columns, or leave axes out."
        )
    for name, group in ((name, group) for name in axes for group in groups):
        for part, words in (((0, 1, 2), "linear"), ((3, 4, 5), "angular")):
            rows = {group.row + k for k in part}
            if axes[name][words == "angular"] == "world" and 0 < len(rows & {*derived.get(name, ())}) < len(rows):
                raise InvalidInput(f"{name} in the axes of the world needs all of its {words} part, or all `derive`.")
    if model is None:
        return Layout(ConfigurationSpace(nv), derived=derived)
    switches = tuple(range(len(model.actuators), len(model.inputs)))
    return Layout(model.robot.space, groups, axes, tuple(model.robot.gravity.tolist()), derived, switches)
