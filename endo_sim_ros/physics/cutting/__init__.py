"""Cutting: a blade sweeps a surface through tissue, across which nodes no longer share grid nodes, nor skin its nodes.

All of it happens in the rest configuration, where the transfer weights of the solver are taken and never change: the
blade is mapped back to rest (`to_rest`), what it sweeps there is a set of triangles (`sweep`), and the topology follows
from which straight lines between rest positions the triangles cross (`separated`). The tissue is then cut as with
virtual nodes (Molino et al. 2004): a grid node that both sides of a cut use gets a copy for each side (`CutStencils`).
"""
