"""Optics in pure JAX: parameters and geometry in, brightness and polarization out."""
