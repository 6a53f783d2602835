"""Where reconstruction breaks: a result or one clear error."""

import dataclasses

import numpy as np
import pytest
from short_training import bare, film, finite, options
from trained import trainer_of

from endo_sim_ros.core.frames import SequenceError


def test_no_views_is_one_clear_error():
    with pytest.raises(SequenceError, match="no views"):
        trainer_of([], options())


def test_one_view_is_enough_with_depth(small):
    assert finite(trainer_of([small[0]], options()).run())


def test_identical_views_train(small, caplog):
    assert finite(trainer_of([small[0]] * 3, options()).run())
    assert "contradict what they see" not in caplog.text


def test_masking_everything_is_an_error(small):
    hidden = dataclasses.replace(small[0], mask=np.zeros_like(small[0].mask))
    with pytest.raises(SequenceError, match="masked"):
        trainer_of([hidden], options())
    assert finite(trainer_of([small[4], hidden], options()).run())  # one of them is no obstacle


def test_depth_with_holes_trains(small):
    depth = small[0].depth.copy()
    depth[:, :60], depth[:40] = np.nan, 0
    empty = dataclasses.replace(small[4], depth=np.zeros_like(depth))
    assert finite(trainer_of([dataclasses.replace(small[0], depth=depth), empty], options()).run())


def test_nothing_to_see_is_an_error(small):
    flat = np.full_like(small[0].image, 128)
    with pytest.raises(SequenceError, match="only 0 scene points"):
        trainer_of([bare(small[0], image=flat), bare(small[4], image=flat)], options())
    with pytest.raises(SequenceError, match="only 0 scene points"):
        trainer_of([dataclasses.replace(bare(small[0]), depth=np.zeros_like(small[0].depth))], options())


def test_views_that_face_away_from_each_other_train(small):
    away = small[4].camera.pose @ np.diag([-1.0, 1, -1, 1])
    other = dataclasses.replace(small[4], camera=small[4].camera.at(away))
    assert finite(trainer_of([small[0], other], options()).run())


def test_points_alone_are_enough(large):
    model = trainer_of([bare(frame) for frame in large[:3]], options(image_width=160)).run()
    assert finite(model)
    assert len(model) > 100


def test_odd_sizes_train():
    frames = film(161, 97, 3)
    model = trainer_of(list(frames[::2]), options(image_width=75)).run()
    assert finite(model)
