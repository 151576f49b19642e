from .report import (
    CheckReport as CheckReport, Finding as Finding, check as check, import_flags as import_flags,
    quick_check as quick_check,
)
