"""Where reconstruction breaks: a result or one clear error."""

import dataclasses

import cv2
import numpy as np
import pytest
from short_training import bare, film, finite, options
from thorough import mostly_thorough
from trained import trainer_of

from endo_sim_ros.core.cameras import rigid_pose
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.evaluation import metrics
from endo_sim_ros.reconstruction import Trainer, prepare
from endo_sim_ros.reconstruction.keyframes import USUAL_DEPTH
from endo_sim_ros.reconstruction.pipeline import find_points, place_gaussians
from endo_sim_ros.reconstruction.priors.stereo import right_view
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import PreparedScene, ScenePoints, TrainingView
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig


def test_no_views_is_one_clear_error():
    with pytest.raises(SequenceError, match="no views"):
        trainer_of([], options())


@pytest.mark.slow
def test_one_view_is_enough_with_depth(small):
    assert finite(trainer_of([small[0]], options()).run())


@pytest.mark.slow
def test_identical_views_train(small, caplog):
    assert finite(trainer_of([small[0]] * 3, options()).run())
    assert "contradict what they see" not in caplog.text


@pytest.mark.slow
def test_masking_everything_is_an_error(small):
    hidden = dataclasses.replace(small[0], mask=np.zeros_like(small[0].mask))
    with pytest.raises(SequenceError, match="masked"):
        trainer_of([hidden], options())
    assert finite(trainer_of([small[4], hidden], options()).run())  # one of them is no obstacle


@pytest.mark.slow
def test_depth_with_holes_trains(small):
    depth = small[0].depth.copy()
    depth[:, :60], depth[:40] = np.nan, 0
    empty = dataclasses.replace(small[4], depth=np.zeros_like(depth))
    assert finite(trainer_of([dataclasses.replace(small[0], depth=depth), empty], options()).run())


@pytest.mark.thorough
@pytest.mark.slow
def test_a_view_without_depth_of_its_own_gets_that_of_the_others(large):
    views = [dataclasses.replace(frame, depth=None) for frame in large[:3]]
    views[1] = bare(views[1])  # its right image is lost
    scene = prepare(views, options(image_width=160, extrapolation=0.0))
    prior = scene.views[1].depth_prior
    known = prior > 0
    assert known.mean() > 0.5 and np.median(np.abs(prior / cv2.resize(large[1].depth, prior.shape[::-1]) - 1)[known]) < 0.02
    assert any("depth of the other views is taken where a view has none" in decision for decision in scene.decisions)


@pytest.mark.slow
def test_a_handful_of_points_starts_from_a_plane(small):
    frame = small[4]
    v, u = np.mgrid[20:110:30, 20:140:40].reshape(2, -1)
    points = frame.camera.backproject(frame.depth)[v, u]
    blank = np.full_like(frame.image, 128)  # nothing of it can be matched
    scene = prepare(
        [bare(small[i], image=blank) for i in (0, 8)], options().replaced({"views.even": 0}), (points, np.full_like(points, 0.5))
    )
    assert len(scene.model) > 500
    assert "from a plane" in "".join(scene.decisions)
    depths = np.concatenate([small[i].camera.project(scene.model.means.numpy().astype(float))[1] for i in (0, 8)])
    assert np.median(depths) == pytest.approx(np.median(frame.camera.project(points)[1]), rel=0.1)


def test_poses_in_another_unit_are_told(small):
    frame = small[4]
    v, u = np.mgrid[20:110:30, 20:140:40].reshape(2, -1)
    points = frame.camera.backproject(frame.depth)[v, u]
    camera = small[0].camera
    for scale, told in ((1.0, ""), (1000.0, "may be in millimetres"), (0.01, "nothing nearer than 1 mm is drawn")):
        pose = camera.pose.copy()
        pose[:3, 3] *= scale
        view = TrainingView.of(dataclasses.replace(bare(small[0]), camera=camera.at(pose)))
        given = ScenePoints(scale * points, np.full_like(points, 0.5), np.full(len(points), 0.01))
        found = find_points(PreparedScene((), (view,), given, given_points=True), options(), StageProgress())
        assert [told in text for text in found.decisions if "SCENE POINTS ARE" in text] == [True] * bool(told)
        surface = np.full(view.image.shape[:2], 0.1 * scale, np.float32)
        smooth = PreparedScene((), (dataclasses.replace(view, depth_prior=surface),), max_gaussians=2000)  # which shows no points
        assert any("THE TISSUE IS" in text for text in place_gaussians(smooth, options(), StageProgress()).decisions) == bool(told)


def from_guess(frames, **changes):
    """How much better than black ones (dB) the pictures of a short training are that has neither depth nor points; its plane's depth."""
    scene = prepare(frames, config := options(**changes))
    told = "".join(scene.decisions)
    assert "NO DEPTH IS KNOWN" in told and len(scene.model) > 500
    assert ("check the poses" in told or "the lens only turns" in told) == ("not compared with none" in told) == (len(frames) > 1)
    renderer = DeformableRenderer(model := Trainer(scene, config).run(), None, RenderingConfig(device="cpu"))
    gains = []
    for frame in frames:
        psnr = lambda image, frame=frame: metrics.psnr(image, frame.image, frame.mask)
        gains.append(psnr(renderer.render(frame.camera, light=model.light)[0]) - psnr(np.zeros_like(frame.image)))
    return min(gains), scene.depth


@pytest.mark.slow
def test_one_view_without_any_depth_trains(small):
    for depth in (None, np.zeros_like(small[0].depth)):
        gain, depth = from_guess([bare(small[0], depth=depth)])
        assert gain > 15 and depth == pytest.approx(USUAL_DEPTH, rel=0.01)


