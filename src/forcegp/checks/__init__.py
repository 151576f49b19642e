"""Checks of one log and its robot: what would spoil a model, how bad it is, and what to do."""

from forcegp.checks.check import CheckReport, check
from forcegp.checks.findings import SEVERITIES, Finding, Severity

__all__ = ["SEVERITIES", "CheckReport", "Finding", "Severity", "check"]
