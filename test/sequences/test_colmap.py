"""The reader of COLMAP's models, on small exact ones."""

import logging

import cv2
import numpy as np
import pycolmap
import pytest
from plane_scene import BARREL, HEIGHT, K_LEFT, NO_DISTORTION, WIDTH, assert_frame_agrees, see_plane, trajectory, write_rgb

from endo_sim_ros.core.cameras import invert_pose, matrix_to_quat
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.colmap import read_colmap
from endo_sim_ros.sequences.readers import find_kind, open_sequence
from endo_sim_ros.sequences.recording import Recording

UNIT = 25.0  # units of the model in a metre


def write_model(root, lens="OPENCV", distortion=BARREL, first=3):
    """Images 3, 4, … of a plane, and COLMAP's text files of them, with four of the plane's points."""
    (root / "sparse/0").mkdir(parents=True)
    parameters = {"OPENCV": [*K_LEFT[[0, 1], [0, 1]], *(K_LEFT[:2, 2] + 0.5), *distortion[:4]], "OPENCV_FISHEYE": [1.0] * 8}[lens]
    (root / "sparse/0/cameras.txt").write_text(
        f"# cameras\n7 {lens} {WIDTH} {HEIGHT} " + " ".join(map(repr, map(float, parameters))) + "\n"
    )
    lines, tracks, depths = ["# images"], [[] for _ in range(4)], []
    corners = np.array([[-0.02, -0.01, 0.08], [0.02, -0.01, 0.08], [-0.02, 0.012, 0.08], [0.018, 0.01, 0.08]])
    for index, pose in enumerate(trajectory(4).values()):
        write_rgb(root / f"images/frame_{first + index:04d}.png", see_plane(K_LEFT, distortion, pose)[0])
        view = invert_pose(pose)
        seen = corners @ view[:3, :3].T + view[:3, 3]
        uv = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), K_LEFT, distortion)[0].reshape(-1, 2) + 0.5
        depths += seen[:, 2].tolist()
        quaternion = " ".join(f"{value:.15g}" for value in [*matrix_to_quat(view[:3, :3]), *(UNIT * view[:3, 3])])
        lines += [f"{index + 1} {quaternion} 7 frame_{first + index:04d}.png"]
        lines += [" ".join(f"{u:.6f} {v:.6f} {number + 1}" for number, (u, v) in enumerate(uv))]
        for number, track in enumerate(tracks):
            track += [index + 1, number]
    (root / "sparse/0/images.txt").write_text("\n".join(lines) + "\n")
    rows = [
        [number + 1, *(UNIT * corner), 200, 100, 50 + number, 0.4, *track] for number, (corner, track) in enumerate(zip(corners, tracks))
    ]
    (root / "sparse/0/points3D.txt").write_text("".join(" ".join(map(str, row)) + "\n" for row in rows))
    return corners, float(np.median(depths))


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("distortion", [NO_DISTORTION, BARREL], ids=["straight", "distorted"])
def test_frames_are_those_of_the_model_undistorted_and_in_metres(tmp_path, distortion, binary):
    corners, depth = write_model(tmp_path, distortion=distortion)
    if binary:
        model = pycolmap.Reconstruction(str(tmp_path / "sparse/0"))
        for path in (tmp_path / "sparse/0").iterdir():
            path.unlink()
        (tmp_path / "sparse/0").rmdir()
        model.write_binary(str(tmp_path / "sparse"))
    write_rgb(tmp_path / "masks/0004.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    recording = open_sequence(tmp_path, scale=depth)
    assert isinstance(recording, Recording)
    frames = list(recording)
    assert find_kind(tmp_path) == "colmap" and len(frames) == len(recording) == 4
    for frame, pose in zip(frames, trajectory(4).values(), strict=True):
        np.testing.assert_allclose(frame.camera.pose, pose, atol=1e-7)
        assert_frame_agrees(frame)
    assert frames[0].stamp_ns == 1_120_000_000  # frame 0 is at one second
    told = recording.points()
    assert told is not None
    points, colors = told
    np.testing.assert_allclose(sorted(points.tolist()), sorted(corners.tolist()), atol=1e-7)
    np.testing.assert_allclose(sorted(255 * colors[:, 2]), [50, 51, 52, 53], atol=1e-6)


def test_images_that_the_model_has_not_are_left_out_and_the_scale_is_told_to_be_a_guess(tmp_path, caplog):
    write_model(tmp_path)
    write_rgb(tmp_path / "images/frame_0009.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    with caplog.at_level(logging.INFO):
        frames = list(read_colmap(tmp_path, start=4))
    assert [(frame.stamp_ns - 1_000_000_000) / 40_000_000 for frame in frames] == [4, 5, 6]
    assert "THE SCALE IS A GUESS" in caplog.text and "skipped, without a pose: 1 of 4 frames" in caplog.text


def test_the_largest_of_several_models_is_read(tmp_path, caplog):
    _, depth = write_model(tmp_path)
    (tmp_path / "sparse/0").rename(tmp_path / "sparse/1")
    few = pycolmap.Reconstruction(str(tmp_path / "sparse/1"))
    for frame in (1, 2):
        few.deregister_frame(frame)
    (tmp_path / "sparse/0").mkdir()
    few.write_text(str(tmp_path / "sparse/0"))
    assert len(read_colmap(tmp_path, scale=depth)) == 4
    assert "holds 2 models, which COLMAP could not join; 1 has the most images, 4, and is read" in caplog.text


def _empty(root):
    (root / "sparse/0/points3D.txt").write_text("")
    images = (root / "sparse/0/images.txt").read_text().splitlines()
    (root / "sparse/0/images.txt").write_text("\n".join("" if number % 2 == 0 and number else line for number, line in enumerate(images)))


def _elsewhere(root):
    for path in sorted((root / "images").iterdir()):
        path.rename(path.with_name(f"other_{path.name}"))


def _smaller(root):
    for path in (root / "images").iterdir():
        cv2.imwrite(str(path), np.zeros((HEIGHT // 2, WIDTH // 2, 3), np.uint8))


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda root: (root / "sparse/0/points3D.txt").unlink(), "holds no model of COLMAP; cameras, images and points3D"),
        (lambda root: (root / "sparse/0/cameras.txt").write_text("7 OPENCV 160\n"), "sparse/0: not a readable model of COLMAP"),
        (_elsewhere, "sparse/0: none of its 4 images is in .*images, such as 'frame_0003.png'"),
        (_empty, "sparse/0: has no points; run COLMAP's mapper"),
        (_smaller, "sparse/0: its camera is 160×128, but images are 80×64; give those of that size"),
    ],
    ids=["no points file", "damaged", "other images", "no points", "other size"],
)
def test_what_does_not_belong_together_is_one_sentence(tmp_path, damage, sentence):
    write_model(tmp_path)
    damage(tmp_path)
    with pytest.raises(SequenceError, match=sentence):
        list(read_colmap(tmp_path))


def test_a_lens_that_is_not_undistorted_here_is_refused_with_what_does_it(tmp_path):
    write_model(tmp_path, "OPENCV_FISHEYE")
    with pytest.raises(SequenceError, match="its lens is OPENCV_FISHEYE, which is not undistorted here; run `colmap image_undistorter`"):
        list(read_colmap(tmp_path))
