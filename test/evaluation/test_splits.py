"""Splits: what is held out."""

import dataclasses

import numpy as np
import pytest

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.evaluation.splits import explain_split, right_views, split_views


@pytest.mark.parametrize(
    "name, count, train, said",
    [
        ("1:49", 250, [0, 50, 100, 150, 200], "Of each 50 views in order the first one trains"),
        ("1:99", 250, [0, 100, 200], "Of each 100 views"),
        ("2:3", 11, [0, 1, 5, 6, 10], "Of each 5 views in order the first 2 train"),
        ("two-views", 7, [0, 6], "The first and the last view train"),
        ("every-12th", 25, [0, 12, 24], "One view in 12 trains"),
        ("every-5", 11, [0, 5, 10], "One view in 5 trains"),
        ("all-but-3rd", 7, [1, 2, 4, 5], "One view in 3 is held out"),
    ],
)
def test_a_split_trains_on_some_views_and_holds_out_the_others(name, count, train, said):
    split = split_views(name, count)
    assert explain_split(name).startswith(said)
    assert split.train == train
    assert sorted(split.train + split.held_out) == list(range(count))
    assert not split.right


def test_in_stereo_the_right_views_are_held_out():
    assert split_views("stereo", 3) == ([0, 1, 2], [0, 1, 2], True)


@pytest.mark.parametrize("name", ["half", "0:5", "5:0", "every-1st", "1-49", ""])
def test_splits_that_there_are_not_are_an_error(name):
    with pytest.raises(SequenceError, match="there is no split .* give 1:49"):
        split_views(name, 10)


def test_a_split_that_leaves_nothing_is_an_error():
    for count, views in ((1, "1 view"), (2, "2 views")):
        with pytest.raises(SequenceError, match=f"two-views of {views} leaves {count} to train on and 0 to hold out"):
            split_views("two-views", count)


def test_right_views_stand_beside_the_left_ones(small_frames):
    K = small_frames[0].camera.K + [[0, 0, 2], [0, 0, 0], [0, 0, 0]]
    frame = dataclasses.replace(small_frames[0], right_K=K)
    (view,) = right_views([frame, dataclasses.replace(small_frames[1], right=None)])
    assert np.array_equal(view.image, frame.right)
    step = view.camera.position - frame.camera.position
    np.testing.assert_allclose(step @ frame.camera.pose[:3, :3], [frame.baseline, 0, 0], atol=1e-12)
    assert view.camera.K[0, 2] == frame.camera.K[0, 2] + 2
    with pytest.raises(SequenceError, match="no right images"):
        right_views(small_frames[:0])


def test_a_border_of_lifted_black_is_no_tissue_of_right_views(small_frames):
    frame = small_frames[0]
    assert frame.right is not None
    right = np.maximum(frame.right, 60)
    right[:, :20] = 24
    right[:, -20:] = 24
    masks = [view.mask for view in right_views([dataclasses.replace(frame, right=right)] * 5)]
    assert all(mask is not None and not mask[:, :20].any() and mask[:, 30:-30].all() for mask in masks)
