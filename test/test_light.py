"""The light at the camera: what it does to a picture, how it is found, and how it travels with a model."""

import dataclasses
import math

import cv2
import numpy as np
import pytest
import torch

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera, look_at
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.gaussians import GaussianModel, ModelError, load_ply, save_ply
from endo_sim_ros.core.light import Light, directions, falloff, features, features_at, log_brightness
from endo_sim_ros.core.shading import shade, to_bytes
from endo_sim_ros.messages import MessageError
from endo_sim_ros.reconstruction.photometry import PRIOR, Drift, fit_exposure, fit_light, unlit
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig

CAMERA = Camera(np.array([[200.0, 0, 80], [0, 200.0, 64], [0, 0, 1]]), 160, 128)
LAMP = Light(distance=1.2, angle=8.0, tilt_x=0.4, tilt_y=-0.3, reference=0.1, level_r=0.1, level_g=0.2, level_b=0.3, response=0.5)


def wall(count: int = 12_000) -> GaussianModel:
    """A flat wall of random colours at 0.1 m, dense enough to be opaque."""
    g = torch.Generator().manual_seed(0)
    xy = (torch.rand(count, 2, generator=g) - 0.5) * torch.tensor([0.16, 0.14])
    points = torch.cat([xy, torch.full((count, 1), 0.1)], 1)
    return GaussianModel.from_points(points, 0.2 + 0.3 * torch.rand(count, 3, generator=g), torch.full((count,), 2e-3), 0.95)


def test_brightness_falls_with_distance_and_angle_as_written():
    one = torch.ones(CAMERA.height, CAMERA.width)
    fixed = dataclasses.replace(LAMP, level_r=0.0, level_g=0.0, level_b=0.0, response=0.0)
    image = shade(fixed, torch.ones(CAMERA.height, CAMERA.width, 3), 0.2 * one, one, CAMERA)
    v, u = 100, 30
    x, y = (u + 0.5 - 80) / 200, (v + 0.5 - 64) / 200
    cosine = 1 / math.sqrt(1 + x * x + y * y)
    expected = (0.2 / cosine / 0.1) ** -1.2 * cosine**8 * math.exp(0.4 * x - 0.3 * y)
    assert image[v, u].tolist() == pytest.approx([expected] * 3, rel=1e-5)


def test_kernels_of_the_cpu_shade_and_round_as_written_whatever_the_size():
    g = torch.Generator().manual_seed(0)
    for height, width in ((37, 41), (1, 3)):
        camera = dataclasses.replace(CAMERA, width=width, height=height)
        colors = 1.4 * torch.rand(height, width, 3, generator=g) - 0.2
        alphas = torch.rand(height, width, generator=g).round(decimals=1)  # some are 0
        depths = alphas * (0.4 * torch.rand(height, width, generator=g)).round(decimals=1)
        theta = torch.tensor([LAMP.distance, LAMP.angle, LAMP.tilt_x, LAMP.tilt_y])
        lit = colors * falloff(features(depths, alphas, directions(camera, "cpu"), LAMP.reference), theta)[..., None]
        level = torch.tensor([LAMP.level_r, LAMP.level_g, LAMP.level_b])
        expected = lit * (level - LAMP.response * log_brightness(lit, alphas > 0.5)).exp()
        torch.testing.assert_close(shade(LAMP, colors, depths, alphas, camera), expected, rtol=3e-6, atol=0)
        assert torch.equal(to_bytes(colors), (colors.clamp(0, 1) * 255 + 0.5).to(torch.uint8))


def test_points_and_pixels_have_the_same_quantities():
    camera = CAMERA.at(look_at(np.array([0.02, -0.01, 0.0]), np.array([0.0, 0.0, 0.1])))
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.08, 0.2, (128, 160)).astype(np.float32)
    alpha = np.full_like(depth, 0.7)
    image = features(torch.from_numpy(depth * alpha), torch.from_numpy(alpha), directions(camera, "cpu"), 0.1)
    points = camera.backproject(depth).reshape(-1, 3)
    np.testing.assert_allclose(image.reshape(4, -1).T.numpy(), features_at(points, camera, 0.1), atol=1e-5)