def test_a_lens_that_only_turns_starts_from_one_ball(small):
    turned = [rigid_pose(cv2.Rodrigues(np.array([0.0, angle, 0.1 * angle]))[0], [0.1, 0.2, 0.3]) for angle in (0.0, 0.3, 0.6)]
    blank, config = np.full_like(small[0].image, 128), options(extrapolation=0.0).replaced({"views.even": 0})
    scene = prepare([bare(small[0], image=blank, camera=small[0].camera.at(pose)) for pose in turned], config)
    assert "the lens only turns. Training starts from a ball of 0.1 m about it" in "".join(scene.decisions)
    np.testing.assert_allclose(np.linalg.norm(scene.model.means.numpy() - [0.1, 0.2, 0.3], axis=1), 0.1, rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{}, {"depth": "none"}, {"initialization": "points"}], ids=["default", "no prior", "points"])
@pytest.mark.parametrize("unit", mostly_thorough([1000.0, 1.0]))
def test_views_that_share_no_point_train_from_a_plane_in_the_unit_of_their_poses(small, unit, changes):
    views = []
    for frame in (small[0], small[4]):
        pose = frame.camera.pose.copy()
        pose[:3, 3] *= unit
        views.append(bare(frame, image=cv2.GaussianBlur(frame.image, (0, 0), 6), camera=frame.camera.at(pose)))
    gain, depth = from_guess(views, plane_sweep=False, **changes)
    assert gain > 15 and 0.3 < depth / unit / np.median(small[0].depth) < 3


@pytest.mark.slow
def test_too_few_points_give_way_to_the_depth_of_the_views(small):
    scene = prepare([small[0]], options(initialization="points"))
    assert "only 0 scene points could be found: training starts from the depth of the views" in "".join(scene.decisions)
    assert scene.depth == pytest.approx(np.median(small[0].depth), rel=0.1)


@pytest.mark.slow
def test_views_that_face_away_from_each_other_train(small):
    away = small[4].camera.pose @ np.diag([-1.0, 1, -1, 1])
    other = dataclasses.replace(small[4], camera=small[4].camera.at(away))
    assert finite(trainer_of([small[0], other], options()).run())


@pytest.mark.thorough
@pytest.mark.slow
def test_points_alone_are_enough(large):
    model = trainer_of([bare(frame) for frame in large[:3]], options(image_width=160)).run()
    assert finite(model)
    assert len(model) > 100


@pytest.mark.slow
def test_odd_sizes_train():
    frames = film(161, 97, 3)
    model = trainer_of(list(frames[::2]), options(image_width=75)).run()
    assert finite(model)


@pytest.mark.thorough
@pytest.mark.slow
def test_the_right_image_is_a_view_of_the_same_scene(views):
    frame = views[4]
    right = right_view(frame)
    model = trainer_of(views, options(iterations=40, max_gaussians=8000, extrapolation=0.0, learning_rate=1.0)).run()
    image, _ = DeformableRenderer(model, None, RenderingConfig(device="cpu")).render(right.camera)
    wrong, _ = DeformableRenderer(model, None, RenderingConfig(device="cpu")).render(frame.camera)
    assert metrics.psnr(image, right.image, right.mask) > metrics.psnr(wrong, right.image, right.mask) + 3


@pytest.mark.slow
def test_pure_rotation_trains_with_depth_and_without(views):
    turned = []
    for frame, angle in ((views[0], 0.0), (views[0], 0.04)):
        pose = frame.camera.pose.copy()
        pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0]
        H = frame.camera.K @ pose[:3, :3].T @ frame.camera.pose[:3, :3] @ np.linalg.inv(frame.camera.K)
        warp = lambda image, H=H: cv2.warpPerspective(image, H, (160, 128))
        images = {name: warp(getattr(frame, name)) for name in ("image", "mask", "depth")}
        turned.append(dataclasses.replace(frame, right=None, camera=frame.camera.at(pose), **images))
    assert finite(trainer_of(turned, options()).run())
    gain, depth = from_guess([bare(frame) for frame in turned])
    assert gain > 15 and depth == pytest.approx(USUAL_DEPTH, rel=0.1)  # on a ball


@pytest.mark.slow
@pytest.mark.parametrize("reason, change", {
    "overexposed": lambda frame: {"image": np.full_like(frame.image, 255)},
    "black": lambda frame: {"image": np.zeros_like(frame.image)},
    "masked": lambda frame: {"mask": np.zeros_like(frame.mask)},
}.items())  # fmt: skip
def test_a_view_that_shows_nothing_is_left_out(views, caplog, reason, change):
    blind = dataclasses.replace(views[4], **change(views[4]))
    trainer = trainer_of([views[0], blind, views[8]], options())
    assert len(trainer.cameras) == 2 and f"left out: {reason}" in caplog.text
    with pytest.raises(SequenceError, match=f"every (view|pixel of every view) is {reason}"):
        trainer_of([blind], options())


@pytest.mark.parametrize(
    "positions, error, said",
    [
        (np.full((9, 3), np.nan), 0.01, "not finite"),
        (np.ones((9, 3)), np.zeros(9), "above zero"),
        (np.ones((9, 3)), np.full(9, np.nan), "above zero"),
        (np.ones((9, 2)), 0.01, r"arrays \[N, 3\]"),
    ],
)
def test_scene_points_that_are_none_are_refused(large, positions, error, said):
    with pytest.raises(SequenceError, match=said):
        trainer_of(list(large[:1]), options(iterations=1), (positions, np.ones((len(positions), positions.shape[1])), error))
