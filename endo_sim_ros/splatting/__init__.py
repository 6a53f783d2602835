"""Gaussian splatting: a model and cameras in, differentiable images out."""

from endo_sim_ros.splatting.api import RenderOutput, rasterize, render
from endo_sim_ros.splatting.reference import _rasterize, sh_basis
