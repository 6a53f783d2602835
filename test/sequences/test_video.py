"""The reader of videos."""

import struct
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from plane_scene import BARREL, HEIGHT, K_LEFT, WIDTH, assert_frame_agrees, see_plane, trajectory, write_poses, write_rgb, write_video

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.eyes import find_halves, with_eyes_checked
from endo_sim_ros.sequences.readers import open_sequence
from endo_sim_ros.sequences.stereo_images import StackedVideo
from endo_sim_ros.sequences.video import read_video
from endo_sim_ros.sequences.video_files import Video


@pytest.fixture
def video(tmp_path):
    root = tmp_path / "recording"
    poses = trajectory(8)
    write_video(root / "endo.mp4", (see_plane(K_LEFT, BARREL, pose)[0] for pose in poses.values()), fps=50.0)
    write_poses(root / "poses.txt", {n: poses[n] for n in range(0, 8, 3)})
    return root


INTRINSICS = {"fx": 150.0, "fy": 152.0, "cx": 78.5, "cy": 65.5, "distortion": BARREL.tolist()}


@pytest.mark.parametrize("named", ["", "endo.mp4"])
def test_video_with_poses_beside_it(video, named):
    frames = list(open_sequence(video / named, **INTRINSICS))
    assert [f.stamp_ns for f in frames] == [1_000_000_000, 1_060_000_000, 1_120_000_000]
    for frame in frames:
        assert frame.right is None and frame.depth is None
        assert_frame_agrees(frame, tolerance=12)


def test_poses_of_more_frames_than_a_video_has_are_told(video, caplog):
    """As of a file that is cut off and states no more frames than it has."""
    with (video / "poses.txt").open("a") as file:
        file.writelines(f"{8 + n} 0 0 0 0 0 0 1\n" for n in range(2))
    assert len(read_video(video, **INTRINSICS)) == 3
    assert "poses.txt: 2 of 5 rows are after the last frame, 7: poses of another sequence, or a part of the images?" in caplog.text


def test_video_pose_scale_and_calibration_file(video):
    (video / "calibration.yaml").write_text("fx: 150\nfy: 152\ncx: 78.5\ncy: 65.5\ndistortion: [-0.2, 0.03]\n")
    frames = list(read_video(video, scale=0.1))
    np.testing.assert_allclose(frames[1].camera.position, 0.1 * trajectory(4)[3][:3, 3], atol=1e-9)


def test_frames_that_structure_from_motion_leaves_out_are_told(video, caplog):
    caplog.set_level("INFO")
    assert len(read_video(video, poses="sfm", start=1, sfm_step=3)) == 3
    assert "endo.mp4: 3 of 7 frames are taken, the others left out by sfm_step 3; 1 takes all" in caplog.text
    caplog.clear()
    assert len(read_video(video, poses="sfm")) == 8
    assert "left out" not in caplog.text


def test_a_step_that_is_given_is_not_thinned_for_structure_from_motion(tmp_path):
    write_video(tmp_path / "endo.mp4", np.zeros((80, 32, 32, 3), np.uint8))
    assert [len(read_video(tmp_path, poses="sfm", **steps)) for steps in ({}, {"step": 2}, {"step": 2, "sfm_step": 4})] == [14, 40, 10]


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
        ({"fx": 150.0, "frames_rectified": True}, "frames_rectified is for calibrations of ROS and OpenCV; leave it out"),
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


