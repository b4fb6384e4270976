"""Captures of known truth, drawn from the same scene and links that a fit uses."""
