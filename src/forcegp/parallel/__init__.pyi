from .backend import Backend as Backend, Joblib as Joblib, Serial as Serial, backend_for as backend_for
