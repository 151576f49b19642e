"""Sensors of a log as evidence: which of them teach, with which noise, and how IMUs are mounted."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from forcegp.data import Dataset
from forcegp.data.dataset import FORCE, IMU
from forcegp.data.imu import SMALL, BesideMotion
from forcegp.errors import InvalidInput
from forcegp.evidence import Accelerations, ContactForces, Evidence, FrameAcceleration, Sensor, Torques
from forcegp.evidence.recorded_rows import share_of, slides
from forcegp.model import Model
from forcegp.noise import Noise


def usual_evidence(model: Model, measured: Collection[str] = ()) -> tuple[Evidence, ...]:
    """That of a fit where none is named, beside sensors of these names: force sensors at contacts, and all IMUs."""
    touched = dict.fromkeys(contact.frame for contact in model.contacts)
    felt = [FrameAcceleration()] if any(name.startswith(IMU) for name in measured) else []
    sensors = [*(ContactForces(frame) for frame in touched if f"{FORCE}{frame}" in measured), *felt]
    if model.unknown_forces or not model.is_open:
        return Accelerations(), *sensors
    return Torques("both" if felt or not model.robot.space.is_vector_space else "u"), *sensors


def with_sensors(dataset: Dataset, model: Model, rest: Evidence, sensors: Sequence[Sensor]) -> tuple[Dataset, Model]:
    """The log with the sensors that teach, IMUs named as they are mounted, and the model with their noise."""
    measured, levels = dict[str, np.ndarray](), dict[str, list[float]]()
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
            elif isinstance(rest, Accelerations) and model.is_open and not model.unknown_forces:
                raise InvalidInput(
                    "force sensors teach numbers beside torques, not beside accelerations; give Torques()."
                )
            elif model.unknown_forces and not at:
                raise InvalidInput(
                    f"a force was measured at {name.removeprefix(FORCE)!r}, where the model has no contact; give it "
                    "one, or leave unknown forces out, so that it is a force that is known."
                )
            measured[found] = dataset.measured[name]
            levels[found] = [each.noise or share_of(measured[found])] * (1 if any(map(slides, at)) else 3)
    dataset, noise = replace(dataset, measured=measured), model.noise or Noise(None)
    if not measured or noise.sensor is not None:
        return dataset, model
    level = tuple(std for name in dataset.measured for std in levels[name])
    return dataset, replace(model, noise=replace(noise, sensor=level))
