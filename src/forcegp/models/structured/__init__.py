"""Gaussian processes on the unknown forces inside known rigid-body dynamics: `StructuredGP` and its posterior."""
