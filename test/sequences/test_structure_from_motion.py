"""Structure from motion, on a relief and on real recordings."""

import itertools
import json
import signal
import subprocess
import sys
import tempfile
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from plane_scene import BASELINE, pose_of, write_rgb

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences import colmap_process, structure_from_motion
from endo_sim_ros.sequences.colmap_process import pairs
from endo_sim_ros.sequences.folder import read_folder
from endo_sim_ros.sequences.masks import lit_area
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence
from endo_sim_ros.sequences.pose_files import read_poses
from endo_sim_ros.sequences.rectification import Rectification
from endo_sim_ros.sequences.structure_from_motion import View, estimate_poses
from endo_sim_ros.sequences.video_files import Video

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


def similarity_error(estimated: np.ndarray, reference: np.ndarray) -> float:
    """Root mean square distance of positions [N, 3] after the best similarity, relative to the path length."""
    a, b = estimated - estimated.mean(0), reference - reference.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = np.trace(np.diag(s) @ sign) / (a**2).sum()
    error = np.sqrt((((scale * a @ (u @ sign @ vt).T) - b) ** 2).sum(1).mean())
    return error / np.linalg.norm(np.diff(reference, axis=0), axis=1).sum()


def relief_images(poses, K_cv, size=(320, 240)):
    """Views of a bumpy, finely textured surface, ray-marched."""
    rng = np.random.default_rng(3)
    noise = sum(
        cv2.resize(rng.uniform(0, 1, (n, n)).astype(np.float32), (1024, 1024), interpolation=cv2.INTER_CUBIC) / 2**i
        for i, n in enumerate((32, 96, 256))
    )
    noise = cv2.normalize(noise, None, 10, 245, cv2.NORM_MINMAX)
    u, v = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    rays = np.stack([(u - K_cv[0, 2]) / K_cv[0, 0], (v - K_cv[1, 2]) / K_cv[1, 1], np.ones_like(u)], -1)
    for pose in poses:
        turned, origin = rays @ pose[:3, :3].T, pose[:3, 3]
        depth = np.full(u.shape, 0.1)
        for _ in range(30):  # fixed point of a gentle height field
            points = origin + turned * depth[..., None]
            height = 0.1 + 0.012 * np.sin(points[..., 0] / 0.012) * np.cos(points[..., 1] / 0.015)
            depth = (height - origin[2]) / turned[..., 2]
        points = origin + turned * depth[..., None]
        columns = ((points[..., 0] / 0.16 + 0.5) * 1024).astype(np.float32)
        rows = ((points[..., 1] / 0.16 + 0.5) * 1024).astype(np.float32)
        grey = cv2.remap(noise, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        yield np.repeat(grey[..., None], 3, -1).round().astype(np.uint8)


def relief_views(poses, K_cv):
    return map(View, relief_images(poses, K_cv))


ORBIT = [pose_of((0.05 * np.sin(a), 0.01 * np.cos(3 * a), 0.1 - 0.1 * np.cos(a)), y=-a) for a in np.linspace(-0.35, 0.35, 6)]
K_RELIEF = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])


@pytest.mark.thorough
@pytest.mark.slow
def test_structure_from_motion_on_stereo_is_metric():
    pytest.importorskip("pycolmap")
    offset = pose_of((BASELINE, 0, 0))
    eyes = relief_images(ORBIT, K_RELIEF), relief_images([pose @ offset for pose in ORBIT], K_RELIEF)
    views = (View(left, right=right) for left, right in zip(*eyes, strict=True))
    result = estimate_poses(views, K_RELIEF + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], baseline=BASELINE, threads=1)
    assert sorted(result.poses) == list(range(6)) and result.metric and not result.distortion
    np.testing.assert_allclose(result.poses[0], np.eye(4), atol=1e-9)
    for number, pose in result.poses.items():
        expected = np.linalg.inv(ORBIT[0]) @ ORBIT[number]
        assert np.linalg.norm(pose[:3, 3] - expected[:3, 3]) < 3e-4
        assert np.abs(pose[:3, :3] - expected[:3, :3]).max() < 0.01
    points, colors = result.points
    world = points @ ORBIT[0][:3, :3].T + ORBIT[0][:3, 3]
    surface = 0.1 + 0.012 * np.sin(world[:, 0] / 0.012) * np.cos(world[:, 1] / 0.015)
    assert len(points) > 100 and np.median(np.abs(world[:, 2] - surface)) < 1e-3
    assert colors.shape == points.shape and 0 <= colors.min() < colors.max() <= 1 and colors.std() > 0.05


