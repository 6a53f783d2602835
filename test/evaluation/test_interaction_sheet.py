"""The sheet of `endo-sim touch`: tools are as large as the scene asks for, unless its scale is wrong."""

import cv2
import numpy as np
import pytest
import torch
from thorough import mostly_thorough

from endo_sim_ros.core.cameras import Camera, save_cameras
from endo_sim_ros.core.gaussians import GaussianModel, save_ply
from endo_sim_ros.evaluation.interaction_sheet import draw_touches
from endo_sim_ros.physics import PhysicsConfig


def wall(folder, scale):
    """A model of a wall, 0.1 m away from its camera and 0.1 m wide, times a scale."""
    grid = np.linspace(-0.06, 0.06, 25)
    points = torch.tensor([(x, y, 0.1) for x in grid for y in grid], dtype=torch.float32)
    colors, size = torch.full_like(points, 0.5), torch.full((len(points),), 0.004)
    save_ply(GaussianModel.from_points(scale * points, colors, scale * size, opacity=0.95), folder / "model.ply")
    save_cameras([Camera(np.array([[64.0, 0, 32], [0, 64, 24], [0, 0, 1]]), 64, 48, np.eye(4))], folder / "cameras.json")
    return folder / "model.ply"


@pytest.mark.parametrize("scale, width", [(300, "30 m"), (0.01, "0.001 m")])
def test_a_model_of_a_wrong_scale_is_told(tmp_path, scale, width):
    sentence = f"model.ply: its middle camera sees {width} of tissue, an endoscope some centimetres; correct the scale of the poses"
    with pytest.raises(ValueError, match=sentence):
        draw_touches(wall(tmp_path, scale), tmp_path / "touch.png", PhysicsConfig(device="cpu"))


@pytest.mark.parametrize("scale, thickness", mostly_thorough([(3, 0.02), (1, 0.06)]))
def test_thick_tissue_and_wide_scenes_are_cut_with_the_longest_blade(tmp_path, scale, thickness):
    draw_touches(wall(tmp_path, scale), tmp_path / "touch.png", PhysicsConfig(device="cpu", node_count=400, thickness=thickness))
    assert cv2.imread(str(tmp_path / "touch.png")).shape[1] == 3 * 256


@pytest.mark.thorough
def test_tissue_that_tears_is_told(tmp_path, caplog):
    tender = PhysicsConfig(device="cpu", node_count=400, tear_strain=0.05)
    draw_touches(wall(tmp_path, 1), tmp_path / "touch.png", tender)
    assert any("torn: the tissue tore where at rest is" in text for text in caplog.messages)
