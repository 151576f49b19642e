from .doubts import (
    unfinished_search as unfinished_search, moved_model as moved_model, system_warnings as system_warnings,
    normal_force_rests_on_prior as normal_force_rests_on_prior,
)
from .evaluation import Evaluation as Evaluation, evaluate as evaluate
from .force_errors import (
    ForceScore as ForceScore, ForceScores as ForceScores, curve_coverage as curve_coverage, force_scores as
    force_scores,
)
from .learning import (
    choose_forces as choose_forces, learn as learn, named_model as named_model, summands as summands,
    usual_evidence as usual_evidence, usual_forces as usual_forces,
    with_intervals_of_motions as with_intervals_of_motions,
)
from .plots.excitation import excitation_figure as excitation_figure
from .plots.friction_curves import curve_panels as curve_panels, friction_curves_figure as friction_curves_figure
from .plots.friction_margins import (
    friction_margins_figure as friction_margins_figure, slip_scores as slip_scores,
)
from .plots.log import check_figure as check_figure, preparation_figure as preparation_figure
from .plots.prediction import (
    normal_force_figure as normal_force_figure, prediction_figure as
    prediction_figure,
)
from .plots.motion_bands import motion_bands_figure as motion_bands_figure
from .plots.contacts import contacts_figure as contacts_figure
from .plots.rollout import rollout_figure as rollout_figure
from .plots.style import save_figure as save_figure
from .predicted_rows import PredictedRows as PredictedRows, predict_rows as predict_rows
from .prior_comparison import (
    PriorComparison as PriorComparison, PriorScore as PriorScore, compare_priors as compare_priors,
)
from .rollout_scores import (
    RolloutErrors as RolloutErrors, rollout_errors as rollout_errors,
)