@pytest.mark.thorough
@pytest.mark.slow
def test_scale_of_one_eye_is_the_median_depth_in_metres():
    pytest.importorskip("pycolmap")
    K = K_RELIEF + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    result = estimate_poses(relief_views(ORBIT, K_RELIEF), K, scale=0.06)
    assert result.metric and result.points is not None
    depths = np.concatenate([(result.points[0] - pose[:3, 3]) @ pose[:3, 2] for pose in result.poses.values()])
    assert np.median(depths) == pytest.approx(0.06, rel=0.03)  # these are those of points that no view shows, too
    travel = [np.linalg.norm(poses[5][:3, 3] - poses[0][:3, 3]) for poses in (result.poses, ORBIT)]
    assert travel[0] == pytest.approx(0.6 * travel[1], rel=0.03)  # the relief is 0.1 m away


@pytest.mark.thorough
@pytest.mark.slow
def test_tissue_that_moves_does_not_put_depth_of_stereo_pairs_off():
    """Of breathing tissue a right eye that is placed anew explains a part of the motion, and depth is a fifth too large."""
    pytest.importorskip("pycolmap")
    patient = PhantomConfig(frames=12, fps=1.0, width=320, height=256, breathing=0.008)
    frames = list(phantom_sequence(patient))
    views = [View(frame.image, right=frame.right) for frame in frames]
    result = estimate_poses(views, frames[0].camera.K, baseline=patient.baseline)
    ratios = []
    for number, pose in result.poses.items():
        frame = frames[number]
        uv, z = replace(frame.camera, pose=pose).project(result.points[0])
        column, row = np.floor(uv).astype(int).T
        seen = (z > 0) & (column >= 0) & (row >= 0) & (column < patient.width) & (row < patient.height)
        ratios.append(z[seen] / frame.depth[row[seen], column[seen]])
    assert len(ratios) > 8 and np.median(np.concatenate(ratios)) == pytest.approx(1, abs=0.03)


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("lower, rolled", [(3, 0), (0, 1)])
def test_a_right_eye_whose_rows_do_not_match_is_placed_by_features(lower, rolled, caplog):
    """Held, it leaves 0.6 pixels and more."""
    pytest.importorskip("pycolmap")
    offset, turn = pose_of((BASELINE, 0, 0)), cv2.getRotationMatrix2D((159.5, 119.5), rolled, 1)
    turn[1, 2] += lower
    rights = [cv2.warpAffine(image, turn, (320, 240)) for image in relief_images([pose @ offset for pose in ORBIT], K_RELIEF)]
    views = [View(left, right=right) for left, right in zip(relief_images(ORBIT, K_RELIEF), rights, strict=True)]
    result = estimate_poses(views, K_RELIEF, baseline=BASELINE)
    assert len(result.poses) == 6 and result.reprojection_error < 0.2
    assert "rows of the eyes do not match" in caplog.text


def test_pairs_tie_every_image_to_its_neighbours_and_to_far_ones():
    assert len(pairs(30, stereo=False)) == 30 * 29 // 2
    many = pairs(600, stereo=True)
    assert len(set(many)) == len(many) < 20 * 600
    assert {("left/000007", "right/000009"), ("right/000007", "left/000008"), ("right/000598", "right/000599")} <= set(many)
    assert {("left/000000", "left/000010"), ("left/000000", "left/000580"), ("left/000599", "right/000599")} <= set(many)
    assert ("left/000000", "left/000011") not in many


@pytest.mark.slow
def test_the_program_goes_on_hearing_sigterm():
    pytest.importorskip("pycolmap")
    code = """if True:
        import os, signal, sys
        from endo_sim_ros.sequences.structure_from_motion import estimate_poses
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(9))
        try:
            estimate_poses([])
        except ValueError:
            os.kill(os.getpid(), signal.SIGTERM)
    """
    assert subprocess.run([sys.executable, "-c", code]).returncode == 9


