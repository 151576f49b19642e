"""Physical parameters as unknowns of a fit, and what was learned of them."""
