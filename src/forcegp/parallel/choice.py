"""Backends by name, for command lines and configurations."""

from __future__ import annotations

import os

from forcegp.errors import InvalidInput
from forcegp.parallel.backend import Backend, Joblib, Serial, check_jobs
from forcegp.parallel.cluster import Ray

BACKENDS: dict[str, type[Backend]] = {kind.name: kind for kind in (Serial, Joblib, Ray)}


def backend_of(name: str, jobs: int | None = None, address: str | None = None) -> Backend:
    """The backend of this name: serial, joblib or ray.

    jobs: tasks at once; None is as many as this machine has cores, or as the cluster can take. address: of a Ray
    cluster, HOST:PORT. Raises InvalidInput for another name, and for arguments that mean nothing to it.
    """
    if name not in BACKENDS:
        raise InvalidInput(f"there is no backend {name!r}; choose {', '.join(BACKENDS)}")
    if jobs is not None:
        check_jobs(jobs)
    if address is not None and name != Ray.name:
        raise InvalidInput(f"the address {address} is that of a cluster, and backend {name} uses none; choose ray")
    if name == Ray.name:
        return Ray(address, jobs)
    if name == Joblib.name:
        return Joblib(os.cpu_count() or 1 if jobs is None else jobs)
    if jobs not in (None, 1):
        raise InvalidInput(f"backend serial does one task at a time, not {jobs}; choose joblib, or leave jobs out")
    return Serial()


def backend_for(given: Backend | str | None, jobs: int | None = None) -> Backend:
    """What a function means that takes both: a backend, its name, or None for processes as soon as jobs is above 1.

    Raises InvalidInput as `backend_of`, and for a backend with jobs of its own together with others.
    """
    if given is None:
        if jobs is not None:
            check_jobs(jobs)
        return Serial() if jobs in (None, 1) else Joblib(jobs)
    if isinstance(given, str):
        return backend_of(given, jobs)
    if not isinstance(given, Backend):
        raise InvalidInput(
            f"backend is a {type(given).__name__}; give Serial(), Joblib(jobs), Ray(address), or one of the names "
            f"{', '.join(BACKENDS)}"
        )
    if jobs is not None and jobs != getattr(given, "jobs", 1):
        raise InvalidInput(f"jobs={jobs} contradicts backend={given}; give one of them")
    return given