@pytest.mark.slow
def test_progress_is_told_and_its_error_ends_the_work_at_once(tmp_path, monkeypatch):
    pytest.importorskip("pycolmap")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    processes = []

    class Recorded(subprocess.Popen):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            processes.append(self)

    monkeypatch.setattr(structure_from_motion.subprocess, "Popen", Recorded)
    told = []

    def stop(stage, done, total):
        told.append((stage, done, total))
        if stage == "mapping":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        estimate_poses(relief_views(ORBIT, K_RELIEF), K_RELIEF, count=6, on_progress=stop)
    assert {("features", 6, 6), ("matching", 0, 15), ("mapping", 0, 0)} <= set(told)
    assert [process.returncode for process in processes] == [-signal.SIGKILL]
    assert not list(tmp_path.iterdir())


@pytest.mark.thorough
@pytest.mark.slow
def test_matching_tells_how_many_pairs_are_done(tmp_path, monkeypatch):
    pytest.importorskip("pycolmap")
    monkeypatch.setattr(colmap_process, "_POLL", 0.002)
    database, told = tmp_path / colmap_process.DATABASE, []
    structure_from_motion._write_features(database, relief_views(ORBIT, K_RELIEF), K_RELIEF, None, 1, lambda *_: None, 6)
    job = colmap_process.ColmapJob(str(tmp_path), 6, fixed=True, stereo=False, threads=1)
    assert colmap_process.run(job, lambda *step: told.append(step)) == 1
    done = [step[1] for step in told if step[0] == "matching"]
    assert done == sorted(done) and done[0] == 0 and set(done) & set(range(1, 15))
    assert {step[2] for step in told if step[0] == "matching"} == {15}


@pytest.mark.slow
def test_the_process_of_colmap_ends_with_its_parent(tmp_path):
    pytest.importorskip("pycolmap")
    job = json.dumps({"folder": str(tmp_path), "count": 0, "fixed": True, "stereo": False, "threads": 1})
    code = "import sys, time; from endo_sim_ros.sequences import colmap_process as c; c.run = lambda *_: time.sleep(600); c.main()"
    with subprocess.Popen([sys.executable, "-c", code, job], stdin=subprocess.PIPE) as process:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(1)
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(120) == 1


@pytest.mark.slow
def test_colmap_that_dies_is_told(monkeypatch):
    pytest.importorskip("pycolmap")
    monkeypatch.setattr(structure_from_motion.sys, "executable", "/bin/false")
    with pytest.raises(SequenceError, match="its process ended with status 1"):
        estimate_poses(itertools.islice(relief_views(ORBIT, K_RELIEF), 2), K_RELIEF)


@pytest.mark.thorough
@pytest.mark.slow
def test_one_thread_gives_the_same_bits():
    pytest.importorskip("pycolmap")
    first, second = (estimate_poses(relief_views(ORBIT, K_RELIEF), K_RELIEF, threads=1) for _ in range(2))
    assert len(first.poses) == 6
    for number, pose in first.poses.items():
        assert pose.tobytes() == second.poses[number].tobytes()


@pytest.mark.thorough
@pytest.mark.slow
def test_unknown_intrinsics_are_estimated():
    pytest.importorskip("pycolmap")
    result = estimate_poses(relief_views(ORBIT, K_RELIEF))
    assert len(result.poses) == 6 and len(result.distortion) == 1
    assert result.reprojection_error < 1


FEATURES = np.random.default_rng(0).uniform((0, 0), (720, 288), (500, 2))


def model_with(params, features):
    """What of a model of COLMAP tells whether its camera is one."""
    points = [SimpleNamespace(xy=feature) for feature in features]
    return SimpleNamespace(cameras={1: SimpleNamespace(params=params)}, images={1: SimpleNamespace(points2D=points)})


@pytest.mark.parametrize(
    ("f", "k1", "placed", "refusal"),
    [
        (1098, 4.467, 2, "placed 2 of 17 images and estimated a focal length of 1098 px and k1 4.467; give calibration.yaml, or fx"),
        (984, -4.682, 9, "placed 9 of 17 images and estimated a focal length of 984 px and k1 -4.682, which no lens has; give"),
        (400, -0.15, 9, ""),  # 84 degrees wide, and barrel as much as lenses are that keep angles
        (907, -0.083, 17, ""),
    ],
)
def test_a_camera_that_places_few_images_or_folds_them_is_refused(f, k1, placed, refusal):
    model = model_with((f, 360, 144, k1), FEATURES)
    with pytest.raises(SequenceError, match=refusal) if refusal else nullcontext():
        structure_from_motion._refuse_poor_camera(model, placed, 17)


