"""Kernels of the MPM solver, one set for each kind of device."""
