"""Poses that are off by a little are put right by features; others stay."""

import logging
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from thorough import mostly_thorough

from endo_sim_ros.core.cameras import Camera, invert_pose, load_cameras, rigid_pose
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.tissue_motion import PeriodicMotion, TissueMotion
from endo_sim_ros.reconstruction import ReconstructionConfig, pipeline
from endo_sim_ros.reconstruction.bundle import Bundle, Tracks, shared_tracks
from endo_sim_ros.reconstruction.camera_errors import CameraErrors, displacement
from endo_sim_ros.reconstruction.from_bag import reconstruct_bag
from endo_sim_ros.reconstruction.pipeline import check_poses, correct_poses, find_points, match_views, select_usable
from endo_sim_ros.reconstruction.pose_correction import corrected_poses
from endo_sim_ros.reconstruction.progress import Cancelled, StageProgress
from endo_sim_ros.reconstruction.scene import Matches, PreparedScene, ScenePoints
from endo_sim_ros.reconstruction.stage_configs import PosesConfig
from endo_sim_ros.sequences.bag import write_bag
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

_BLACK = np.zeros((512, 640, 3), np.uint8)
K = np.array([[600.0, 0, 320], [0, 600, 256], [0, 0, 1]])


def off(camera: Camera, rng: np.random.Generator, turn: float = 0.3, place: float = 0.0006) -> Camera:
    """The camera turned (degrees) and moved (m) by as much in each direction, one standard deviation."""
    pose = camera.pose.copy()
    pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(np.radians(turn) * rng.standard_normal(3))[0]
    pose[:3, 3] += place * rng.standard_normal(3)
    return camera.at(pose)


def scene(rng, views: int = 6, points: int = 300, noise: float = 0.2, moving: float = 0.0, wrong: float = 0.0):
    """Cameras that go around points, and matches of each with the next two."""
    places = np.column_stack([rng.uniform(-0.04, 0.04, (points, 2)), rng.uniform(0.09, 0.13, points)])
    cameras, pixels = [], []
    for angle in np.linspace(-0.3, 0.3, views):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(np.array([0.05 * np.cos(7 * angle), angle, 0.1 * angle]))[0]
        pose[:3, 3] = np.array([0, 0, 0.11]) - pose[:3, :3] @ [0, 0, 0.11 + 0.01 * np.sin(9 * angle)]
        cameras.append(Camera(K, 640, 512, pose))
        # Folds that move against each other are no motion of a camera.
        there = places + moving * np.sin(80 * places[:, [1, 0, 0]]) * rng.standard_normal(3)
        pixels.append(cameras[-1].project(there)[0] + noise * rng.standard_normal((points, 2)))
        lost = rng.random(points) < wrong
        pixels[-1][lost] = rng.uniform(0, [640, 512], (lost.sum(), 2))
    pairs = [(i, j) for i in range(views) for j in range(i + 1, min(i + 3, views))]
    return cameras, [Matches(pair, pixels[pair[0]], pixels[pair[1]]) for pair in pairs]


def framed(cameras) -> list[Frame]:
    """Frames of the cameras, one each tenth of a second."""
    return [Frame(i * 100_000_000, _BLACK, camera) for i, camera in enumerate(cameras)]


def correct(cameras, matches, *options, **given):
    return corrected_poses(framed(cameras), matches, *options, **given)


def placed(cameras, found) -> list[Camera]:
    """The cameras where they were found to be."""
    return [found.errors.corrected(frame.camera, frame.stamp_ns) for frame in framed(cameras)]


def apart(cameras, others) -> tuple[float, float]:
    """How far poses differ when places, turns and scale of all agree: the largest turn (degrees), and distance as part of the spread."""
    here, there = (np.array([camera.position for camera in each]) for each in (cameras, others))
    here, there = here - here.mean(0), there - there.mean(0)
    turns = np.array([other.pose[:3, :3] @ camera.pose[:3, :3].T for camera, other in zip(cameras, others)])
    u, _, v = np.linalg.svd(turns.sum(0))  # the mean rotation
    mean = u @ v
    degrees = [np.degrees(np.linalg.norm(cv2.Rodrigues(mean.T @ turn)[0])) for turn in turns]
    moved = here @ mean.T
    scale = (moved * there).sum() / (moved**2).sum()
    spread = np.linalg.norm(there, axis=1).max()
    return max(degrees), float(np.linalg.norm(scale * moved - there, axis=1).max() / spread)


