"""Figures of data, predictions and scores; these modules import matplotlib, `forcegp.scores` them at first use."""
