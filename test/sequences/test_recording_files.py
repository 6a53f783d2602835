"""What readers share: poses, numbers, masks, the lit area."""

from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from plane_scene import pose_of, write_poses

from endo_sim_ros.core.cameras import matrix_to_quat, quat_to_matrix
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences import pose_files
from endo_sim_ros.sequences.images import numbered_files
from endo_sim_ros.sequences.masks import UNMASKED, MaskFiles, lit_area, lit_now, lit_part, tool_is_white
from endo_sim_ros.sequences.pose_files import read_poses
from endo_sim_ros.sequences.readers import READERS, open_sequence
from endo_sim_ros.sequences.recording import keep_posed, tell_lacking


def test_pose_file_is_xyzw_and_camera_to_world(tmp_path):
    expected = pose_of((0.1, 0.2, 0.3), x=0.3, y=-0.2, z=0.5)
    write_poses(tmp_path / "poses.txt", {7: expected})
    np.testing.assert_allclose(read_poses(tmp_path / "poses.txt")[7], expected, atol=1e-9)
    w, x, y, z = matrix_to_quat(expected[:3, :3])
    (tmp_path / "poses.csv").write_text(f"frame,tx,ty,tz,qx,qy,qz,qw\n7,.1,.2,.3,{x},{y},{z},{w}\n")
    np.testing.assert_allclose(read_poses(tmp_path / "poses.csv")[7], expected, atol=1e-9)


def test_a_table_of_poses_is_converted_at_once(tmp_path, monkeypatch):
    """Row by row a million of them took half a minute."""
    convert = Mock(wraps=quat_to_matrix)
    monkeypatch.setattr(pose_files, "quat_to_matrix", convert)
    (tmp_path / "poses.txt").write_text("frame x y z\n# none\n\n9, 1, 2 3e0 0 0 0 1 # last\n ,, \n4 0 0 0 1 0 0 0\r\n")
    poses = read_poses(tmp_path / "poses.txt")
    assert list(poses) == [9, 4] and convert.call_count == 1
    np.testing.assert_array_equal(poses[9][:3], np.column_stack([np.eye(3), [1, 2, 3]]))
    np.testing.assert_array_equal(poses[4], np.diag([1, -1, -1, 1]))
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 0 1\r\n1 0 0 0 0 0 0 1\r\n", encoding="utf-8-sig")  # as an editor of Windows does
    assert list(read_poses(tmp_path / "poses.txt")) == [0, 1]


def test_poses_so_far_away_that_nothing_can_be_computed_are_refused(tmp_path):
    near = {n: pose_of((1000.0 * n, 0, 0)) for n in range(3)}  # as in millimetres
    assert keep_posed([0, 1, 2], near, tmp_path / "poses.txt") == [0, 1, 2]
    with pytest.raises(SequenceError, match="poses.txt: number 1 is 1e.07 m from the origin, .*; subtract a place near the tissue"):
        keep_posed([0, 1, 2], near | {1: pose_of((1e7, 0, 0))}, tmp_path / "poses.txt")


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("# none\n", "holds no poses"),
        ("1 2 3\n1 2 3\n", "line 1 has 3 numbers, expected 8"),
        ("1 0 0 0 0 0 0 1\n\n2 0 0\n", "line 3 has 3 numbers, expected 8"),
        ("# none\n1.5 0 0 0 0 0 0 1\n", "line 2 is not a pose; expected a whole frame number first, got 1.5, which may be a time"),
        ("nan 0 0 0 0 0 0 1\n", "line 1 is not a pose"),
        ("0 O.1 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "line 1 is not made of numbers: '0 O.1 0"),
        ("1e300 0 0 0 0 0 0 1\n", "line 1 is not a pose"),
        ("1 0 0 0 0 0 0 1_0\n", "not made of numbers"),
        ("3 0 0 0 0 0 0 1\n#\n3 0 0 0 0 0 0 1\n3 0 0 0 0 0 0 1\n", "line 3 repeats frame 3"),
    ],
)
def test_what_is_wrong_with_a_table_of_poses_is_told_by_line(text, sentence, tmp_path):
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(SequenceError, match=f"poses.txt: {sentence}"):
        read_poses(tmp_path / "poses.txt")


def test_numbers_in_file_names(tmp_path):
    for name in ("000012l.png", "000012r.png", "frame-000003.mask.png", "notes.txt", "nothing.png"):
        (tmp_path / name).touch()
    assert numbered_files(tmp_path, ending="l") == {12: tmp_path / "000012l.png"}
    assert numbered_files(tmp_path, ending="mask") == {3: tmp_path / "frame-000003.mask.png"}
    assert numbered_files(tmp_path / "absent") == {}


