from .findings import SEVERITIES as SEVERITIES
from .findings import Finding as Finding
from .findings import Severity as Severity
from .report import CheckReport as CheckReport
from .report import check as check