def test_a_round_picture_in_a_wide_frame_is_distorted_as_far_as_it_goes():
    """A lens of 90 degrees that keeps angles, a third of the frame wide: in focal lengths the frame goes twice as far as k1 allows."""
    params = 153, 360, 144, -0.23
    middle = FEATURES[np.hypot(*(FEATURES - (360, 144)).T) < 120]
    structure_from_motion._refuse_poor_camera(model_with(params, middle), 17, 17)
    with pytest.raises(SequenceError, match="which no lens has"):
        structure_from_motion._refuse_poor_camera(model_with(params, FEATURES), 17, 17)


@pytest.mark.thorough
@pytest.mark.slow
def test_a_focal_length_that_images_leave_open_is_guessed(caplog):
    pytest.importorskip("pycolmap")
    short = [pose_of((x, 0.3 * x, 0)) for x in np.linspace(-0.004, 0.004, 6)]  # an estimate finds no pair
    result = estimate_poses(relief_views(short, K_RELIEF))
    assert len(result.poses) == 6 and result.K[0, 0] == pytest.approx(160 / np.tan(np.radians(35))) and not result.distortion
    assert "THE FOCAL LENGTH IS A GUESS, 229 px" in caplog.text and "fell apart" not in caplog.text
    assert similarity_error(np.array([result.poses[n][:3, 3] for n in range(6)]), np.array([pose[:3, 3] for pose in short])) < 0.01


@pytest.mark.thorough
@pytest.mark.slow
def test_images_of_which_few_overlap_are_refused_without_a_calibration(caplog):
    pytest.importorskip("pycolmap")
    others = np.random.default_rng(0).integers(0, 256, (4, 240, 320, 3), np.uint8)
    views = [View(image) for image in (*relief_images(ORBIT[:3], K_RELIEF), *others)]
    with pytest.raises(SequenceError, match="without a calibration placed 3 of 7 images and estimated a focal length of"):
        estimate_poses(views)
    names = [f"{number}.png" for number in range(10, 80, 10)]
    assert len(estimate_poses(views, K_RELIEF + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], names=names).poses) == 3
    assert "could not place 4 of 7 images: 40.png, 50.png, 60.png, 70.png" in caplog.text


@pytest.mark.thorough
@pytest.mark.slow
def test_folder_is_posed_on_request_and_the_guessed_scale_is_announced(tmp_path, caplog):
    pytest.importorskip("pycolmap")
    for number, image in enumerate(relief_images(ORBIT, K_RELIEF)):
        write_rgb(tmp_path / f"left/{number:06d}.png", image)
    write_rgb(tmp_path / "left/000006.png", np.random.default_rng(0).integers(0, 256, (240, 320, 3), np.uint8))
    (tmp_path / "calibration.yaml").write_text("fx: 300\nfy: 300\ncx: 160\ncy: 120\n")
    (tmp_path / "poses_left.txt").write_text("0 0 0 0 0 0 0 1\n")
    assert len(list(read_folder(tmp_path))) == 1
    recording = read_folder(tmp_path, poses="sfm")  # although there are some
    frames = list(recording)
    assert len(frames) == 6 and recording.points() is not None
    positions = np.array([frame.camera.position for frame in frames])
    assert similarity_error(positions, np.array([pose[:3, 3] for pose in ORBIT])) < 0.01
    assert "THE SCALE IS A GUESS" in caplog.text and "could not place 1 of 7 images: 000006.png" in caplog.text
    caplog.clear()
    assert [f.stamp_ns for f in recording] == [f.stamp_ns for f in frames]
    assert "SCALE" not in caplog.text  # estimated once


@pytest.mark.thorough
@pytest.mark.slow
def test_recorded_depth_sets_the_scale_of_one_eye(tmp_path, caplog):
    pytest.importorskip("pycolmap")
    v, u = np.mgrid[:240, :320]
    rays = np.stack([(u - 159.5) / 300, (v - 119.5) / 300, np.ones_like(u)], -1)
    for number, (pose, image) in enumerate(zip(ORBIT, relief_images(ORBIT, K_RELIEF))):
        write_rgb(tmp_path / f"left/{number:06d}.png", image)
        if number:  # not all need it
            depth = 0.6 * (0.1 - pose[2, 3]) / (rays @ pose[2, :3])  # the relief is 0.1 m away
            write_rgb(tmp_path / f"depth/{number:06d}.png", (depth * 1e4).round().astype(np.uint16))
    (tmp_path / "calibration.yaml").write_text("fx: 300\nfy: 300\ncx: 160\ncy: 120\n")
    with caplog.at_level("INFO"):
        poses = [frame.camera.pose for frame in read_folder(tmp_path, poses="sfm", depth_scale=1e-4)]
    travel = [np.linalg.norm(path[5][:3, 3] - path[0][:3, 3]) for path in (poses, ORBIT)]
    assert travel[0] == pytest.approx(0.6 * travel[1], rel=0.03)
    assert "scale from the recorded depth of 5 images" in caplog.text and "GUESS" not in caplog.text


