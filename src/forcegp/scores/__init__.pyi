from .accuracy import ACCELERATION as ACCELERATION, TORQUE as TORQUE, unfinished_search as unfinished_search
from .figures.model import (
    curve_panels as curve_panels, friction_curves_figure as friction_curves_figure,
    model_pictures as model_pictures, normal_force_figure as normal_force_figure,
)
from .figures.style import Picture as Picture, save_figure as save_figure
from .models import (
    identify as identify, learn as learn, named_model as named_model, summands as summands,
    usual_forces as usual_forces, with_intervals_of_motions as with_intervals_of_motions,
)
from .page import (
    model_table as model_table, number as number, overall as overall, unit_of as unit_of,
)
from .score import score as score
from .scores import PairedDifference as PairedDifference, Scores as Scores, USABLE as USABLE
from .held_out import Split as Split, split_named as split_named
