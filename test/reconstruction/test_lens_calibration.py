"""A lens that is not as recorded is found by features, and pictures are straightened; nothing else passes for one."""

import logging
from dataclasses import astuple, replace

import cv2
import numpy as np
import pytest
from thorough import mostly_thorough

from endo_sim_ros.core.cameras import Camera, rigid_pose
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.tissue_motion import PeriodicMotion, TissueMotion
from endo_sim_ros.reconstruction import ReconstructionConfig
from endo_sim_ros.reconstruction.camera_errors import LensError
from endo_sim_ros.reconstruction.lens_calibration import calibrated_lens
from endo_sim_ros.reconstruction.pipeline import calibrate_lens, correct_poses, find_points, match_views, select_usable
from endo_sim_ros.reconstruction.progress import Cancelled, StageProgress
from endo_sim_ros.reconstruction.scene import Matches, PreparedScene, ScenePoints
from endo_sim_ros.reconstruction.stage_configs import LensConfig
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

K = np.array([[600.0, 0, 320], [0, 600, 256], [0, 0, 1]])
CAMERA = Camera(K, 640, 512)
_BLACK = np.zeros((512, 640, 3), np.uint8)
WRONG = [LensError(1.2), LensError(0.8), LensError(1.0, -0.3), LensError(1.0, 0.4), LensError(1.1, -0.2)]
ASIDE = [LensError(right=0.08, down=-0.05), LensError(1.2, right=0.08, down=-0.05), LensError(1.15, -0.2, right=0.06, down=0.06)]
NOT_SQUARE = [LensError(aspect=0.92), LensError(1.1, aspect=1.08, right=-0.05)]


def lenses(wrong):
    return pytest.mark.parametrize("lens", wrong, ids=lambda lens: ", ".join(map(str, astuple(lens))))


