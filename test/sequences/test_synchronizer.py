"""Streams become frames: matched by stamp, in order, with what is missing counted."""

import numpy as np
import pytest

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.messages import CameraInfo
from endo_sim_ros.sequences.synchronizer import Synchronizer

MS = 1_000_000
WIDTH, HEIGHT = 8, 6


def info(width=WIDTH, height=HEIGHT, baseline=0.0):
    K = np.array([[10.0, 0, width / 2], [0, 10.0, height / 2], [0, 0, 1]])
    P = np.hstack([K, [[-10.0 * baseline], [0], [0]]])
    return CameraInfo(K, np.zeros(5), np.eye(3), P, width, height)


def image(value=0, width=WIDTH, height=HEIGHT):
    return np.full((height, width, 3), value, np.uint8)


def pose(x=0.0):
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix


def ready(tolerance=0.01, **limits):
    synchronizer = Synchronizer(tolerance, **limits)
    synchronizer.add_info("left", info())
    return synchronizer


def test_equal_stamps_are_matched_whatever_comes_first():
    synchronizer, frames = ready(), []
    for number in range(1, 6):
        pair = [("image", image(number)), ("pose", pose(number))]
        for stream, value in pair if number % 2 else pair[::-1]:
            frames += synchronizer.add(stream, number * 40 * MS, value)
    frames += synchronizer.flush()
    assert [frame.stamp_ns for frame in frames] == [number * 40 * MS for number in range(1, 6)]
    for number, frame in enumerate(frames, 1):
        assert frame.image[0, 0, 0] == number == frame.camera.pose[0, 3]


def test_the_nearest_pose_within_the_tolerance_is_taken():
    synchronizer = ready(tolerance=0.01)
    for stamp in (91, 97, 104, 120):
        synchronizer.add("pose", stamp * MS, pose(stamp))
    synchronizer.add("image", 100 * MS, image())
    (frame,) = synchronizer.flush()
    assert frame.camera.pose[0, 3] == 97


@pytest.mark.parametrize("offset, matched", [(10 * MS, 1), (10 * MS + 1, 0), (-10 * MS, 1), (-10 * MS - 1, 0)])
def test_the_tolerance_is_inclusive_and_no_wider(offset, matched):
    synchronizer = ready(tolerance=0.01)
    synchronizer.add("pose", 100 * MS + offset, pose())
    synchronizer.add("image", 100 * MS, image())
    assert len(synchronizer.flush()) == matched
    assert synchronizer.dropped["without pose"] == 1 - matched


def test_an_image_waits_for_the_pose_that_is_late():
    synchronizer = ready()
    for number in range(1, 8):
        assert synchronizer.add("image", number * 40 * MS, image()) == []
    frames = synchronizer.add("pose", 40 * MS, pose())
    assert [frame.stamp_ns for frame in frames] == [40 * MS]
    assert synchronizer.add("pose", 200 * MS, pose()) != []  # the images between have no pose any more
    assert synchronizer.dropped["without pose"] == 3


def test_images_without_any_pose_are_counted_and_do_not_pile_up():
    synchronizer = ready(max_pending=40)
    for number in range(1, 201):
        assert synchronizer.add("image", number * 40 * MS, image()) == []
    assert synchronizer.pending == 40
    assert synchronizer.dropped["without pose"] == 200 - 40
    assert synchronizer.flush() == [] and synchronizer.pending == 0
    assert synchronizer.dropped["without pose"] == 200


def test_images_before_any_camera_info_are_kept_for_it():
    synchronizer = Synchronizer()
    for number in range(1, 6):
        synchronizer.add("pose", number * 40 * MS, pose())
        assert synchronizer.add("image", number * 40 * MS, image()) == []
    synchronizer.add_info("left", info())
    assert len(synchronizer.flush()) == 5
    bare = Synchronizer()
    bare.add("image", 40 * MS, image())
    assert bare.flush() == [] and bare.dropped["without camera_info"] == 1


def test_optional_streams_may_start_late_and_stop_early():
    synchronizer, frames = ready(), []
    for number in range(1, 13):
        frames += synchronizer.add("pose", number * 40 * MS, pose())
        frames += synchronizer.add("image", number * 40 * MS, image())
        if 4 <= number <= 8:
            frames += synchronizer.add("depth", number * 40 * MS, np.full((HEIGHT, WIDTH), number, np.float32))
        if number % 2:
            frames += synchronizer.add("mask", number * 40 * MS, np.full((HEIGHT, WIDTH), 255, np.uint8))
    frames += synchronizer.flush()
    assert len(frames) == 12
    assert [None if frame.depth is None else frame.depth[0, 0] for frame in frames] == [None] * 3 + [4, 5, 6, 7, 8] + [None] * 4
    assert [frame.mask is not None for frame in frames] == [bool(number % 2) for number in range(1, 13)]


def test_a_slow_depth_is_waited_for():
    synchronizer, frames = ready(), []
    for number in range(1, 11):
        frames += synchronizer.add("pose", number * 40 * MS, pose())
        frames += synchronizer.add("image", number * 40 * MS, image())
        if number > 3:
            frames += synchronizer.add("depth", (number - 3) * 40 * MS, np.ones((HEIGHT, WIDTH), np.float32))
    with_depth = [frame.stamp_ns for frame in frames if frame.depth is not None]
    assert with_depth == [number * 40 * MS for number in range(3, 8)]  # two had left before depth was known to exist


