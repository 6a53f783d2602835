"""The reader of videos."""

import av
import numpy as np
import pytest
from plane_scene import BARREL, HEIGHT, K_LEFT, WIDTH, assert_frame_agrees, see_plane, trajectory, write_poses, write_rgb, write_video

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.readers import open_sequence
from endo_sim_ros.sequences.video import read_video
from endo_sim_ros.sequences.video_files import Video, warn_of_uneven_times


@pytest.fixture
def video(tmp_path):
    root = tmp_path / "recording"
    poses = trajectory(8)
    write_video(root / "endo.mp4", (see_plane(K_LEFT, BARREL, pose)[0] for pose in poses.values()), fps=50.0)
    write_poses(root / "poses.txt", {n: poses[n] for n in range(0, 8, 3)})
    return root


INTRINSICS = {"fx": 150.0, "fy": 152.0, "cx": 78.5, "cy": 65.5, "distortion": BARREL.tolist()}


@pytest.mark.parametrize("named", ["", "endo.mp4"])
def test_video_with_poses_beside_it(video, named, caplog):
    frames = list(open_sequence(video / named, **INTRINSICS))
    assert "apart" not in caplog.text
    assert [f.stamp_ns for f in frames] == [1_000_000_000, 1_060_000_000, 1_120_000_000]
    for frame in frames:
        assert frame.right is None and frame.depth is None
        assert_frame_agrees(frame, tolerance=12)


def test_video_pose_scale_and_calibration_file(video):
    (video / "calibration.yaml").write_text("fx: 150\nfy: 152\ncx: 78.5\ncy: 65.5\ndistortion: [-0.2, 0.03]\n")
    frames = list(read_video(video, scale=0.1))
    np.testing.assert_allclose(frames[1].camera.position, 0.1 * trajectory(4)[3][:3, 3], atol=1e-9)


def test_video_mask_for_all_frames_and_per_frame(video, caplog):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, :80] = 255
    write_rgb(video / "mask.png", mask)
    assert all(f.mask[60, 20] == 255 and f.mask[60, 140] == 0 for f in read_video(video, **INTRINSICS))
    write_rgb(video / "tools/000003.png", mask)
    frames = list(read_video(video, mask=video / "tools", mask_polarity="tool", **INTRINSICS))
    assert [f.mask[60, 20] for f in frames] == [255, 0, 255]
    write_rgb(video / "others/000300.png", mask)
    with pytest.raises(SequenceError, match="others: holds numbers from 300 to 300, but no frame from 0 to 6 has one of them"):
        read_video(video, mask=video / "others", **INTRINSICS)
    write_rgb(video / f"others/{'9' * 20}.png", mask)
    with pytest.raises(SequenceError, match="others: 99999999999999999999.png has 20 digits in a row; number frames with 15 at most"):
        read_video(video, mask=video / "others", **INTRINSICS)
    assert "tools: no image there for 2 of 3 frames" in caplog.text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "poses are given .* but no intrinsics; pass fx"),
        ({"fy": 3.0}, "need fx as well"),
        ({"fx": -3.0}, "fx and fy must be positive"),
        (
            {"fx": 150.0, "cx": 640.0},
            rf"the principal point \(640, {HEIGHT / 2:g}\) lies outside the images of {WIDTH}×{HEIGHT}",
        ),
        ({"fx": 0.9}, f"no endoscope has focal lengths of 0.9 and 0.9 pixels with images of {WIDTH}×{HEIGHT}; give them in pixels"),
        ({"fx": 150.0, "step": 0}, "step must be 1 or more"),
        ({"fx": 150.0, "start": 100}, "no frame between start=100"),
        ({"fx": 150.0, "poses": "absent.txt"}, "absent.txt: file is missing"),
        ({"fx": 150.0, "mask": "absent.png"}, "absent.png: file is missing"),
        ({"fx": 150.0, "colour": 1}, "video layout has no option 'colour'; it has start, stop"),
        ({"fx": 150.0, "step": "x"}, "step must be a whole number, got 'x'"),
        ({"fx": 150.0, "step": 1.5}, "step must be a whole number, got 1.5"),
        ({"fx": 150.0, "fps": 0.0}, "fps must be above 0 and at most 1e\\+09, got 0"),
        ({"fx": 150.0, "fps": np.inf}, "fps must be above 0 and at most 1e\\+09, got inf"),
        ({"fx": 150.0, "fps": 1e300}, "fps must be above 0 and at most 1e\\+09, got 1e\\+300"),
        ({"fx": 150.0, "fps": 1e-300}, "at 1e-300 Hz comes after 68 years"),
        ({"fx": 150.0, "scale": -1.0}, "scale must be above 0 and at most 1e\\+09, got -1"),
        ({"fx": True}, "fx must be a number, got True"),
        ({"fx": 150.0, "threads": 0}, "threads must be -1 for all cores, or 1 or more, got 0"),
        ({"fx": 150.0, "threads": -2}, "threads must be -1 for all cores, or 1 or more, got -2"),
        ({"fx": 150.0, "mask_border": 1}, "mask_border must be true or false, got 1"),
    ],
)
def test_wrong_video_options_are_explained(video, options, message):
    with pytest.raises(SequenceError, match=message):
        open_sequence(video, **options)


@pytest.mark.parametrize("line", ["6 0 0 nan 0 0 0 1", "6 0 0 0 0 0 0 0"])
def test_a_pose_that_is_none_matters_only_where_its_frame_is_asked_for(video, line):
    lines = (video / "poses.txt").read_text().splitlines()
    (video / "poses.txt").write_text("\n".join([*lines[:-1], line]))
    assert len(list(read_video(video, stop=6, **INTRINSICS))) == 2
    with pytest.raises(SequenceError, match="poses.txt: number 6 is not a pose; expected a finite position and a rotation"):
        read_video(video, **INTRINSICS)


def test_video_that_ends_early_is_reported_once(video, caplog):
    source = Video(video / "endo.mp4")
    source.frame_count = 10  # as a file says that was cut off
    for _ in range(2):
        assert [number for number, _ in source.frames([2, 4, 6, 8])] == [2, 4, 6]
    (record,) = caplog.records
    assert f"ends before frame 8, at {8 / source.fps:.1f} s, and lacks 2 of its 10 frames" in record.getMessage()
    with pytest.raises(SequenceError, match="frame 50 cannot be decoded"):
        list(source.frames([50]))


@pytest.mark.parametrize("pause", [1, 20])
def test_frames_that_are_unevenly_spaced_in_time_are_told(tmp_path, caplog, pause):
    with av.open(str(tmp_path / "endo.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for number in range(12):
            frame = av.VideoFrame.from_ndarray(np.full((HEIGHT, WIDTH, 3), 10 * number, np.uint8), format="rgb24")
            frame.pts = number + pause * (number > 5)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    warn_of_uneven_times(tmp_path / "endo.mp4")
    told = f"endo.mp4: its frames are 0.040 to {0.04 * (1 + pause):.3f} s apart, and are stamped as if they were even"
    assert told in caplog.text


def test_what_is_no_video_is_told_in_a_sentence_and_not_by_the_decoder(video, capfd):
    (video / "endo.mp4").write_bytes(bytes(40))
    with pytest.raises(SequenceError, match="endo.mp4: not a readable video"):
        Video(video / "endo.mp4")
    assert not capfd.readouterr().err