@pytest.mark.parametrize("views, wrong", [(3, 0.0), (6, 0.0), (6, 0.15)])
def test_poses_that_are_off_come_back(views, wrong):
    rng = np.random.default_rng(views)
    cameras, matches = scene(rng, views, wrong=wrong)
    given = [off(camera, rng) for camera in cameras]
    found = correct(given, matches)
    assert found is not None and found.before > 1.2 and found.after < 0.3 and found.distance == pytest.approx(0.11, rel=0.05)
    now = placed(given, found)
    (turned, moved), (was_turned, was_moved) = apart(cameras, now), apart(cameras, given)
    assert turned < 0.1 and turned < 0.3 * was_turned and moved < 0.3 * was_moved
    # Place, turn and scale of the whole are those of the poses that were given.
    middle = np.mean([camera.position for camera in now], 0)
    assert np.linalg.norm(middle - np.mean([camera.position for camera in given], 0)) < 3e-4


@pytest.mark.parametrize("turn", [5.0, 30.0])
@pytest.mark.parametrize("views", mostly_thorough([5, 9]))
def test_poses_that_are_all_off_alike_come_back(turn, views):
    """As where the lens sits elsewhere on the arm than a hand-eye calibration says; that also tells the poses of other views."""
    rng = np.random.default_rng(views)
    cameras, matches = scene(rng, views)
    mount = rigid_pose(cv2.Rodrigues(np.radians(turn) * np.array([0.48, 0.6, 0.64]))[0], [0.01, -0.015, 0.0])
    given = [camera.at(camera.pose @ mount) for camera in cameras]
    found = correct(given, matches)
    assert found is not None and found.after < 0.3 < 0.2 * found.before
    assert apart(cameras, placed(given, found))[0] < 0.1 and not len(found.errors.stamps_ns)
    other = cameras[0].at(rigid_pose(cv2.Rodrigues(np.array([0.0, 0.03, 0.2]))[0], [0.0, 0.01, 0.0]))
    there = found.errors.corrected(other.at(other.pose @ mount), 10**12)
    assert np.linalg.norm(cv2.Rodrigues(other.pose[:3, :3].T @ there.pose[:3, :3])[0]) < np.radians(0.15 * turn)
    assert np.linalg.norm(there.position - other.position) < 0.004
    with_more = correct(given, matches, PosesConfig(mount_views=views + 1))
    assert with_more is None or not with_more.errors.mount.any()


@pytest.mark.parametrize("seed", mostly_thorough(range(3)))
@pytest.mark.parametrize("views", [5, 12])
def test_poses_that_are_each_off_are_not_all_off_alike(views, seed):
    rng = np.random.default_rng(seed)
    cameras, matches = scene(rng, views)
    walk = np.cumsum(np.radians(0.15) * rng.standard_normal((views, 3)), 0)
    walked = [camera.at(camera.pose @ rigid_pose(cv2.Rodrigues(turn)[0], np.zeros(3))) for camera, turn in zip(cameras, walk)]
    for given in (walked, [off(camera, rng) for camera in cameras]):
        found = correct(given, matches)
        assert found is None or not found.errors.mount.any()


def test_views_that_err_each_by_itself_come_back_though_they_foresee_little_of_each_other():
    """A view that is left out has its own error, which is most of what is left where many others have each point."""
    rng = np.random.default_rng(3)
    cameras, matches = scene(rng, 24)
    given = [off(camera, rng) for camera in cameras]
    found = correct(given, matches)
    assert found is not None and apart(cameras, placed(given, found))[0] < 0.1 * apart(cameras, given)[0]
    with_less = correct(given, matches, PosesConfig(exact=0.0))  # nothing is exact: what views foresee decides
    assert with_less is None