def write_timed(path, ticks, rate=Fraction(25), sound=None, **options):
    """A video whose frame n, bright where n divides by 7, is shown at ticks[n] / rate seconds; with so many seconds of sound."""
    codec = {".mpg": "mpeg2video", ".mov": "mjpeg"}.get(path.suffix, "mpeg4")
    with av.open(str(path), "w", options={"movflags": "faststart"} if path.suffix == ".mp4" else {}) as container:
        stream = container.add_stream(codec, rate=rate, options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuvj420p" if codec == "mjpeg" else "yuv420p"
        voice = sound and container.add_stream("pcm_s16le", rate=8000, layout="mono")
        stream.codec_context.max_b_frames = 0 if path.suffix in (".avi", ".mov") else 2  # an avi does not say when these are shown
        for number, tick in enumerate(ticks):
            frame = av.VideoFrame.from_ndarray(np.full((HEIGHT, WIDTH, 3), 50 if number % 7 else 200, np.uint8), format="rgb24")
            frame.pts = tick
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        if sound:
            silence = av.AudioFrame.from_ndarray(np.zeros((1, 8000 * sound), np.int16), format="s16", layout="mono")
            silence.sample_rate, silence.pts = 8000, 0
            container.mux(voice.encode(silence))
    return path


@pytest.mark.parametrize(("name", "start"), [("endo.mp4", 0), ("endo.mkv", 0), ("endo.avi", 0), ("endo.mp4", 60), ("endo.mkv", 60)])
def test_frames_that_are_uneven_in_time_have_the_times_in_the_file(tmp_path, caplog, name, start):
    ticks = [start + number + (number > 5) * 20 + (number > 9) * number for number in range(40)]
    path = write_timed(tmp_path / name, ticks)
    write_poses(tmp_path / "poses.txt", dict.fromkeys(range(40), np.eye(4)))
    frames = list(read_video(path, mask_border=False, **INTRINSICS))
    assert [frame.stamp_ns for frame in frames] == [1_000_000_000 + 40_000_000 * (tick - start) for tick in ticks]
    assert [number for number, frame in enumerate(frames) if frame.image[60, 80].mean() > 125] == list(range(0, 40, 7))
    at_rate = read_video(path, fps=50.0, mask_border=False, **INTRINSICS)
    assert [frame.stamp_ns for frame in at_rate] == [1_000_000_000 + 20_000_000 * number for number in range(40)]
    assert not caplog.records


def test_a_constant_rate_is_not_rounded_to_the_clock_of_the_file(tmp_path, caplog):
    rate = Fraction(30000, 1001)
    path = write_timed(tmp_path / "endo.mkv", range(60), rate)  # milliseconds
    even = [1_000_000_000 + round(number / float(rate) * 1e9) for number in range(60)]
    assert [Video(path).stamp_ns(number) for number in range(60)] == even
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    cut = Video(path)
    assert [cut.stamp_ns(number) for number in range(60)] == even
    assert not caplog.records
    read = sum(1 for _ in cut.frames(range(60)))
    assert 10 < read < 50 and f"ends before frame {read}" in caplog.text and f"lacks {60 - read} of its 60 frames" in caplog.text


@pytest.mark.parametrize("start", [0, 100])
def test_a_cut_video_that_begins_late_lacks_as_many_frames_as_one_that_does_not(tmp_path, caplog, start):
    path = write_timed(tmp_path / "endo.mp4", range(start, start + 100))
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    video = Video(path)
    read = sum(1 for _ in video.frames(range(100)))
    assert video.frame_count == 100 and f"lacks {100 - read} of its 100 frames" in caplog.text


def test_sound_that_goes_on_does_not_make_frames_lack(tmp_path, caplog):
    video = Video(write_timed(tmp_path / "endo.mkv", range(20), sound=4))
    assert len(list(video.frames(range(video.frame_count)))) == 20 and not caplog.records


def test_times_that_begin_again_are_told_and_not_taken(tmp_path, caplog):
    path = write_timed(tmp_path / "endo.mpg", range(20))
    path.write_bytes(2 * path.read_bytes())
    video = Video(path)
    assert video.frame_count == 40 and video.stamp_ns(39) == 1_000_000_000 + 39 * 40_000_000
    Video(path).stamp_ns(0)
    assert caplog.text.count("endo.mpg: the file has no usable times of its frames, which are stamped evenly, at 25 Hz") == 1


def test_interlaced_pictures_are_refused(tmp_path):
    with pytest.raises(SequenceError, match="endo.mpg: its pictures are marked as interlaced, .* with `ffmpeg -i IN -vf bwdif"):
        Video(write_timed(tmp_path / "endo.mpg", range(5), flags="+ildct+ilme"))


def write_pairs(root, join):
    """A video whose pictures hold two images, joined, and these: rectified left and right ones."""
    rng = np.random.default_rng(0)
    tissue = cv2.GaussianBlur(rng.uniform(0, 255, (120, 200, 3)).astype(np.float32), (0, 0), 2)
    tissue = np.uint8(np.clip(120 + 4 * (tissue - tissue.mean()), 0, 255))
    pairs = [[tissue[:, shift : shift + 160] for shift in (frame, frame + 12)] for frame in range(6)]
    write_poses(root / "poses.txt", dict.fromkeys(range(6), np.eye(4)))
    write_video(root / "endo.mp4", [join(pair) for pair in pairs])
    return pairs


def alike(image, other):
    """Whether images of this tissue differ by compression only."""
    return np.abs(np.subtract(image, other, dtype=float)).mean() < 15


@pytest.mark.parametrize(
    ("join", "eyes", "auto"),
    [
        (np.hstack, "left_right", True),
        (np.vstack, "top_bottom", True),
        (lambda pair: np.hstack(pair[::-1]), "right_left", False),
        (lambda pair: np.vstack(pair[::-1]), "bottom_top", False),
    ],
)
def test_pictures_of_both_eyes_are_read_as_pairs(tmp_path, caplog, join, eyes, auto):
    pairs = write_pairs(tmp_path, join)
    tissue = np.full((120, 160), 255, np.uint8)
    tissue[:, :40] = 0
    write_rgb(tmp_path / "mask.png", join([tissue, 0 * tissue]))
    options = {"fx": 150.0, "baseline_m": 0.005}
    for each in ["auto", eyes] if auto else [eyes]:
        frames = list(read_video(tmp_path, eyes=each, **options))
        assert len(frames) == 6
        for frame, (left, right) in zip(frames, pairs):
            assert alike(frame.image, left) and alike(frame.right, right) and not alike(frame.right, left)
            np.testing.assert_array_equal(frame.mask, tissue)
            assert frame.baseline == 0.005 and (frame.camera.K[0, 2], frame.camera.K[1, 2]) == (80, 60)
    write_rgb(tmp_path / "mask.png", tissue)
    np.testing.assert_array_equal(next(iter(read_video(tmp_path, eyes=eyes, **options))).mask, tissue)
    assert not caplog.records
    (alone,) = read_video(tmp_path, eyes=eyes, fx=150.0, stop=1)
    assert alone.right is None and alike(alone.image, pairs[0][0])
    assert "endo.mp4: its pictures hold both eyes, but no calibration of both is given, so the left one alone is read" in caplog.text
    (tmp_path / "mask.png").unlink()
    if not auto:
        with pytest.raises(SequenceError, match=r"endo.mp4: left and right eye are exchanged, .* images \(of one picture: option eyes\)"):
            list(read_video(tmp_path, **options))
    assert next(iter(read_video(tmp_path, eyes="one", fx=150.0))).image.shape == join(pairs[0]).shape
    with pytest.raises(SequenceError, match="endo.mp4: baseline_m is given, but no pairs are found; state eyes, as left_right"):
        read_video(tmp_path, eyes="one", **options)
    with pytest.raises(SequenceError, match="endo.mp4: eyes must be auto, one, left_right, .*, got 'both'"):
        read_video(tmp_path, eyes="both", **options)


def test_both_eyes_are_looked_for_in_the_frames_that_are_asked_for(tmp_path):
    pairs = write_pairs(tmp_path, np.hstack)
    write_video(tmp_path / "endo.mp4", [np.full((120, 320, 3), 90, np.uint8)] * 12 + [np.hstack(pair) for pair in pairs])
    write_poses(tmp_path / "poses.txt", dict.fromkeys(range(18), np.eye(4)))
    assert next(iter(read_video(tmp_path, start=12, fx=150.0, baseline_m=0.005))).right is not None


@pytest.mark.parametrize("make", [lambda left: np.hstack([left, left[:, ::-1]]), lambda left: left[:1], lambda left: left[:, :1]])
def test_mirrored_and_tiny_pictures_are_those_of_one_eye(tmp_path, make):
    (left, _), *_ = write_pairs(tmp_path, np.hstack)
    picture = make(left)
    assert find_halves("auto", picture.shape[1::-1], lambda: [picture] * 5, tmp_path, None) is None


def test_a_calibration_of_two_eyes_beside_a_video_of_one_is_told_of(tmp_path, caplog):
    write_pairs(tmp_path, lambda pair: pair[0])
    (tmp_path / "calibration.yaml").write_text("{fx: 150, fy: 150, cx: 80, cy: 60, baseline_m: 0.005}")
    assert next(iter(read_video(tmp_path))).right is None
    assert "endo.mp4: its calibration is of two eyes, but no pairs are found, so one is read" in caplog.text


def test_pairs_that_share_nothing_are_told_of(tmp_path, caplog):
    pairs = write_pairs(tmp_path, lambda pair: np.hstack([pair[0], pair[0][::-1, ::-1]]))
    frames = with_eyes_checked(read_video(tmp_path, eyes="left_right", fx=150.0, baseline_m=0.005), "here")
    assert len(list(frames)) == len(pairs)
    assert "here: fewer than 30 features of left and right images match in each of 5 pairs" in caplog.text


def test_eyes_that_are_squeezed_into_their_halves_have_the_size_of_their_calibration(tmp_path):
    half = lambda image: cv2.resize(image, (80, 120), interpolation=cv2.INTER_AREA)
    pairs = write_pairs(tmp_path, lambda pair: np.hstack([half(image) for image in pair]))
    (tmp_path / "calibration.yaml").write_text("{width: 160, height: 120, fx: 150, fy: 150, cx: 80, cy: 60, baseline_m: 0.005}")
    frame = next(iter(read_video(tmp_path)))
    assert frame.image.shape == frame.right.shape == (120, 160, 3) and frame.camera.K[0, 0] == 150
    assert alike(frame.right, pairs[0][1]) and not alike(frame.right, pairs[0][0])


@pytest.mark.parametrize(("name", "aspect"), [("endo.mkv", "2/1"), ("endo.mkv", "1/1"), ("endo.mov", "")])
def test_pixels_that_are_not_square_are_told_where_one_focal_length_is_taken(tmp_path, caplog, name, aspect):
    path = write_timed(tmp_path / name, range(5), **({"aspect": aspect} if aspect else {}))
    write_poses(tmp_path / "poses.txt", dict.fromkeys(range(5), np.eye(4)))
    read_video(path, fx=150.0, fy=300.0)
    assert not caplog.records
    read_video(path, fx=150.0)
    assert ("endo.mkv: its pixels are 2 times as wide as high, but one focal length" in caplog.text) == (aspect == "2/1")


def turn(path):
    """Have an mp4 ask for its pictures to be turned by a quarter."""
    content = bytearray(path.read_bytes())
    at = content.index(b"tkhd") + 44  # of the matrix
    content[at : at + 36] = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, HEIGHT << 16, 0, 1 << 30)
    path.write_bytes(content)


