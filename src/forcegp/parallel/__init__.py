"""Work spread over processes and machines: the same outcomes, wherever they are computed."""

from forcegp.parallel.backend import MOST_DEATHS, Backend, Pool, Serial, Shared
from forcegp.parallel.choice import backend_for, backend_of
from forcegp.parallel.cluster import Ray
from forcegp.parallel.processes import Joblib

__all__ = ["MOST_DEATHS", "Backend", "Joblib", "Pool", "Ray", "Serial", "Shared", "backend_for", "backend_of"]
