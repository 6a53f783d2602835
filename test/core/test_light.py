"""The light at the camera: what it does to a picture, and how it travels with a model."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from lit_wall import CAMERA, LAMP, wall

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import look_at
from endo_sim_ros.core.gaussians import ModelError, load_ply, save_ply
from endo_sim_ros.core.light import Light, directions, falloff, features, features_at, features_from, log_brightness, toned, untoned
from endo_sim_ros.core.shading import shade, to_bytes
from endo_sim_ros.messages import MessageError
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig


def test_brightness_falls_with_distance_and_angle_as_written():
    one = torch.ones(CAMERA.height, CAMERA.width)
    fixed = dataclasses.replace(LAMP, level_r=0.0, level_g=0.0, level_b=0.0, response=0.0)
    image = shade(fixed, torch.ones(CAMERA.height, CAMERA.width, 3), 0.2 * one, one, CAMERA)
    v, u = 100, 30
    x, y = (u + 0.5 - 80) / 200, (v + 0.5 - 64) / 200
    cosine = 1 / math.sqrt(1 + x * x + y * y)
    expected = (0.2 / cosine / 0.1) ** -1.2 * cosine**8 * math.exp(0.4 * x - 0.3 * y)
    assert image[v, u].tolist() == pytest.approx([expected] * 3, rel=1e-5)


def test_the_other_eye_sees_tissue_as_the_lamp_lights_it():
    """Not as if it carried a lamp itself: what a pixel of it shows is as bright as from where the lamp is."""
    right = CAMERA.at(CAMERA.pose @ look_at(np.array([0.006, 0.001, 0.002]), np.array([0.0, 0.0, 0.1]), np.array([0.0, -1.0, 0.0])))
    generator = np.random.default_rng(0)
    depth = generator.uniform(0.05, 0.15, (CAMERA.height, CAMERA.width))
    alpha = generator.uniform(0.5, 1.0, depth.shape)
    fixed = dataclasses.replace(LAMP, level_r=0.0, level_g=0.0, level_b=0.0, response=0.0)
    tensors = [torch.tensor(x, dtype=torch.float32) for x in (depth * alpha, alpha)]
    image = shade(fixed, torch.ones(*depth.shape, 3), *tensors, right, CAMERA).numpy()
    points = (right.rays() * depth[..., None]).reshape(-1, 3) @ right.pose[:3, :3].T + right.position
    theta = np.array([LAMP.distance, LAMP.angle, LAMP.tilt_x, LAMP.tilt_y])
    expected = np.exp(features_at(points, CAMERA, LAMP.reference) @ theta).reshape(depth.shape)
    np.testing.assert_allclose(image[..., 0], expected, rtol=2e-4)
    own = shade(fixed, torch.ones(*depth.shape, 3), *tensors, right).numpy()
    assert np.abs(own[..., 0] / expected - 1).max() > 0.02


def test_kernels_of_the_cpu_shade_and_round_as_written_whatever_the_size():
    g = torch.Generator().manual_seed(0)
    for height, width in ((37, 41), (1, 3)):
        camera = dataclasses.replace(CAMERA, width=width, height=height)
        colors = 1.4 * torch.rand(height, width, 3, generator=g) - 0.2
        alphas = torch.rand(height, width, generator=g).round(decimals=1)  # some are 0
        depths = alphas * (0.4 * torch.rand(height, width, generator=g)).round(decimals=1)
        theta, level = (
            torch.tensor([LAMP.distance, LAMP.angle, LAMP.tilt_x, LAMP.tilt_y]),
            torch.tensor([LAMP.level_r, LAMP.level_g, LAMP.level_b]),
        )
        beside = camera.at(camera.pose @ look_at(np.array([0.006, 0.001, 0.002]), np.array([0.0, 0.0, 0.1]), np.array([0.0, -1.0, 0.0])))
        rays, motion = directions(camera, "cpu"), (beside.viewmat @ camera.pose)[:3]
        here, aside = features(depths, alphas, rays, LAMP.reference), features_from(motion, rays, depths, alphas, LAMP.reference)
        for lamp, quantities in ((None, here), (beside, aside)):
            lit = colors * falloff(quantities, theta)[..., None]
            expected = lit * (level - LAMP.response * log_brightness(lit, alphas > 0.5)).exp()
            torch.testing.assert_close(shade(LAMP, colors, depths, alphas, camera, lamp), expected, rtol=6e-6, atol=0)
            curved = shade(dataclasses.replace(LAMP, shoulder=0.6), colors, depths, alphas, camera, lamp)
            torch.testing.assert_close(curved, toned(expected, 0.6), rtol=6e-6, atol=3e-7)
            factors = 0.5 + torch.rand(height, width, 1, generator=g)
            brighter = shade(dataclasses.replace(LAMP, shoulder=0.6), colors, depths, alphas, camera, lamp, factors)
            torch.testing.assert_close(brighter, toned(expected * factors, 0.6), rtol=6e-6, atol=3e-7)
        assert torch.equal(to_bytes(colors), (colors.clamp(0, 1) * 255 + 0.5).to(torch.uint8))


def test_the_curve_of_a_camera_keeps_what_is_dark_and_reaches_white_without_a_bend():
    brightness = torch.linspace(0, 2, 2001, dtype=torch.float64)
    for shoulder in (0.01, 0.3, 1.0):
        values = toned(brightness, shoulder)
        dark = brightness <= 1 - shoulder
        assert torch.equal(values[dark], brightness[dark]) and (values[brightness >= 1 + shoulder] == 1).all()
        slope = values.diff() / brightness.diff()
        assert (slope > -1e-9).all() and (slope.diff() < 1e-9).all()  # it rises, and flattens all the way
        assert -slope.diff().min() < 0.002 / shoulder  # by the shoulder's width, not at once
        seen = values < 1
        found = untoned(values[seen].numpy(), shoulder)
        np.testing.assert_allclose(found, brightness[seen], atol=2e-3 * shoulder**0.5)  # a float of 0.9999 may be any of many
    gamma, light = 1 / 2.2, brightness**2.2
    assert (toned(brightness, 0.8) - (1 - (-light).exp()) ** gamma).abs().max() < 0.016
    assert untoned(np.array([0.2, 0.9, 1.0]), 0.0).tolist() == pytest.approx([0.2, 0.9, 1.0])
    assert untoned(np.array([1.0]), 0.4) == pytest.approx(1.4)


def test_the_shoulder_has_the_gradient_of_the_curve():
    brightness = torch.tensor([0.1, 0.6, 0.9, 1.3, 1.9], dtype=torch.float64, requires_grad=True)
    shoulder = torch.tensor(0.55, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(toned, (brightness, shoulder))


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
    with pytest.raises(ValueError, match="sheen_sharpness is -1"):
        Light(sheen_sharpness=-1.0)
    with pytest.raises(ValueError, match="shoulder is 1.5; it must be from 0 to 1"):
        Light(shoulder=1.5)
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
