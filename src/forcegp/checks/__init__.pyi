from .report import (
    CheckReport as CheckReport, check as check, quick_check as quick_check,
)
from .stops import without_stops as without_stops