def test_a_full_response_holds_the_brightness_whatever_the_light():
    light = dataclasses.replace(LAMP, level_r=-0.4, level_g=-0.4, level_b=-0.4, response=1.0)
    one = torch.ones(CAMERA.height, CAMERA.width)
    for factor in (0.2, 1.0, 5.0):
        image = shade(light, factor * torch.rand(128, 160, 3, generator=torch.Generator().manual_seed(1)), 0.1 * one, one, CAMERA)
        peak = float((image[::4, ::4].amax(-1) ** 6).mean() ** (1 / 6))
        assert peak == pytest.approx(math.exp(-0.4), rel=1e-4)


def lit_views(light: Light, gains, poses) -> list[Frame]:
    """Pictures of the wall by cameras of fixed exposures."""
    frames = []
    for stamp, (gain, pose) in enumerate(zip(gains, poses), 1):
        model = dataclasses.replace(wall(), light=dataclasses.replace(light, level_r=gain, level_g=gain, level_b=gain, response=0.0))
        image, depth = DeformableRenderer(model, None, RenderingConfig(device="cpu")).render(CAMERA.at(pose))
        frames.append(Frame(stamp, image, CAMERA.at(pose), depth=depth))
    return frames


def test_light_and_exposures_are_found_from_views_at_several_distances():
    places = ((-0.02, 0.03), (0.02, 0.0), (0.0, -0.03), (0.015, -0.05))
    poses = [look_at(np.array([x, 0.5 * x, z]), np.array([x, -x, 0.1])) for x, z in places]
    gains = [-0.5, 0.0, 0.2, 0.4]
    frames = lit_views(LAMP, gains, poses)
    points = wall().means.numpy().astype(np.float64)
    theta, exposures = fit_light(frames, points, 0.1, 0.1)
    assert (np.abs(theta - [1.2, 8.0, 0.4, -0.3]) < [0.2, 0.5, 0.1, 0.1]).all(), theta
    np.testing.assert_allclose(exposures.mean(1) - exposures.mean(), np.array(gains) - np.mean(gains), atol=0.1)
    # Glints do not matter.
    spoilt = frames[1].image.copy()
    for center in ((40, 40), (100, 80), (90, 20)):
        cv2.circle(spoilt, center, 9, (255, 255, 255), -1)
    again, _ = fit_light([frames[0], dataclasses.replace(frames[1], image=spoilt), *frames[2:]], points, 0.1, 0.1)
    assert (np.abs(again - theta) < [0.1, 0.5, 0.1, 0.1]).all(), again
    # The colours without light are the wall's, up to one factor.
    colors = unlit(wall(), frames, theta, exposures, 0.1, 0.1).base_colors
    ratio = (colors / wall().base_colors).median()
    assert (colors.mean(0) / wall().base_colors.mean(0) / ratio - 1).abs().max() < 0.1


def test_what_is_switched_off_stays_off():
    frames = lit_views(LAMP, [0.0, 0.3], [np.eye(4), look_at(np.array([0.02, 0, 0]), np.array([0, 0, 0.1]))])
    points = wall().means.numpy().astype(np.float64)
    theta, exposures = fit_light(frames, points, 0.1, 0.1, light=False)
    np.testing.assert_allclose(theta, 0, atol=1e-6)
    assert np.ptp(exposures) > 0.1
    theta, exposures = fit_light(frames, points, 0.1, 0.1, exposure=False)
    np.testing.assert_allclose(exposures, 0, atol=1e-6)
    assert theta[1] > 4


def test_without_two_views_of_a_point_the_prior_counts():
    theta, exposures = fit_light(lit_views(LAMP, [0.3], [np.eye(4)]), wall().means.numpy().astype(np.float64), 0.1, 0.1)
    np.testing.assert_array_equal(theta, PRIOR)
    assert not exposures.any()


