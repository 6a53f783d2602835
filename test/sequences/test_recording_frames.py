"""Recordings that do not fit into memory: glances, samples, frames taken again, frames in files."""

import dataclasses
import pickle
import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence
from endo_sim_ros.sequences.recording import Recording, keep_posed, store, survey


def small_frames(count, side=8):
    """Every tenth is masked whole."""
    camera = Camera(intrinsic_matrix(10, 10, side / 2, side / 2), side, side)
    for number in range(count):
        mask = np.full((side, side), number % 10 != 9, np.uint8)
        yield Frame(number + 1, np.zeros((side, side, 3), np.uint8), camera, mask=mask)


def test_memory_of_a_survey_does_not_grow_with_the_recording():
    peaks = []
    for count in (60, 240):
        tracemalloc.start()
        survey(small_frames(count, 256), 12)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0] < 1.2 * 60 * 256 * 256 * 4


def test_a_survey_glances_at_all_and_holds_an_even_sample():
    frames = list(small_frames(100))
    glances, sample = survey(frames, 8)
    assert [glance.stamp_ns for glance in glances] == [frame.stamp_ns for frame in frames]
    assert not glances[9].tissue and glances[8].tissue
    assert 8 <= len(sample) <= 16
    stamps = [frame.stamp_ns for frame in sample]
    assert stamps == sorted(stamps) and np.ptp(stamps) > 0.8 * np.ptp([frame.stamp_ns for frame in frames])
    assert len(survey(frames[:8], 8)[1]) == 8


def test_frames_at_positions_are_taken_again_and_again():
    frames = list(small_frames(12))
    taken = Recording(lambda: iter(frames), 12).take({1, 5}, 2)
    assert [frame.stamp_ns for frame in taken] == [frame.stamp_ns for frame in taken] == [frames[1].stamp_ns, frames[5].stamp_ns]
    assert len(taken) == 2


def test_a_stored_frame_is_the_same_here_and_elsewhere(tmp_path):
    (frame,) = small_frames(1)
    stored = store(frame, tmp_path / "0")
    elsewhere = pickle.loads(pickle.dumps(stored.carried()))
    stored.file.rename(tmp_path / "1")
    np.testing.assert_array_equal(elsewhere.load().mask, frame.mask)
    assert (elsewhere.stamp_ns, elsewhere.depth) == (frame.stamp_ns, False)


@pytest.mark.parametrize(("posed", "level"), [(range(5), "WARNING"), (range(12), "INFO")])
def test_frames_without_a_pose_are_a_warning_if_they_are_most(posed, level, caplog):
    with caplog.at_level("INFO"):
        keep_posed([*range(24)], {number: np.eye(4) for number in posed}, Path("poses.txt"))
    (record,) = caplog.records
    assert (record.levelname, record.getMessage()) == (level, f"poses.txt: skipped, without a pose: {24 - len(posed)} of 24 frames")


@pytest.mark.parametrize("rows", [0, 3, -3])
def test_a_pair_whose_rows_do_not_match_is_told_once(rows, caplog):
    frames = list(phantom_sequence(PhantomConfig(frames=2, width=96, height=80)))
    moved = [dataclasses.replace(frame, right=np.roll(frame.right, rows, 0)) for frame in frames]
    assert len(list(Recording(lambda: iter(moved), 2, source="files"))) == 2
    how = "lower" if rows > 0 else "higher"
    expected = rf"files: images of the right eye lie (2.9|3.\d) px {how} than those of the left one, at 1.000 s: the pair is not rectified"
    assert len(caplog.messages) == (rows != 0) and all(re.match(expected, message) for message in caplog.messages)


def test_exchanged_eyes_are_refused_by_the_first_pair_that_tells():
    textured = next(phantom_sequence(PhantomConfig(frames=1, width=96, height=80)))
    assert textured.right is not None
    flat = dataclasses.replace(textured, image=np.zeros_like(textured.image), right=np.zeros_like(textured.image))
    assert len(list(Recording(lambda: iter([flat, textured]), 2))) == 2
    exchanged = dataclasses.replace(textured, image=textured.right, right=textured.image)
    with pytest.raises(SequenceError, match="^files: left and right eye are exchanged, .* of the view at 1.000 s lie farther right"):
        list(Recording(lambda: iter([flat, exchanged]), 2, source="files"))
    wide = np.array([[1, 0, 30], [0, 1, 0], [0, 0, 1]])  # the principal point of the right eye counts
    assert list(Recording(lambda: iter([dataclasses.replace(exchanged, right_K=wide @ textured.camera.K)]), 1))
