"""Sensors of a log as evidence: which of them teach, with which noise, and how IMUs are mounted."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from forcegp.data import Dataset
from forcegp.data.dataset import FORCE, IMU
from forcegp.data.imu import BesideMotion
from forcegp.errors import InvalidInput
from forcegp.evidence import Accelerations, ContactForces, Evidence, FrameAcceleration, Sensor, Torques
from forcegp.evidence.recorded_rows import share_of, slides
from forcegp.model import Model
from forcegp.noise import Noise

Stated = Mapping[str, float | None]
"""By name of a sensor, its noise where somebody states it [N or m/s^2]."""


def usual_evidence(model: Model, measured: Collection[str] = ()) -> tuple[Evidence, ...]:
    """That of a fit where none is named, beside sensors of these names: force sensors at contacts, and all IMUs."""
    touched = dict.fromkeys(contact.frame for contact in model.contacts)
    felt = any(name.startswith(IMU) for name in measured)
    sensors: list[Evidence] = [ContactForces(frame) for frame in touched if f"{FORCE}{frame}" in measured]
    sensors += [FrameAcceleration()] * felt
    if model.unknown_forces or not model.is_open:
        return Accelerations(), *sensors
    return Torques("both" if felt or not model.robot.space.is_vector_space else "u"), *sensors


def with_sensors(
    dataset: Dataset, model: Model, rest: Evidence, sensors: Sequence[Sensor]
) -> tuple[Dataset, dict[str, float | None]]:
    """The log with the sensors that are evidence, with IMUs as they are mounted; and their noise. InvalidInput."""
    measured, noise = dict[str, np.ndarray](), dict[str, float | None]()
    at_contacts = {contact.frame for contact in model.contacts}
    for each in sensors:
        each.check(dataset)
        for name in each.names(dataset):
            found = name
            if isinstance(each, FrameAcceleration):
                beside = BesideMotion.of(dataset, model, name)
                found = beside.mounted() if each.mounting == "estimated" else name
                if found == name and beside.doubt().level == "wrong":
                    raise InvalidInput(str(beside.doubt()))
                if isinstance(rest, Torques) and not rest.noisy_in_both:
                    raise InvalidInput(
                        "Torques() take accelerations for exact, which no IMU makes better; give Torques('both'), that "
                        "is --evidence torques:both,frame-acceleration."
                    )
            elif isinstance(rest, Accelerations) and model.is_open and not model.unknown_forces:
                raise InvalidInput(
                    "force sensors teach numbers beside torques, not beside accelerations; give Torques()."
                )
            elif model.unknown_forces and (frame := name.removeprefix(FORCE)) not in at_contacts:
                raise InvalidInput(
                    f"a force was measured at {frame!r}, where the model has no contact; give it one, or leave unknown "
                    "forces out, so that it is a force that is known."
                )
            measured[found], noise[found] = dataset.measured[name], each.noise
    return replace(dataset, measured=measured), noise


def with_sensor_noise(noise: Noise, rows: Dataset, stated: Stated, model: Model) -> Noise:
    """The noise with that of every column of the sensors, where the log has them."""
    if not rows.measured or noise.sensor is not None:
        return noise
    levels = list[float]()
    for name, values in rows.measured.items():
        along = any(slides(each) for each in model.contacts if f"{FORCE}{each.frame}" == name)
        levels += [stated.get(name) or share_of(values)] * (1 if along else 3)
    return replace(noise, sensor=tuple(levels))
