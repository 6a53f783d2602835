"""The reader of StereoMIS, on a small exact copy of its layout."""

import logging
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from plane_scene import (
    BARREL,
    HEIGHT,
    K_LEFT,
    K_RIGHT,
    R_EYES,
    T_EYES,
    WIDTH,
    assert_frame_agrees,
    plane_colours,
    stereo_images,
    trajectory,
    write_poses,
    write_rgb,
    write_video,
)

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.stereomis import read_stereomis


def write_ini(path: Path):
    lines = []
    for section, K in (("StereoLeft", K_LEFT), ("StereoRight", K_RIGHT)):
        lines += [f"[{section}]", f"res_x={WIDTH}", f"res_y={HEIGHT}", f"fc_x={K[0, 0]}", f"fc_y={K[1, 1]}"]
        lines += [f"cc_x={K[0, 2]}", f"cc_y={K[1, 2]}"] + [f"kc_{i}={k}" for i, k in enumerate(BARREL)]
    lines += [f"R_{i}={value:.12g}" for i, value in enumerate(R_EYES.ravel())]
    lines += [f"T_{i}={1000 * value:.12g}" for i, value in enumerate(T_EYES)]
    path.write_text("\n".join(lines))


@pytest.fixture(scope="module")
def stereomis_source(tmp_path_factory):
    root = tmp_path_factory.mktemp("stereomis") / "P1"
    root.mkdir()
    poses = trajectory(8)
    write_ini(root / "StereoCalibration.ini")
    write_video(root / "IFBS_ENDOSCOPE-part0001.mp4", (np.vstack(pair) for pair in stereo_images(poses)), fps=20.0)
    write_poses(root / "groundtruth.txt", {n: pose for n, pose in poses.items() if n != 3})
    (root / "train_split.csv").write_text("start,end\n0,1\n4,5\n")
    (root / "test_split.csv").write_text("start,end\n6,7\n")
    for number in (0, 4):
        tool = np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8)
        tool[30:50, 30:] = 255
        write_rgb(root / f"masks/{number:06d}l.png", tool)
    return root


@pytest.fixture
def stereomis(stereomis_source, tmp_path):
    """A copy that a test may damage."""
    return Path(shutil.copytree(stereomis_source, tmp_path / "P1"))


def test_stereomis_frames_are_rectified_posed_and_timed(stereomis_source):
    frames = list(read_stereomis(stereomis_source))
    assert len(frames) == len(read_stereomis(stereomis_source)) == 7  # frame 3 has no pose
    assert [f.stamp_ns for f in frames] == [1_000_000_000 + n * 50_000_000 for n in (0, 1, 2, 4, 5, 6, 7)]
    for frame in frames:
        assert frame.baseline == pytest.approx(np.linalg.norm(T_EYES), rel=1e-6)
        assert frame.image.dtype == np.uint8 and frame.mask.dtype == np.uint8
        assert_frame_agrees(frame, tolerance=12)


def test_stereomis_counts_frames_without_pose_in_the_log(stereomis_source, caplog):
    with caplog.at_level(logging.INFO):
        read_stereomis(stereomis_source)
    assert "groundtruth.txt: 1 of 8 frames have no pose" in caplog.text
    assert "white is taken for tools" in caplog.text


