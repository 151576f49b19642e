from .fit import fit as fit
from .motion_calibration import calibrated as calibrated
from .physical import Solution as Solution, fit_physical as fit_physical, held_out_noise as held_out_noise
from .search import default_options as default_options