def test_a_half_of_the_tissue_that_moves_as_one_is_no_error_of_the_poses():
    """Other poses would be a little more exact, and foresee left-out views worse."""
    rng = np.random.default_rng(2)
    places = np.column_stack([rng.uniform(-0.04, 0.04, (300, 2)), rng.uniform(0.09, 0.13, 300)])
    cameras, _ = scene(rng, 24)
    moves = places[:, 0] < 0
    pixels = [
        camera.project(places + moves[:, None] * rng.normal(0, 0.0005, 3))[0] + 0.2 * rng.standard_normal((300, 2)) for camera in cameras
    ]
    matches = [Matches((i, j), pixels[i], pixels[j]) for i in range(24) for j in range(i + 1, min(i + 3, 24))]
    assert correct(cameras, matches) is None


def test_the_order_of_the_views_does_not_matter():
    rng = np.random.default_rng(4)
    cameras, matches = scene(rng, 8)
    given = framed([off(camera, rng) for camera in cameras])
    turned = [Matches((7 - match.views[0], 7 - match.views[1]), match.first, match.second) for match in matches]
    found = corrected_poses(given[::-1], turned)
    assert found is not None
    there = [found.errors.corrected(frame.camera, frame.stamp_ns) for frame in given]
    assert apart(cameras, there)[0] < 0.2 * apart(cameras, [frame.camera for frame in given])[0]


def test_poses_that_are_right_stay():
    rng = np.random.default_rng(0)
    assert correct(*scene(rng, noise=0.5)) is None


@pytest.mark.parametrize("seed", range(3))
def test_poses_stay_where_tissue_that_moves_is_what_is_off(seed, caplog):
    """Other poses would take a part of it, but foresee no view that is left out."""
    rng = np.random.default_rng(seed)
    with caplog.at_level(logging.INFO):
        assert correct(*scene(rng, moving=0.001)) is None
    assert "poses stay, though features lie" in caplog.text, "they are off by more than right poses are"


def test_poses_of_a_lens_that_stands_still_stay():
    """Whatever moves before it is tissue."""
    rng = np.random.default_rng(0)
    cameras, matches = scene(rng)
    assert correct([cameras[0]] * len(cameras), matches) is None


def test_a_view_that_shares_nothing_keeps_its_pose():
    rng = np.random.default_rng(1)
    cameras, matches = scene(rng)
    given = [off(camera, rng) for camera in cameras] + [cameras[0]]
    found = correct(given, matches)
    assert found is not None
    np.testing.assert_allclose(found.errors.changes[-1], 0, atol=1e-12)


def test_too_few_features_correct_nothing(caplog):
    rng = np.random.default_rng(1)
    cameras, matches = scene(rng, points=20)
    given = [off(camera, rng) for camera in cameras]
    with caplog.at_level(logging.INFO):
        assert correct(given, matches) is None and correct(given, []) is None and correct(given[:1], []) is None
    assert [record.message for record in caplog.records] == [
        "whether poses are off cannot be told: three views or more share 0 features in front of them"
    ] * 2


def test_derivatives_are_those_of_finite_differences():
    rng = np.random.default_rng(2)
    cameras, matches = scene(rng, 3, 40)
    tracks = shared_tracks(matches, 3, 200, StageProgress())
    bundle = Bundle(cameras, tracks._replace(beside=0.005 * rng.integers(0, 2, len(tracks.views))), PosesConfig(), 2.0)
    changes = np.zeros((3, 6))
    changes[:, 3:] = rng.standard_normal((3, 3))  # of turns the derivatives are those at none
    at, local, R = bundle._seen(changes, bundle.points)
    by_pose, by_point = bundle._derivatives(changes, local, R)
    step = 1e-6
    for k in range(6):
        moved = bundle._seen(changes + step * np.eye(6)[k], bundle.points)[0]
        np.testing.assert_allclose(by_pose[..., k], (moved - at) / step, rtol=1e-3, atol=1e-2)
    for k in range(3):
        moved = bundle._seen(changes, bundle.points + step * np.eye(3)[k])[0]
        np.testing.assert_allclose(by_point[..., k], (moved - at) / step, rtol=1e-3, atol=1)


