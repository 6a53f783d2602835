"""Models that are touched: layers and surfaces."""

import dataclasses

import numpy as np
import pytest
import torch

from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.evaluation.deformed_views import deformed_view_psnr
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence


@pytest.mark.thorough
@pytest.mark.slow
def test_layers_of_other_colours_come_apart_when_touched_and_a_surface_does_not(caplog):
    (frame,) = phantom_sequence(PhantomConfig(frames=1, width=160, height=128, stereo=False))
    points = torch.from_numpy(frame.camera.backproject(frame.depth).reshape(-1, 3)).float()
    colors, radii = torch.from_numpy(frame.image.reshape(-1, 3) / 255.0).float(), torch.full((len(points),), 4e-4)
    surface = GaussianModel.from_points(points, colors, radii, opacity=0.95)
    ahead = torch.from_numpy(frame.camera.pose[:3, 2]).float()
    striped = torch.sign(torch.sin(4e3 * points[:, :1]))
    front, behind = (
        GaussianModel.from_points(points + step * ahead, colors + shift * striped, radii, opacity=opacity)
        for step, shift, opacity in ((0.0, 0.3, 0.3), (0.003, -0.2, 0.9))
    )
    layers = GaussianModel(**{name: torch.cat([tensor, behind.tensors()[name]]) for name, tensor in front.tensors().items()})
    found = [deformed_view_psnr(model, [frame.camera], "cpu") for model in (surface, layers)]
    assert found[0] > 28 and found[1] < found[0] - 1
    kilometres = dataclasses.replace(surface, means=1000 * surface.means, log_scales=surface.log_scales + np.log(1000))
    pose = frame.camera.pose.copy()
    pose[:3, 3] *= 1000
    assert np.isnan(deformed_view_psnr(kilometres, [frame.camera.at(pose)], "cpu"))
    assert "poses are in metres" in caplog.text and "travel" not in caplog.text
