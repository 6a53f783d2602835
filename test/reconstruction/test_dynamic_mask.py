"""What moved between the views."""

import dataclasses
import logging

import cv2
import numpy as np
import pytest
from short_training import options
from training_views import with_prior

from endo_sim_ros.reconstruction import dynamic_mask, prepare
from endo_sim_ros.reconstruction.dynamic_mask import mask_motion
from endo_sim_ros.reconstruction.stage_configs import DynamicMaskConfig


@pytest.fixture
def tool():
    """Pixels [128, 160] of an instrument."""
    pixels = np.zeros((128, 160), np.uint8)
    cv2.line(pixels, (60, 100), (110, 50), 1, 14)
    return pixels > 0


def holding(frame, shown, depth=0.6, color=(150, 150, 150)):
    """The frame with an instrument there, before the tissue by this factor of its depth."""
    image = np.where(shown[..., None], np.uint8(color), frame.image)
    return dataclasses.replace(frame, image=image, depth=np.where(shown, depth * frame.depth, frame.depth).astype(np.float32))


@pytest.mark.slow
def test_an_instrument_in_one_of_several_views_is_left_out(views, tool, caplog):
    shown = tool & (views[4].depth > 0)
    *still, empty, held = with_prior([views[0], views[2], views[6], views[8], views[4], holding(views[4], shown)])
    assert all(a is b for a, b in zip(mask_motion([*still, empty], 0.05), [*still, empty])) and not caplog.text
    found = mask_motion([*still, held], 0.05)
    assert all(a is b for a, b in zip(found[:4], still)) and f"{held.stamp_ns * 1e-9:.3f} s: " in caplog.text
    hidden = (found[4].mask == 0) & (held.mask > 0)
    assert hidden[shown].mean() > 0.8 and hidden[~shown].mean() < 0.05
    assert (found[4].depth_prior[hidden] == 0).all()


def test_a_share_of_no_percent_is_not_told(views, caplog):
    (view,), moved = with_prior([views[4]]), np.zeros((128, 160), bool)
    caplog.set_level(logging.INFO)
    for side, told in ((5, []), (20, [logging.WARNING])):
        moved[:side, :side] = True
        dynamic_mask._masked(view, moved, DynamicMaskConfig())
        assert [record.levelno for record in caplog.records] == told


@pytest.mark.slow
def test_an_instrument_on_the_tissue_is_told_by_its_colour(views, tool):
    shown = tool & (views[4].depth > 0)
    seen = with_prior([views[0], views[2], views[6], views[8], holding(views[4], shown, 1.0, (60, 150, 160))])
    assert ((mask_motion(seen, 0.05)[4].mask == 0) & shown).sum() > 0.8 * shown.sum()
    assert mask_motion(seen, 0.05, DynamicMaskConfig(chroma=5.0))[4] is seen[4]


@pytest.mark.slow
def test_nothing_is_left_out_where_nobody_can_tell_what_is_right(views, tool, caplog):
    held = holding(views[4], tool & (views[4].depth > 0))
    pair = with_prior([views[0], held])
    assert mask_motion(pair, 0.05)[1] is pair[1]
    shallow = with_prior([views[0], views[2], views[6], views[8], dataclasses.replace(views[4], depth=0.6 * views[4].depth)])
    assert mask_motion(shallow, 0.05)[4] is shallow[4] and "check its depth and pose" in caplog.text


@pytest.mark.thorough
@pytest.mark.slow
def test_it_is_a_stage_that_can_be_switched_off(views, tool, caplog):
    frames = [views[0], views[2], views[6], views[8], holding(views[4], tool & (views[4].depth > 0))]
    for choice in (False, True):
        caplog.clear()
        prepare(frames, options(dynamic_mask=choice))
        assert ("something moved" in caplog.text) == choice