@pytest.mark.parametrize("response", [0.0, 0.9])
def test_the_response_of_the_exposure_is_found_where_brightness_varies(response):
    brightness = np.linspace(-1, 1, 6)
    exposures = np.stack([0.2 * c - response * brightness for c in range(3)], 1)
    found, levels, residuals = fit_exposure(exposures, brightness)
    assert found == pytest.approx(response, abs=0.01)
    np.testing.assert_allclose(levels, [0, 0.2, 0.4], atol=1e-9)
    np.testing.assert_allclose(residuals, 0, atol=0.01)
    assert fit_exposure(exposures[:1], brightness[:1])[0] == 0.9  # one view tells nothing


def test_what_brightness_does_not_explain_of_the_exposures_is_taken_as_time_has_it():
    brightness, darker = np.array([-0.5, 0.5, 0.0]), np.array([0.3, 0.0, -0.3])  # in the order of time: third, second, first
    exposures = (darker - 0.9 * brightness)[:, None] + np.zeros(3)
    response, levels, residuals = fit_exposure(exposures, brightness)
    light = dataclasses.replace(LAMP, response=response, **dict(zip(("level_r", "level_g", "level_b"), levels)))
    drift = Drift([30, 20, 10], residuals)
    for stamp, own, seen in zip(drift.stamps_ns, exposures, brightness):
        then = drift.at(light, stamp)
        np.testing.assert_allclose(np.array([then.level_r, then.level_g, then.level_b]) - response * seen, own, atol=1e-9)
    between = (drift.at(light, 10).level_g + drift.at(light, 20).level_g) / 2
    assert drift.at(light, 15).level_g == pytest.approx(between)
    assert drift.at(light, 5) == drift.at(light, 10) and drift.at(light, 99) == drift.at(light, 30)
    assert drift.at(None, 15) is None
    at_once = Drift([10, 10, 20], residuals)
    assert at_once.at(light, 10).level_r == pytest.approx(light.level_r + residuals[:2, 0].mean())


def test_the_light_travels_with_the_model(tmp_path):
    model = dataclasses.replace(wall(50), light=Light(*np.float32(dataclasses.astuple(LAMP)).tolist()))
    save_ply(model, tmp_path / "lit.ply")
    assert load_ply(tmp_path / "lit.ply").light == model.light
    assert model.select(torch.arange(20)).detach().to("cpu").light == model.light
    assert messages.decode_gaussians(messages.encode_gaussians(model, 1, "world")).light == model.light
    save_ply(dataclasses.replace(model, light=None), tmp_path / "plain.ply")
    assert load_ply(tmp_path / "plain.ply").light is None


def test_a_light_that_cannot_be_is_refused(tmp_path):
    with pytest.raises(ValueError, match="reference is 0"):
        Light(reference=0)
    with pytest.raises(ValueError, match="expected the values"):
        Light.from_json('{"distance": 1.0}')
    path = tmp_path / "lit.ply"
    save_ply(dataclasses.replace(wall(50), light=LAMP), path)
    path.write_bytes(path.read_bytes().replace(b'"angle": 8.0', b'"angle": NaN'))
    with pytest.raises(ModelError, match="angle is nan"):
        load_ply(path)
    message = messages.encode_gaussians(dataclasses.replace(wall(50), light=LAMP), 1, "world")
    points = messages.decode_cloud(message, "gaussians").copy()
    points["light"][1] = np.inf
    message.data = messages.ros_types().sequence(points.view(np.uint8))
    with pytest.raises(MessageError, match="angle is inf"):
        messages.decode_gaussians(message)


def test_the_renderer_shades_deformed_tissue_too():
    model = dataclasses.replace(wall(), light=dataclasses.replace(LAMP, response=0.0))
    rest = model.means[::50].numpy()
    renderer = DeformableRenderer(model, rest, RenderingConfig(device="cpu"))
    F = np.tile(np.eye(3, dtype=np.float32), (len(rest), 1, 1))
    near, _ = renderer.render(CAMERA, rest - np.float32([0, 0, 0.03]), F)
    far, _ = renderer.render(CAMERA, rest, F)
    centre = (slice(54, 74), slice(70, 90))
    assert near[centre].mean() / far[centre].mean() == pytest.approx((0.07 / 0.1) ** -1.2, rel=0.03)
