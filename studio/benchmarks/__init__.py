"""Measurements of our own parts, run by `studio bench`."""
