from .report import (
    CheckReport as CheckReport, check as check, quick_check as quick_check,
)
from .torque_doubts import without_pushes as without_pushes, without_stops as without_stops
