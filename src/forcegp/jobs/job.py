"""`Job`: one piece of work, and the digest of all that decides its result."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from forcegp.jobs.source_code import code_digest


@dataclass(frozen=True)
class Job:
    """One piece of work, the smallest that is kept.

    Fields
    ------
    name: its place in the store.
    task: "package.module:function" of a function `(store, spec, folder, *arguments)`, which may write files to `folder`
        and returns plain JSON values.
    spec: the settings of the task, plain JSON values.
    inputs: names of the jobs whose results the task reads.
    cost: about how many CPU seconds it takes, for the remaining time and the order.
    arguments: objects for the task that JSON cannot hold; `spec` must identify them.
    code: more modules that decide the result, those of functions among the arguments for example.
    """

    name: str
    task: str
    spec: Mapping[str, Any]
    inputs: tuple[str, ...] = ()
    cost: float = field(default=1.0, compare=False)
    arguments: tuple[Any, ...] = field(default=(), compare=False, repr=False)
    code: tuple[str, ...] = ()

    @property
    def code_digest(self) -> str:
        """The digest of the code that computes it."""
        return code_digest(self.task.partition(":")[0], *self.code)


def digests(jobs: Sequence[Job]) -> dict[str, str]:
    """By name, what decides each result: the task, its code and spec, and the digests of its inputs, which are jobs."""
    by_name = {job.name: job for job in jobs}
    out: dict[str, str] = {}

    def digest(job: Job) -> str:
        if job.name not in out:
            inputs = [digest(by_name[name]) for name in job.inputs]
            decisive = [job.task, job.code_digest, dict(job.spec), inputs]
            out[job.name] = hashlib.sha256(json.dumps(decisive, sort_keys=True).encode()).hexdigest()
        return out[job.name]

    for job in jobs:
        digest(job)
    return out
