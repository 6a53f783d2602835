"""Recordings as bags: what goes in comes out, and damage is told in one sentence."""

import contextlib
import dataclasses
import resource
import shutil

import numpy as np
import pytest
import torch

from endo_sim_ros import messages
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.messages import Topic, bag_types
from endo_sim_ros.sequences.bag import LEFT_FRAME, BagReader, BagWriter, canonical_cdr, read_bag, write_bag

STAMP = 1_000_000_000


def same(a, b):
    return (a is None) == (b is None) and (a is None or np.array_equal(a, b))


def test_frames_come_back_bit_by_bit(small_frames, small_bag):
    back = list(read_bag(small_bag))
    assert len(back) == len(small_frames) == 12
    for old, new in zip(small_frames, back):
        assert old.stamp_ns == new.stamp_ns
        for name in ("image", "right", "depth", "mask"):
            assert getattr(old, name) is not None and same(getattr(old, name), getattr(new, name)), name
            assert getattr(old, name).dtype == getattr(new, name).dtype
        np.testing.assert_array_equal(old.camera.K, new.camera.K)
        np.testing.assert_allclose(old.camera.pose, new.camera.pose, atol=1e-12)
        assert new.baseline == pytest.approx(old.baseline, rel=1e-12)


def test_frames_with_images_and_poses_alone_come_back(small_frames, tmp_path):
    bare = [dataclasses.replace(f, right=None, baseline=None, depth=None, mask=None) for f in small_frames[:4]]
    assert write_bag(tmp_path / "bag", iter(bare)) == 4
    with BagReader(tmp_path / "bag") as bag:
        assert set(bag.topics) == {"/endoscope/left/image_raw", "/endoscope/left/camera_info", "/ECM/measured_cp"}
        assert bag.message_count == 12 and bag.duration == pytest.approx(3 * 0.04, abs=1e-6)
    for old, new in zip(bare, read_bag(tmp_path / "bag"), strict=True):
        assert same(old.image, new.image) and new.right is new.depth is new.mask is None


@pytest.mark.parametrize("end", [SequenceError, KeyboardInterrupt])
def test_a_bag_that_ends_before_its_frames_is_removed(small_frames, tmp_path, end):
    def frames():
        yield small_frames[0]
        raise end("in the middle")

    with pytest.raises(end, match="in the middle"):
        write_bag(tmp_path / "new" / "too" / "bag", frames())
    assert not any(tmp_path.iterdir())


def test_a_right_eye_with_its_own_intrinsics_comes_back(small_frames, tmp_path):
    right_K = small_frames[0].camera.K @ np.diag([1.1, 1.1, 1.0])
    write_bag(tmp_path / "bag", [dataclasses.replace(small_frames[0], right_K=right_K)])
    (frame,) = read_bag(tmp_path / "bag")
    np.testing.assert_allclose(frame.right_K, right_K)
    assert frame.baseline == pytest.approx(small_frames[0].baseline)


def test_a_single_mcap_file_is_a_bag_too(small_bag):
    assert len(list(read_bag(next(small_bag.glob("*.mcap"))))) == 12


def test_latched_topics_stay_latched(tmp_path):
    model = GaussianModel(*(torch.ones(shape) for shape in ((5, 3), (5, 4), (5, 3), (5,), (5, 1, 3))))
    with BagWriter(tmp_path / "bag") as bag:
        bag.write(messages.GAUSSIANS, messages.encode_gaussians(model, STAMP, "world", bag_types()), STAMP)
        bag.write(messages.CAMERA_POSE, messages.encode_pose(np.eye(4), STAMP, "world", bag_types()), STAMP)
    with BagReader(tmp_path / "bag") as bag:
        assert bag.latched == {"/gaussians"}
        assert bag.topics == {"/gaussians": messages.GAUSSIANS.type, "/ECM/measured_cp": messages.CAMERA_POSE.type}


def test_raw_messages_come_in_the_order_of_recording_and_of_chosen_topics(small_bag):
    with BagReader(small_bag) as bag:
        stamps = [raw.stamp_ns for raw in bag.raw_messages()]
        assert stamps == sorted(stamps) and len(stamps) == 12 * 7
        assert {raw.topic for raw in bag.raw_messages(["/ECM/measured_cp"])} == {"/ECM/measured_cp"}
        assert list(bag.raw_messages(["/nothing"])) == []


def test_a_writer_whose_block_raises_leaves_a_readable_bag(tmp_path):
    with pytest.raises(RuntimeError, match="source is gone"), BagWriter(tmp_path / "bag") as bag:
        for number in range(3):
            bag.write(messages.CAMERA_POSE, messages.encode_pose(np.eye(4), STAMP + number, "world", bag_types()), STAMP + number)
        raise RuntimeError("the disk of the source is gone")
    with BagReader(tmp_path / "bag") as bag:
        assert len(list(bag.raw_messages())) == 3


