from .job import Job as Job, digests as digests, code_digest as code_digest
from .running import Progress as Progress, run_jobs as run_jobs, JobStore as JobStore
