"""Pieces of work whose results are kept: computed once, on any backend, until their settings or their code change."""

from forcegp.jobs.code_digest import code_digest
from forcegp.jobs.job import Job, digests
from forcegp.jobs.running import Progress, run_jobs
from forcegp.jobs.store import JobStore

__all__ = ["Job", "JobStore", "Progress", "code_digest", "digests", "run_jobs"]
