from .job import Job as Job, digests as digests
from .running import Progress as Progress, run_jobs as run_jobs
from .source_code import code_digest as code_digest
from .store import JobStore as JobStore
