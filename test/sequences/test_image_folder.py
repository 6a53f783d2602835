"""The reader of image folders."""

import logging
import shutil
import struct
import zlib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from plane_scene import (
    BASELINE,
    HEIGHT,
    NO_DISTORTION,
    WIDTH,
    assert_frame_agrees,
    right_pose,
    see_plane,
    trajectory,
    write_poses,
    write_rgb,
)

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.physics import regions
from endo_sim_ros.reconstruction.priors.stereo import right_view
from endo_sim_ros.sequences import calibration_files, estimated_poses
from endo_sim_ros.sequences.bag import read_bag, write_bag
from endo_sim_ros.sequences.folder import read_folder
from endo_sim_ros.sequences.images import read_image
from endo_sim_ros.sequences.point_files import read_points, write_points
from endo_sim_ros.sequences.pose_files import read_poses
from endo_sim_ros.sequences.readers import open_sequence
from endo_sim_ros.sequences.structure_from_motion import StructureFromMotion

CALIBRATION = f"width: {WIDTH}\nheight: {HEIGHT}\nfx: 150\nfy: 150\ncx: {WIDTH / 2}\ncy: {HEIGHT / 2}\n"


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "recording"
    root.mkdir()
    K = np.array([[150.0, 0, WIDTH / 2 - 0.5], [0, 150.0, HEIGHT / 2 - 0.5], [0, 0, 1]])
    poses = dict(zip((1, 51, 101), trajectory(3).values(), strict=True))
    for number, pose in poses.items():
        left, points = see_plane(K, NO_DISTORTION, pose)
        right, _ = see_plane(K, NO_DISTORTION, right_pose(pose, np.eye(3), np.array([-BASELINE, 0, 0])))
        left[:, : 15 if number == 101 else 12] = 3  # a border, which wanders
        write_rgb(root / f"left/{number:05d}.png", left)
        write_rgb(root / f"right/{number:05d}.png", right)
        write_rgb(root / f"depth/{number:05d}.png", (1000 * points[..., 2]).round().astype(np.uint16))
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:30] = 0
    write_rgb(root / "masks/00051.png", mask)
    (root / "calibration.yaml").write_text(CALIBRATION + f"baseline_m: {BASELINE}\n")
    write_poses(root / "poses_left.txt", poses)
    return root


def test_a_folder_says_where_each_eye_was_read_from(folder):
    assert read_folder(folder).source == f"{folder}/left and {folder}/right" == read_folder(folder, poses="sfm").take({0}, 1).source


def test_image_folder_tells_which_files_are_lacking(folder, caplog):
    (folder / "depth/00051.png").unlink()
    read_folder(folder)
    assert "masks: no image there for 2 of 3 frames (1, 101): tools stay visible in these" in caplog.text
    assert "depth: no image there for 1 of 3 frames (51): these have no depth of their own" in caplog.text
    caplog.clear()
    shutil.rmtree(folder / "depth")
    (folder / "masks/00051.png").unlink()
    read_folder(folder)
    assert "masks: no image there for 3 of 3 frames" in caplog.text and "depth" not in caplog.text
    (folder / "left/00051.png").unlink()
    read_folder(folder)
    assert "left: no image there for 1 of 3 frames (51): their right images are left out" in caplog.text


