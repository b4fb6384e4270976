"""Numerical methods: functions of arrays, independent of captures, scenes and models."""
