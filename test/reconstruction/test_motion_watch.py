"""Breath and heart of synthetic patients are found in what an endoscope films, and no motion is seen where there is none."""

import dataclasses

import numpy as np
import pytest
from lit_wall import CAMERA

from endo_sim_ros.core.frames import Frame
from endo_sim_ros.reconstruction.tissue_motion import MotionWatch, TissueMotion
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence


def filmed(**moving: float) -> list[Frame]:
    options = {"seed": 2, "width": 160, "height": 128, "frames": 110, "fps": 12.5, "rounds": 0.5}
    return list(phantom_sequence(PhantomConfig.from_mapping(options | moving)))


def watched(frames: list[Frame]) -> tuple[list[TissueMotion], str]:
    watch = MotionWatch()
    assert [frame.stamp_ns for frame in watch.watch(frames)] == [frame.stamp_ns for frame in frames]
    return watch.found()


def with_one_lens(frames: list[Frame]) -> list[Frame]:
    return [dataclasses.replace(frame, right=None, baseline=None, right_K=None) for frame in frames]


@pytest.fixture(scope="module")
def breathing() -> list[Frame]:
    return filmed(breathing=0.008, breathing_period=3.5, heartbeat=0.003)


@pytest.mark.slow
def test_breath_and_heart_have_their_periods_and_amplitudes(breathing):
    (breath, heart), text = watched(breathing)
    assert abs(breath.period / 3.5 - 1) < 0.03 and abs(breath.amplitude / 0.008 - 1) < 0.12
    assert abs(heart.period / 0.9 - 1) < 0.01 and 0.0015 < heart.amplitude < 0.0035
    assert breath.explained > 0.8 and abs(breath.cycles - 8.72 / breath.period) < 0.01
    assert text.startswith("the tissue moves by itself: ") and "mm every 0.90 s" in text


@pytest.mark.slow
def test_one_lens_sees_the_breath(breathing):
    breath = watched(with_one_lens(breathing))[0][0]
    assert abs(breath.period / 3.5 - 1) < 0.03 and abs(breath.amplitude / 0.008 - 1) < 0.12


@pytest.mark.slow
def test_one_breath_alone_is_no_period(breathing):
    motions, text = watched(breathing[:60])  # 4.7 s
    assert not any(motion.period > 2 for motion in motions)
    assert "mm every 3" not in text


@pytest.mark.slow
def test_still_tissue_does_not_breathe():
    frames = filmed()
    for each in (frames, with_one_lens(frames)):
        assert watched(each) == ([], "no breath and no heartbeat seen in 9 s")


def test_what_cannot_be_told_is_said():
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    black = [Frame(80_000_000 * k, image, CAMERA) for k in range(75)]
    assert watched([]) == ([], "whether the tissue moves by itself cannot be told from 0.0 s")
    at_once = [dataclasses.replace(frame, stamp_ns=5) for frame in black]
    assert watched(at_once)[1] == "whether the tissue moves by itself cannot be told from 0.0 s"
    assert watched(black)[1].endswith("too few points could be followed for long")