def test_right_eyes_tell_how_far_all_poses_are_off_along_the_axis():
    """Of lenses that go round what they look at, left eyes alone hardly tell it: all is nearer and smaller then."""
    rng = np.random.default_rng(4)
    cameras, _ = scene(rng, 6, 10)
    points = rng.uniform([-0.02, -0.02, 0.08], [0.02, 0.02, 0.12], (200, 3))
    wrong = rigid_pose(np.eye(3), np.array([0, 0, 0.005]))
    round_it = [
        cameras[0].at(rigid_pose(R, np.array([0, 0, 0.1]) - R @ [0, 0, 0.1]))
        for R in (cv2.Rodrigues(turn)[0] for turn in rng.normal(0, 0.1, (8, 3)))
    ]
    left, right = (np.array([eye.project(points)[0] for eye in eyes]) for eyes in (round_it, [eye.beside(0.005) for eye in round_it]))
    views, numbers = (each.ravel() for each in np.mgrid[:8, :200])
    noisy = lambda uv: (uv + rng.normal(0, 0.3, uv.shape)).reshape(-1, 2)
    one = Tracks(views, noisy(left), numbers)
    both = Tracks(*(np.concatenate(each) for each in zip(one[:3], (views, noisy(right), numbers))), np.repeat([0, 0.005], len(views)))
    off = []
    for tracks in (one, both):
        bundle = Bundle([eye.at(eye.pose @ wrong) for eye in round_it], tracks, PosesConfig(), 2.0)
        off.append(np.abs((wrong @ displacement(bundle.alike(StageProgress())[0] * bundle.likely))[2, 3]))
    assert off[1] < min(0.001, off[0])


def test_the_least_is_that_of_another_solver():
    rng = np.random.default_rng(3)
    cameras, matches = scene(rng, 3, 60)
    given = [off(camera, rng) for camera in cameras]
    bundle = Bundle(given, shared_tracks(matches, 3, 200, StageProgress()), PosesConfig(), 2.0)
    changes, points = bundle.adjusted(np.zeros((3, 6)), bundle.points, True, StageProgress())

    def residuals(values):
        tried, there = values[:18].reshape(3, 6), values[18:].reshape(-1, 3)
        squares = (bundle._seen(tried, there)[0] ** 2).sum(1)
        return np.concatenate([2.0 * np.sqrt(np.log1p(squares / 4.0)), tried.ravel()])

    best = least_squares(residuals, np.concatenate([changes.ravel(), points.ravel()]), x_scale="jac")
    ours = (residuals(np.concatenate([changes.ravel(), points.ravel()])) ** 2).sum()
    assert ours == pytest.approx(2 * best.cost, rel=1e-3)
    np.testing.assert_allclose(changes * bundle.likely, best.x[:18].reshape(3, 6) * bundle.likely, atol=1e-4)


def test_a_feature_that_a_view_has_twice_is_no_track():
    uv = np.arange(12.0).reshape(6, 2)
    chain = [Matches((0, 1), uv[:3], uv[:3]), Matches((1, 2), uv[:2], uv[3:5]), Matches((0, 2), uv[1:2], uv[5:])]
    views, pixels, points, _ = shared_tracks(chain, 3, 200, StageProgress())
    found = {tuple(sorted(zip(views[points == k].tolist(), map(tuple, pixels[points == k].tolist())))) for k in range(points.max() + 1)}
    assert found == {
        ((0, (0.0, 1.0)), (1, (0.0, 1.0)), (2, (6.0, 7.0))),  # the second is (8, 9) and (10, 11) in the third view
        ((0, (4.0, 5.0)), (1, (4.0, 5.0))),
    }


def test_it_can_be_cancelled():
    rng = np.random.default_rng(4)
    cameras, matches = scene(rng)
    calls = []

    def cancel(*_):
        calls.append(1)
        if len(calls) > 10:  # nine pairs, and then steps
            raise Cancelled

    with pytest.raises(Cancelled):
        correct([off(camera, rng) for camera in cameras], matches, progress=StageProgress("correcting poses", cancel))


