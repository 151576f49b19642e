"""How good is a fitted model: scores and plots. Plots need matplotlib, which is imported when one is drawn."""

from forcegp.evaluation.evaluation import Evaluation
from forcegp.evaluation.figure_style import save_figure
from forcegp.evaluation.force_scores import ForceScore, ForceScores, curve_coverage, force_scores
from forcegp.evaluation.friction_curves_plot import curve_panels, friction_curves_figure
from forcegp.evaluation.likelihood_plot import likelihood_figure
from forcegp.evaluation.normal_force_plot import normal_force_figure
from forcegp.evaluation.overlap import system_warnings
from forcegp.evaluation.predicted_rows import PredictedRows, predict_rows
from forcegp.evaluation.prediction_plot import prediction_figure
from forcegp.evaluation.prior_comparison import PriorComparison, PriorScore, compare_priors
from forcegp.evaluation.recorded_motions import RecordedMotions, recorded_motions
from forcegp.evaluation.rollout_errors import RolloutErrors, rollout_errors
from forcegp.evaluation.rollout_plot import rollout_figure
from forcegp.evaluation.scoring import evaluate
from forcegp.evaluation.summary_plot import summary_figure
from forcegp.evaluation.tool_path_plot import tool_path_figure
from forcegp.evaluation.unseen_forces import normal_force_rests_on_prior

__all__ = [
    "Evaluation",
    "ForceScore",
    "ForceScores",
    "PredictedRows",
    "PriorComparison",
    "PriorScore",
    "RecordedMotions",
    "RolloutErrors",
    "compare_priors",
    "curve_coverage",
    "curve_panels",
    "evaluate",
    "force_scores",
    "friction_curves_figure",
    "likelihood_figure",
    "normal_force_figure",
    "normal_force_rests_on_prior",
    "predict_rows",
    "prediction_figure",
    "recorded_motions",
    "rollout_errors",
    "rollout_figure",
    "save_figure",
    "summary_figure",
    "system_warnings",
    "tool_path_figure",
]
