from .candidates import CANDIDATES as CANDIDATES, Candidate as Candidate, Training as Training
from .comparison import Comparison as Comparison, training_subset as training_subset
from .figures import figures_of as figures_of
from .paired_tests import SCORES as SCORES
from .run import Validation as Validation, validate as validate
from .splits import (
    Split as Split, Stretch as Stretch, hold_out_blocks as hold_out_blocks, hold_out_episodes as hold_out_episodes,
    hold_out_fraction as hold_out_fraction, leave_one_episode_out as leave_one_episode_out, split_named as split_named,
)
from .winner import fitted_on_all_rows as fitted_on_all_rows, recommended as recommended
