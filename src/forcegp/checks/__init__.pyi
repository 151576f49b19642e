from .report import (
    CheckReport as CheckReport, check as check, quick_check as quick_check,
)
