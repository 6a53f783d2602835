"""The reader of EndoNeRF, on a small exact copy of its layout."""

import numpy as np
import pytest
from plane_scene import HEIGHT, NO_DISTORTION, WIDTH, plane_colours, see_plane, trajectory, write_rgb

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.endonerf import read_endonerf
from endo_sim_ros.sequences.readers import open_sequence


@pytest.fixture
def endonerf(tmp_path):
    """Positions and depth in millimetres; focal length for images of twice the size."""
    root = tmp_path / "pulling"
    root.mkdir()
    K = np.array([[150.0, 0, WIDTH / 2 - 0.5], [0, 150.0, HEIGHT / 2 - 0.5], [0, 0, 1]])
    rows = []
    for number, pose in trajectory(4).items():
        image, points = see_plane(K, NO_DISTORTION, pose)
        write_rgb(root / f"images/{number:06d}.png", image)
        write_rgb(root / f"depth/{number:06d}.png", (1000 * points[..., 2]).round().astype(np.uint16))
        tool = np.zeros((HEIGHT, WIDTH), np.uint8)
        tool[90:, 100:] = 255
        write_rgb(root / f"masks/{number:06d}.png", tool)
        x, y, z = pose[:3, :3].T
        hwf = [2 * HEIGHT, 2 * WIDTH, 300.0]
        block = np.stack([y, x, -z, 1000 * pose[:3, 3], hwf], 1)  # LLFF: down, right, back
        rows.append(np.concatenate([block.ravel(), [50.0, 120.0]]))
    np.save(root / "poses_bounds.npy", np.array(rows))
    return root


def test_endonerf_frames_are_posed_in_metres_with_tools_masked(endonerf):
    frames = list(open_sequence(endonerf))
    assert len(frames) == 4 and frames[1].stamp_ns == 1_040_000_000
    for frame, pose in zip(frames, trajectory(4).values(), strict=True):
        np.testing.assert_allclose(frame.camera.pose, pose, atol=1e-9)
        assert frame.mask[120, 150] == 0 and frame.mask[20, 20] == 255
        assert frame.depth.dtype == np.float32
        expected, depth = plane_colours(frame)
        assert np.abs(frame.image - expected).max() < 1
        assert np.abs(frame.depth - depth).max() < 6e-4  # rounded to millimetres


def test_endonerf_scales_can_be_stated(endonerf):
    frame = list(read_endonerf(endonerf, depth_scale=1e-2, pose_scale=2e-3))[2]
    np.testing.assert_allclose(frame.camera.position, 2 * trajectory(3)[2][:3, 3], atol=1e-9)
    assert np.median(frame.depth) == pytest.approx(0.8, rel=0.05)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda r: (r / "poses_bounds.npy").unlink(), "poses_bounds.npy: file is missing"),
        (lambda r: (r / "poses_bounds.npy").write_bytes(b"x"), "poses_bounds.npy: not a readable NumPy array"),
        (
            lambda r: (r / "poses_bounds.npy").write_bytes(
                (r / "poses_bounds.npy").read_bytes().replace(b"(4, 17)", b"(9999999999, 17)")[:128] + bytes(100)
            ),
            "poses_bounds.npy: not a readable NumPy array",
        ),
        (lambda r: np.save(r / "poses_bounds.npy", np.array([{}])), "poses_bounds.npy: not a readable NumPy array"),
        (lambda r: np.save(r / "poses_bounds.npy", np.ones((4, 15))), r"shape \[frames, 17\], got shape \[4, 15\]"),
        (lambda r: np.save(r / "poses_bounds.npy", np.ones((3, 17))), "has 3 poses, but .* has 4 images"),
        (
            lambda r: np.save(r / "poses_bounds.npy", np.ones((4, 17))),
            "row of frame 0: its 3×3 block is not a rotation",
        ),
        (lambda r: (r / "images/000002.png").write_bytes(b"x"), "000002.png: not a readable image"),
        (lambda r: write_rgb(r / "depth/000001.png", np.ones((8, 8), np.uint16)), "depth/000001.png: is 8×8"),
    ],
)
def test_damaged_endonerf_is_refused_by_name(endonerf, damage, message):
    damage(endonerf)
    with pytest.raises(SequenceError, match=message):
        list(read_endonerf(endonerf))


def test_a_pose_that_is_none_matters_only_where_its_frame_is_asked_for(endonerf):
    table = np.load(endonerf / "poses_bounds.npy")
    table[3] = np.nan
    np.save(endonerf / "poses_bounds.npy", table)
    assert len(list(read_endonerf(endonerf, stop=3))) == 3
    with pytest.raises(SequenceError, match="poses_bounds.npy: number 3 is not a pose"):
        read_endonerf(endonerf)