def test_a_calibration_of_a_video_that_is_turned_is_told_of(video, caplog):
    turn(video / "endo.mp4")
    frame = next(iter(read_video(video, fx=150.0)))
    assert frame.image.shape == (WIDTH, HEIGHT, 3) and (frame.camera.K[0, 2], frame.camera.K[1, 2]) == (HEIGHT / 2, WIDTH / 2)
    assert f"its pictures are turned, as the file asks; calibration and poses must be those of turned ones, of {HEIGHT}×" in caplog.text
    (video / "calibration.yaml").write_text(f"{{fx: 150, fy: 152, cx: 78.5, cy: 65.5, width: {WIDTH}, height: {HEIGHT}}}")
    with pytest.raises(SequenceError, match=f"{WIDTH}×{HEIGHT}, but the images are {HEIGHT}×{WIDTH}; turn fx, fy, cx, cy or the images"):
        read_video(video)
    with pytest.raises(SequenceError, match="endo.mp4: the file asks for its pictures to be turned, which would move the eyes"):
        StackedVideo(video / "endo.mp4")


def test_what_is_no_video_is_told_in_a_sentence_and_not_by_the_decoder(video, capfd):
    (video / "endo.mp4").write_bytes(bytes(40))
    with pytest.raises(SequenceError, match="endo.mp4: not a readable video"):
        Video(video / "endo.mp4")
    assert not capfd.readouterr().err