def test_of_many_frames_without_a_file_three_are_named(tmp_path, caplog):
    tell_lacking(range(1, 11), range(2, 6), tmp_path, UNMASKED)
    assert f"{tmp_path}: no image there for 6 of 10 frames (1, 6, 7 and others): {UNMASKED}" in caplog.text


def test_masks_without_tools_keep_all_tissue(tmp_path, caplog):
    caplog.set_level("INFO")
    assert tool_is_white([np.zeros((4, 4), np.uint8)], tmp_path)
    assert "white covers 0 % of the masks, so white is taken for tools; these masks hide nothing" in caplog.text
    assert not tool_is_white([np.full((4, 4), 255, np.uint8)], tmp_path)
    caplog.clear()
    assert not tool_is_white([np.full((4, 4), 255, np.uint8)], tmp_path, "tissue")
    assert caplog.messages == [f"{tmp_path}: these masks hide nothing"]


def test_near_balance_of_mask_colours_is_a_warning(tmp_path, caplog):
    half = np.zeros((4, 4), np.uint8)
    half[:2] = 255
    tool_is_white([half], tmp_path)
    assert "this is close" in caplog.text


@pytest.mark.parametrize("polarity, other", [("tissue", "tool"), ("tool", "tissue")])
def test_masks_that_leave_next_to_nothing_are_told_to_be_the_wrong_way_round(tmp_path, caplog, polarity, other):
    mask = np.full((10, 10), 255 * (polarity == "tool"), np.uint8)
    mask[0] = 255 - mask[0]
    assert tool_is_white([mask], tmp_path, polarity) == (polarity == "tool")
    assert f"leave 10 % of the images as tissue, as white is said to be {polarity}; state mask_polarity={other}" in caplog.text
    caplog.clear()
    tool_is_white([255 - mask], tmp_path, polarity)
    assert not caplog.text


def tissue_of(folder, *masks, polarity="tissue"):
    """What `MaskFiles` returns for masks, which are written as files."""
    files = {}
    for number, mask in enumerate(masks):
        files[number] = folder / f"{number}.{'tiff' if mask.dtype == np.float32 else 'png'}"
        cv2.imwrite(str(files[number]), mask)
    read = MaskFiles(files, folder, polarity)
    return [read.of(number, masks[0].shape[1::-1]) for number in files]


SHOWN = np.zeros((4, 6), bool)
SHOWN[:3, 2:] = True


@pytest.mark.parametrize(
    ("white", "dtype"),
    [(255, np.uint8), (1, np.uint8), (65535, np.uint16), (4095, np.uint16), (1, np.uint16), (255, np.uint16), (1.0, np.float32)],
)
def test_masks_of_0_and_1_and_of_16_bits_are_read_as_black_and_white(tmp_path, white, dtype):
    mask = np.where(SHOWN, dtype(white), dtype(0))
    found, black = tissue_of(tmp_path, mask, np.zeros_like(mask))
    np.testing.assert_array_equal(found, np.where(SHOWN, 255, 0))
    assert not black.any()


def test_masks_in_colour_or_by_transparency_are_read_as_black_and_white(tmp_path):
    clear = np.full((4, 6, 4), 255, np.uint8)
    clear[~SHOWN, 3] = 0
    red = np.where(SHOWN[..., None], np.array([0, 0, 255], np.uint8), np.uint8(0))
    for image in (red, clear, np.dstack([red, np.full((4, 6), 255, np.uint8)])):
        np.testing.assert_array_equal(tissue_of(tmp_path, image)[0], np.where(SHOWN, 255, 0))


def test_a_red_tool_in_a_white_mask_is_dark(tmp_path):
    red_on_white = np.where(SHOWN[..., None], np.uint8(255), np.array([0, 0, 255], np.uint8))
    np.testing.assert_array_equal(tissue_of(tmp_path, red_on_white)[0], np.where(SHOWN, 255, 0))


def test_masks_of_labels_are_refused(tmp_path):
    labels = np.arange(4, dtype=np.uint8).reshape(2, 2)
    with pytest.raises(SequenceError, match="the masks hold no number above 3, as labels do; masks have 0 and 255, or 0 and 1"):
        tissue_of(tmp_path, labels, np.zeros_like(labels))


@pytest.mark.parametrize("noise", [1, 3])
def test_noise_of_a_black_mask_is_black(tmp_path, noise):
    mask = np.where(SHOWN, np.uint8(255), np.uint8(0))
    assert (tissue_of(tmp_path, mask, np.full_like(mask, noise), polarity="tool")[1] == 255).all()