@pytest.mark.thorough
@pytest.mark.slow
def test_a_picture_that_stands_still_tells_no_poses():
    pytest.importorskip("pycolmap")
    image, rng = next(relief_images(ORBIT[:1], K_RELIEF)), np.random.default_rng(0)
    noisy = [np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8) for _ in range(8)]
    with pytest.raises(SequenceError, match="found [0-9] points? in 8 images, which tell no poses: the picture stands still|found no pair"):
        estimate_poses(list(map(View, noisy)))


@pytest.mark.slow
def test_structure_from_motion_that_fails_says_why(tmp_path, capfd):
    pytest.importorskip("pycolmap")
    flat = itertools.repeat(View(np.full((120, 160, 3), 128, np.uint8)), 3)
    with pytest.raises(SequenceError, match="found no pair of images"):
        estimate_poses(flat)
    assert not capfd.readouterr().err  # of COLMAP
    one = [View(np.zeros((120, 160, 3), np.uint8))]
    with pytest.raises(SequenceError, match="needs at least 2 images, got 1; select more frames$"):
        estimate_poses(one)
    with pytest.raises(ValueError, match="no view has a right image, which baseline is for; give some, or leave baseline out"):
        estimate_poses(one, K_RELIEF, baseline=BASELINE)
    with pytest.raises(SequenceError, match="of one stereo pair, give its pose: its number and 0 0 0 0 0 0 1 in poses_left.txt"):
        estimate_poses([View(one[0].image, right=one[0].image)], K_RELIEF, baseline=BASELINE)


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.skipif(not (SHARED / "gallbladder/endo.mp4").is_file(), reason="the gallbladder video is not at ../shared/data")
def test_structure_from_motion_on_a_real_video(tmp_path):
    reference = read_poses(SHARED / "gallbladder/poses.txt")
    video = Video(SHARED / "gallbladder/endo.mp4")
    numbers = list(range(0, 96, 12))
    images = [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for _, image in video.frames(numbers)]
    lit = lit_area(images)
    K, distortion = np.array([[453.7, 0, 320], [0, 453.7, 180], [0, 0, 1]]), [-0.083]
    rectification = Rectification.mono(K, distortion, (640, 360))
    views = (View(rectification.left(image), rectification.mask(lit)) for image in images)
    result = estimate_poses(views, rectification.K, scale=0.01)
    assert len(result.poses) >= len(numbers) - 1
    assert result.reprojection_error < 2.0
    placed = sorted(result.poses)
    estimated = np.array([result.poses[n][:3, 3] for n in placed])
    # Loose: the tissue moves and the camera hardly does, so a few frames of one eye leave the relief open.
    assert similarity_error(estimated, np.array([reference[numbers[n]][:3, 3] for n in placed])) < 0.25


@pytest.mark.slow
@pytest.mark.skipif(not (SHARED / "hamlyn06/left").is_dir(), reason="the hamlyn06 recording is not at ../shared/data")
def test_structure_from_motion_on_real_stereo_is_metric(tmp_path):
    source = SHARED / "hamlyn06"
    for name in ("left", "right", "calibration.yaml"):
        (tmp_path / name).symlink_to(source / name)
    reference = [frame.camera.position for frame in read_folder(source, stop=400, step=2)]
    estimated = [frame.camera.position for frame in read_folder(tmp_path, stop=400, step=2)]
    assert len(estimated) == len(reference) == 4
    assert similarity_error(np.array(estimated), np.array(reference)) < 0.02
    travel = [np.linalg.norm(np.diff(positions, axis=0), axis=1).sum() for positions in (estimated, reference)]
    assert travel[0] == pytest.approx(travel[1], rel=0.08)  # the reference's own scale is good to 3 %
