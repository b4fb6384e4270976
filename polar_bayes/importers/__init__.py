"""Captures from instruments: tables, goniometers and cameras."""
