from .check_input import (
    import_flags as import_flags, SEVERITIES as SEVERITIES, Finding as Finding, Severity as Severity,
)
from .report import CheckReport as CheckReport, check as check, quick_check as quick_check
