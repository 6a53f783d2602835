"""Gaussian splatting: a model and cameras in, differentiable images out."""

from endo_sim_ros.splatting.api import RenderOutput as RenderOutput, rasterize as rasterize, render as render
from endo_sim_ros.splatting.reference import rasterize_in_torch as rasterize_in_torch, sh_basis as sh_basis