def test_cameras_in_between_are_corrected_where_poses_go_off_gradually():
    rng = np.random.default_rng(6)
    cameras, matches = scene(rng, 9)
    gradually = lambda i: cameras[i].at(cameras[i].pose @ rigid_pose(cv2.Rodrigues(0.01 * np.sin(i / 2 + np.arange(3)))[0], np.zeros(3)))
    found = correct([gradually(i) for i in range(9)], matches)
    assert found is not None and found.errors.gradual
    at_once = correct([off(camera, rng) for camera in cameras], matches)
    assert at_once is not None and not at_once.errors.gradual
    np.testing.assert_array_equal(at_once.errors.corrected(cameras[0], 50_000_000).pose, cameras[0].pose)
    # Halfway between two views a camera is off by what they are in the mean.
    between = found.errors.corrected(cameras[0], 250_000_000)
    change = found.errors.changes[2:4].mean(0)
    point = np.array([0.01, 0.02, 0.1])
    there = (between.viewmat @ cameras[0].pose @ [*point, 1])[:3]
    np.testing.assert_allclose(there, cv2.Rodrigues(change[:3])[0] @ point + change[3:], atol=1e-9)
    np.testing.assert_array_equal(CameraErrors().corrected(cameras[0], 3).pose, cameras[0].pose)


def test_poses_of_two_views_stay():
    """Any breath of the tissue would be a motion of the camera."""
    rng = np.random.default_rng(7)
    cameras, matches = scene(rng, 2)
    assert correct([off(camera, rng) for camera in cameras], matches) is None


def test_what_is_off_by_more_than_a_robot_stays():
    rng = np.random.default_rng(8)
    cameras, matches = scene(rng, 6)
    given = [off(camera, rng, 1.0, 0.002) for camera in cameras]
    assert correct(given, matches) is not None
    assert correct(given, matches, PosesConfig(turn_error=0.1, place_error=0.002)) is None


def test_a_view_has_no_more_tracks_than_asked_for_where_others_have_enough():
    rng = np.random.default_rng(9)
    _, matches = scene(rng, 4)
    for most in (50, 300):
        views, _, points, _ = shared_tracks(matches, 4, most, StageProgress())
        assert np.bincount(views).tolist() == [most] * 4 and points.max() == most - 1


@pytest.fixture(scope="module")
def frames():
    return list(phantom_sequence(PhantomConfig(frames=5, width=320, height=256, rounds=0.3)))


def stages(frames, **options):
    config, progress = ReconstructionConfig.from_mapping({"device": "cpu"} | options), StageProgress()
    made_up = ScenePoints(np.zeros((1, 3)), np.zeros((1, 3)))
    found = PreparedScene(tuple(frames), points=made_up, given_points=True)
    for stage in (select_usable, match_views, correct_poses, check_poses, find_points):
        found = stage(found, config, progress)
    return found


@pytest.mark.slow
def test_a_preparation_corrects_poses_and_triangulates_points_with_these(frames, caplog):
    rng = np.random.default_rng(5)
    given = [replace(frame, camera=off(frame.camera, rng, 0.5, 0.001)) for frame in frames]
    with caplog.at_level(logging.WARNING):
        found = stages(given)
    assert "POSES ARE OFF, or all the tissue moves: features lie" in caplog.text and any(
        "POSES ARE OFF" in each for each in found.decisions
    )
    true, before = [frame.camera for frame in frames], [frame.camera for frame in given]
    now = [frame.camera for frame in found.frames]
    assert [view.camera for view in found.views] == now
    assert apart(true, now)[0] < 0.3 * apart(true, before)[0]
    assert len(found.points.positions) > 100 and not found.given_points


@pytest.mark.thorough
@pytest.mark.slow
def test_the_cameras_beside_a_model_are_those_that_it_was_trained_with(frames, tmp_path):
    rng = np.random.default_rng(5)
    given = [replace(frame, camera=off(frame.camera, rng, 0.5, 0.001)) for frame in frames]
    write_bag(tmp_path / "bag", given)
    config = ReconstructionConfig(device="cpu", iterations=1, max_gaussians=500, image_width=80, watch_motion=False, reflections=False)
    trainer, _ = reconstruct_bag(tmp_path / "bag", tmp_path, config)
    saved = [camera.pose for camera in load_cameras(tmp_path / "cameras.json")]
    np.testing.assert_allclose(saved, [camera.pose for camera in trainer.cameras], atol=1e-6)
    assert all(np.abs(pose - frame.camera.pose).max() > 1e-4 for pose, frame in zip(saved, given))


