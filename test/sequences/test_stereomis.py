"""The reader of StereoMIS: a textured plane for what is exact, and copies of the layout in every form in which it is found."""

import collections
import logging
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import stereomis_copy
from peak_memory import peak_of
from plane_scene import (
    BARREL,
    HEIGHT,
    K_LEFT,
    K_RIGHT,
    R_EYES,
    T_EYES,
    WIDTH,
    assert_frame_agrees,
    stereo_images,
    trajectory,
    write_poses,
    write_rgb,
    write_video,
)
from stereomis_copy import COUNT, FPS, write_calibration, write_stereomis
from thorough import mostly_thorough

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.words import counted
from endo_sim_ros.sequences import stereomis
from endo_sim_ros.sequences.rectification import Rectification
from endo_sim_ros.sequences.stereomis import read_stereo_ini, read_stereomis
from endo_sim_ros.sequences.video_files import Video


def numbers_of(frames, fps=20.0) -> list[int]:
    return [round((frame.stamp_ns - 1_000_000_000) * fps / 1e9) for frame in frames]


@pytest.fixture(scope="module")
def plane_source(tmp_path_factory):
    root = tmp_path_factory.mktemp("stereomis") / "P1"
    root.mkdir()
    poses = trajectory(8)
    write_calibration(root / "StereoCalibration.ini", (WIDTH, HEIGHT), (K_LEFT, K_RIGHT), BARREL, R_EYES, T_EYES)
    write_video(root / "IFBS_ENDOSCOPE-part0001.mp4", (np.vstack(pair) for pair in stereo_images(poses)), fps=20.0)
    write_poses(root / "groundtruth.txt", {n: pose for n, pose in poses.items() if n != 3})
    (root / "train_split.csv").write_text("start,end\n0,1\n4,6\n")
    (root / "test_split.csv").write_text("start,end\n6,8\n")
    return root


@pytest.fixture
def plane(plane_source, tmp_path):
    """A copy that a test may damage."""
    return Path(shutil.copytree(plane_source, tmp_path / "P1"))


def test_frames_are_rectified_posed_and_timed(plane_source):
    frames = list(read_stereomis(plane_source, pose_lag=0))
    assert len(frames) == len(read_stereomis(plane_source, pose_lag=0)) == 7  # frame 3 has no pose
    assert [f.stamp_ns for f in frames] == [1_000_000_000 + n * 50_000_000 for n in (0, 1, 2, 4, 5, 6, 7)]
    for frame in frames:
        assert frame.baseline == pytest.approx(np.linalg.norm(T_EYES), rel=1e-6)
        assert frame.image.dtype == np.uint8 and frame.mask.dtype == np.uint8
        assert_frame_agrees(frame, tolerance=12)


def test_lag_that_is_stated_shifts_the_rows(plane_source):
    assert numbers_of(read_stereomis(plane_source, pose_lag=2)) == [2, 3, 4, 6, 7]
    assert numbers_of(read_stereomis(plane_source, pose_lag=-5)) == [0, 1, 2]


def test_lag_of_too_short_a_sequence_is_assumed(plane_source, caplog):
    assert numbers_of(read_stereomis(plane_source)) == [4, 5, 6]
    assert "(there are poses in rows 0 to 7, 7 of them within 10 of the frames 0 to 7: too few)" in caplog.text
    assert "the lag of the poses cannot be told from the images" in caplog.text and "4 frames are assumed" in caplog.text


@pytest.mark.parametrize("lag", [None, -3])
def test_poses_of_other_frames_are_told_before_the_images_are_looked_at(plane, lag, monkeypatch):
    monkeypatch.setattr(stereomis, "_look", None)
    write_poses(plane / "groundtruth.txt", {row: stereomis_copy.pose_of_frame(row % 8) for row in range(500, 508)})
    with pytest.raises(SequenceError, match=f"8 chosen frames, 0 to 7 with a lag of {lag or 4}; it holds those of 500 to 507"):
        read_stereomis(plane, pose_lag=lag)