def test_vignette_is_dark_and_dark_tissue_is_not():
    images = [np.full((60, 80, 3), 100, np.uint8) for _ in range(2)]
    for image in images:
        image[:, :20] = 2
        image[25:35, 50:60] = 2  # a hole in the tissue
    images[1][10:20, 40:50] = 0
    mask = lit_area(images)
    assert not mask[:, :20].any()
    assert mask[:, 24:].all()


def test_one_bright_image_does_not_hide_the_border():
    rows, columns = np.mgrid[:60, :80]
    picture = np.where(np.hypot(rows - 30, columns - 40) < 28, 120, 2).astype(np.uint8)[..., None].repeat(3, -1)
    np.testing.assert_array_equal(lit_area([picture] * 9 + [np.full_like(picture, 255)]), lit_area([picture]))


def test_edge_of_a_round_picture_may_wander():
    rows, columns = np.mgrid[:120, :160]
    tissue = [np.hypot(rows - 60, columns - 78 - shift) < 50 for shift in (0, 3)]
    images = [np.where(inside, 120, 2).astype(np.uint8)[..., None].repeat(3, -1) for inside in tissue]
    images[0][55:65, 70:90] = images[0][55:65, 31:36] = 2  # a hole, and a dark spot that begins inside
    lit = lit_area(images)
    for image, inside in zip(images, tissue):
        mask = lit_now(lit, image)
        assert not mask[~inside].any()
        assert mask[cv2.erode(np.uint8(inside), np.ones((13, 13))) > 0].all()
    assert lit[~tissue[0]].any()
    whole = np.full_like(lit, 255)
    assert lit_now(whole, images[0]) is whole


def pictures_of_tissue(shifts):
    """Tissue with texture, overexposed in a part, that a lens passes by so many pixels, with a logo in the corner."""
    whole = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (80, 200, 3)).astype(np.float32), (0, 0), 2)
    whole = np.clip(120 + 3 * (whole - whole.mean()), 30, 225)
    cv2.circle(whole, (70, 30), 28, (255, 255, 255), -1)
    images = [np.uint8(whole[:, shift : shift + 100]) for shift in shifts]
    for image in images:
        image[60:76, 4:40] = 40, 70, 150
        image[64:72, 8:36] = 240
    return images


def round_pictures(black):
    """Tissue that a lens passes by, within a round picture of a recorder with this black, and where the picture is."""
    y, x = np.mgrid[:80, :100]
    inside = np.hypot(y - 40, x - 50) < 38
    rng = np.random.default_rng(1)
    images = [
        image * (inside[..., None] * (1 - black / 255)) + black + rng.normal(0, 1, (80, 100, 1))
        for image in pictures_of_tissue(range(0, 40, 4))
    ]
    return [np.uint8(np.clip(image, 0, 255)) for image in images], inside


@pytest.mark.parametrize("black", [3, 16, 25])
def test_border_of_any_black_is_left_out(black, caplog):
    caplog.set_level("INFO")
    images, inside = round_pictures(black)
    mask = lit_part(Path(f"black {black}"), images)(images[0]) > 0
    assert not mask[~inside].any()
    assert mask[cv2.erode(np.uint8(inside), np.ones((9, 9))) > 0][:20].all()
    assert ("the black around what is seen has the grey level" in caplog.text) == (black >= 16)


@pytest.mark.parametrize("lens", ["passing", "still"])
def test_dark_tissue_in_the_corners_is_no_border(lens):
    """A lamp that leaves the corners in the dark, and a lumen that is darker."""
    y, x = np.mgrid[:80, :100]
    light = np.clip(1.2 - np.hypot(y - 40, x - 50) / 60, 0.15, 1)[..., None]
    images = [np.uint8(60 + light * (image - 60.0)) for image in pictures_of_tissue([0] * 10 if lens == "still" else range(0, 40, 4))]
    for number, image in enumerate(images):
        image[:] = np.clip(image * light, 24, 255)
        image[LOGO] = image[:16, 4:40]
        image[20:32, 30 + 4 * number : 42 + 4 * number] = 17
    assert lit_part(Path(f"dark corners, {lens}"), images)(images[0]).all()


LOGO = np.s_[60:76, 4:40]


def test_what_is_burnt_in_is_left_out(caplog):
    caplog.set_level("INFO")
    images = pictures_of_tissue(range(0, 40, 4))
    mask = lit_part(Path("passing"), images)(images[0])
    assert not mask[LOGO].any()
    mask[56:80, :44] = 255  # and about it
    assert mask.all()
    assert "passing: 10.00% of its pictures stays the same while the lens moves, as writing does, and is left out" in caplog.text