@pytest.mark.slow
@pytest.mark.parametrize("turn, options", [(0.5, {"poses.correct": False}), (0.0, {})])
def test_a_preparation_leaves_poses_that_are_right_or_are_to_stay(frames, turn, options):
    rng = np.random.default_rng(5)
    given = [replace(frame, camera=off(frame.camera, rng, turn, 0.002 * turn)) for frame in frames]
    found = stages(given, **options)
    assert all(now.camera is frame.camera for now, frame in zip(found.frames, given)) and found.given_points


@pytest.mark.slow
@pytest.mark.parametrize("told", mostly_thorough([True, False]))
def test_poses_by_which_a_motion_was_told_are_taken_until_features_tell_better_ones(frames, told, caplog):
    """Of too few views they tell none."""
    wrong = rigid_pose(cv2.Rodrigues(np.radians([5.0, -4.0, 6.0]))[0], np.array([0.002, 0.003, -0.001]))
    nearly = rigid_pose(cv2.Rodrigues(np.radians([0.5, 0.5, 0.5]))[0], np.array([0.001, 0.0, 0.001]))
    given = [replace(frame, right=None, baseline=None, camera=frame.camera.at(frame.camera.pose @ wrong)) for frame in frames]
    points = np.concatenate([frame.camera.backproject(frame.depth)[::40, ::40].reshape(-1, 3) for frame in frames])
    breath = PeriodicMotion("breathing", 4.0, 1.0, 9.0, 1e-7 * np.eye(6)[:, :3], np.ones(len(points)))  # too little to be seen
    motion = TissueMotion(given[0].stamp_ns * 1e-9, points, (breath,), lens=invert_pose(wrong) @ nearly)
    config = {"device": "cpu", "image_width": 80, "iterations": 1, "max_gaussians": 300, "reflections": False}
    config["poses.mount_views"] = 3 if told else 100
    found = pipeline.prepare(given, ReconstructionConfig.from_mapping(config), motion=motion)
    now = [found.camera_errors.corrected(frame.camera, frame.stamp_ns) for frame in given]
    left = [invert_pose(frame.camera.pose) @ camera.pose for frame, camera in zip(frames, now)]
    turned = max(np.degrees(np.linalg.norm(cv2.Rodrigues(pose[:3, :3])[0])) for pose in left)
    assert turned < 0.6 if told else turned == pytest.approx(0.87, abs=0.01)
    np.testing.assert_allclose([view.camera.pose for view in found.views], [camera.pose for camera in now])
    assert ("POSES ARE OFF" if told else "POSES ARE ALL OFF alike") in caplog.text
    found = pipeline.prepare(given, ReconstructionConfig.from_mapping(config | {"poses.correct": False}), motion=motion)
    np.testing.assert_array_equal([view.camera.pose for view in found.views], [frame.camera.pose for frame in given])
    assert not found.camera_errors.mount.any()


@pytest.mark.thorough
@pytest.mark.slow
def test_depth_that_views_of_moving_tissue_tell_together_is_of_corrected_poses():
    frames = list(phantom_sequence(PhantomConfig(seed=1, frames=6, width=160, height=128)))
    rng = np.random.default_rng(1)
    given = [replace(frame, depth=None, camera=off(frame.camera, rng)) for frame in frames]
    points = np.concatenate([frame.camera.backproject(frame.depth)[::40, ::40].reshape(-1, 3) for frame in frames])
    breath = PeriodicMotion("breathing", 4.0, 1.0, 9.0, 1e-7 * np.eye(6)[:, :3], np.ones(len(points)))  # too little to be seen
    motion = TissueMotion(given[0].stamp_ns * 1e-9, points, (breath,))
    config, progress = ReconstructionConfig.from_mapping({"device": "cpu", "image_width": 160}), StageProgress()
    before = pipeline._stilled(PreparedScene(tuple(given), motion=motion), motion, config, progress)
    after = correct_poses(match_views(before, config, progress), config, progress)

    def error(scene: PreparedScene) -> float:
        pairs = [(frame.depth, scene.recorded[frame.stamp_ns].depth_prior) for frame in frames]
        return float(np.sqrt(np.mean(np.concatenate([(prior - true)[(prior > 0) & (true > 0)] ** 2 for true, prior in pairs]))))

    assert len(after.camera_errors.stamps_ns) == len(frames)
    assert error(after) < 0.6 * error(before)
    assert all(view.right is None for view in after.recorded.values()) and all(frame.right is not None for frame in after.frames)
