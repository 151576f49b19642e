"""Models without physics to compare with: one Gaussian process per joint."""
