"""Light and exposures found from views."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from lit_wall import CAMERA, LAMP, wall
from short_training import options
from thorough import mostly_thorough

from endo_sim_ros.core.cameras import look_at
from endo_sim_ros.core.gaussians import SH_C0, GaussianModel
from endo_sim_ros.core.light import Light, directions
from endo_sim_ros.reconstruction import Trainer, prepare
from endo_sim_ros.reconstruction.photometry import Drift, find_shoulder, fit_exposure, fit_light, remove_light, unlit_colors
from endo_sim_ros.reconstruction.progress import Cancelled, StageProgress
from endo_sim_ros.reconstruction.scene import TrainingView
from endo_sim_ros.reconstruction.stage_configs import PhotometryConfig
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig


def lit_views(light: Light, gains, poses, tissue: GaussianModel | None = None) -> list[TrainingView]:
    """Pictures of the wall, or of other tissue, by cameras of fixed exposures."""
    frames = []
    for stamp, (gain, pose) in enumerate(zip(gains, poses), 1):
        model = dataclasses.replace(
            tissue or wall(), light=dataclasses.replace(light, level_r=gain, level_g=gain, level_b=gain, response=0.0)
        )
        image, depth = DeformableRenderer(model, None, RenderingConfig(device="cpu")).render(CAMERA.at(pose))
        frames.append(TrainingView(stamp, image, CAMERA.at(pose), depth_prior=depth))
    return frames


@pytest.mark.slow
@pytest.mark.parametrize("shoulder, brighter", [(0.0, 0.0), (0.9, 0.5)])  # where the curve bends
def test_light_and_exposures_are_found_from_views_at_several_distances(shoulder, brighter):
    places = ((-0.02, 0.03), (0.02, 0.0), (0.0, -0.03), (0.015, -0.05))
    poses = [look_at(np.array([x, 0.5 * x, z]), np.array([x, -x, 0.1])) for x, z in places]
    gains = [-0.5, 0.0, 0.2, 0.4]
    toned = lit_views(dataclasses.replace(LAMP, shoulder=shoulder), [gain + brighter for gain in gains], poses)
    frames = [dataclasses.replace(frame, shoulder=shoulder) for frame in toned]
    points = wall().means.numpy().astype(np.float64)
    theta, exposures, _ = fit_light(frames, points, 0.1, 0.1)
    assert (np.abs(theta - [1.2, 8.0, 0.4, -0.3]) < [0.2, 0.5, 0.1, 0.1]).all(), theta
    np.testing.assert_allclose(exposures.mean(1) - exposures.mean(), np.array(gains) - np.mean(gains), atol=0.1)
    # Glints do not matter.
    spoilt = frames[1].image.copy()
    for center in ((40, 40), (100, 80), (90, 20)):
        cv2.circle(spoilt, center, 9, (255, 255, 255), -1)
    again, *_ = fit_light([frames[0], dataclasses.replace(frames[1], image=spoilt), *frames[2:]], points, 0.1, 0.1)
    assert (np.abs(again - theta) < [0.1, 0.5, 0.1, 0.1]).all(), again
    # The colours without light are the wall's, up to one factor.
    colors = remove_light(wall(), unlit_colors(wall().means, frames, theta, exposures, 0.1, 0.1)).base_colors
    ratio = (colors / wall().base_colors).median()
    assert (colors.mean(0) / wall().base_colors.mean(0) / ratio - 1).abs().max() < 0.1


@pytest.mark.slow
def test_the_tone_curve_is_found_where_pictures_are_bright_enough_to_tell_it():
    places = ((-0.02, 0.03), (0.02, 0.0), (0.0, -0.05), (0.015, 0.04), (-0.01, -0.02))
    poses = [look_at(np.array([x, 0.5 * x, z]), np.array([x, -x, 0.1])) for x, z in places]
    x, y = (wall().means[:, :2] / 0.02).split(1, dim=1)
    colors = 0.4 + 0.15 * torch.cat([torch.sin(x + y), torch.sin(y - 1), torch.cos(x)], 1)
    smooth = dataclasses.replace(wall(), sh=((colors - 0.5) / SH_C0)[:, None])
    points = smooth.means.numpy().astype(np.float64)

    def found(shoulder: float, gain: float, options: PhotometryConfig = PhotometryConfig()) -> float:
        lamp = Light(distance=0.9, angle=3.0, reference=0.1, shoulder=shoulder)
        return find_shoulder(lit_views(lamp, [gain] * 5, poses, smooth), points, 0.1, 0.1, options)

    assert [found(shoulder, 0.3) for shoulder in (0.0, 0.25, 0.5, 0.7)] == [0.0, 0.25, 0.5, 0.5]  # a softer one is left to training
    assert [found(shoulder, -0.5) for shoulder in (0.0, 0.25, 0.5)] == [0.5] * 3  # all is darker than where they begin
    assert found(0.5, 0.3, PhotometryConfig(shoulder=0.0)) == 0.0  # said to clip
    assert found(0.5, 0.3, PhotometryConfig(shoulder=0.1)) == 0.1  # only sharper ones are tried


def test_the_curve_is_trained_and_the_model_is_drawn_through_it(views):
    config = options(iterations=40)
    scene = prepare(views[::4], config)
    trainer = Trainer(scene, config)
    trainer.run()
    light = trainer.light
    assert light is not None and scene.views[0].shoulder == 0.5 and 0.001 < abs(light.shoulder - 0.5) < 0.1
    renderer = DeformableRenderer(trainer.model, None, RenderingConfig(device="cpu", image_width=0))
    exposures = trainer.appearance.tensors["exposures"].detach().numpy()
    for view, own, exposure in zip(trainer._device_views, scene.views, exposures, strict=True):
        with torch.no_grad():
            size = view.camera.width, view.camera.height
            seen = trainer.render(view.viewmats, view.Ks, size)[1]
            seen, _ = trainer._exposed(seen, directions(view.camera, "cpu"), view.index_tensor)
        fixed = dataclasses.replace(light, response=0.0, filled=0.0, **{f"level_{c}": float(e) for c, e in zip("rgb", exposure)})
        drawn = renderer.render(own.camera, light=fixed)[0]
        assert np.abs(drawn - 255 * seen.numpy()).max() < 0.6 and drawn.max() > 200


@pytest.mark.parametrize("trained, prepared", mostly_thorough([(0.0, 0.5), (0.5, 0.0)]))
def test_a_training_that_goes_on_keeps_the_curve_that_it_had(views, tmp_path, trained, prepared):
    config = options(iterations=4)
    scene = prepare(views[::4], config)
    curved = lambda shoulder: dataclasses.replace(scene, views=tuple(dataclasses.replace(v, shoulder=shoulder) for v in scene.views))
    first, other = (Trainer(curved(shoulder), config) for shoulder in (trained, prepared))
    first.step()
    first.save_checkpoint(tmp_path / "half")
    other.load_checkpoint(tmp_path / "half")
    for trainer in (first, other):
        trainer.step()
    assert first.light is not None and first.light == other.light and (first.light.shoulder > 0) == (trained > 0)


def test_a_camera_that_is_said_to_clip_is_trained_so(views):
    config = options(iterations=10, photometry=PhotometryConfig(shoulder=0.0))
    trainer = Trainer(prepare(views[::4], config), config)
    trainer.run()
    assert trainer.light is not None and trainer.light.shoulder == 0.0


def test_what_is_switched_off_stays_off():
    frames = lit_views(LAMP, [0.0, 0.3], [np.eye(4), look_at(np.array([0.02, 0, 0]), np.array([0, 0, 0.1]))])
    points = wall().means.numpy().astype(np.float64)
    theta, exposures, _ = fit_light(frames, points, 0.1, 0.1, light=False)
    np.testing.assert_allclose(theta, 0, atol=1e-6)
    assert np.ptp(exposures) > 0.1
    theta, exposures, _ = fit_light(frames, points, 0.1, 0.1, exposure=False)
    np.testing.assert_allclose(exposures, 0, atol=1e-6)
    assert theta[1] > 4


def test_light_falls_with_distance_and_towards_the_edge_and_not_too_fast():
    """Depth that is wrong makes it seem so; here pictures do."""
    poses = [look_at(np.array([x, 0.5 * x, z]), np.array([x, -x, 0.1])) for x, z in ((-0.02, 0.03), (0.02, 0.0), (0.0, -0.03))]
    # Of the second one exponent is below 0 at first, the other then.
    for distance, angle, limit, noise in ((-1.0, -4.0, 0.0, 0.05), (0.0, -6.0, 0.0, 0.05), (3.0, 2.0, 2.0, 0.05), (-1.0, -4.0, 0.0, 0.001)):
        frames = lit_views(Light(distance=distance, angle=angle, tilt_x=0.3, reference=0.1), [0.0, 0.0, 0.0], poses)
        theta, exposures, _ = fit_light(frames, wall().means.numpy().astype(np.float64), 0.1, 0.1, PhotometryConfig(noise=noise))
        assert (theta[:2] > -1e-4).all() and theta[0] < 2 + 1e-4 and np.abs(theta[:2] - limit).min() < 1e-4
        assert theta[2] > 0.1 and np.isfinite(exposures).all()


def test_a_fixed_exposure_is_told_from_one_that_evens_brightness_out_and_from_drift():
    places = ((-0.02, 0.03), (0.02, 0.0), (0.0, -0.03), (0.015, 0.02), (-0.01, -0.02))
    poses = [look_at(np.array([x, 0.5 * x, z]), np.array([x, -x, 0.1])) for x, z in places]
    lamp = dataclasses.replace(LAMP, distance=0.9, tilt_x=0.2, tilt_y=-0.1)
    points = wall().means.numpy().astype(np.float64)
    theta, exposures, fixed = fit_light(lit_views(lamp, [0.0] * 5, poses), points, 0.1, 0.1)
    assert fixed and not exposures.any() and theta[0] == pytest.approx(0.9, abs=0.1)
    assert not fit_light(lit_views(lamp, [0.0] * 5, poses), points, 0.1, 0.1, PhotometryConfig(fixed_below=0.0)).fixed
    away = np.array([np.log(0.1 - z) for _, z in places])
    for gains in (0.9 * 0.9 * (away - away.mean()), np.array([0.1, -0.1, 0.0, 0.1, -0.1])):
        found = fit_light(lit_views(lamp, gains, poses), points, 0.1, 0.1)
        assert not found.fixed
        np.testing.assert_allclose(found.exposures.mean(1) - found.exposures.mean(), gains - gains.mean(), atol=0.06)
    aside = dataclasses.replace(lamp, tilt_x=0.9)  # as exposures make it seem where views are few
    assert not fit_light(lit_views(aside, [0.0] * 5, poses), points, 0.1, 0.1).fixed
    tinted = lit_views(lamp, [0.0] * 5, poses)  # by a white balance that brightens nothing
    tint = np.array([1.06, 1.0, 1 / 1.06])
    tinted[1] = dataclasses.replace(tinted[1], image=(tinted[1].image * tint).clip(0, 255).astype(np.uint8))
    found = fit_light(tinted, points, 0.1, 0.1)
    assert not found.fixed and np.ptp(found.exposures[1]) > 0.08


def test_exposures_that_are_fixed_are_not_trained(views):
    config = options(iterations=20)
    scene = prepare(views[::4], config)
    trained = {}
    for fixed in (True, False):
        trainer = Trainer(dataclasses.replace(scene, exposures=0 * scene.exposures, fixed_exposure=fixed), config)
        trainer.run()
        trained[fixed] = trainer.light, trainer.appearance.tensors["exposures"].detach()
    assert trained[False][1].any() and trained[False][0].response > 0
    assert not trained[True][1].any() and trained[True][0].response == trained[True][0].level_g == 0


def test_the_fit_of_the_light_can_be_cancelled():
    frames = lit_views(LAMP, [0.0, 0.3], [np.eye(4), look_at(np.array([0.02, 0, 0]), np.array([0, 0, 0.1]))])
    finished = []

    def cancel(stage, done, total):
        finished.extend([done] * (done == total))
        if len(finished) > 1:  # the first says that all views were looked at
            raise Cancelled

    with pytest.raises(Cancelled):
        fit_light(frames, wall().means.numpy().astype(np.float64), 0.1, 0.1, progress=StageProgress("photometry", cancel))


def test_without_two_views_of_a_point_the_prior_counts():
    theta, exposures, _ = fit_light(lit_views(LAMP, [0.3], [np.eye(4)]), wall().means.numpy().astype(np.float64), 0.1, 0.1)
    np.testing.assert_array_equal(theta, [0.9, 3.0, 0.0, 0.0])
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


def test_what_the_views_leave_open_is_taken_from_the_options():
    (view,) = lit_views(LAMP, [0.3], [np.eye(4)])
    points = wall().means.numpy().astype(np.float64)
    theta, *_ = fit_light([view], points, 0.1, 0.1, PhotometryConfig(distance=2.0, angle=1.0))
    np.testing.assert_array_equal(theta, [2, 1, 0, 0])
    one = np.zeros((1, 3)), np.zeros(1)
    assert fit_exposure(*one, PhotometryConfig(response=0.3))[0] == pytest.approx(0.3)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def test_hidden_and_masked_points_keep_their_colour(device):
    if device != "cpu" and not torch.cuda.is_available():
        pytest.skip("needs CUDA")
    (view,) = lit_views(LAMP, [0.0], [np.eye(4)])
    mask = np.full(view.image.shape[:2], 255, np.uint8)
    mask[:, :80] = 0
    model = dataclasses.replace(wall(), sh=torch.full_like(wall().sh, 7.0))
    behind = dataclasses.replace(model, means=model.means + torch.tensor([0.0, 0.0, 0.03]))
    seen = lambda model, view: unlit_colors(model.means.to(device), [view], np.zeros(4), np.zeros((1, 3)), 0.1, 0.05)
    unlit = lambda model, view: remove_light(model, seen(model, view))
    assert torch.equal(unlit(behind, view).sh, behind.sh)
    uv = view.camera.project(model.means.numpy().astype(np.float64))[0]
    changed = (unlit(model, dataclasses.replace(view, mask=mask)).sh != model.sh).flatten(1).any(1).numpy()
    inside = view.camera.sees(model.means.numpy().astype(np.float64))
    assert not changed[uv[:, 0] < 80].any() and changed[inside & (uv[:, 0] >= 80)].mean() > 0.95


def test_a_masked_view_is_drawn_with_the_exposure_that_it_was_learnt_with(views):
    half = np.zeros(views[0].image.shape[:2], np.uint8)
    half[:, : half.shape[1] // 2] = 255
    masked = [dataclasses.replace(view, mask=half) for view in views[::4]]
    config = options(iterations=40)
    trainer = Trainer(prepare(masked, config), config)
    trainer.run()
    exposures = trainer.appearance.tensors["exposures"].detach().numpy()
    renderer = DeformableRenderer(trainer.model, None, RenderingConfig(device="cpu", image_width=0))
    for view, exposure in zip(masked, exposures, strict=True):
        light = trainer.drift.at(trainer.light, view.stamp_ns)
        fixed = dataclasses.replace(light, response=0.0, **{f"level_{c}": float(e) for c, e in zip("rgb", exposure)})
        automatic, learnt = (renderer.render(view.camera, light=of)[0].astype(int) for of in (light, fixed))
        assert np.abs(automatic - learnt)[half > 0].mean() < 1
