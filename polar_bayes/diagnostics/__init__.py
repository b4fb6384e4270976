"""What a finished fit is worth: convergence, predictive checks, what the data determine."""
