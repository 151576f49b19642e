"""Measured data: the `Dataset`, its file format, splits, sampling and filtering."""

from forcegp.data.contact_rows import contact_rows, rows_in_contact
from forcegp.data.dataset import Dataset
from forcegp.data.farthest_points import farthest_point_sampling, farthest_rows
from forcegp.data.filtering import (
    differentiate,
    differentiated,
    low_pass,
    resample,
    uniform_step,
    zero_phase_low_pass,
)
from forcegp.data.frozen_dict import FrozenDict
from forcegp.data.splits import require_disjoint, train_test_split
from forcegp.data.time_blocks import time_blocks
from forcegp.data.units import REVOLUTE_UNITS, units_for

__all__ = [
    "REVOLUTE_UNITS",
    "Dataset",
    "FrozenDict",
    "contact_rows",
    "differentiate",
    "differentiated",
    "farthest_point_sampling",
    "farthest_rows",
    "low_pass",
    "require_disjoint",
    "resample",
    "rows_in_contact",
    "time_blocks",
    "train_test_split",
    "uniform_step",
    "units_for",
    "zero_phase_low_pass",
]
