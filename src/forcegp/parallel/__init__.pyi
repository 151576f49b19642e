from .backend import (
    MOST_DEATHS as MOST_DEATHS, Backend as Backend, Joblib as Joblib, Pool as Pool, Serial as Serial,
    backend_for as backend_for,
)
