"""Models that are displaced as a synthetic patient is, against the patient filmed anew."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.evaluation.deformed_truth import deformed_truth_psnr
from endo_sim_ros.evaluation.sources import find_patient
from endo_sim_ros.sequences.phantom import PhantomConfig, displacement_at, phantom_camera, phantom_poses, render_phantom

PATIENT = PhantomConfig(seed=0, width=96, height=80, stereo=False, frames=2)


def painted(camera: Camera, image: np.ndarray, depth: np.ndarray) -> GaussianModel:
    """A picture, painted on the surface that it shows."""
    points = torch.from_numpy(camera.backproject(depth).reshape(-1, 3)).float()
    colors, radii = torch.from_numpy(image.reshape(-1, 3) / 255.0).float(), torch.from_numpy(depth.reshape(-1) / camera.K[0, 0] / 2)
    return GaussianModel.from_points(points, colors, radii, opacity=0.95)


@pytest.mark.slow
def test_a_painted_surface_follows_and_one_that_is_elsewhere_does_not():
    camera = phantom_camera(PATIENT, phantom_poses(PATIENT)[0])
    model = painted(camera, *render_phantom(PATIENT, camera))
    found, at_rest = deformed_truth_psnr(model, PATIENT, [camera], [camera], "cpu")
    pulled = dataclasses.replace(PATIENT, deformed=0.012)
    # The same painting of the patient who is pulled already comes apart when it is pulled again.
    displacement = displacement_at(pulled, 0.0)
    assert displacement is not None
    points = model.means.double().numpy()
    moved = points + displacement.at(points)
    twice = dataclasses.replace(model, means=torch.from_numpy(moved).float())
    assert 24 < found < at_rest - 2 and deformed_truth_psnr(twice, PATIENT, [camera], [camera], "cpu")[0] < found - 2
    for other in (pulled, dataclasses.replace(PATIENT, flight=0.3)):  # one who was not at rest, and one who is pulled out of view
        assert np.isnan(deformed_truth_psnr(model, other, [camera], [camera], "cpu")).all()


@pytest.mark.thorough
def test_truth_is_averaged_as_held_out_views_are():
    filmed = dataclasses.replace(PATIENT, seed=1, width=384, height=320)
    camera = phantom_camera(filmed, phantom_poses(filmed)[0])
    small = camera.resized(96, 80)
    at_points, depth = render_phantom(filmed, small)
    averaged = cv2.resize(render_phantom(filmed, camera)[0], (96, 80), interpolation=cv2.INTER_AREA)
    figures = [deformed_truth_psnr(painted(small, image, depth), filmed, [small], [small], "cpu") for image in (averaged, at_points)]
    assert (np.array(figures[0]) > np.array(figures[1]) + 0.5).all()


def test_sources_name_patients():
    assert find_patient("phantom:3,deformed=0.01") == PhantomConfig(seed=3, rounds=0.5, deformed=0.01)
    assert find_patient("my_bag,step=2") is None
