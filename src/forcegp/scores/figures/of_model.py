"""Which pictures a model and a recording allow."""

from collections.abc import Callable

from matplotlib.figure import Figure

from forcegp.data import Dataset
from forcegp.posterior.posterior import Posterior
from forcegp.scores.figures.friction_curves import curve_panels, friction_curves_figure
from forcegp.scores.figures.motion_bands import motion_bands_figure
from forcegp.scores.figures.prediction import normal_force_figure, prediction_figure


def model_figures(posterior: Posterior, dataset: Dataset) -> dict[str, tuple[str, Callable[[], Figure]]]:
    """File name without ending -> a caption, and what draws it.

    Drawing raises ForceGPError for what the recording does not allow, as motions with uneven time steps.
    """
    found: dict[str, tuple[str, Callable[[], Figure]]] = {}
    if curve_panels(posterior):
        caption = (
            "Forces over velocity, with 95 % bands: the friction laws of the model and what was learned beside them. "
        )
        caption += "Ticks are the velocities of the training data."
        found["forces"] = caption, lambda: friction_curves_figure(posterior, dataset)
    caption = "Every half second a prediction begins at the recorded state and follows the recorded u. The line is its "
    caption += "error, the band its 95 % interval."
    found["motions_ahead"] = caption, lambda: motion_bands_figure(posterior, dataset)
    if posterior.model.contacts:
        caption = "The forces of contacts, which no sensor measured."
        found["normal_force"] = caption, lambda: normal_force_figure(posterior, dataset)
    caption = "Accelerations over time, and their errors on the right."
    found["prediction"] = caption, lambda: prediction_figure(posterior, dataset)
    return found
