"""Holes of a picture, where nobody has seen what is there: they take the colour of what is around them in the picture.

Cameras that look past what the training views saw would else see black, as if tissue were far away there. Depth and labels still tell that
nothing is known. The light of a model says whether its holes are `filled`: not those of dark lumens, which training tells from black by
having no tissue there.
"""

import functools

import torch
from torch import Tensor

from endo_sim_ros.core import surroundings_kernels as kernels
from endo_sim_ros.core.kernels import launch, launch_in_shares, load_kernels
from endo_sim_ros.core.light import SURFACE

_CELLS = 20  # in a picture's width: what fills holes is as smooth
_SAMPLES = 8  # pixels of a cell, each way, that tell its colour: more tell the same


def fill_holes(colors: Tensor, alphas: Tensor) -> None:
    """Change colours of pictures [E, H, W, 3], in place, where their opacities [E, H, W] show no surface.

    Each cell of a picture takes the mean colour of all of them, weighted by opacity and 1 / distance⁴ (Shepard 1968).
    """
    pictures, height, width = alphas.shape
    on_cpu = alphas.device.type == "cpu"
    if on_cpu and alphas.min() >= SURFACE:  # a GPU fills nothing sooner than the host would hear of it
        return
    side = max(width // _CELLS, 1)
    size = -(-height // side), -(-width // side)
    weights, sums = _weights(size, alphas.device), alphas.new_empty(pictures, *size, 4)
    of_cells, of_pixels = [height, width, side, max(side // _SAMPLES, 1)], [height, width, side, SURFACE]
    if on_cpu:
        launch_in_shares(kernels.sum_cells, sums[..., 0].numel(), [*of_cells, colors, alphas, sums], least=20)
    else:
        launch(kernels.sum_cells, sums[..., 0].numel(), [0, *of_cells, colors, alphas, sums], alphas.device)
    # One picture at a time: of several at once a product may have other last bits.
    means = torch.stack([weights @ each for each in sums.flatten(1, 2)])
    filling = (means[..., :3] / means[..., 3:].clamp_min(1e-6)).view(pictures, *size, 3).contiguous()
    if on_cpu:
        launch_in_shares(kernels.fill_holes, pictures * height, [width, *of_pixels, filling, alphas, colors], least=4)
    else:
        launch(kernels.fill_holes, alphas.numel(), [0, 1, *of_pixels, filling, alphas, colors], alphas.device)


@functools.cache
@torch.inference_mode(False)
def _weights(size: tuple[int, int], device: torch.device) -> Tensor:
    """Weights [h w, h w] of the cells of a picture for each of them; the kernels are ready then, too."""
    load_kernels((kernels,), str(device))
    places = torch.cartesian_prod(*(torch.arange(n, dtype=torch.float32) for n in size))
    return (((places[:, None] - places) ** 2).sum(-1) + 0.1).pow(-2).to(device)
