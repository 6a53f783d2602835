"""Breath and heart are found in what an endoscope films of tissue that moves exactly so, and no motion is seen where there is none."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from lit_wall import CAMERA
from short_training import options

from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.motion import beat_share, breath_share
from endo_sim_ros.core.tissue_motion import MovingModel, TissueMotion
from endo_sim_ros.evaluation.held_out import model_renderer
from endo_sim_ros.evaluation.metrics import psnr
from endo_sim_ros.reconstruction import Cancelled, Trainer, prepare, reconstruct
from endo_sim_ros.reconstruction.motion_watch import MotionWatch
from endo_sim_ros.reconstruction.progress import StageProgress

DEPTH, BASELINE, RATE = 0.1, 0.005, 12.5  # m, m, Hz
SLIDES, KNOCKS = np.array([0.8, 0.5, -0.4]), np.array([0.2, 0.1, -1.0])  # directions
PATTERN = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 1, (512, 640)).astype(np.float32), (0, 0), 2.5)
PIXEL = 0.0005  # metres of it


def shares(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """How much of the way each place of a wall goes."""
    return np.exp(-0.5 * (x**2 + y**2) / 0.06**2)


def displaced(x: np.ndarray, y: np.ndarray, way: np.ndarray) -> np.ndarray:
    return shares(x, y)[..., None] * way


def picture(camera, way: np.ndarray) -> np.ndarray:
    """A patterned wall, displaced by shares of a way."""
    rays = camera.rays() @ camera.pose[:3, :3].T
    rest = np.zeros((*rays.shape[:2], 2))
    for _ in range(4):  # where what a ray hits is at rest
        moved = displaced(*np.moveaxis(rest, -1, 0), way)
        reach = (DEPTH + moved[..., 2] - camera.position[2]) / rays[..., 2]
        rest = (camera.position + reach[..., None] * rays - moved)[..., :2]
    u, v = ((rest[..., i] / PIXEL + PATTERN.shape[1 - i] / 2 - 0.5).astype(np.float32) for i in (0, 1))
    gray = 128 + 400 * cv2.remap(PATTERN, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return np.repeat(gray.clip(0, 255).astype(np.uint8)[..., None], 3, -1)


def way(seconds: float, breath: float, heart: float) -> np.ndarray:
    slides, knocks = (direction / np.linalg.norm(direction) for direction in (SLIDES, KNOCKS))
    return breath * breath_share(seconds, 3.5) * slides + heart * beat_share(seconds, 0.9) * knocks


def filmed(breath: float = 0.0, heart: float = 0.0, count: int = 110, rate: float = RATE) -> list[Frame]:
    """By a camera that goes to and fro."""
    frames = []
    for k in range(count):
        pose = np.eye(4)
        pose[:3, 3] = 0.008 * np.sin(0.11 * k), 0.005 * np.sin(0.17 * k), 0.003 * np.sin(0.07 * k)
        camera, moved = CAMERA.at(pose), way(k / rate, breath, heart)
        right = picture(camera.beside(BASELINE), moved)
        frames.append(Frame(round(1e9 * (5 + k / rate)), picture(camera, moved), camera, right=right, baseline=BASELINE))
    return frames


def watched(frames: list[Frame]) -> tuple[TissueMotion | None, str]:
    watch = MotionWatch()
    assert [frame.stamp_ns for frame in watch.watch(frames)] == [frame.stamp_ns for frame in frames]
    return watch.found()


def with_one_lens(frames: list[Frame]) -> list[Frame]:
    return [dataclasses.replace(frame, right=None, baseline=None, right_K=None) for frame in frames]


@pytest.fixture(scope="module")
def breathing() -> list[Frame]:
    return filmed(0.008, 0.003)


@pytest.mark.slow
def test_breath_and_heart_have_their_periods_amplitudes_and_ways(breathing):
    motion, text = watched(breathing)
    assert motion is not None
    breath, heart = motion.parts
    assert (breath.name, heart.name) == ("breathing", "heartbeat")
    assert abs(breath.period / 3.5 - 1) < 0.01 and abs(motion.amplitudes[0] / 0.008 - 1) < 0.1
    assert abs(heart.period / 0.9 - 1) < 0.01 and abs(motion.amplitudes[1] / 0.003 - 1) < 0.15
    assert breath.explained > 0.8 and abs(breath.cycles - 8.72 / breath.period) < 0.01
    assert text.startswith("the tissue moves by itself: ") and "mm every 0.90 s" in text
    assert motion.start == 5.0 and abs(motion.end - 13.72) < 1e-6
    paths = np.stack([motion.shares(motion.points) @ motion.paths(frame.stamp_ns) for frame in breathing])
    truth = np.stack([displaced(*motion.points[:, :2].T, way(k / RATE, 0.008, 0.003)) for k in range(len(breathing))])
    off = np.linalg.norm(paths - paths.mean(0) - (truth - truth.mean(0)), axis=-1)
    assert np.quantile(off, 0.9) < 0.0006
    means = displaced(*motion.points[:, :2].T, np.mean([way(k / RATE, 0.008, 0.003) for k in range(len(breathing))], 0))
    assert np.median(np.abs(motion.points[:, 2] - DEPTH - means[:, 2])) < 0.0005


@pytest.mark.slow
def test_a_model_of_moving_tissue_is_sharp_at_all_times(breathing):
    motion = watched(breathing)[0]
    config = options(iterations=80, max_gaussians=3000, depth="stereo", extrapolation=0.0)
    views, others = [breathing[3], breathing[28]], breathing[10:90:20]  # different phases

    def quality(motion):
        moving = MovingModel(reconstruct(views, config, motion=motion), motion)
        drawn = [model_renderer(moving.at(frame.stamp_ns), "cpu").render(frame.camera)[0] for frame in others]
        return np.mean([psnr(image, frame.image) for image, frame in zip(drawn, others)])

    assert quality(motion) > quality(None) + 3


@pytest.mark.slow
def test_a_training_of_moving_tissue_goes_on_as_if_never_interrupted(breathing, tmp_path):
    motion, config = watched(breathing)[0], options(iterations=60, max_gaussians=600, refine_every=10, depth="stereo", extrapolation=0.0)
    first, second = (Trainer(prepare(breathing[3:30:25], config, motion=motion), config) for _ in range(2))
    for _ in range(35):
        first.step()
    first.save_checkpoint(tmp_path / "checkpoint.pt")
    second.load_checkpoint(tmp_path / "checkpoint.pt")
    pairs = zip(first.run().tensors().values(), second.run().tensors().values())
    assert all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.slow
def test_one_lens_sees_the_breath(breathing):
    motion = watched(with_one_lens(breathing))[0]
    assert motion is not None
    assert abs(motion.parts[0].period / 3.5 - 1) < 0.01 and abs(motion.amplitudes[0] / 0.008 - 1) < 0.15


@pytest.mark.slow
def test_one_breath_alone_is_no_period(breathing):
    for count in (45, 60, 75):  # images; a breath takes 44
        motion, text = watched(breathing[:count])
        assert "mm every 3" not in text
        if motion is not None:  # the heart, although the breath is beside it
            (heart,) = motion.parts
            assert abs(heart.period / 0.9 - 1) < 0.03 and motion.amplitudes[0] < 0.004


@pytest.mark.slow
def test_no_harmonic_is_taken_for_another_that_images_cannot_tell_from_it():
    for beat in (0.003, 0.0):
        motion = watched(filmed(0.008, beat, 80, 8.0))[0]
        assert motion is not None and abs(motion.parts[0].period / 3.5 - 1) < 0.01
        assert [part.name for part in motion.parts] == ["breathing", "heartbeat"][: 1 + (beat > 0)]
        assert not beat or abs(motion.parts[1].period / 0.9 - 1) < 0.01


@pytest.mark.slow
def test_a_beat_that_images_are_too_seldom_for_is_not_taken_for_another():
    """At 2 Hz a beat every 0.9 s looks like one every 1.1 s, and like one every 9 s."""
    motion = watched(filmed(0.008, 0.003, 60, 2.0))[0]
    assert motion is None or [part.name for part in motion.parts] == ["breathing"]


@pytest.mark.slow
def test_still_tissue_does_not_breathe():
    frames = filmed()
    for each in (frames, with_one_lens(frames)):
        assert watched(each) == (None, "no breath and no heartbeat seen in 9 s")


@pytest.mark.slow
def test_the_search_can_be_cancelled_at_any_time(breathing):
    watch, calls = MotionWatch(), 0
    assert len(list(watch.watch(breathing[:60]))) == 60
    times = []

    def on_progress(stage: str, done: int, total: int) -> None:
        times.append(stage)
        if len(times) > calls:
            raise Cancelled

    for calls in (0, 100, 400):  # as tracks are triangulated, and as rates are tried
        times.clear()
        with pytest.raises(Cancelled):
            watch.found(StageProgress("motion", on_progress))
    assert set(times) == {"motion"}


def test_what_cannot_be_told_is_said():
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    black = [Frame(80_000_000 * k, image, CAMERA) for k in range(75)]
    assert watched([]) == (None, "whether the tissue moves by itself cannot be told from 0.0 s")
    at_once = [dataclasses.replace(frame, stamp_ns=5) for frame in black]
    assert watched(at_once)[1] == "whether the tissue moves by itself cannot be told from 0.0 s"
    seldom = [dataclasses.replace(frame, stamp_ns=20 * frame.stamp_ns) for frame in black]
    assert watched(seldom)[1] == "whether the tissue moves by itself cannot be told from images 1.6 s apart"
    with_two = [dataclasses.replace(frame, right=image, baseline=BASELINE) for frame in black]
    assert watched(with_two)[1].endswith("too few points could be followed for long")
    assert watched(black)[1].endswith("one lens that stays where it is sees no depth")
