"""Measurement: held-out and deformed views, benchmarks' rows, and comparisons of methods."""
