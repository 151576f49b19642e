"""Figures of data, predictions and scores; these modules import matplotlib, `forcegp.evaluation` them at first use."""
