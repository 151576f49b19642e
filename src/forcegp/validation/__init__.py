"""Models side by side on rows that none of them has seen: splits, scores, verdicts and one page of results."""

from forcegp.validation.candidates import CANDIDATES, DEFAULT_MODELS, Candidate, Training
from forcegp.validation.comparison import Comparison
from forcegp.validation.identified_systems import IDENTIFICATIONS, Identification
from forcegp.validation.run import Validation, validate
from forcegp.validation.splits import (
    Split,
    Stretch,
    hold_out_blocks,
    hold_out_episodes,
    hold_out_fraction,
    leave_one_episode_out,
    split_named,
)
from forcegp.validation.training_subsets import training_subset

__all__ = [
    "CANDIDATES",
    "DEFAULT_MODELS",
    "Candidate",
    "Comparison",
    "IDENTIFICATIONS",
    "Identification",
    "Split",
    "Stretch",
    "Training",
    "Validation",
    "hold_out_blocks",
    "hold_out_episodes",
    "hold_out_fraction",
    "leave_one_episode_out",
    "split_named",
    "training_subset",
    "validate",
]
