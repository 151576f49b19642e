"""Sensors of a log as evidence: which of them teach, with which noise, and how IMUs are mounted."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from forcegp.data import Dataset, preparation_report
from forcegp.data.dataset import FORCE, IMU, TORQUE
from forcegp.data.imu import SMALL, BesideMotion, delay_doubts, short_means
from forcegp.doubts import Doubt, look, ok, wrong
from forcegp.errors import InvalidInput
from forcegp.evidence import Accelerations, ContactForces, Evidence, FrameAcceleration, JointTorques, Sensor, Torques
from forcegp.evidence.recorded_rows import share_of, slides
from forcegp.fit.force_sensors import force_sensor_doubts
from forcegp.fit.unseen import rows_of_known_physics
from forcegp.model import Model
from forcegp.noise import Noise

PERIODS = 1.3
"""Of the cut-off, over which equations are averaged where a base moves: its noisy accelerations would lower masses."""


def usual_evidence(model: Model, dataset: Dataset) -> tuple[Evidence, ...]:
    """That of a fit where none is named, beside sensors of the log: force sensors at contacts, and all IMUs."""
    measured, touched = dataset.measured, dict.fromkeys(contact.frame for contact in model.contacts)
    felt = [FrameAcceleration()] if any(name.startswith(IMU) for name in measured) else []
    sensors = [*(ContactForces(frame) for frame in touched if f"{FORCE}{frame}" in measured), *felt]
    if model.unknown_forces or not model.is_open:
        return Accelerations(), *sensors
    sensors += [JointTorques()] if any(name.startswith(TORQUE) for name in measured) else []
    moves = not model.robot.space.is_vector_space
    cutoff = preparation_report(dataset.metadata).get("cutoff") if moves and dataset.time_ordered else None
    return Torques("both" if felt or moves else "u", round(PERIODS / cutoff, 4) if cutoff else None), *sensors


def with_sensors(dataset: Dataset, model: Model, rest: Evidence, sensors: Sequence[Sensor]) -> tuple[Dataset, Model]:
    """The log with the sensors that teach, IMUs named as they are mounted, and the model with their noise."""
    measured, levels = dict[str, np.ndarray](), dict[str, list[float]]()
    looked = torque_sensor_doubts(dataset, model) if any(isinstance(each, JointTorques) for each in sensors) else ()
    felt = force_sensor_doubts(dataset, model) if any(isinstance(each, ContactForces) for each in sensors) else ()
    forces = {doubt.numbers["frame"]: doubt for doubt in felt if doubt.level == "wrong"}
    links = {doubt.joints: doubt for doubt in looked if doubt.level == "wrong"}
    for each in sensors:
        each.check(dataset)
        for name in each.names(dataset):
            found = name
            at = [contact for contact in model.contacts if f"{FORCE}{contact.frame}" == name]
            if isinstance(each, FrameAcceleration):
                beside = BesideMotion.of(dataset, model, name)
                little = each.turned and beside.whole and beside.angle < SMALL
                if little:
                    found = beside.turned
                    beside = BesideMotion.of(replace(dataset, measured={found: dataset.measured[name]}), model, found)
                if beside.doubt().level == "wrong" or (each.turned and not little):
                    raise InvalidInput(f"{'no small turn explains it: ' * each.turned}{beside.doubt()}")
                if isinstance(rest, Torques) and not rest.noisy_in_both:
                    raise InvalidInput(
                        "Torques() take accelerations for exact, which no IMU makes better; give torques:both, that is "
                        "Torques('both')."
                    )
            elif isinstance(each, JointTorques):
                if isinstance(rest, Accelerations):
                    seen = "torque sensors at links teach numbers of laws and bodies, beside torques"
                    raise InvalidInput(f"{seen}; give Torques(), without unknown forces.")
                if said := links.get((name.removeprefix(TORQUE),)):
                    raise InvalidInput(str(said))
            elif said := forces.get(name.removeprefix(FORCE)):
                raise InvalidInput(str(said))
            elif isinstance(rest, Accelerations) and model.is_open and not model.unknown_forces:
                raise InvalidInput("force sensors teach numbers beside torques, not accelerations; give Torques().")
            elif model.unknown_forces and not at:
                seen = f"a force was measured at {name.removeprefix(FORCE)!r}, where the model has no contact"
                remedy = "give it one, or leave unknown forces out, so that it is a force that is known"
                raise InvalidInput(f"{seen}; {remedy}.")
            measured[found] = dataset.measured[name]
            channels = 1 if any(map(slides, at)) else measured[found].shape[1]
            levels[found] = [each.noise or share_of(measured[found])] * channels
    dataset, noise = replace(dataset, measured=measured), model.noise or Noise(None)
    if not measured or noise.sensor is not None:
        return dataset, model
    level = tuple(std for name in dataset.measured for std in levels[name])
    return dataset, replace(model, noise=replace(noise, sensor=level))


FOLLOWS, OTHER, OFF, MOST_ROWS = 0.7, 0.3, 0.05, 20_000
"""Least correlation with the expected torque, what that of another joint may leave, deviations worth a word, rows."""


def torque_sensor_doubts(dataset: Dataset, model: Model) -> Iterator[Doubt]:
    """Each torque sensor at a link beside what bodies need there: its joint, sign, unit, gain, offset and delay."""
    names = [name.removeprefix(TORQUE) for name in dataset.measured if name.startswith(TORQUE)]
    if not names or any(f"{FORCE}{contact.frame}" not in dataset.measured for contact in model.contacts):
        return
    middle = max(0, (len(dataset) - MOST_ROWS) // 2)
    dataset = dataset.rows(slice(middle, middle + MOST_ROWS))
    rows = rows_of_known_physics(model, dataset)
    needed = rows.in_torque(np.zeros(0), rows.moving(dataset.a))[0][:, model.robot.nv :] + rows.at_links
    p, f = short_means(dataset, needed, rows.at_links)
    apart = np.sqrt(((f[:, :, None] - p[:, None]) ** 2).mean(0))
    for k, joint in enumerate(names):
        best, size, sensor = int(apart[k].argmin()), float(np.std(f[:, k])), f"torque sensor at the link of {joint}"
        own = float(np.corrcoef(f[:, k], p[:, k])[0, 1]) if size > 0.0 else 0.0
        trend = np.c_[p[:, k], np.ones(len(p)), np.linspace(-0.5, 0.5, len(p))]
        factor, offset, drift = np.linalg.lstsq(trend, f[:, k])[0].tolist()
        kind, says, do = ok, f"differs by {apart[k, k]:.2g} Nm from what bodies need there", ""
        if apart[k, best] < OTHER * min(apart[k, k], size):
            kind, says = wrong, f"shows the torque of {names[best]}"
            do = "Give columns in the order of the joints: forcegp import --force torque:JOINT=COLUMN."
        elif own < -FOLLOWS:
            kind, says = wrong, "has the other sign"
            do = f"Give its column with a minus: forcegp import --force torque:{joint}=-COLUMN."
        elif own < FOLLOWS:
            kind, says = look, "does not follow what bodies need there"
            do = "Compare its joint and the robot, or leave it out."
        elif not 0.1 < factor < 10.0:
            kind, says = wrong, f"shows {factor:.4g} times what bodies need there"
            do = "State its unit: forcegp import --unit torque=mNm."
        elif abs(drift) > OFF * size:
            kind, says, do = look, f"drifts by {drift:.2g} Nm over the log", "Tare it more often, or cut the log."
        elif abs(factor - 1.0) > OFF or abs(offset) > OFF * size:
            kind, says = look, f"shows {factor:.3g} times what bodies of the file need there, and {offset:.2g} Nm more"
            do = "That is its gain and offset if the masses are right: correct its column, or identify the bodies."
        numbers = {"factor": factor, "offset": offset, "drift": drift}
        what = f"the {sensor} {says}; it varies by {size:.3g} Nm."
        yield kind(about="torque sensor", what=what, do=do, joints=(joint,), numbers=numbers)
        if own > FOLLOWS:
            yield from delay_doubts(dataset, sensor, rows.at_links[:, [k]], factor * needed[:, [k]] + offset)
