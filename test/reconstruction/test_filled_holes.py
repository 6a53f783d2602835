"""Whether holes of pictures are filled is decided by the training views."""

import numpy as np
import pytest
import torch
from short_training import options

from endo_sim_ros.core.frames import Frame
from endo_sim_ros.reconstruction.appearance import Appearance
from endo_sim_ros.reconstruction.device_views import DeviceView
from endo_sim_ros.reconstruction.scene import TrainingView
from endo_sim_ros.splatting import RenderOutput


@pytest.mark.parametrize(
    "hole, opacity, changes, filled",
    [
        (0.0, 0.0, {}, 0.0),  # a dark lumen
        (0.6, 0.0, {}, 1.0),  # tissue that the model lacks
        (0.42, 0.7, {}, 1.0),  # tissue that lets black through
        (None, 1.0, {}, 1.0),  # no view shows a hole
        (0.6, 0.0, {"extrapolation": 0.0}, 0.0),
        (0.6, 0.0, {"extrapolated.hole_error": 0.0}, 0.0),
    ],
)
def test_holes_are_filled_unless_views_show_that_they_are_dark(small, hole, opacity, changes, filled):
    image, alpha = np.full((128, 160, 3), 0.6, np.float32), np.ones((128, 160), np.float32)
    if hole is not None:
        image[40:80, 50:100], alpha[40:80, 50:100] = hole, opacity
    frame = Frame(1, (255 * image).round().astype(np.uint8), small[0].camera)
    view = DeviceView.of(TrainingView.of(frame), 0, "cpu")
    alphas = torch.from_numpy(alpha)[None]
    noise = 0.02 * torch.rand(1, 128, 160, 3, generator=torch.Generator().manual_seed(0))
    output = RenderOutput((0.6 + noise) * alphas[..., None], 0.1 * alphas, alphas, 0 * alphas, torch.zeros(1, 0))
    config = options(extrapolation=0.3, light=False).replaced(changes)
    light, _ = Appearance(np.zeros(4), np.zeros((1, 3)), 0.1, config, "cpu").fitted([view], lambda _: output)
    assert light is not None and light.filled == filled