def test_an_existing_bag_is_not_overwritten(small_bag, small_frames):
    with pytest.raises(SequenceError, match="exists already"):
        write_bag(small_bag, small_frames)
    assert len(list(read_bag(small_bag))) == 12


def test_a_sequence_without_frames_leaves_nothing_behind(tmp_path):
    with pytest.raises(SequenceError, match="no frames"):
        write_bag(tmp_path / "bag", [])
    assert not (tmp_path / "bag").exists()


def test_a_place_that_cannot_be_written_is_named(small_frames):
    with pytest.raises(SequenceError, match="/proc/nowhere/bag: the bag cannot be made"):
        write_bag("/proc/nowhere/bag", small_frames)


NOISE = Topic("noise", messages.LEFT_IMAGE.type)


def noise(number, size=100_000):
    """An image message that does not compress."""
    pixels = np.random.default_rng(number).integers(0, 256, (size // 300, 100, 3), np.uint8)
    return messages.encode_image(pixels, STAMP + number, LEFT_FRAME, bag_types())


def stamps_of(path):
    with BagReader(path) as bag:
        found = [(stamp, messages.stamp_to_ns(message.header.stamp)) for _, stamp, message in bag.messages([NOISE])]
        assert bag.message_count == len(found)
    return found


def written(path, count, flush_every=7):
    """A bag as a killed process leaves it: its writer never came to an end."""
    source = path.with_name(f"{path.name}_open")
    with BagWriter(source) as bag:
        for number in range(count):
            bag.write(NOISE, noise(number), STAMP + number)
            if number % flush_every == flush_every - 1:
                bag.flush()
        shutil.copytree(source, path)
    return path


def test_what_was_flushed_is_read_without_the_end_of_the_file(tmp_path):
    path = written(tmp_path / "bag", 40)  # the last flush came after 35; a chunk of a megabyte is never full between them
    assert not (path / "metadata.yaml").exists()
    for place in (path, path / "bag_open.mcap"):
        assert stamps_of(place) == [(STAMP + number, STAMP + number) for number in range(35)]
    with BagReader(path) as bag:
        assert bag.topics == {"/noise": NOISE.type} and bag.duration == pytest.approx(34e-9, abs=2e-9)
        assert bag.latched == set() and list(bag.raw_messages(["/nothing"])) == []


def test_full_chunks_need_no_flush(tmp_path):
    assert len(stamps_of(written(tmp_path / "bag", 40, flush_every=1000))) >= 30


@pytest.mark.parametrize("share", [0.05, 0.25, 0.5, 0.77, 0.999])
def test_half_a_chunk_at_the_end_is_passed_over(tmp_path, share):
    file = written(tmp_path / "bag", 40) / "bag_open.mcap"
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    if share < 0.1:
        with pytest.raises(SequenceError, match="bag: the bag cannot be read .*nothing was written before"):
            stamps_of(tmp_path / "bag")
    else:
        assert len(stamps_of(tmp_path / "bag")) == 7 * int(5 * share)  # five chunks of seven
    file.write_bytes(data + bytes(5000))  # what a file system may leave after a power cut
    assert len(stamps_of(tmp_path / "bag")) == 35


def test_messages_out_of_order_are_put_in_order(tmp_path):
    with BagWriter(tmp_path / "open") as bag:
        for number in (3, 1, 2, 0):
            bag.write(NOISE, noise(number), STAMP + number)
            bag.flush()
        shutil.copytree(tmp_path / "open", tmp_path / "bag")
    assert [stamp - STAMP for stamp, _ in stamps_of(tmp_path / "bag")] == [0, 1, 2, 3]


@contextlib.contextmanager
def largest_file(size):
    """No file of this process grows beyond a size: what a full disk does to a writer."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize("flush_every", [1, 1000])
def test_a_full_disk_leaves_what_fitted(tmp_path, flush_every):
    count = 0
    with pytest.raises(OSError, match="File too large"), largest_file(3_500_000), BagWriter(tmp_path / "bag") as bag:
        while True:
            bag.write(NOISE, noise(count), STAMP + count)
            count += 1
            if count % flush_every == 0:
                bag.flush()
    found = stamps_of(tmp_path / "bag")
    assert found == [(STAMP + number, STAMP + number) for number in range(len(found))]
    assert len(found) > (30 if flush_every == 1 else 20)


def test_a_disk_without_room_for_the_index_keeps_all_messages(tmp_path):
    with contextlib.ExitStack() as stack, pytest.raises(OSError, match="File too large"), BagWriter(tmp_path / "bag") as bag:
        for number in range(25):
            bag.write(NOISE, noise(number), STAMP + number)
        bag.flush()
        stack.enter_context(largest_file(next((tmp_path / "bag").glob("*.mcap")).stat().st_size + 100))
    assert len(stamps_of(tmp_path / "bag")) == 25 and not (tmp_path / "bag" / "metadata.yaml").exists()


def test_a_bag_that_failed_takes_no_more_messages(tmp_path):
    with largest_file(300_000), contextlib.suppress(OSError), BagWriter(tmp_path / "bag") as bag:
        bag.write(NOISE, noise(0), STAMP)
        bag.flush()
        with pytest.raises(OSError):
            bag.write(NOISE, noise(1, 3_000_000), STAMP)
        with pytest.raises(SequenceError, match="bag: the bag takes no more messages"):
            bag.write(NOISE, noise(2), STAMP)
    assert len(stamps_of(tmp_path / "bag")) == 1


def test_gaps_between_fields_become_zeros_and_nothing_else_changes():
    message = messages.encode_image(np.arange(30, dtype=np.uint8).reshape(2, 5, 3), STAMP, "abc", bag_types())
    clean = bytes(bag_types().typestore.serialize_cdr(message, messages.LEFT_IMAGE.type))
    dirty, gaps = bytearray(clean), 0
    for place in range(4, len(clean)):  # a byte that no field holds
        trial = bytearray(clean)
        trial[place] ^= 0x55
        try:
            again = bag_types().typestore.deserialize_cdr(bytes(trial), messages.LEFT_IMAGE.type)
            changed = bytes(bag_types().typestore.serialize_cdr(again, messages.LEFT_IMAGE.type)) != clean
        except Exception:
            changed = True
        if not changed:
            dirty[place], gaps = 0x55, gaps + 1
    assert gaps and bytes(dirty) != clean
    assert canonical_cdr(bytes(dirty), messages.LEFT_IMAGE.type) == clean == canonical_cdr(clean, messages.LEFT_IMAGE.type)


@pytest.mark.parametrize("data, kind", [(b"anything", "foreign_msgs/msg/Thing"), (b"\0\1\0\0\7", "sensor_msgs/msg/Image"), (b"", "x")])
def test_bytes_that_cannot_be_understood_stay_as_they_are(data, kind):
    assert canonical_cdr(data, kind) is data


def test_what_is_no_bag_is_told_with_what_a_bag_is(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "model.ply").write_bytes(b"ply")
    for name, what in {"missing": "no such bag", "empty": "a folder, but no rosbag2", "model.ply": "a file, but no rosbag2"}.items():
        with pytest.raises(SequenceError, match=f"{name}: {what}; give a rosbag2 folder"):
            list(read_bag(tmp_path / name))


@pytest.mark.parametrize("image", ["left/000001.png", "endoscope.mp4", ""])
def test_a_folder_of_images_that_is_taken_for_a_bag_is_told_how_to_become_one(tmp_path, image):
    folder = tmp_path / "recording"
    if not image:
        folder = tmp_path / "recording.mp4"
        folder.touch()
    else:
        (folder / image).parent.mkdir(parents=True)
        (folder / image).touch()
    with pytest.raises(SequenceError, match="a recording, but not a bag; `endo-sim convert .*recording.* BAG` makes"):
        list(read_bag(folder))


@pytest.mark.parametrize("fraction", [0.0, 0.00001, 0.01])
def test_a_bag_cut_off_at_its_beginning_is_one_sentence(small_bag, tmp_path, fraction):
    shutil.copytree(small_bag, tmp_path / "bag")
    file = next((tmp_path / "bag").glob("*.mcap"))
    data = file.read_bytes()
    file.write_bytes(data[: int(fraction * len(data))])
    for path in (tmp_path / "bag", file):
        with pytest.raises(SequenceError, match="the bag cannot be read") as caught:
            list(read_bag(path))
        assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


@pytest.mark.parametrize("share", [0.5, 0.9, 0.9999])
def test_a_bag_that_was_cut_off_later_is_read_with_a_warning(tmp_path, share, caplog):
    with BagWriter(tmp_path / "bag") as bag:
        for number in range(40):
            bag.write(NOISE, noise(number), STAMP + number)
    file = next((tmp_path / "bag").glob("*.mcap"))
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    assert (tmp_path / "bag" / "metadata.yaml").exists()
    for place in (tmp_path / "bag", file, file):
        found = stamps_of(place)
        assert found == [(STAMP + number, STAMP + number) for number in range(len(found))] and len(found) > 40 * share - 15
    (warning,) = [record.getMessage() for record in caplog.records]
    assert warning.startswith(f"{file}: the file is cut off; its {len(found)} whole messages, 0.0 s, are read")


def test_a_bag_that_is_still_being_written_is_read_with_one_warning(tmp_path, caplog):
    with BagWriter(tmp_path / "bag") as bag:
        file = next((tmp_path / "bag").glob("*.mcap"))
        for count in (40, 80):
            for number in range(count - 40, count):
                bag.write(NOISE, noise(number), STAMP + number)
            assert 0 < len(stamps_of(tmp_path / "bag")) <= count
    (warning,) = [record.getMessage() for record in caplog.records]
    assert warning.startswith(f"{file}: the recording has no end: its recorder was killed, or still writes; its ")


@pytest.mark.parametrize("name", ["noise.mcap", "text.mcap", "notes.txt", "old.bag"])
def test_a_foreign_file_is_one_sentence(tmp_path, name):
    data = np.random.default_rng(0).bytes(5000) if name == "noise.mcap" else b"#ROSBAG V2.0\n" + b"hello " * 100
    (tmp_path / name).write_bytes(data)
    with pytest.raises(SequenceError, match="the bag cannot be read" if name.endswith(".mcap") else "a file, but no rosbag2; ") as caught:
        list(read_bag(tmp_path / name))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "hello", "{[", "\x00\x01", "rosbag2_bagfile_information:\n  version: 9\n"])
def test_damaged_metadata_is_one_sentence(small_bag, tmp_path, text):
    shutil.copytree(small_bag, tmp_path / "bag")
    (tmp_path / "bag" / "metadata.yaml").write_text(text)
    with pytest.raises(SequenceError, match="the bag cannot be read"):
        list(read_bag(tmp_path / "bag"))


@pytest.mark.slow
def test_flipped_bytes_are_told_or_harmless(small_bag, tmp_path):
    shutil.copytree(small_bag, tmp_path / "bag")
    file = next((tmp_path / "bag").glob("*.mcap"))
    good, random, told = file.read_bytes(), np.random.default_rng(1), 0
    for _ in range(25):
        data = bytearray(good)
        for place in [*random.integers(0, len(good), 5), *(len(good) - 1 - random.integers(0, 3000, 3))]:
            data[place] = random.integers(0, 256)
        file.write_bytes(data)
        try:
            list(read_bag(tmp_path / "bag"))
        except SequenceError:
            told += 1
    assert told > 12


def test_a_wrong_type_on_a_topic_is_named(tmp_path):
    wrong = Topic(messages.LEFT_IMAGE.name, messages.CAMERA_POSE.type)
    with BagWriter(tmp_path / "bag") as bag:
        pose = messages.encode_pose(np.eye(4), STAMP, "world", bag_types())
        info = messages.encode_camera_info(np.eye(3), 4, 4, STAMP, LEFT_FRAME, types=bag_types())
        bag.write(wrong, pose, STAMP)
        bag.write(messages.CAMERA_POSE, pose, STAMP)
        bag.write(messages.LEFT_INFO, info, STAMP)
    with pytest.raises(SequenceError, match="/endoscope/left/image_raw is a geometry_msgs.*expected a sensor_msgs"):
        list(read_bag(tmp_path / "bag"))


@pytest.mark.parametrize("missing", [messages.LEFT_IMAGE, messages.LEFT_INFO, messages.CAMERA_POSE])
def test_missing_topics_are_named_with_what_there_is(small_bag, tmp_path, missing):
    with BagReader(small_bag) as source, BagWriter(tmp_path / "bag") as bag:
        for raw in source.raw_messages():
            if raw.topic != f"/{missing.name}":
                bag.write_raw(Topic(raw.topic, raw.type), bytes(raw.data), raw.stamp_ns)
    with pytest.raises(SequenceError, match=f"no topic /{missing.name}; the bag has .*/endoscope/right/image_raw"):
        list(read_bag(tmp_path / "bag"))


@pytest.mark.slow
def test_a_bag_whose_stamps_never_meet_says_so(small_bag, tmp_path):
    with BagReader(small_bag) as source, BagWriter(tmp_path / "bag") as bag:
        for topic, stamp, message in source.messages(messages.RECORDING_TOPICS):
            if topic == messages.CAMERA_POSE:
                message.header.stamp.sec += 1000
            bag.write(topic, message, stamp)
    with pytest.raises(SequenceError, match="no view in the bag .12 without pose.; are image and pose stamps within"):
        list(read_bag(tmp_path / "bag"))


@pytest.mark.slow
def test_an_unusable_message_is_named_with_its_bag(small_bag, tmp_path):
    with BagReader(small_bag) as source, BagWriter(tmp_path / "bag") as bag:
        for topic, stamp, message in source.messages(messages.RECORDING_TOPICS):
            if topic == messages.CAMERA_POSE:
                message.pose.orientation.w = 3.0
            bag.write(topic, message, stamp)
    with pytest.raises(SequenceError, match="bag: ECM/measured_cp: the orientation's quaternion has length"):
        list(read_bag(tmp_path / "bag"))