def test_size_mismatch_is_one_sentence_and_later_images_go_on():
    synchronizer = ready()
    for number in range(1, 6):
        synchronizer.add("pose", number * 40 * MS, pose())
    synchronizer.add("image", 40 * MS, image())
    synchronizer.add("image", 80 * MS, image(width=WIDTH + 1))
    with pytest.raises(SequenceError, match="the image is 9×6 but camera_info says 8×6; publish both at the same size"):
        for number in (3, 4, 5):
            synchronizer.add("image", number * 40 * MS, image())
        synchronizer.flush()
    assert synchronizer.dropped["invalid"] == 1
    assert synchronizer.pending


def test_frames_before_and_after_a_bad_image_are_not_lost():
    synchronizer = ready()
    for number in (1, 2, 3):
        synchronizer.add("image", number * 40 * MS, image(width=WIDTH + (number == 2)))
    for number in (1, 2, 3):  # behind the back of `add`, so that all three are still waiting
        synchronizer.streams["pose"].add(number * 40 * MS, pose())
    with pytest.raises(SequenceError, match="endoscope/left: the image"):
        synchronizer.flush()
    assert [frame.stamp_ns // (40 * MS) for frame in synchronizer.flush()] == [1, 3]
    assert synchronizer.pending == 0


@pytest.mark.parametrize("name", ["depth", "mask"])
def test_depth_and_mask_of_another_size_are_refused_by_name(name):
    synchronizer = ready()
    synchronizer.add("pose", 40 * MS, pose())
    synchronizer.add(name, 40 * MS, np.ones((3, 3), np.float32))
    synchronizer.add("image", 40 * MS, image())
    with pytest.raises(SequenceError, match=f"the {name} is 3×3 but camera_info says 8×6"):
        synchronizer.flush()


def test_the_right_eye_needs_its_own_camera_info_and_brings_the_baseline():
    for right_info, baseline in ((None, None), (info(baseline=0.0), None), (info(baseline=0.005), 0.005)):
        synchronizer = ready()
        if right_info is not None:
            synchronizer.add_info("right", right_info)
        synchronizer.add("pose", 40 * MS, pose())
        synchronizer.add("right", 40 * MS, image(7))
        synchronizer.add("image", 40 * MS, image())
        (frame,) = synchronizer.flush()
        assert (frame.right is None) == (baseline is None)
        assert frame.baseline == (pytest.approx(baseline) if baseline else None)


def test_a_right_eye_that_is_left_of_the_left_one_is_told(caplog):
    ready().add_info("right", info(baseline=-0.0055))
    assert "right/camera_info: P: the right eye would be 0.0055 m to the left of the left one, so its images are not used" in caplog.text


def test_a_right_eye_of_another_size_is_refused():
    synchronizer = ready()
    synchronizer.add_info("right", info(width=16, baseline=0.005))
    synchronizer.add("pose", 40 * MS, pose())
    synchronizer.add("right", 40 * MS, image(width=16))
    synchronizer.add("image", 40 * MS, image())
    with pytest.raises(SequenceError, match="endoscope/right: the image is 16×6.*left image is 8×6"):
        synchronizer.flush()


def test_the_latest_camera_info_counts():
    synchronizer = ready()
    synchronizer.add("pose", 40 * MS, pose())
    synchronizer.add("image", 40 * MS, image())
    assert synchronizer.flush()[0].camera.width == WIDTH
    synchronizer.add_info("left", info(width=16, height=12))
    synchronizer.add("pose", 80 * MS, pose())
    synchronizer.add("image", 80 * MS, image(width=16, height=12))
    assert synchronizer.flush()[0].camera.width == 16


def test_duplicate_and_late_images_come_once_and_in_order():
    synchronizer, frames = ready(), []
    for number in (1, 2, 2, 4, 3, 5, 6, 1, 2, 7):
        frames += synchronizer.add("pose", number * 40 * MS, pose())
        frames += synchronizer.add("image", number * 40 * MS, image())
    frames += synchronizer.flush()
    assert [frame.stamp_ns // (40 * MS) for frame in frames] == [1, 2, 3, 4, 5, 6, 7]
    assert synchronizer.dropped["out of order"] == 2


def test_a_stamp_of_zero_is_refused_by_stream():
    for stream in ("image", "pose", "depth"):
        with pytest.raises(SequenceError, match=f"{stream}: a stamp of zero"):
            ready().add(stream, 0, image())


def test_a_pose_from_the_far_future_spoils_nothing():
    synchronizer, frames = ready(), []
    synchronizer.add("pose", 10**18, pose())
    for number in range(1, 11):
        frames += synchronizer.add("image", number * 40 * MS, image())
        frames += synchronizer.add("pose", number * 40 * MS, pose())
    frames += synchronizer.flush()
    assert len(frames) == 10 and synchronizer.dropped["without pose"] == 0


def test_streams_without_images_keep_a_bounded_number_of_messages():
    synchronizer = ready(max_poses=200, max_others=30)
    for number in range(1, 701):
        synchronizer.add("pose", number * 2 * MS, pose(number))
    for number in range(1, 60):
        synchronizer.add("depth", number * 40 * MS, np.ones((HEIGHT, WIDTH), np.float32))
    assert len(synchronizer.streams["pose"].stamps) == 200
    assert len(synchronizer.streams["depth"].stamps) == 30
    synchronizer.add("image", 700 * 2 * MS, image())
    assert synchronizer.flush()[0].camera.pose[0, 3] == 700  # the newest are kept