def test_the_edge_of_the_picture_is_not_burnt_in():
    """It stays where it is, and beside it tissue in the dark looks alike in all pictures."""
    column = np.arange(100)[:, None]
    optics, light = np.clip((column - 6) / 4, 0, 1), np.clip((column - 20) / 20, 0, 1)
    tissue = [image[:56] for image in pictures_of_tissue(range(0, 40, 4))]  # without the logo
    images = [np.uint8(optics * (60 + light * (image * 0.7 - 60))) for image in tissue]
    mask = lit_part(Path("bordered"), images)(images[0])
    assert mask[:, 12:].all() and not mask[:, :6].any()


@pytest.mark.parametrize("shifts", [[0] * 10, [0, 0, 0, 0, 1] * 2, [0, 12, 24, 36]], ids=["still", "nearly still", "few"])
def test_nothing_is_burnt_in_where_it_cannot_be_told(shifts):
    images = pictures_of_tissue(shifts)
    assert lit_part(Path("still"), images)(images[0]).all()


def test_nothing_is_burnt_in_where_poses_stand_still():
    """Most of the tissue moves by itself, before a lens that does not."""
    images = pictures_of_tissue(range(0, 40, 4))
    rng, poses = np.random.default_rng(0), np.tile(np.eye(4), (60, 1, 1))
    poses[:, :3, 3] += rng.normal(0, 3e-4, (60, 3))  # as trackers err
    poses[20:23, 2, 3] -= 0.05  # pulled out to be cleaned
    assert lit_part(Path("fixed"), images, poses)(images[0]).all()
    poses[:, 0, 3] = np.linspace(0, 0.02, 60)
    assert not lit_part(Path("fixed"), images, poses)(images[0])[LOGO].any()


def test_a_speck_on_a_dark_lumen_does_not_mask_it():
    images, (y, x) = pictures_of_tissue(range(0, 40, 4)), np.mgrid[:80, :100]
    for number, image in enumerate(images):
        image[LOGO] = image[:16, 4:40]
        lumen = np.hypot(y - 40, x - 46 - number)  # from its middle, pixels
        image[:] = 20 + np.clip(lumen / 24 - 1, 0, 1)[..., None] * (image - 20.0)
        image[38:41, 48:51] = 90
    assert lit_part(Path("lumen"), images)(images[0])[30, 50]


def test_shadow_whose_edge_lies_along_the_motion_is_not_burnt_in():
    images = pictures_of_tissue(range(0, 40, 4))
    for image in images:
        image[LOGO] = image[:16, 4:40]
        image[6:26], image[10:22] = 120, 20
    assert lit_part(Path("shadow"), images)(images[0]).all()


@pytest.mark.parametrize("place", [".", "images", "left"])
def test_images_outside_of_left_are_told_where_to_go(tmp_path, place):
    (tmp_path / place).mkdir(exist_ok=True)
    for number in range(2):
        cv2.imwrite(str(tmp_path / place / f"{number}.png"), np.zeros((4, 4), np.uint8))
    (tmp_path / place / "._0.png").touch()
    (tmp_path / "depth").mkdir()
    cv2.imwrite(str(tmp_path / "depth/0.png"), np.zeros((4, 4), np.uint8))
    if place == "left":
        with pytest.raises(SequenceError, match=f"{tmp_path}/left: holds 2 images of an eye; pass the folder that it is in"):
            open_sequence(tmp_path / place)
        return
    with pytest.raises(SequenceError) as error:
        open_sequence(tmp_path)
    assert str(error.value) == (
        f"{tmp_path / place}: holds 2 images, but none is in {tmp_path}/left: move them there, and give fx, fy, cx, cy [pixels] in "
        f"{tmp_path}/calibration.yaml where they are known; what is not, and poses without poses_left.txt, is estimated. "
        "docs/datasets.md has other layouts"
    )


def test_a_bag_is_told_to_be_one_already(tmp_path):
    (tmp_path / "metadata.yaml").touch()
    with pytest.raises(SequenceError, match=f"{tmp_path}: is a bag already; give it to `endo-sim reconstruct`"):
        open_sequence(tmp_path)


def test_unknown_layouts_are_listed(tmp_path):
    with pytest.raises(SequenceError, match="StereoCalibration.ini.*poses_bounds.npy.*left/.*mp4") as error:
        open_sequence(tmp_path)
    assert all(name in str(error.value) for name in READERS)
    (tmp_path / "film.mp4").touch()
    with pytest.raises(SequenceError, match="film.mp4: a file, but recordings of this kind are folders; pass the folder, or let --kind be"):
        open_sequence(tmp_path / "film.mp4", kind="scared")
    with pytest.raises(SequenceError, match="unknown kind 'nerf'; choose auto, stereomis"):
        open_sequence(tmp_path, kind="nerf")
    with pytest.raises(SequenceError, match="no such file or folder"):
        open_sequence(tmp_path / "absent")
