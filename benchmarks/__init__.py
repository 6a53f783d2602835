"""Benchmarks of every room, run by `endo-sim bench`. Nothing in the package imports them."""