@pytest.mark.thorough
@pytest.mark.slow
def test_a_pose_that_is_needed_with_any_lag_is_refused_before_the_images_are_looked_at(tmp_path, monkeypatch):
    root = write_stereomis(tmp_path / "P2_1")
    lines = (root / "groundtruth.txt").read_text().splitlines()
    (root / "groundtruth.txt").write_text("\n".join("20 0 0 nan 0 0 0 1" if line.startswith("20 ") else line for line in lines))
    monkeypatch.setattr(stereomis, "_look", None)
    with pytest.raises(SequenceError, match="groundtruth.txt: number 20 is not a pose"):
        read_stereomis(root)


def test_frames_without_pose_are_counted_in_the_log(plane_source, caplog):
    with caplog.at_level(logging.INFO):
        read_stereomis(plane_source, pose_lag=0)
    assert "groundtruth.txt: skipped, without a pose: 1 of 8 frames" in caplog.text


@pytest.mark.parametrize(("split", "numbers"), [("train", [0, 4, 5]), ("test", [6, 7]), (None, [0, 1, 2, 4, 5, 6, 7])])
def test_splits_end_before_their_end(plane_source, split, numbers):
    assert numbers_of(read_stereomis(plane_source, split=split, pose_lag=0)) == numbers


def test_range_and_step(plane_source):
    assert numbers_of(read_stereomis(plane_source, start=1, stop=7, step=2, pose_lag=0)) == [1, 5]  # 3 has no pose