def test_depth_that_was_made_to_be_looked_at_is_told_or_refused(folder, caplog):
    for path in sorted((folder / "depth").iterdir()):
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        eight = (depth // 2).clip(0, 255).astype(np.uint8)
        cv2.imwrite(str(path), np.stack([eight] * 3, -1))
    frame = next(iter(read_folder(folder, depth_scale=2e-3)))
    assert "has 8 bits, so that depth goes in steps of 2 mm up to 0.51 m; if it was made to be looked at, leave" in caplog.text
    assert caplog.text.count("has 8 bits") == 1 and frame.depth is not None and frame.depth.max() == pytest.approx(eight.max() * 2e-3)
    cv2.imwrite(str(path), cv2.applyColorMap(eight, cv2.COLORMAP_TURBO))
    with pytest.raises(SequenceError, match=f"{path.name}: is a picture in colours; depth needs one channel, of 16 bits or floats"):
        list(read_folder(folder))


def test_image_folder_refuses_masks_of_other_images(folder):
    for file in (folder / "masks").iterdir():
        file.rename(file.with_name(f"9{file.name}"))
    with pytest.raises(SequenceError, match="masks: holds numbers from 9.* to 9.*, but no image in left/, from .* has one of them"):
        read_folder(folder)


def test_image_folder_refuses_units_and_times_that_cannot_be(folder):
    for name, value in (("fps", np.nan), ("depth_scale", -1e-3)):
        with pytest.raises(SequenceError, match=f"recording: {name} must be above 0"):
            read_folder(folder, **{name: value})
    with pytest.raises(SequenceError, match="frame [0-9]+ at 1e-08 Hz comes after 68 years"):
        read_folder(folder, start=2, fps=1e-8)  # before any image but the first is read


def test_poses_and_points_of_a_folder_have_a_scale(folder):
    write_points(folder, np.array([[0.1, 0.2, 0.3]]), np.array([[1.0, 0.5, 0.0]]))
    plain, twice = read_folder(folder), read_folder(folder, scale=2.0)
    for frame, other in zip(plain, twice, strict=True):
        np.testing.assert_allclose(other.camera.position, 2 * frame.camera.position)
        np.testing.assert_array_equal(other.camera.pose[:3, :3], frame.camera.pose[:3, :3])
        np.testing.assert_array_equal(other.depth, frame.depth)
    np.testing.assert_allclose(twice.points()[0], 2 * plain.points()[0])


def test_image_folder_frames(folder):
    frames = list(open_sequence(folder))
    assert [f.stamp_ns for f in frames] == [1_040_000_000, 3_040_000_000, 5_040_000_000]
    for frame in frames:
        assert frame.baseline == BASELINE
        assert not frame.mask[:, :12].any()
        assert_frame_agrees(frame)
    assert not frames[1].mask[:30].any() and frames[0].mask[10, 80] == frames[1].mask[60, 80] == 255
    assert frames[0].mask[60, 14] == 255 and not frames[2].mask[:, :15].any()


def test_points_of_a_folder_are_those_of_its_poses(folder):
    assert read_points(folder) is None
    (folder / "points.txt").write_text("# x y z r g b track\n0.01 0.02 0.1 255 0 51 7\n0 0 0.2 0 0 0 2\n")
    points, colors = read_points(folder)
    np.testing.assert_allclose(points, [[0.01, 0.02, 0.1], [0, 0, 0.2]])
    np.testing.assert_allclose(colors, [[1, 0, 0.2], [0, 0, 0]])
    for text, reason in (
        ("1 2 3\n", "not lines of x y z r g b"),
        ("0 0 nan 1 1 1\n", "finite"),
        ("0 0 1 300 1 1\n", "0 to 255"),
        ("", "expected finite"),
    ):
        (folder / "points.txt").write_text(text)
        with pytest.raises(SequenceError, match=f"points.txt: .*{reason}"):
            read_points(folder)
        with pytest.raises(SequenceError, match=f"points.txt: .*{reason}"):
            read_folder(folder).points()
    write_points(folder, points, colors)
    again = read_folder(folder).points()
    assert again is not None
    np.testing.assert_allclose(again[0], points)
    np.testing.assert_allclose(again[1], colors)


def test_image_folder_with_left_images_only(folder):
    shutil.rmtree(folder / "right")
    shutil.rmtree(folder / "depth")
    (folder / "calibration.yaml").write_text(CALIBRATION)
    frames = list(read_folder(folder, step=2, mask_border=False))
    assert len(frames) == 2
    assert frames[0].right is None and frames[0].baseline is None and frames[0].depth is None
    assert frames[0].mask.all()


def test_a_folder_of_one_eye_takes_intrinsics_as_options(folder):
    with pytest.raises(SequenceError, match="recording: baseline_m is missing, but there are right images"):
        read_folder(folder, fx=150.0)
    shutil.rmtree(folder / "right")
    (folder / "calibration.yaml").unlink()
    with pytest.raises(SequenceError, match="calibration.yaml: file is missing; .*; of one eye, fx .* may be passed instead"):
        read_folder(folder)
    with pytest.raises(SequenceError, match="fy, cx, cy, distortion and baseline_m need fx as well"):
        read_folder(folder, cx=80.0)
    frame = next(iter(read_folder(folder, fx=150.0, cy=60.0)))
    np.testing.assert_allclose(frame.camera.K, [[150, 0, WIDTH / 2], [0, 150, 60], [0, 0, 1]])


def test_intrinsics_of_one_eye_are_estimated_with_its_poses(folder, monkeypatch):
    """Frames are those of the same camera in a file; they are estimated from raw images."""
    shutil.rmtree(folder / "right")
    poses, given = read_poses(folder / "poses_left.txt"), []
    (folder / "poses_left.txt").unlink()
    K, distortion = np.array([[150.0, 0, WIDTH / 2], [0, 152.0, HEIGHT / 2], [0, 0, 1]]), (-0.2,)

    def estimate(views, K_known, **options):
        given.append((K_known, options["scale"], [view.image for view in views]))
        placed = {position: poses[number] for position, number in enumerate((1, 51, 101)) if number != 51}
        return StructureFromMotion(placed, K, distortion, 0.5, True)

    monkeypatch.setattr(estimated_poses, "estimate_poses", estimate)
    (folder / "calibration.yaml").write_text(CALIBRATION.replace("fy: 150", "fy: 152") + "distortion: [-0.2]\n")
    expected = list(read_folder(folder))
    (folder / "calibration.yaml").unlink()
    frames = list(read_folder(folder, scale=0.05))
    assert given[1][:2] == (None, 0.05) and np.array_equal(given[0][0], expected[0].camera.K)
    np.testing.assert_array_equal(given[1][2][2], read_image(folder / "left/00101.png"))
    assert [frame.stamp_ns for frame in frames] == [frame.stamp_ns for frame in expected] and len(frames) == 2
    for frame, other in zip(frames, expected):
        for name in ("image", "mask", "depth"):
            np.testing.assert_array_equal(getattr(frame, name), getattr(other, name), name)
        np.testing.assert_allclose(frame.camera.K, other.camera.K)
        np.testing.assert_array_equal(frame.camera.pose, other.camera.pose)


def test_eyes_that_are_stated_beside_right_images_are_refused(folder):
    with pytest.raises(SequenceError, match="has right/, so that eyes=one has no effect; leave it out, or take right/ away"):
        read_folder(folder, eyes="one")


@pytest.mark.parametrize("options", [{}, {"fx": 150.0, "baseline_m": BASELINE}])
def test_images_of_both_eyes_in_one_are_read_as_pairs(folder, options):
    expected = list(read_folder(folder))
    for file in (folder / "right").iterdir():
        left = folder / "left" / file.name
        write_rgb(left, np.hstack([read_image(left), read_image(file)]))
    shutil.rmtree(folder / "right")
    if options:
        (folder / "calibration.yaml").unlink()
    frames = list(read_folder(folder, eyes="left_right", **options))
    assert len(frames) == len(expected) == 3
    for frame, other in zip(frames, expected):
        for name in ("image", "right", "mask", "depth", "baseline", "stamp_ns"):
            np.testing.assert_array_equal(getattr(frame, name), getattr(other, name), name)
        np.testing.assert_array_equal(frame.camera.K, other.camera.K)
        np.testing.assert_array_equal(frame.camera.pose, other.camera.pose)


@pytest.mark.parametrize("in_one", [False, True])
def test_a_border_of_lifted_black_is_no_tissue_of_the_right_eye(tmp_path, in_one):
    tissue = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (120, 200, 3)), (0, 0), 2)
    tissue = np.uint8(np.clip(120 + 4 * (tissue - tissue.mean()), 60, 255))
    for number in range(6):
        left, right = tissue[:, number : number + 160].copy(), tissue[:, number + 12 : number + 172].copy()
        for eye in (left, right):
            eye[:, :20] = eye[:, -20:] = 24
        for name, image in {"left": np.hstack([left, right])}.items() if in_one else {"left": left, "right": right}.items():
            write_rgb(tmp_path / f"{name}/{number}.png", image)
    write_poses(tmp_path / "poses_left.txt", dict.fromkeys(range(6), np.eye(4)))
    frames = list(read_folder(tmp_path, fx=150.0, baseline_m=BASELINE))
    masks = [right_view(frame).mask for frame in frames]
    assert len(masks) == 6 and all(not mask[:, :20].any() and not mask[:, -20:].any() and mask[:, 30:-30].all() for mask in masks)
    np.testing.assert_array_equal(frames[1].right[:, 30:-30], tissue[:, 43:143])
    assert (next(iter(read_folder(tmp_path, fx=150.0, baseline_m=BASELINE, mask_border=False))).right[:, :20] == 24).all()


