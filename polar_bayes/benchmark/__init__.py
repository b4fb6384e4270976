"""Accuracy against time: every method and setting on one capture."""