def test_reading_is_lazy_and_repeatable(plane):
    write_rgb(plane / "masks/000001l.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    write_rgb(plane / "masks/000005l.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    write_rgb(plane / "masks/000008l.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    recording = read_stereomis(plane, mask_polarity="tool", masks_rectified=True, pose_lag=0)
    first = next(iter(recording))
    (plane / "masks/000005l.png").write_bytes(b"damaged")
    assert next(iter(recording)).stamp_ns == first.stamp_ns
    with pytest.raises(SequenceError, match="000005l.png"):
        list(recording)


def test_mask_is_borrowed_from_a_neighbour_only(plane, caplog):
    tool = np.zeros((HEIGHT, WIDTH), np.uint8)
    tool[60:100, 60:] = 255
    for number in (0, 4):
        write_rgb(plane / f"masks/{number:06d}l.png", tool)
    frames = dict(zip((0, 1, 2, 4, 5, 6, 7), read_stereomis(plane, pose_lag=0, masks_rectified=False), strict=True))
    for number in (0, 1, 4, 5):
        mask = frames[number].mask
        assert mask.shape == (HEIGHT, WIDTH) and set(np.unique(mask)) == {0, 255}
        assert mask[80, 120] == 0  # the tool
        assert mask[20, 80] == 255
    assert frames[2].mask[80, 120] == frames[7].mask[80, 120] == 255  # no mask within one frame
    assert "no mask for 3 of 7 frames" in caplog.text
    for file in (plane / "masks").iterdir():
        file.unlink()
    read_stereomis(plane, pose_lag=0)
    assert "no mask for 7 of 7 frames" in caplog.text


# ------------------------------------------------------------------------------------ the forms in which copies are found


def assert_masks_and_poses_fit(root: Path, recording, lag: int, size: tuple[int, int]):
    """Masks are where the tools are in rectified images, and poses those at which the frames were rendered."""
    frames = list(recording)
    numbers = numbers_of(frames, FPS)
    assert numbers == [n for n in range(COUNT) if 0 <= n - lag < COUNT and n - lag not in (7, 8, 21)]
    raw = Rectification.stereo(read_stereo_ini(root / "StereoCalibration.ini"))
    for number, frame in zip(numbers, frames, strict=True):
        assert (frame.camera.width, frame.camera.height) == size
        np.testing.assert_allclose(frame.camera.pose, raw.pose(stereomis_copy.pose_of_frame(number)), atol=1e-6)
        left, _, tool = stereomis_copy.raw_frame(number)
        truth = cv2.resize(raw.left(tool), size, interpolation=cv2.INTER_NEAREST) > 0
        masked = (frame.mask == 0) & (cv2.resize(raw.valid, size, interpolation=cv2.INTER_NEAREST) > 0)
        assert (truth & masked).sum() / (truth | masked).sum() > 0.85  # a pixel off is 0.9; rectified again 0.3
        expected = cv2.resize(raw.left(left), size, interpolation=cv2.INTER_AREA).astype(float)
        assert np.median(np.abs(frame.image - expected)) < 4


FORMS = {
    "as published": ({}, 4, "rectified images", 1),
    "masks from 0": ({"first_mask": 0, "lag": 2, "masked": range(2, 37)}, 2, "rectified images", 0),
    "masks from 1": ({"masked": range(2, 37), "lag": 6}, 6, "rectified images", 1),
    "every third mask": ({"masked": range(3, 37, 3), "lag": -3}, -3, "rectified images", 1),
    "masks of tissue": ({"white": "tissue"}, 4, "rectified images", 1),
    "raw masks": ({"masks": "raw", "first_mask": 0, "lag": 0}, 0, "raw images", 0),
    "frames beside the video": ({"frames": "rectified"}, 4, "rectified images", 1),
    "frames alone": ({"frames": "rectified", "video": False}, 4, "rectified images", 1),
    "frames alone, masks from 0": (
        {"frames": "rectified", "video": False, "first_mask": 0, "masked": range(2, 37)},
        4,
        "rectified images",
        0,
    ),
    "raw frames": ({"frames": "raw", "video": False, "masks": "raw", "first_mask": 0}, 4, "raw images", 0),
}

# What each of these tests is in others.
ALIKE = "raw masks", "every third mask", "masks from 0", "masks of tissue", "frames beside the video", "frames alone, masks from 0"


@pytest.mark.slow
@pytest.mark.parametrize("form", [pytest.param(form, marks=pytest.mark.thorough) if form in ALIKE else form for form in FORMS])
def test_every_form_is_recognised_from_its_data(form, tmp_path, caplog):
    options, lag, kind, first = FORMS[form]
    root = write_stereomis(tmp_path / "P2_1", **options)
    with caplog.at_level(logging.INFO):
        recording = read_stereomis(root, max_mask_gap=3)
    small = not options.get("video", True) and options["frames"] == "rectified"
    if "every" not in form:  # frames between masks have that of a neighbour
        assert_masks_and_poses_fit(root, recording, lag, stereomis_copy.SMALL if small else (stereomis_copy.WIDTH, stereomis_copy.HEIGHT))
    assert f"poses lag the images by {counted(lag, 'frame')}:" in caplog.text
    assert re.search(rf"masks are taken for those of {kind} \(.*, numbered from {first} \(", caplog.text)
    assert f"white is taken for {options.get('white', 'tool').replace('tool', 'tools')}" in caplog.text
    if small:
        assert "images are taken for rectified ones" in caplog.text
    assert not [record for record in caplog.records if record.levelno > logging.INFO and "no mask" not in record.message]


@pytest.mark.slow
def test_a_video_that_ends_before_its_masks_is_read_as_far_as_it_goes(tmp_path, monkeypatch):
    root = write_stereomis(tmp_path / "P2_1", masked=range(20, COUNT))
    (video,) = root.glob("*.mp4")
    short = tmp_path / "short.mp4"
    write_video(short, (np.vstack(stereomis_copy.raw_frame(number)[:2]) for number in range(8)), fps=FPS)
    shutil.move(short, video)
    start = Video.__init__

    def claim(self, path):
        start(self, path)
        self.frame_count = COUNT

    monkeypatch.setattr(Video, "__init__", claim)
    assert len(list(read_stereomis(root, stop=6, step=2, pose_lag=0))) == 3


@pytest.mark.slow
def test_one_stray_mask_does_not_tell_what_all_are_numbered_from(tmp_path, caplog):
    root = write_stereomis(tmp_path / "P2_1", first_mask=0, masked=range(2, 37))
    shutil.copy(root / "masks/000036l.png", root / f"masks/{COUNT:06d}l.png")  # counted from 1 it would be of the last frame
    with caplog.at_level(logging.INFO):
        recording = read_stereomis(root, max_mask_gap=3)
    assert_masks_and_poses_fit(root, recording, 4, (stereomis_copy.WIDTH, stereomis_copy.HEIGHT))
    assert "masks are taken for those of rectified images" in caplog.text and "numbered from 0 (edges" in caplog.text
    assert f"no frame from 0 to {COUNT - 1} for 1 of 36 masks" in caplog.text


@pytest.mark.slow
@pytest.mark.parametrize("copied", [True, False], ids=["with a part of the recording", "of a recording that is cut short"])
def test_masks_that_begin_later_are_counted_from_the_first_frame_if_outlines_say_so(tmp_path, caplog, copied):
    root = write_stereomis(tmp_path / "P2_1", masked=range(0 if copied else 5, COUNT))
    names = sorted(path.name for path in (root / "masks").iterdir())
    moved = 6 if copied else 0  # by which they are numbered higher than the frames
    for name in reversed(names):
        (root / "masks" / name).rename(root / f"masks/{int(name[:6]) + moved:06d}l.png")
    if not copied:
        shutil.copy(root / "masks" / names[-1], root / f"masks/{COUNT + 3:06d}l.png")
    with caplog.at_level(logging.INFO):
        recording = read_stereomis(root, max_mask_gap=3, pose_lag=4)
    assert f"numbered from {1 + moved} (edges" in caplog.text
    assert_masks_and_poses_fit(root, recording, 4, (stereomis_copy.WIDTH, stereomis_copy.HEIGHT))


@pytest.mark.slow
def test_exchanged_eyes_of_lenses_that_converge_are_refused(tmp_path):
    root = write_stereomis(tmp_path / "P2_1", masks=None)
    write_video(next(root.glob("*.mp4")), (np.vstack(stereomis_copy.raw_frame(number)[1::-1]) for number in range(COUNT)), fps=FPS)
    with pytest.raises(SequenceError, match="ini: left and right eye are exchanged: rows of features of frame 4 are 1"):
        next(iter(read_stereomis(root)))


@pytest.mark.slow
def test_options_overrule_what_images_tell(tmp_path, caplog):
    root = write_stereomis(tmp_path / "P2_1")
    with caplog.at_level(logging.INFO):
        stated = read_stereomis(root, pose_lag=0, first_mask=0, masks_rectified=False)
    assert "looking at" not in caplog.text
    found = read_stereomis(root)
    assert numbers_of(stated, FPS)[0] == 0 and numbers_of(found, FPS)[0] == 4
    assert not np.array_equal(next(iter(stated)).mask, next(iter(found)).mask)


@pytest.mark.slow
def test_camera_at_rest_does_not_tell_the_lag(tmp_path, caplog):
    root = write_stereomis(tmp_path / "P2_1", lag=None)
    write_poses(root / "groundtruth.txt", {row: stereomis_copy.pose_of_frame(5) for row in range(COUNT)})
    assert numbers_of(read_stereomis(root), FPS)[0] == 4
    assert "the camera moves too little" in caplog.text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lag", "how"), mostly_thorough([(10, "best with the largest lag that is tried"), (None, "with no lag from -10 to 10 frames")])
)
def test_poses_that_fit_the_images_with_no_lag_are_refused_unless_one_is_stated(tmp_path, lag, how):
    root = write_stereomis(tmp_path / "P2_1", lag=lag)
    if lag is None:
        write_poses(root / "groundtruth.txt", {row: stereomis_copy.true_poses()[-1 - row] for row in range(COUNT)})
    with pytest.raises(SequenceError, match=f"groundtruth.txt: its poses fit the images {how} .*; pass pose_lag"):
        read_stereomis(root)
    assert numbers_of(read_stereomis(root, pose_lag=4), FPS)[0] == 4


@pytest.mark.slow
def test_poses_the_wrong_way_round_are_refused_as_such(tmp_path):
    root = write_stereomis(tmp_path / "P2_1")
    write_poses(root / "groundtruth.txt", {row: np.linalg.inv(stereomis_copy.pose_of_frame(row + 4)) for row in range(COUNT)})
    with pytest.raises(
        SequenceError, match=r"groundtruth.txt: its poses are world-to-camera: .* px with inverse poses; invert each, or pass poses=sfm"
    ):
        read_stereomis(root)
    assert numbers_of(read_stereomis(root, pose_lag=4), FPS)[0] == 4


def test_poses_in_millimetres_are_refused_unless_a_lag_is_stated(tmp_path):
    root = write_stereomis(tmp_path / "P2_1")
    poses = {row: stereomis_copy.pose_of_frame(row + 4).copy() for row in range(COUNT)}
    for pose in poses.values():
        pose[:3, 3] *= 1e3
    write_poses(root / "groundtruth.txt", poses)
    with pytest.raises(SequenceError, match=r"groundtruth.txt: its poses are wrong, or not in metres: they span \d+"):
        read_stereomis(root)
    assert numbers_of(read_stereomis(root, pose_lag=4), FPS)[0] == 4


def test_video_whose_eyes_are_not_on_top_of_each_other_is_refused(tmp_path):
    root = write_stereomis(tmp_path / "P2_1")
    write_video(next(root.glob("*.mp4")), (np.hstack(stereomis_copy.raw_frame(number)[:2]) for number in range(2)), fps=FPS)
    with pytest.raises(SequenceError, match="seem to have the eyes side by side, as .* on top of the right one: stack the eyes so"):
        read_stereomis(root)


@pytest.mark.slow
def test_poses_that_fit_badly_are_told(tmp_path, caplog):
    root = write_stereomis(tmp_path / "P2_1")
    poses = {row: stereomis_copy.pose_of_frame(row + 4).copy() for row in range(COUNT)}
    rng = np.random.default_rng(0)
    for pose in poses.values():
        pose[:3, 3] += rng.normal(0, 0.0015, 3)
    write_poses(root / "groundtruth.txt", poses)
    read_stereomis(root)
    assert [record.levelname for record in caplog.records if "that is far: tissue moves, or poses are inexact" in record.message] == [
        "WARNING"
    ]


@pytest.mark.thorough
@pytest.mark.slow
def test_poses_can_be_estimated_instead(tmp_path):
    root = write_stereomis(tmp_path / "P2_1")
    frames = list(read_stereomis(root, poses="sfm", start=4, stop=34, step=6))
    first = np.linalg.inv(frames[0].camera.pose) @ frames[-1].camera.pose
    raw = Rectification.stereo(read_stereo_ini(root / "StereoCalibration.ini"))
    one, other = (raw.pose(stereomis_copy.pose_of_frame(n)) for n in (4, 28))
    truth = np.linalg.inv(one) @ other
    assert len(frames) == 5
    assert np.linalg.norm(first[:3, 3] - truth[:3, 3]) < 0.15 * np.linalg.norm(truth[:3, 3])
    with pytest.raises(SequenceError, match="poses must be sfm"):
        read_stereomis(root, poses="colmap")


@pytest.mark.thorough
@pytest.mark.slow
def test_memory_does_not_grow_with_the_sequence(tmp_path):
    root = write_stereomis(tmp_path / "P2_1")
    video, masks = next(root.glob("*.mp4")), root / "masks"
    images = [np.vstack(stereomis_copy.raw_frame(n)[:2]) for n in range(COUNT)]
    write_video(video, (images[n % COUNT] for n in range(10 * COUNT)), fps=FPS)
    poses = {row: stereomis_copy.pose_of_frame(row % COUNT + 4) for row in range(10 * COUNT)}
    write_poses(root / "groundtruth.txt", poses)
    for number in range(COUNT + 1, 10 * COUNT + 1):
        shutil.copy(masks / f"{(number - 1) % COUNT + 1:06d}l.png", masks / f"{number:06d}l.png")
    # So many whole frames would be 110 MB; the images that are looked at are bounded.
    assert peak_of(lambda: collections.deque(read_stereomis(root), 0)) < 40


def test_a_lag_of_poses_that_are_estimated_is_told(plane, caplog):
    read_stereomis(plane, poses="sfm", pose_lag=100)
    assert "pose_lag has no effect while poses are estimated" in caplog.text
    caplog.clear()
    read_stereomis(plane, poses="sfm")
    assert "pose_lag" not in caplog.text


@pytest.mark.parametrize("lag", [None, 4])
def test_a_pose_that_is_none_matters_only_where_its_frame_is_asked_for(plane, lag):
    lines = (plane / "groundtruth.txt").read_text().splitlines()
    row = next(int(line.split()[0]) for line in lines[2:])
    (plane / "groundtruth.txt").write_text("\n".join(line if line.split()[0] != str(row) else f"{row} 0 0 nan 0 0 0 1" for line in lines))
    assert len(list(read_stereomis(plane, stop=row + 4, pose_lag=lag))) > 0
    with pytest.raises(SequenceError, match=f"groundtruth.txt: number {row} is not a pose"):
        read_stereomis(plane, pose_lag=lag)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("StereoCalibration.ini", None, "StereoCalibration.ini: file is missing"),
        (
            "StereoCalibration.ini",
            "[StereoLeft]\nres_x=1\nres_y=1\nfc_x=5",
            r"StereoCalibration.ini: \[StereoLeft\] fc_y",
        ),
        ("StereoCalibration.ini", "[StereoLeft]\nres_x=inf\nres_y=9", r"\[StereoLeft\] res_x is not a number: 'inf'"),
        ("StereoCalibration.ini", "no ini at all", "StereoCalibration.ini: not a readable ini"),
        ("groundtruth.txt", "0 0 0 0 0 0 1", "groundtruth.txt: line 1 has 7 numbers, expected 8"),
        ("groundtruth.txt", "0 0 0 0 0 0 0 0", "groundtruth.txt: number 0 is not a pose"),
        ("groundtruth.txt", "0 0 0 0 0 0 0 1\n1 0 0 nan 0 0 0 1", "groundtruth.txt: number 1 is not a pose"),
        ("groundtruth.txt", "0 0 0 0 0 0 0 1\n0 0 0 1 0 0 0 1", "groundtruth.txt: line 2 repeats frame 0"),
        ("groundtruth.txt", "0 0 0 0 0 0 0 1\nx y", "groundtruth.txt: line 2 is not made of numbers"),
        ("groundtruth.txt", "", "groundtruth.txt: holds no poses"),
        ("groundtruth.txt", "99 0 0 0 0 0 0 1", "groundtruth.txt: holds no pose for any of the 8"),
        ("groundtruth.txt", "1000000000 0 0 0 0 0 0 1", "groundtruth.txt: holds no pose for any of the 8"),
        ("IFBS_ENDOSCOPE-part0001.mp4", "not a video", "part0001.mp4: not a readable video"),
        ("IFBS_ENDOSCOPE-part0001.mp4", None, "holds neither a video"),
        ("second.mp4", "", "more than one video"),
        ("train_split.csv", "start,end\n9,2\n", "train_split.csv: line 2 is not a range"),
        ("train_split.csv", "start,end\n2,2\n", "train_split.csv: line 2 is not a range"),
        ("train_split.csv", "start,end\n1000000,2000000\n", "the train split of train_split.csv holds none of the frames 0 to 7"),
        ("train_split.csv", None, "train_split.csv: file is missing"),
    ],
)
def test_damaged_stereomis_is_refused_by_name(plane, name, text, message):
    (plane / name).unlink(missing_ok=True)
    if text is not None:
        (plane / name).write_text(text)
    with pytest.raises(SequenceError, match=message):
        read_stereomis(plane, split="train" if "split" in name else None)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda masks: write_rgb(masks / "000001l.png", np.zeros((64, 64), np.uint8)), "000001l.png: is 64×64, but the images are 160×128"),
        (lambda masks: write_rgb(masks / "000004l.png", np.zeros((64, 64), np.uint8)), "000004l.png: is 64×64, but the images are 160×128"),
        (lambda masks: (masks / "000001l.png").write_bytes(b"no image"), "000001l.png: not a readable image"),
        (lambda masks: write_rgb(masks / "P1_1l.png", np.zeros((64, 80), np.uint8)), "have the same number"),
    ],
)
def test_damaged_masks_are_refused_by_name(plane, damage, message):
    for number in range(1, 9):
        write_rgb(plane / f"masks/{number:06d}l.png", np.zeros((64, 80), np.uint8))
    damage(plane / "masks")
    with pytest.raises(SequenceError, match=message):
        read_stereomis(plane)