@pytest.mark.parametrize(("split", "numbers"), [("train", [0, 1, 4, 5]), ("test", [6, 7]), (None, [0, 1, 2, 4, 5, 6, 7])])
def test_stereomis_splits_are_inclusive_ranges(stereomis_source, split, numbers):
    frames = read_stereomis(stereomis_source, split=split)
    assert [(f.stamp_ns - 1_000_000_000) // 50_000_000 for f in frames] == numbers


def test_stereomis_range_and_step(stereomis_source):
    frames = read_stereomis(stereomis_source, start=1, stop=7, step=2)
    assert [(f.stamp_ns - 1_000_000_000) // 50_000_000 for f in frames] == [1, 5]  # 3 has no pose


def test_stereomis_mask_ignores_the_tool_at_full_resolution_and_is_borrowed_from_a_neighbour(stereomis_source):
    frames = {(f.stamp_ns - 1_000_000_000) // 50_000_000: f for f in read_stereomis(stereomis_source)}
    for number in (0, 1, 4, 5):
        mask = frames[number].mask
        assert mask.shape == (HEIGHT, WIDTH) and set(np.unique(mask)) == {0, 255}
        assert mask[80, 120] == 0  # the tool
        assert mask[20, 80] == 255
    assert frames[2].mask[80, 120] == frames[7].mask[80, 120] == 255  # no mask within one frame


def test_stereomis_masks_of_either_polarity_mean_the_same(stereomis):
    usual = [f.mask for f in read_stereomis(stereomis)]
    for path in (stereomis / "masks").glob("*.png"):
        cv2.imwrite(str(path), 255 - cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    for mask, inverted in zip(usual, (f.mask for f in read_stereomis(stereomis)), strict=True):
        np.testing.assert_array_equal(mask, inverted)
    forced = next(iter(read_stereomis(stereomis, mask_polarity="tool"))).mask
    assert forced[80, 120] == 255 and forced[20, 80] == 0


@pytest.mark.slow
def test_stereomis_extracted_frames_equal_the_video(stereomis):
    next(stereomis.glob("*.mp4")).unlink()
    for number, (left, right) in enumerate(stereo_images(trajectory(8))):
        write_rgb(stereomis / f"video_frames/{number:06d}l.png", left)
        write_rgb(stereomis / f"video_frames/{number:06d}r.png", right)
    frames = list(read_stereomis(stereomis))
    assert len(frames) == 7
    assert frames[1].stamp_ns - frames[0].stamp_ns == 40_000_000  # extracted frames have no rate; 25 Hz
    for frame in frames:
        assert_frame_agrees(frame)


@pytest.mark.slow
def test_intrinsics_follow_images_of_another_resolution(stereomis):
    next(stereomis.glob("*.mp4")).unlink()
    for number, pair in enumerate(stereo_images(trajectory(2))):
        for eye, image in zip("lr", pair, strict=True):
            write_rgb(stereomis / f"video_frames/{number:06d}{eye}.png", cv2.resize(image, None, fx=2, fy=2))
    frame = next(iter(read_stereomis(stereomis)))
    assert frame.image.shape == (2 * HEIGHT, 2 * WIDTH, 3)
    expected, _ = plane_colours(frame)
    assert np.median(np.abs(frame.image - expected)) < 3


def test_reading_is_lazy_and_repeatable(stereomis):
    recording = read_stereomis(stereomis, mask_polarity="tool")
    first = next(iter(recording))
    (stereomis / "masks/000004l.png").write_bytes(b"damaged")
    assert next(iter(recording)).stamp_ns == first.stamp_ns
    with pytest.raises(SequenceError, match="000004l.png"):
        list(recording)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("StereoCalibration.ini", None, "StereoCalibration.ini: file is missing"),
        (
            "StereoCalibration.ini",
            "[StereoLeft]\nres_x=1\nres_y=1\nfc_x=5",
            r"StereoCalibration.ini: \[StereoLeft\] fc_y",
        ),
        ("StereoCalibration.ini", "no ini at all", "StereoCalibration.ini: not a readable ini"),
        ("groundtruth.txt", "0 0 0 0 0 0 1", "groundtruth.txt: line 1 has 7 numbers, expected 8"),
        ("groundtruth.txt", "0 0 0 0 0 0 0 0", "groundtruth.txt: line 1 is not a pose"),
        ("groundtruth.txt", "0 0 0 0 0 0 0 1\n0 0 0 nan 0 0 0 1", "groundtruth.txt: line 2 is not a pose"),
        ("groundtruth.txt", "0 0 0 0 0 0 0 1\n0 0 0 1 0 0 0 1", "groundtruth.txt: line 2 repeats frame 0"),
        ("groundtruth.txt", "0 0 0 0 0 0 0 1\nx y", "groundtruth.txt: line 2 is not made of numbers"),
        ("groundtruth.txt", "", "groundtruth.txt: holds no poses"),
        ("groundtruth.txt", "99 0 0 0 0 0 0 1", "groundtruth.txt: holds no pose for any of the 8"),
        ("IFBS_ENDOSCOPE-part0001.mp4", "not a video", "part0001.mp4: not a readable video"),
        ("IFBS_ENDOSCOPE-part0001.mp4", None, "holds neither a video"),
        ("second.mp4", "", "more than one video"),
        ("train_split.csv", "start,end\n9,2\n", "train_split.csv: line 2 is not a range"),
        ("train_split.csv", None, "train_split.csv: file is missing"),
    ],
)
def test_damaged_stereomis_is_refused_by_name(stereomis, name, text, message):
    (stereomis / name).unlink(missing_ok=True)
    if text is not None:
        (stereomis / name).write_text(text)
    with pytest.raises(SequenceError, match=message):
        read_stereomis(stereomis, split="train" if "split" in name else None)