def test_hidden_files_are_no_images(folder):
    count = len(list(read_folder(folder)))
    shutil.copy(folder / "left" / "00001.png", folder / "left" / "._00001.png")  # as macOS leaves them
    assert len(list(read_folder(folder))) == count > 0


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("calibration.yaml", None, "calibration.yaml: file is missing"),
        ("calibration.yaml", "fx: [", "calibration.yaml: not a readable YAML"),
        ("calibration.yaml", "fx: 1\n", "calibration.yaml: fy is missing; give lines as `fx: 907.4`"),
        ("calibration.yaml", "fx: -1\n", "calibration.yaml: fx must be a positive number below 1e9, got -1"),
        ("calibration.yaml", CALIBRATION, "calibration.yaml: baseline_m is missing"),
        ("calibration.yaml", CALIBRATION.replace("160", "320") + "baseline_m: 0.005\n", "width and height are 320×128"),
        (
            "calibration.yaml",
            CALIBRATION + "baseline_m: 0.005\ncx: 320\n",
            r"calibration.yaml: the principal point \(320, 64\) lies out",
        ),
        ("right/00051.png", None, "right image of 00051.png is missing"),
        ("left/00001.png", "x", "left/00001.png: not a readable image"),
        ("left/a00001.png", "x", "have the same number, the last in the name; rename one"),
    ],
)
def test_damaged_image_folder_is_refused_by_name(folder, name, text, message):
    (folder / name).unlink(missing_ok=True)
    if text is not None:
        (folder / name).write_text(text)
    with pytest.raises(SequenceError, match=message):
        list(read_folder(folder))