@pytest.mark.parametrize(
    ("poses", "message"), [("slam", "poses must be sfm, vggt or"), ("vggt:nowhere", "nowhere: there is no checkpoint")]
)
def test_unknown_ways_to_poses_are_refused_before_the_images_are_looked_at(plane, poses, message, monkeypatch):
    monkeypatch.setattr(stereomis, "_look", None)
    with pytest.raises(SequenceError, match=message):
        read_stereomis(plane, poses=poses)


def test_negative_gap_of_masks_is_refused(plane):
    with pytest.raises(SequenceError, match="max_mask_gap must be 0 or more, got -1"):
        read_stereomis(plane, max_mask_gap=-1)


def test_masks_of_another_sequence_are_told_once(plane, caplog):
    for number in (0, 8, 10**6):
        write_rgb(plane / f"masks/{number:06d}l.png", np.zeros((64, 80), np.uint8))
    read_stereomis(plane, pose_lag=0)
    (told,) = [record.getMessage() for record in caplog.records if "masks: " in record.getMessage()]
    what = "no frame from 0 to 7 for 2 of 3 masks, and outlines do not tell what the others belong to"
    assert told == f"{plane / 'masks'}: {what}: masks of another sequence, or another first_mask?"


@pytest.mark.parametrize(("more", "level"), [(3, logging.INFO), (30, logging.WARNING)])
def test_rows_of_poses_after_the_last_frame_are_told(plane, caplog, more, level):
    caplog.set_level(logging.INFO)
    with (plane / "groundtruth.txt").open("a", encoding="utf-8") as file:
        file.writelines(f"{8 + n} 0 0 0 0 0 0 1\n" for n in range(more))
    read_stereomis(plane, pose_lag=0)
    (told,) = [record for record in caplog.records if "after the last frame" in record.getMessage()]
    asked = ": poses of another sequence, or a part of the images?" if level == logging.WARNING else ""
    said = f"{more} of {7 + more} rows are after the last frame, 7{asked}"
    assert told.levelno == level and told.getMessage() == f"{plane / 'groundtruth.txt'}: {said}"


def test_masks_of_no_frame_are_refused_and_nothing_else_is_said_of_them(plane, caplog):
    write_rgb(plane / "masks/000300l.png", np.zeros((64, 80), np.uint8))
    with (
        caplog.at_level(logging.INFO),
        pytest.raises(SequenceError, match="masks: holds numbers from 300 to 300, but frames go from 0 to 7"),
    ):
        read_stereomis(plane, pose_lag=0)
    assert not caplog.records


def test_right_images_must_be_there(plane):
    next(plane.glob("*.mp4")).unlink()
    write_rgb(plane / "video_frames/000001l.png", np.zeros((64, 80, 3), np.uint8))
    with pytest.raises(SequenceError, match="video_frames: the right image of 000001l.png is missing"):
        read_stereomis(plane)
