from .accuracy import (
    force_errors as force_errors, mass_matrices as mass_matrices, row_scores as row_scores,
)
from .candidates import Candidate as Candidate, Training as Training
from .doubts import (
    normal_force_rests_on_prior as normal_force_rests_on_prior, unfinished_search as unfinished_search,
)
from .figures.log import contacts_figure as contacts_figure
from .figures.friction_curves import curve_panels as curve_panels, friction_curves_figure as friction_curves_figure
from .figures.log import check_figure as check_figure
from .figures.model import (
    model_pictures as model_pictures, motion_bands_figure as motion_bands_figure,
    normal_force_figure as normal_force_figure, prediction_figure as prediction_figure,
)
from .figures.scores import scores_pictures as scores_pictures
from .figures.style import Picture as Picture, save_figure as save_figure
from .learning import (
    learn as learn, named_model as named_model, summands as summands, usual_evidence as usual_evidence,
    usual_forces as usual_forces, with_intervals_of_motions as with_intervals_of_motions,
)
from .paired import CRITERIA as CRITERIA, PairedDifference as PairedDifference
from .page import (
    joint_table as joint_table, overall as overall, quantity_table as quantity_table, unit_of as unit_of,
    winner_table as winner_table,
)
from .predicted_rows import PredictedRows as PredictedRows, predict_rows as predict_rows
from .score import score as score
from .scores import Scores as Scores
from .splits import Split as Split, split_named as split_named
