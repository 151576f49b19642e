from .job import Job as Job
from .job import digests as digests
from .running import Progress as Progress
from .running import run_jobs as run_jobs
from .source_code import code_digest as code_digest
from .store import JobStore as JobStore
