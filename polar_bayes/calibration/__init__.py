"""Do the intervals hold? Simulate from the prior, fit, and see where the truth stands."""
