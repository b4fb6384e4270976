"""From a model and data to posterior draws."""
