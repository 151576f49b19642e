"""Measured data: the `Dataset`, its file format, splits, sampling and filtering."""

from forcegp.data.contact_rows import contact_rows, rows_in_contact
from forcegp.data.dataset import Dataset
from forcegp.data.delay import Delay, estimate_delay
from forcegp.data.farthest_points import farthest_point_sampling, farthest_rows
from forcegp.data.filtering import (
    differentiate,
    differentiated,
    episodes_in_order,
    low_pass,
    low_pass_gain,
    resample,
    uniform_step,
    zero_phase_low_pass,
)
from forcegp.data.frozen_dict import FrozenDict
from forcegp.data.preparation import Preparation, Prepared
from forcegp.data.spectrum import MotionSpectrum, motion_spectrum, power_density
from forcegp.data.splits import require_disjoint, train_test_split
from forcegp.data.time_blocks import time_blocks
from forcegp.data.units import REVOLUTE_UNITS, units_for
from forcegp.data.windows import OBSERVATIONS, VelocityIncrements, WeakForm, WindowObservation, Windows, observation_of

__all__ = [
    "OBSERVATIONS",
    "REVOLUTE_UNITS",
    "Dataset",
    "Delay",
    "FrozenDict",
    "MotionSpectrum",
    "Preparation",
    "Prepared",
    "VelocityIncrements",
    "WeakForm",
    "WindowObservation",
    "Windows",
    "contact_rows",
    "differentiate",
    "differentiated",
    "episodes_in_order",
    "estimate_delay",
    "farthest_point_sampling",
    "farthest_rows",
    "low_pass",
    "low_pass_gain",
    "motion_spectrum",
    "observation_of",
    "power_density",
    "require_disjoint",
    "resample",
    "rows_in_contact",
    "time_blocks",
    "train_test_split",
    "uniform_step",
    "units_for",
    "zero_phase_low_pass",
]
