from .doubts import (
    unfinished_search as unfinished_search, moved_system as moved_system, system_warnings as system_warnings,
    normal_force_rests_on_prior as normal_force_rests_on_prior,
)
from .evaluation import Evaluation as Evaluation, evaluate as evaluate
from .force_errors import (
    ForceScore as ForceScore, ForceScores as ForceScores, curve_coverage as curve_coverage, force_scores as
    force_scores,
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
from .prior_choice import (
    LOOK as LOOK, all_rows_at_once as all_rows_at_once, allowing_for_correlation as allowing_for_correlation,
    with_force_noise as with_force_noise,
    choose_prior as choose_prior, usual_prior as usual_prior,
)
from .rollout_scores import (
    RolloutErrors as RolloutErrors, rollout_errors as rollout_errors,
)
