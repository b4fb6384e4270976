"""Measurements: what a capture holds, and the doors through which it enters."""
