"""Gaussian splatting: a model and cameras in, differentiable images out."""

from endo_sim_ros.splatting.api import (
    RenderOutput as RenderOutput,
    camera_arrays as camera_arrays,
    rasterize as rasterize,
    render as render,
    render_from as render_from,
)
from endo_sim_ros.splatting.reference import rasterize_in_torch as rasterize_in_torch, sh_basis as sh_basis