def rendered(frame: Frame, lens: LensError, shorter: float = 0.8) -> Frame:
    """The frame as a camera with this lens records it, that takes its focal length to be so many times as long as that of the frame.

    Independent of how pictures are straightened: each pixel of the recorded picture takes what its ray meets in the true one.
    """

    def through(K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        recorded = K / np.array([[lens.focal * shorter], [lens.focal * lens.aspect * shorter], [1.0]])
        recorded[:2, 2] = K[:2, 2] - np.array([lens.right, lens.down]) * recorded.diagonal()[:2]
        v, u = np.mgrid[: frame.camera.height, : frame.camera.width] + 0.5
        x, y = shorter * (u - K[0, 2]) / K[0, 0], shorter * (v - K[1, 2]) / K[1, 1]
        scale = 1 / (1 + lens.division * (x**2 + y**2))
        at = np.stack([x * scale * K[0, 0] + K[0, 2] - 0.5, y * scale * K[1, 1] + K[1, 2] - 0.5], -1)
        return recorded, at.astype(np.float32)

    recorded, at = through(frame.camera.K)
    seen = {"image": cv2.remap(frame.image, at, None, cv2.INTER_CUBIC), "camera": replace(frame.camera, K=recorded)}
    inside = np.full(frame.image.shape[:2], 255, np.uint8) if frame.mask is None else frame.mask
    seen["mask"] = cv2.remap(inside, at, None, cv2.INTER_NEAREST)
    if frame.depth is not None:
        seen["depth"] = cv2.remap(frame.depth, at, None, cv2.INTER_NEAREST)
    if frame.right is not None:
        seen["right_K"], beside = through(frame.right_intrinsics)
        seen["right"] = cv2.remap(frame.right, beside, None, cv2.INTER_CUBIC)
    return replace(frame, **seen)


def rotated(degrees: float, *axis: float) -> np.ndarray:
    """A pose at the origin, turned about an axis of length 1."""
    return rigid_pose(cv2.Rodrigues(np.radians(degrees) * np.array(axis))[0], np.zeros(3))


def features(
    rng,
    lens: LensError,
    views: int = 8,
    noise: float = 0.2,
    turned: float = 0.0,
    moving: float = 0.0,
    sideways: bool = False,
    rolled: float = 0.1,
    mounted: np.ndarray = np.eye(4),
):
    """Cameras around or before points, with the recorded lens, and what each pair of near views shares by the lens as it is."""
    places = np.column_stack([rng.uniform(-0.04, 0.04, (400, 2)), rng.uniform(0.09, 0.13, 400)])
    cameras, pixels = [], []
    for angle in np.linspace(-0.3, 0.3, views):
        pose = np.eye(4)
        if sideways:
            pose[:3, 3] = 0.07 * angle, 0.003 * np.sin(10 * angle), 0
        else:
            pose[:3, :3] = cv2.Rodrigues(np.array([0.05 * np.cos(7 * angle), angle, rolled * angle]))[0]
            pose[:3, 3] = np.array([0, 0, 0.11]) - pose[:3, :3] @ [0, 0, 0.11 + 0.01 * np.sin(9 * angle)]
        here = places + moving * np.sin(80 * places[:, [1, 0, 0]]) * rng.standard_normal(3)
        local = here @ np.linalg.inv(pose)[:3, :3].T + np.linalg.inv(pose)[:3, 3]
        rays = local[:, :2] / local[:, 2:]
        distorted = rays.copy()
        for _ in range(50):  # s = d / (1 + division |d|²), by d
            distorted = rays * (1 + lens.division * (distorted**2).sum(1, keepdims=True))
        slopes = distorted * [lens.focal, lens.focal * lens.aspect] + [lens.right, lens.down]
        pixels.append(slopes * K.diagonal()[:2] + K[:2, 2] + noise * rng.standard_normal((400, 2)))
        pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(np.radians(turned) * rng.standard_normal(3))[0]
        cameras.append(Camera(K, 640, 512, pose @ mounted))
    within = [((uv > 0) & (uv < [640, 512])).all(1) for uv in pixels]
    frames = [Frame(i * 100_000_000, _BLACK, camera) for i, camera in enumerate(cameras)]
    pairs = [(i, j) for i in range(views) for j in range(i + 1, min(i + 3, views))]
    return frames, [Matches((i, j), pixels[i][within[i] & within[j]], pixels[j][within[i] & within[j]]) for i, j in pairs]


@lenses([*WRONG, LensError(1.0, -0.8), *ASIDE, *NOT_SQUARE])
def test_rays_and_pictures_are_of_one_lens(lens):
    """A straightened picture that shows its own rays shows those of the recorded one."""
    rays = lens.rays(CAMERA.rays()[..., :2])
    depth = rays[..., 0].astype(np.float32)  # of each pixel, its ray to the right
    frame = lens.straight(Frame(0, _BLACK, CAMERA, depth=depth + 2))
    seen = (frame.mask if frame.mask is not None else np.ones((512, 640), np.uint8)) > 0
    np.testing.assert_allclose(frame.depth[seen] - 2, frame.camera.rays()[..., 0][seen], atol=2.0 / 600)
    assert seen.mean() > 0.5 and (frame.mask is None) == (lens.division == 0)


@lenses([*WRONG, *ASIDE, *NOT_SQUARE])
def test_a_straightened_picture_shows_all_of_the_recorded_one_and_is_recorded_again(lens):
    v, u = np.mgrid[:512, :640]
    image = np.stack([127 + 100 * np.sin(u / 20), 127 + 100 * np.cos(v / 25), 127 + 100 * np.sin((u + v) / 30)], -1).astype(np.uint8)
    depth = (0.1 + u * 1e-4 + v * 5e-5).astype(np.float32)
    frame = lens.straight(Frame(0, image, CAMERA, depth=depth))
    again, its_depth = lens.as_recorded(CAMERA, frame.image, frame.depth)
    inner = np.s_[8:-8, 8:-8]
    assert np.abs(again[inner].astype(int) - image[inner]).mean() < 1.0
    np.testing.assert_allclose(its_depth[inner], depth[inner], atol=4e-4)
    assert again.shape == image.shape and frame.image.shape == image.shape


@lenses([*WRONG, LensError(1.1, -0.2, 0.95, 0.05, -0.03)])
def test_coefficients_are_those_with_which_opencv_distorts_alike(lens):
    k1, k2 = lens.coefficients(CAMERA)
    rays = lens.rays(CAMERA.rays()[::16, ::16, :2]).reshape(-1, 2)
    theirs, _ = cv2.projectPoints(
        np.column_stack([rays, np.ones(len(rays))]),
        np.zeros(3),
        np.zeros(3),
        np.diag([lens.focal * K[0, 0], lens.focal * lens.aspect * K[1, 1], 1.0]),
        np.array([k1, k2, 0, 0]),
    )
    ours = ((CAMERA.rays()[::16, ::16, :2] - [lens.right, lens.down]) * K.diagonal()[:2]).reshape(-1, 2)
    assert np.linalg.norm(theirs[:, 0] - ours, axis=1).max() < 1.5


def test_pictures_of_the_right_eye_are_straightened_about_its_own_principal_point():
    right_K = K + np.array([[0, 0, 40.0], [0, 0, 0], [0, 0, 0]])
    lens = LensError(1.05, -0.3, right=0.03)
    level = lambda middle: np.repeat(
        np.repeat(np.clip(np.abs(np.arange(640) + 0.5 - middle) / 2, 0, 255)[None, :, None], 512, 0), 3, 2
    ).astype(np.uint8)
    frame = lens.straight(Frame(0, level(320), CAMERA, right=level(360), baseline=0.005, right_K=right_K))
    assert frame.right is not None and frame.right_K is not None
    np.testing.assert_allclose(frame.right_K[:2, 2], right_K[:2, 2] + [0.03 * 600, 0])
    np.testing.assert_allclose(frame.right_K[0, 0], frame.camera.K[0, 0])
    # Both see one level at one slope.
    np.testing.assert_allclose(frame.right[100, 240:600, 0], frame.image[100, 200:560, 0], atol=1)


CASES = [(n, lens) for n in (8, 4, 12) for lens in WRONG + ASIDE * (n > 4)]


@pytest.mark.parametrize("views, lens", mostly_thorough(reversed(CASES), 4), ids=str)
def test_a_wrong_lens_is_found(views, lens):
    found = calibrated_lens(*features(np.random.default_rng(views), lens, views))
    assert found is not None and found.after < 0.6 * found.before
    assert found.error.focal == pytest.approx(lens.focal, rel=0.015)
    assert found.error.division == pytest.approx(lens.division, abs=0.05)
    assert [found.error.right, found.error.down] == pytest.approx([lens.right, lens.down], abs=0.003)


@pytest.mark.parametrize("seed", mostly_thorough(range(6)))
@pytest.mark.parametrize("views", [3, 4])
def test_of_few_views_of_a_breath_no_principal_point_is_told(views, seed):
    frames, matches = features(np.random.default_rng(seed), LensError(), views, moving=0.002)
    found = calibrated_lens(frames, matches)
    assert found is None or found.error == LensError(found.error.focal, found.error.division)


@lenses(mostly_thorough(NOT_SQUARE))
def test_pixels_that_are_not_square_are_found_where_the_lens_rolls(lens):
    found = calibrated_lens(*features(np.random.default_rng(0), lens, rolled=3.0))
    assert found is not None and found.error.division == 0
    assert [found.error.focal, found.error.aspect] == pytest.approx([lens.focal, lens.aspect], rel=0.01)


def test_a_focal_length_alone_has_nothing_beside_it():
    """A distortion would blur the pictures for nothing."""
    found = calibrated_lens(*features(np.random.default_rng(0), LensError(1.15)))
    assert found is not None and found.error == LensError(found.error.focal)


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"noise": 1.0},
        {"turned": 0.15},
        {"turned": 0.5},
        {"turned": 0.1, "sideways": True},
        {"turned": 0.2, "sideways": True},
        {"moving": 0.0005},
        {"mounted": rotated(6.0, 0.6, 0.8, 0.0)},
        {"mounted": rotated(4.0, 0.0, 0.0, 1.0)},
        {"mounted": rigid_pose(np.eye(3), [0.01, -0.005, 0])},
        {"lens": LensError(1.01)},
        {"lens": LensError(1.2), "views": 2},
    ],
    ids=[
        "right",
        "noise",
        "poses a little off",
        "poses off",
        "poses off sideways",
        "poses farther off sideways",
        "moving tissue",
        "poses turned alike",
        "poses rolled alike",
        "poses moved alike",
        "as good as right",
        "two views",
    ],
)
@pytest.mark.parametrize("seed", mostly_thorough(range(3)))
def test_what_is_no_lens_stays(given, seed):
    lens = given.pop("lens", LensError()) if "lens" in given else LensError()
    assert calibrated_lens(*features(np.random.default_rng(seed), lens, **given)) is None


