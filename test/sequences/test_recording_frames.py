"""Recordings that do not fit into memory: glances, samples, frames taken again, frames in files."""

import pickle
import tracemalloc

import numpy as np

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.sequences.recording import Recording, store, survey


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