@pytest.mark.parametrize("thumbnail", [False, True])
def test_a_jpeg_that_is_cut_off_is_damaged(folder, thumbnail):
    """Its rest would be grey."""
    whole = cv2.imencode(".jpg", cv2.imread(str(folder / "left/00001.png")))[1].tobytes()
    if thumbnail:  # of its own, and whole, in a header of the first one's
        whole = whole[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(whole)) + whole + whole[2:]
    (folder / "left/00001.png").unlink()
    (folder / "left/00001.jpg").write_bytes(whole + b"\0" * 100)  # some cameras write more after the end
    assert len(read_folder(folder)) == 3
    (folder / "left/00001.jpg").write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises(SequenceError, match="left/00001.jpg: not a readable image; the file is damaged, copy it again"):
        list(read_folder(folder))


def test_images_of_other_formats_are_read_or_refused(folder):
    """Left out without a word, half of a recording would be missing."""
    image = cv2.imread(str(folder / "left/00001.png"))
    (folder / "left/00001.png").unlink()
    cv2.imwrite(str(folder / "left/00001.webp"), image, [cv2.IMWRITE_WEBP_QUALITY, 101])
    assert (next(iter(read_folder(folder, mask_border=False))).image == image[..., ::-1]).all()
    (folder / "left/00002.exr").touch()
    with pytest.raises(SequenceError, match="left: 00002.exr is of a format that is not read; convert such images"):
        read_folder(folder)


def test_images_that_are_left_out_or_not_of_8_or_16_bits_are_told(folder, caplog):
    shutil.copy(folder / "left/00001.png", folder / "left/first.png")
    read_folder(folder)
    assert f"{folder}/left: images without a number in their names are left out: first.png" in caplog.text
    cv2.imwrite(str(folder / "left/00003.tiff"), np.zeros((8, 8, 3), np.float32))
    with pytest.raises(SequenceError, match=r"00003.tiff: is an image of float32 numbers; convert it to 8 or 16 bits"):
        read_image(folder / "left/00003.tiff")
    (folder / "left/00003.tiff").unlink()
    for side in "lr":
        shutil.copy(folder / "left/00001.png", folder / f"left/00007{side}.png")
    with pytest.raises(SequenceError, match="00007l.png and 00007r.png are of two eyes, as in StereoMIS; put its StereoCalibration.ini"):
        read_folder(folder)


def test_poses_that_are_numbered_otherwise_than_images_are_told(folder, caplog):
    write_poses(folder / "poses_left.txt", dict(zip((51, 101, 151), trajectory(3).values(), strict=True)))
    with caplog.at_level(logging.WARNING):
        read_folder(folder)
        assert "its numbers begin" not in caplog.text  # these are others
        write_poses(folder / "poses_left.txt", dict(zip((2, 52, 102, 51), trajectory(4).values(), strict=True)))
        read_folder(folder)
    assert "poses_left.txt: its numbers begin with 2, those of the images with 1: if the first pose is that of the first" in caplog.text