def test_few_features_tell_no_lens():
    frames, matches = features(np.random.default_rng(1), LensError(1.2))
    assert calibrated_lens(frames, [match._replace(first=match.first[:3], second=match.second[:3]) for match in matches]) is None
    assert calibrated_lens(frames, []) is None


def test_the_options_say_when_a_lens_is_wrong():
    frames, matches = features(np.random.default_rng(2), LensError(1.2))
    assert calibrated_lens(frames, matches, LensConfig(left=0.05)) is None
    assert calibrated_lens(frames, matches, LensConfig(exact=0.0001)) is None


def test_a_calibration_can_be_cancelled():
    calls = []

    def cancel(*_):
        calls.append(1)
        if len(calls) > 30:
            raise Cancelled

    with pytest.raises(Cancelled):
        calibrated_lens(*features(np.random.default_rng(3), LensError(1.2)), progress=StageProgress("calibrating the lens", cancel))


@pytest.fixture(scope="module")
def frames():
    return list(phantom_sequence(PhantomConfig(frames=6, width=320, height=256, rounds=0.4)))


def stages(frames, motion: TissueMotion | None = None, **options):
    config, progress = ReconstructionConfig.from_mapping({"device": "cpu"} | options), StageProgress()
    made_up = ScenePoints(np.zeros((1, 3)), np.zeros((1, 3)))
    found = PreparedScene(tuple(frames), points=made_up, given_points=True, motion=motion)
    for stage in (select_usable, match_views, calibrate_lens, correct_poses, find_points):
        found = stage(found, config, progress)
    return found


