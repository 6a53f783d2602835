"""Gaussian splatting: a model and cameras in, differentiable images out."""

from endo_sim_ros.splatting.api import RenderOutput as RenderOutput, rasterize as rasterize, render as render
from endo_sim_ros.splatting.reference import _rasterize as _rasterize, sh_basis as sh_basis