def test_a_huge_image_is_one_sentence(tmp_path):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(bytes(1000))), chunk(b"IEND", b"")
    (tmp_path / "1.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    with pytest.raises(SequenceError, match=r"1.png: the image has over 64 megapixels"):
        read_image(tmp_path / "1.png")
    with pytest.raises(ConfigError, match=r"1.png has over 64 megapixels"):
        regions._read_mask(str(tmp_path / "1.png"))


@pytest.mark.parametrize("orientation", [3, 6])
def test_images_are_as_stored_whatever_exif_says(tmp_path, orientation):
    """Calibrations and masks are of what is stored."""
    image = np.zeros((16, 32, 3), np.uint8)
    image[:, :16] = 200
    coded = cv2.imencode(".jpg", image)[1].tobytes()
    tag = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0" + bytes([orientation]) + b"\0\0\0\0\0\0"
    segment = b"Exif\0\0" + tag
    (tmp_path / "1.jpg").write_bytes(coded[:2] + b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment + coded[2:])
    assert cv2.imread(str(tmp_path / "1.jpg")).shape != image.shape or cv2.imread(str(tmp_path / "1.jpg"))[8, 4].max() < 50  # OpenCV turns
    read = read_image(tmp_path / "1.jpg")
    assert read.shape == image.shape and read[8, 4].min() > 150 > 50 > read[8, 28].max()


def test_an_image_of_ten_bits_in_sixteen_is_not_black_but_told(tmp_path):
    shades = np.random.default_rng(0).integers(0, 1024, (8, 8, 3), np.uint16)
    cv2.imwrite(str(tmp_path / "10.png"), shades)
    cv2.imwrite(str(tmp_path / "16.png"), 64 * shades)
    np.testing.assert_array_equal(read_image(tmp_path / "16.png"), (shades >> 2)[..., ::-1])
    with pytest.raises(
        SequenceError, match=r"10.png: has 16 bits, but no value above 10\d\d, as of a camera of 10 or 12 bits; scale images"
    ):
        read_image(tmp_path / "10.png")


def test_a_baseline_in_millimetres_is_refused(folder, caplog):
    frames = [replace(frame, baseline=5.4) for frame in read_folder(folder)]
    assert "apart" not in caplog.text
    (folder / "calibration.yaml").write_text(CALIBRATION + "baseline_m: 5.4\n")
    refusal = r"the two eyes would be 5.4 m apart; give metres, 0.0054 if this is millimetres"
    with pytest.raises(SequenceError, match=f"calibration.yaml: baseline_m: {refusal}"):
        read_folder(folder)
    write_bag(folder.parent / "bag", frames)
    with pytest.raises(SequenceError, match=f"bag: endoscope/right/camera_info: P: {refusal}"):
        list(read_bag(folder.parent / "bag"))


def test_a_baseline_of_no_endoscope_is_told_once(folder, caplog):
    calibration_files.check_baseline.cache_clear()
    (folder / "calibration.yaml").write_text(CALIBRATION + "baseline_m: 0.12\n")
    for _ in range(2):
        read_folder(folder)
    assert caplog.text.count("calibration.yaml: baseline_m: the two eyes would be 120 mm apart, those of laparoscopes are 3 to 6") == 1


def test_a_logo_is_masked_where_the_lens_moves(tmp_path):
    K, poses = np.array([[150.0, 0, WIDTH / 2 - 0.5], [0, 150.0, HEIGHT / 2 - 0.5], [0, 0, 1]]), trajectory(6)
    for number, pose in poses.items():
        image, _ = see_plane(K, NO_DISTORTION, pose)
        image[-16:, 4:24] = 20, 40, 120
        image[-10:-6, 8:20] = 240
        write_rgb(tmp_path / f"left/{number:05d}.png", image)
    (tmp_path / "calibration.yaml").write_text(CALIBRATION)
    for moves in True, False:
        write_poses(tmp_path / "poses_left.txt", poses if moves else dict.fromkeys(poses, np.eye(4)))
        masks = [frame.mask for frame in read_folder(tmp_path)]
        assert len(masks) == 6 and all(mask[:-20].all() and mask[-16:, 4:24].any() != moves for mask in masks)
    assert all(frame.mask.all() for frame in read_folder(tmp_path, mask_border=False))


def test_a_dark_recording_is_told_that_most_of_it_is_left_out(folder, caplog):
    for path in (folder / "left").iterdir():
        write_rgb(path, read_image(path) // 12)
    list(read_folder(folder))
    (told,) = [record.getMessage() for record in caplog.records if "mask_border=false" in record.getMessage()]
    assert str(folder) in told and "% of its pictures is dark to their edges and left out" in told
    caplog.clear()
    list(read_folder(folder, mask_border=False))
    assert "mask_border" not in caplog.text