@pytest.mark.slow
@lenses(mostly_thorough([LensError(1.0, -0.3), LensError(aspect=0.9, right=0.08), LensError(1.2)], 2))
def test_a_preparation_sees_through_the_lens_as_it_is(frames, lens, caplog):
    with caplog.at_level(logging.WARNING):
        found = stages([rendered(frame, lens) for frame in frames])
    assert "THE LENS IS NOT AS RECORDED, or poses are all off alike: features" in caplog.text
    assert "scene points are those of these views alone" in caplog.text
    assert ("k1, k2" in caplog.text) == bool(lens.division) and ("cx, cy" in caplog.text) == bool(lens.right)
    assert not found.given_points and not len(found.camera_errors.stamps_ns)
    assert all(view.camera is frame.camera for view, frame in zip(found.views, found.frames))
    # Scene points lie on the tissue, which the wrong lens saw centimetres away.
    errors = []
    for frame in frames:
        uv, depth = frame.camera.project(found.points.positions)
        column, row = np.floor(uv).astype(int).T
        inside = (column >= 0) & (column < 320) & (row >= 0) & (row < 256) & (depth > 0)
        true = frame.depth[row[inside], column[inside]]
        errors.append((np.abs(true - depth[inside]) / true)[true > 0])
    assert len(found.points.positions) > 100 and np.median(np.concatenate(errors)) < 0.01


@pytest.mark.slow
def test_poses_are_corrected_by_what_the_lens_shows(frames):
    rng = np.random.default_rng(0)

    def off(camera: Camera) -> Camera:
        pose = camera.pose.copy()
        pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(np.radians(0.05) * rng.standard_normal(3))[0]
        return camera.at(pose)

    given = [rendered(frame, LensError(1.2)) for frame in frames]
    found = stages([replace(frame, camera=off(frame.camera)) for frame in given], **{"poses.exact": 0.0002})
    assert len(found.camera_errors.stamps_ns) == len(frames) and found.camera_errors.lens.focal == pytest.approx(1.2, rel=0.02)
    for frame, now in zip(given, found.frames):
        np.testing.assert_allclose(found.camera_errors.corrected(frame.camera, frame.stamp_ns).K, now.camera.K)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["right", "off", "moving"])
def test_a_preparation_leaves_a_lens_that_is_right_or_is_to_stay(frames, case):
    lens = LensError() if case == "right" else LensError(1.1)
    breath = PeriodicMotion("breathing", 4.0, 1.0, 9.0, 1e-7 * np.eye(6)[:, :3], np.ones(9))
    motion = TissueMotion(0.0, np.zeros((9, 3)), (breath,)) if case == "moving" else None
    given = [rendered(frame, lens) if case != "right" else frame for frame in frames]
    found = stages(given, motion, **({"lens.correct": False} if case == "off" else {}), **{"poses.correct": False})
    assert found.camera_errors.lens == LensError()
    assert all(now.camera is frame.camera for now, frame in zip(found.frames, given)) and found.given_points
