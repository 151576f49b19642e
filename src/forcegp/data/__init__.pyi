from .contacts import contact_doubts as contact_doubts, rows_in_contact as rows_in_contact
from .dataset import Dataset as Dataset, units_for as units_for
from .delay import Delay as Delay, estimate_delay as estimate_delay
from .filters import (
    LowPass as LowPass, differentiate as differentiate, differentiated as differentiated,
    episodes_in_order as episodes_in_order, lagged as lagged, low_pass as low_pass, resample as resample,
    uniform_step as uniform_step,
)
from .hdf5 import is_dataset as is_dataset
from .preparation import Preparation as Preparation, preparation_report as preparation_report
from .spectrum import MotionSpectrum as MotionSpectrum, motion_spectrum as motion_spectrum
from .stance import Stance as Stance, estimate_stance as estimate_stance
from .strokes import strokes as strokes, with_strokes as with_strokes
from .views import (
    RecordedMotions as RecordedMotions, Select as Select, evenly as evenly,
    farthest_point_sampling as farthest_point_sampling, farthest_rows as farthest_rows,
    recorded_motions as recorded_motions, repeated_rows as repeated_rows, tensors as tensors,
    with_memory as with_memory,
)
from .wind import AirLaw as AirLaw, find_wind as find_wind, thruster_columns as thruster_columns, with_wind as with_wind
