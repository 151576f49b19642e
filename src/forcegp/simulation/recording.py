"""What a simulation of our own dynamics recorded, as a dataset: even times, episodes, noise, ground truth."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from forcegp import __version__
from forcegp.data import Dataset, units_for
from forcegp.model import Model

RATE = 240
"""Rows per second."""


def recorded(
    scenario: str,
    config: Any,
    model: Model,
    motion: Mapping[str, np.ndarray],
    truth: Mapping[str, np.ndarray],
    metadata: Mapping[str, Any] | None = None,
) -> Dataset:
    """Rows of `config.episodes` episodes of equal length: q, v, u and the true a of `motion`, which gets its noise.

    The noise has a stream of its own for each episode, so that it leaves the motion of a seed as it is. Rows are
    1 / RATE apart, unless `motion` has their time.
    """
    nv, steps = model.robot.nv, len(motion["a"]) // config.episodes
    streams = [np.random.default_rng([config.seed, episode, 1]) for episode in range(config.episodes)]
    noise = np.concatenate([stream.standard_normal((steps, nv)) for stream in streams])
    return Dataset(
        **{
            "time": np.tile(np.arange(steps) / RATE, config.episodes),
            **motion,
            "a": motion["a"] + config.noise * noise,
        },
        episode=np.repeat(np.arange(config.episodes), steps),
        units=units_for(model.robot),
        model=model,
        noise_std=np.full(nv, config.noise) if config.noise > 0 else None,
        truth={"a": motion["a"], **truth},
        metadata={
            **{"scenario": scenario, "config": dataclasses.asdict(config), "versions": {"forcegp": __version__}},
            **(metadata or {}),
        },
    )
