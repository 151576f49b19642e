"""How good is a fitted model: scores and plots. Plots need matplotlib, which is imported when one is drawn."""

from forcegp.evaluation.evaluation import Evaluation
from forcegp.evaluation.figure_style import save_figure
from forcegp.evaluation.likelihood_plot import likelihood_figure
from forcegp.evaluation.predicted_rows import PredictedRows, predict_rows
from forcegp.evaluation.prediction_plot import prediction_figure
from forcegp.evaluation.prior_comparison import PriorComparison, PriorScore, compare_priors
from forcegp.evaluation.recorded_motions import RecordedMotions, recorded_motions
from forcegp.evaluation.rollout_errors import RolloutErrors, rollout_errors
from forcegp.evaluation.rollout_plot import rollout_figure
from forcegp.evaluation.scoring import evaluate
from forcegp.evaluation.summary_plot import summary_figure
from forcegp.evaluation.tool_path_plot import tool_path_figure

__all__ = [
    "Evaluation",
    "PredictedRows",
    "PriorComparison",
    "PriorScore",
    "RecordedMotions",
    "RolloutErrors",
    "compare_priors",
    "evaluate",
    "likelihood_figure",
    "predict_rows",
    "prediction_figure",
    "recorded_motions",
    "rollout_errors",
    "rollout_figure",
    "save_figure",
    "summary_figure",
    "tool_path_figure",
]
