"""Breath and heart are found in what an endoscope films of tissue that moves exactly so, and no motion is seen where there is none."""

import dataclasses
import re
import sys
from collections.abc import Sequence

import cv2
import numpy as np
import pytest
import torch
from lit_wall import CAMERA
from short_training import equal, options

from endo_sim_ros.core.cameras import rigid_pose
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.motion import beat_share, breath_share
from endo_sim_ros.core.tissue_motion import MovingModel, PeriodicMotion, TissueMotion
from endo_sim_ros.evaluation.held_out import model_renderer
from endo_sim_ros.evaluation.metrics import psnr
from endo_sim_ros.reconstruction import Cancelled, Trainer, prepare
from endo_sim_ros.reconstruction.bundle import Bundle
from endo_sim_ros.reconstruction.learnt_motion import LearntMotion
from endo_sim_ros.reconstruction.motion_watch import MotionWatch
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.stage_configs import MotionSearchConfig, PosesConfig
from endo_sim_ros.reconstruction.still_frames import stilled
from endo_sim_ros.sequences.phantom import PhantomConfig, displacement_at, phantom_sequence, render_phantom
from endo_sim_ros.sequences.phantom.rendering import build_phantom

DEPTH, BASELINE, RATE = 0.1, 0.005, 12.5  # m, m, Hz
SLIDES, KNOCKS = np.array([0.8, 0.5, -0.4]), np.array([0.2, 0.1, -1.0])  # directions
PATTERN = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 1, (512, 640)).astype(np.float32), (0, 0), 2.5)
PIXEL = 0.0005  # metres of it
STILL = "no breath and no heartbeat seen in {} s; less than 1 px (root mean square, watch.least_pixels) counts as no breath"
SEARCH = MotionSearchConfig(points=130)  # one to 160 pixels; highlights take more to be mistaken for tissue


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


def way(seconds: float, breath: float, heart: float, breaths: Sequence[float] = ()) -> np.ndarray:
    """By breaths of 3.5 s, or of these times, s."""
    slides, knocks = (direction / np.linalg.norm(direction) for direction in (SLIDES, KNOCKS))
    cycles = np.interp(seconds, np.cumsum([0, *breaths]), np.arange(len(breaths) + 1)) if breaths else seconds / 3.5
    return breath * breath_share(cycles, 1.0) * slides + heart * beat_share(seconds, 0.9) * knocks


def filmed(
    breath: float = 0.0, heart: float = 0.0, count: int = 110, rate: float = RATE, travel: float = 0.0, breaths: Sequence[float] = ()
) -> list[Frame]:
    """By a camera that goes to and fro, and along the wall, m."""
    frames = []
    for k in range(count):
        pose = np.eye(4)
        pose[:3, 3] = 0.008 * np.sin(0.11 * k), 0.005 * np.sin(0.17 * k), 0.003 * np.sin(0.07 * k)
        pose[0, 3] += travel * (k / count - 0.5)
        camera, moved = CAMERA.at(pose), way(k / rate, breath, heart, breaths)
        right = picture(camera.beside(BASELINE), moved)
        frames.append(Frame(round(1e9 * (5 + k / rate)), picture(camera, moved), camera, right=right, baseline=BASELINE))
    return frames


def watched(frames: list[Frame], options: MotionSearchConfig = SEARCH) -> tuple[TissueMotion | None, str]:
    watch = MotionWatch(options)
    assert [frame.stamp_ns for frame in watch.watch(frames)] == [frame.stamp_ns for frame in frames]
    return watch.found()


def with_one_lens(frames: list[Frame]) -> list[Frame]:
    return [dataclasses.replace(frame, right=None, baseline=None, right_K=None) for frame in frames]


@pytest.fixture(scope="module")
def breathing() -> list[Frame]:
    return filmed(0.008, 0.003)


@pytest.fixture(scope="module")
def still() -> list[Frame]:
    return filmed()


@pytest.fixture(scope="module")
def found(breathing) -> tuple[TissueMotion, str]:
    """The motion in it, and what is said of it."""
    motion, text = watched(breathing)
    assert motion is not None
    return motion, text


@pytest.mark.slow
def test_breath_and_heart_have_their_periods_amplitudes_and_ways(breathing, found):
    motion, text = found
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


@pytest.mark.thorough
@pytest.mark.slow
def test_breath_is_told_though_poses_go_off_slowly(breathing):
    """As those of a robot do, here by a quarter of a degree and half a millimetre."""
    frames = []
    for k, frame in enumerate(breathing):
        waves = np.sin(2 * np.pi * k / RATE / 30 + np.arange(6))
        error = rigid_pose(cv2.Rodrigues(np.radians(0.25) * waves[:3])[0], 0.0005 * waves[3:])
        frames.append(dataclasses.replace(frame, camera=frame.camera.at(frame.camera.pose @ error)))
    motion = watched(frames)[0]
    assert motion is not None
    assert abs(motion.parts[0].period / 3.5 - 1) < 0.02 and abs(motion.amplitudes[0] / 0.008 - 1) < 0.15


@pytest.mark.thorough
@pytest.mark.slow
def test_points_that_go_with_highlights_hardly_tell_how_far_tissue_goes(breathing):
    """Thirty white spots go 0.4 of the way of the tissue behind them, and corners are found at their rims first."""
    rng, speckled = np.random.default_rng(1), []
    x, y = rng.uniform(-0.05, 0.05, (2, 30))
    for k, frame in enumerate(breathing):
        places = np.c_[x, y, np.full(30, DEPTH)] + 0.4 * displaced(x, y, way(k / RATE, 0.008, 0.003))
        left, right = frame.image.copy(), frame.right.copy()
        for image, eye in ((left, frame.camera), (right, frame.right_camera)):
            for u, v in 16 * (eye.project(places)[0] - 0.5):
                cv2.circle(image, (round(u), round(v)), 40, (255, 255, 255), -1, cv2.LINE_AA, shift=4)  # in sixteenths of a pixel
        speckled.append(dataclasses.replace(frame, image=left, right=right))
    motion = watched(speckled)[0]
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(-0.04, 0.04, 9), np.linspace(-0.03, 0.03, 7)))
    goes = motion.shares(np.c_[x, y, np.full(x.size, DEPTH)])
    off = np.stack([goes @ motion.paths(frame.stamp_ns) - displaced(x, y, way(k / RATE, 0.008, 0.003)) for k, frame in enumerate(speckled)])
    assert np.sqrt(((off - off.mean(0)) ** 2).sum(-1).mean()) < 0.00035  # 0.33 mm; where all count alike 0.46


@pytest.mark.thorough
@pytest.mark.slow
def test_a_small_place_that_moves_alone_is_no_highlight(monkeypatch):
    """It fades to a half within 14 mm, where points are 7 mm apart: next to each lie others that move, though most around stand still."""
    monkeypatch.setattr(sys.modules[__name__], "shares", lambda x, y: np.exp(-0.5 * (x**2 + y**2) / 0.012**2))
    frames = filmed(0.004)
    motion = watched(frames, MotionSearchConfig())[0]
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(-0.008, 0.008, 5), np.linspace(-0.008, 0.008, 5)))
    goes = motion.shares(np.c_[x, y, np.full(x.size, DEPTH)])
    truth = np.stack([displaced(x, y, way(k / RATE, 0.004, 0.0)) for k in range(len(frames))])
    off = np.stack([goes @ motion.paths(frame.stamp_ns) for frame in frames]) - truth
    assert np.sqrt(((off - off.mean(0)) ** 2).sum(-1).mean()) < 0.00019  # 0.16 mm; without the points next to each 0.22


@pytest.mark.slow
def test_a_model_of_moving_tissue_is_sharp_at_all_times(breathing, found):
    motion = found[0]
    config = options(iterations=40, max_gaussians=3000, depth="stereo", extrapolation=0.0)
    views, others = [breathing[3], breathing[28]], breathing[10:90:20]  # different phases

    def quality(motion):
        trainer = Trainer(prepare(views, config, motion=motion), config)
        moving = MovingModel(trainer.run(), trainer.motion)
        drawn = [model_renderer(moving.at(frame.stamp_ns), "cpu").render(frame.camera)[0] for frame in others]
        return np.mean([psnr(image, frame.image) for image, frame in zip(drawn, others)])

    assert quality(motion) > quality(None) + 3


@pytest.mark.thorough
@pytest.mark.slow
def test_pairs_tell_the_depth_of_moving_tissue_as_well_as_at_rest():
    """And in its mean position, which training starts from."""

    def filmed_patient(breathing: float):
        config = PhantomConfig(1, 6, 1.5, 160, 128, noise=0.0, breathing=breathing)
        return config, [dataclasses.replace(frame, mask=None) for frame in phantom_sequence(config)]

    config, frames = filmed_patient(0.008)
    mean = np.mean([breath_share(phase, 1.0) for phase in np.arange(1000) / 1000])
    way = np.array([[np.mean([2 * breath_share(phase, 1.0) * np.cos(2 * np.pi * phase) for phase in np.arange(1000) / 1000])], [0.0]])
    farthest = displacement_at(config, config.breathing_period / 2)
    at_rest = [frame.camera.backproject(render_phantom(PhantomConfig(1), frame.camera)[1])[::8, ::8].reshape(-1, 3) for frame in frames]
    rest = np.concatenate(at_rest)
    goes = farthest.at(rest) @ farthest.amplitudes[0] / (farthest.amplitudes[0] @ farthest.amplitudes[0])
    breath = PeriodicMotion("breathing", config.breathing_period, 1.0, 9.0, way * farthest.amplitudes[0], goes)
    motion = TissueMotion(frames[0].stamp_ns * 1e-9, rest + mean * farthest.at(rest), (breath,))

    patient = build_phantom(1)

    def off(frames, motion, mean):
        """How far depth is off in the views, and in the middle the surface that training starts from, m."""
        seen = [dataclasses.replace(frame, depth=None) for frame in frames]
        scene = prepare(seen, options(depth="stereo", extrapolation=0.0), motion=motion)
        priors = [np.abs(view.depth_prior - frame.depth)[view.depth_prior > 0] for view, frame in zip(scene.views, frames)]
        means = scene.model.means.numpy().astype(np.float64)
        rest = means
        for _ in range(5):
            rest = means - mean * farthest.at(rest)
        middle = np.abs(rest[:, :2]).max(1) < 0.03
        return np.median(np.concatenate(priors)), np.median(np.abs(rest[:, 2] - patient.height(*rest[:, :2].T))[middle])

    still, moving = off(filmed_patient(0.0)[1], None, 0.0), off(frames, motion, mean)
    assert moving[0] < still[0] and moving[1] < still[1]  # of images warped to the mean position 0.95 and 1.12 times as much
    small = prepare(frames[:2], options(depth="stereo", extrapolation=0.0, image_width=64), motion=motion).views[0]
    assert small.depth_prior.shape == small.image.shape[:2] == (51, 64)  # as of pictures that are finer than depth is told in


@pytest.mark.thorough
@pytest.mark.slow
def test_a_training_of_moving_tissue_goes_on_as_if_never_interrupted(breathing, found, tmp_path):
    motion, config = found[0], options(iterations=30, max_gaussians=600, refine_every=10, depth="stereo", extrapolation=0.0)
    first, second = (Trainer(prepare(breathing[3:30:25], config, motion=motion), config) for _ in range(2))
    for _ in range(17):
        first.step()
    first.save_checkpoint(tmp_path / "checkpoint.pt")
    second.load_checkpoint(tmp_path / "checkpoint.pt")
    assert equal(first.run(), second.run())
    assert equal_motion(first.motion, second.motion) and not equal_motion(first.motion, motion)
    for view in prepare(breathing[3:30:25], config, motion=motion).views:
        np.testing.assert_array_equal(view.paths, motion.paths(view.stamp_ns))
    later = dataclasses.replace(motion, start=motion.start + 0.1)
    with pytest.raises(SequenceError, match="its tissue moves otherwise"):
        Trainer(prepare(breathing[3:30:25], config, motion=later), config).load_checkpoint(tmp_path / "checkpoint.pt")


def equal_motion(first: TissueMotion, second: TissueMotion) -> bool:
    pairs = zip(first.parts, second.parts, strict=True)
    return all(np.array_equal(a.way, b.way) and np.array_equal(a.shares, b.shares) for a, b in pairs)


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["shares", "way"])
def test_colours_correct_a_motion_that_was_found_wrongly(wrong):
    """A wall slides; up to a quarter less is found about one place, or 15 % less everywhere."""
    reach, size = np.array([0.004, 0.002, 0.0]), {"width": 80, "height": 64}
    camera, frames = dataclasses.replace(CAMERA, K=CAMERA.K * [[0.5], [0.5], [1]], **size), []
    for k in range(8):
        pose = np.eye(4)
        pose[:2, 3] = 0.008 * np.sin(1.1 * k), 0.005 * np.sin(1.7 * k)
        there, depth = camera.at(pose), np.full((64, 80), DEPTH, np.float32)
        frames.append(Frame(round(3.5e9 * k / 8), picture(there, np.cos(2 * np.pi * k / 8) * reach), there, depth=depth))
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(-0.05, 0.05, 14), np.linspace(-0.04, 0.04, 12)))
    less = 0.25 * np.exp(-0.5 * ((x - 0.02) ** 2 + (y + 0.01) ** 2) / 0.015**2)
    way = np.stack([reach, 0 * reach])
    found, way = (shares(x, y) - less, way) if wrong == "shares" else (shares(x, y), 0.85 * way)
    motion = TissueMotion(0.0, np.c_[x, y, np.full(x.size, DEPTH)], (PeriodicMotion("breathing", 3.5, 1.0, 3.0, way, found),))

    def off(iterations: int, learn_from: float) -> float:
        """Root mean square of what is wrong after training, m."""
        watch = MotionSearchConfig(learn_from=learn_from)
        poses = PosesConfig(correct=False)  # else some of what is wrong is taken for poses that are off
        config = options(iterations=iterations, depth="topic", extrapolation=0.0, image_width=80, watch=watch, poses=poses)
        trainer = Trainer(prepare(frames, config, motion=motion), config)
        trainer.run()
        (part,) = trainer.motion.parts
        return np.sqrt(((part.shares[:, None] * part.way[0] - displaced(x, y, reach)) ** 2).sum(1).mean())

    before = np.sqrt(((found[:, None] * way[0] - displaced(x, y, reach)) ** 2).sum(1).mean())
    assert off(5, 1.0) == pytest.approx(before, rel=1e-5)
    assert off(200, 0.2) < 0.8 * before


def test_corrections_of_shares_have_their_slopes_and_are_smooth_between_nodes():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.05, 0.05, (300, 3)) + [0.3, -0.2, 0.5]
    ways = np.arange(18).reshape(6, 3) * 1e-3, np.arange(6).reshape(2, 3) * 1e-3
    parts = [PeriodicMotion(name, 3.0, 1.0, 3.0, way, rng.normal(size=300)) for name, way in zip(("breathing", "heartbeat"), ways)]
    motion, h = TissueMotion(0.0, points, tuple(parts)), 1e-3
    places = np.concatenate([points[:5] + offset for offset in (np.zeros(3), *h * np.eye(3), *-h * np.eye(3))])
    learnt = LearntMotion(motion, places, MotionSearchConfig(nodes=12), "cpu")
    with torch.no_grad():
        learnt.tensors["shares"].copy_(torch.from_numpy(rng.normal(size=(12, 2))))
        added = (learnt.follows - learnt.found).double().numpy().reshape(7, 5, 2, 4)
    levels, slopes = added[..., 0], added[0, ..., 1:]
    differences = np.moveaxis((levels[1:4] - levels[4:]) / (2 * h), 0, -1)
    np.testing.assert_allclose(slopes, differences, atol=0.02 * np.abs(differences).max())
    corrections = np.stack([new.shares - old.shares for new, old in zip(learnt.motion.parts, parts)], 1)
    np.testing.assert_allclose(corrections[:5], levels[0], atol=1e-5)


def bordered(frame: Frame, number: int) -> np.ndarray:
    """A mask [H, W], 0 where a round optic is black."""
    return cv2.circle(np.zeros(frame.image.shape[:2], np.uint8), (80, 64), 72, 255, -1)


def beside_a_tool(frame: Frame, number: int) -> np.ndarray:
    """A mask [H, W], 0 where a bar stands that goes slowly to and fro."""
    at = round(80 + 30 * np.sin(0.05 * number))
    return cv2.rectangle(np.full(frame.image.shape[:2], 255, np.uint8), (at - 20, 0), (at + 20, 90), 0, -1)


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("mask_of", [bordered, beside_a_tool])
def test_edges_of_masks_do_not_hide_breath_and_are_none(mask_of, breathing, still):
    for frames, reach in ((breathing, 0.008), (still, None)):
        masks = [mask_of(frame, number) for number, frame in enumerate(frames)]
        eyes = [[np.where(mask[..., None] > 0, image, 5) for image in (frame.image, frame.right)] for frame, mask in zip(frames, masks)]
        masked = [dataclasses.replace(f, image=left, right=right, mask=mask) for f, (left, right), mask in zip(frames, eyes, masks)]
        for each in (masked, with_one_lens(masked)):
            motion, text = watched(each)
            if reach is None:
                assert text == STILL.format(9)
            else:
                assert motion is not None and abs(motion.parts[0].period / 3.5 - 1) < 0.01 and abs(motion.amplitudes[0] / reach - 1) < 0.15


@pytest.mark.thorough
@pytest.mark.slow
def test_one_lens_tells_breath_and_heart_as_two_do(breathing, found):
    """A point that moves at random while the lens goes by seems too near, and one whose rays count about there goes too short a way."""
    x, y = np.meshgrid(np.linspace(-0.03, 0.03, 13), np.linspace(-0.02, 0.02, 9))
    truth = np.stack([displaced(x.ravel(), y.ravel(), way(k / RATE, 0.008, 0.003)) for k in range(len(breathing))])
    mean = truth.mean(0)
    places = np.stack([x.ravel(), y.ravel(), np.full(x.size, DEPTH)], 1) + mean
    covered = [dataclasses.replace(frame, right=np.zeros_like(frame.image)) for frame in breathing]
    for motion in (found[0], watched(with_one_lens(breathing))[0], watched(covered)[0]):
        assert motion is not None
        assert abs(motion.parts[0].period / 3.5 - 1) < 0.01 and abs(motion.amplitudes[0] / 0.008 - 1) < 0.04
        assert abs(motion.parts[1].period / 0.9 - 1) < 0.01 and abs(motion.amplitudes[1] / 0.003 - 1) < 0.06
        paths = np.stack([motion.shares(places) @ motion.paths(frame.stamp_ns) for frame in breathing])
        off = np.linalg.norm(paths - paths.mean(0) - (truth - mean), axis=-1)
        assert np.sqrt((off**2).mean()) < 0.0001  # of 2.8 mm; 0.27 mm about where points seem to be


@pytest.mark.thorough
@pytest.mark.slow
def test_a_breath_is_regular_by_poses_that_are_all_changed_alike():
    """Those recorded are off as where the lens sits elsewhere on its arm than a hand-eye calibration says."""
    wrong = rigid_pose(cv2.Rodrigues(np.radians(12) * np.array([0.6, -0.6, 0.53]))[0], np.zeros(3))
    frames = [dataclasses.replace(frame, camera=frame.camera.at(frame.camera.pose @ wrong)) for frame in filmed(0.008, count=100)]
    motion, text = watched(frames)
    assert motion is not None and motion.lens is not None
    assert text.endswith(", by poses that are all changed alike; by the recorded ones it is not regular") and "poses err" not in text
    assert np.degrees(np.linalg.norm(cv2.Rodrigues((wrong @ motion.lens)[:3, :3])[0])) < 1.5
    assert abs(motion.parts[0].period / 3.5 - 1) < 0.01 and abs(motion.amplitudes[0] / 0.008 - 1) < 0.1
    still = stilled(frames[0], motion)
    np.testing.assert_allclose(still.camera.pose, frames[0].camera.pose @ motion.lens)
    watch = MotionWatch(SEARCH, PosesConfig(correct=False))
    assert len(list(watch.watch(frames))) == 100
    motion, text = watch.found()
    assert motion is not None and motion.lens is None and "not regular, or poses err: off by" in text


@pytest.mark.thorough
@pytest.mark.slow
def test_features_less_the_motion_that_was_told_are_those_of_still_points(breathing, found):
    watch = MotionWatch(SEARCH)
    assert len(list(watch.watch(breathing))) == len(breathing)
    told = watch._told(watch._eyes, StageProgress())
    assert told.rays is not None and told.moved is not None
    images = {number: breathing[number].camera for number in range(0, len(breathing), 10)}
    off = []
    for moved in (np.zeros_like(told.moved), told.moved):
        bundle = Bundle(list(images.values()), told.rays.features(images, moved, 60), PosesConfig(), 2.0)
        assert bundle.told > 40
        off.append(bundle.error(np.zeros((len(images), 6)), bundle.points))
    assert off[0] > 2 and off[1] < 0.5


@pytest.mark.thorough
@pytest.mark.slow
def test_one_breath_alone_is_no_period(breathing):
    watch, count = MotionWatch(SEARCH), 0
    for enough in (45, 60, 75):  # images; a breath takes 44
        count += sum(1 for _ in watch.watch(breathing[count:enough]))
        motion, text = watch.found()
        assert "mm every 3" not in text and "no regular breath is seen 2 times" in text and "film 2 regular breaths or more" in text
        if motion is not None:  # the heart, although the breath is beside it
            (heart,) = motion.parts
            assert abs(heart.period / 0.9 - 1) < 0.03 and motion.amplitudes[0] < 0.004


@pytest.mark.thorough
@pytest.mark.slow
def test_no_harmonic_is_taken_for_another_that_images_cannot_tell_from_it():
    for beat in (0.003, 0.0):
        motion = watched(filmed(0.008, beat, 80, 8.0))[0]
        assert motion is not None and abs(motion.parts[0].period / 3.5 - 1) < 0.01
        assert [part.name for part in motion.parts] == ["breathing", "heartbeat"][: 1 + (beat > 0)]
        assert not beat or abs(motion.parts[1].period / 0.9 - 1) < 0.01


@pytest.mark.thorough
@pytest.mark.slow
def test_a_beat_that_images_are_too_seldom_for_is_not_taken_for_another():
    """At 2 Hz a beat every 0.9 s looks like one every 1.1 s, and like one every 9 s."""
    motion = watched(filmed(0.008, 0.003, 60, 2.0))[0]
    assert motion is None or [part.name for part in motion.parts] == ["breathing"]


@pytest.mark.slow
def test_still_tissue_does_not_breathe(still):
    for each in (still, with_one_lens(still)):
        assert watched(each) == (None, STILL.format(9))


@pytest.mark.thorough
@pytest.mark.slow
def test_highlights_that_slide_as_a_lens_goes_fast_are_no_heart():
    frames = list(phantom_sequence(PhantomConfig(4, 64, 8.0, 160, 128, rounds=2)))
    for each in (frames, with_one_lens(frames)):
        assert watched(each, MotionSearchConfig()) == (None, STILL.format(8))


@pytest.mark.thorough
@pytest.mark.slow
def test_a_heart_is_seen_beside_highlights_that_slide():
    breath = {"breathing": 0.008, "breathing_period": 3.0}
    config = PhantomConfig(4, 56, 8.0, 128, 102, rounds=2.1, stereo=False, heartbeat=0.002, **breath)
    motion, text = watched(list(phantom_sequence(config)), MotionSearchConfig())
    assert motion is not None and [part.name for part in motion.parts] == ["breathing", "heartbeat"]
    assert abs(motion.parts[0].period / 3 - 1) < 0.02 and abs(motion.parts[1].period / 0.9 - 1) < 0.01
    assert abs(motion.amplitudes[0] / 0.0074 - 1) < 0.2 and 0.001 < motion.amplitudes[1] < 0.002
    assert "not regular" not in text and motion.told == f"{1e3 * motion.amplitudes[0]:.1f} mm every {motion.parts[0].period:.2f} s and " + (
        f"{1e3 * motion.amplitudes[1]:.1f} mm every 0.90 s"
    )


@pytest.mark.thorough
@pytest.mark.slow
def test_places_that_the_lens_leaves_within_two_breaths_have_their_share():
    motion = watched(filmed(0.008, travel=0.1))[0]
    assert motion is not None
    x, y = np.meshgrid(np.linspace(-0.07, 0.07, 15), np.linspace(-0.02, 0.02, 5))
    mean = np.stack([x, y, np.full_like(x, DEPTH)], -1).reshape(-1, 3)
    rest = mean.copy()
    average = np.mean([way(k / RATE, 0.008, 0.0) for k in range(110)], 0)
    for _ in range(5):
        rest = mean - displaced(rest[:, 0], rest[:, 1], average)
    far = 0.008 * shares(rest[:, 0], rest[:, 1])
    off = np.abs(motion.shares(mean)[:, 0]) * motion.parts[0].reach - far
    assert np.sqrt((off**2).mean()) < 0.0003 and np.abs(off).max() < 0.001


@pytest.mark.slow
def test_breath_is_seen_in_few_images_a_second():
    for rate, count in ((3.0, 36), (4.2, 42)):
        motion = watched(filmed(0.008, count=count, rate=rate))[0]
        assert motion is not None and abs(motion.parts[0].period / 3.5 - 1) < 0.01


@pytest.mark.thorough
@pytest.mark.slow
def test_irregular_breath_is_said_to_be():
    frames = filmed(0.008, count=88, rate=22 / 3.5)
    cycles, shares = np.arange(88) / 22, np.array([breath_share(k / 22, 1.0) for k in range(88)])

    def with_breaths_of(*seconds: float) -> tuple[TissueMotion | None, str, np.ndarray]:
        stamps = np.interp(cycles, np.arange(5), np.cumsum([0, *seconds]))
        return *watched([dataclasses.replace(frame, stamp_ns=round(1e9 * stamp)) for frame, stamp in zip(frames, stamps)]), stamps

    steady = with_breaths_of(3.5, 3.5, 3.5, 3.5)[1]
    assert "mm every 3.50 s" in steady and "not regular" not in steady
    motion, text, stamps = with_breaths_of(2.5, 4.5, 3.0, 4.0)
    assert motion is not None and motion.lens is None
    phases = np.outer(stamps, np.arange(1, 4)) * 2 * np.pi / motion.parts[0].period
    basis = np.c_[np.ones(88), np.cos(phases), np.sin(phases)]
    best = basis @ np.linalg.lstsq(basis, shares, rcond=None)[0]
    off = re.search(r"; not regular, or poses err: off by (\d+)%, and followed image by image", text)
    assert off and abs(int(off[1]) / 100 - np.std(shares - best) / np.std(best)) < 0.05
    motion, text, _ = with_breaths_of(2.0, 7.0, 2.0, 5.0)
    assert motion is None and text == (
        "points move by 2.3 pixels in 16 s, but no regular breath is seen 2 times, so this stays in the pictures and blurs the model: "
        "film 2 regular breaths or more; where nothing breathes, check poses and stamps"
    )


def by_period_alone(motion: TissueMotion) -> TissueMotion:
    """The motion without what goes beside the period of a breath."""
    breath, *rest = motion.parts
    return dataclasses.replace(motion, parts=(dataclasses.replace(breath, way=breath.way[:-1], beside=np.zeros(0)), *rest))


@pytest.mark.thorough
@pytest.mark.slow
def test_an_irregular_breath_is_followed_while_it_is_watched():
    breaths = 3.0, 4.5, 2.5, 4.0
    frames = filmed(0.008, 0.002, 140, 10.0, breaths=breaths)
    motion = watched(frames)[0]
    assert motion is not None and [part.name for part in motion.parts] == ["breathing", "heartbeat"]

    def off(motion: TissueMotion) -> float:
        """Root mean square by which points are elsewhere than they were filmed, m."""
        paths = np.stack([motion.shares(motion.points) @ motion.paths(frame.stamp_ns) for frame in frames])
        truth = np.stack([displaced(*motion.points[:, :2].T, way(k / 10, 0.008, 0.002, breaths)) for k in range(140)])
        return float(np.sqrt(((paths - paths.mean(0) - truth + truth.mean(0)) ** 2).sum(-1).mean()))

    one_period = watched(frames, dataclasses.replace(SEARCH, most_irregular=10.0))[0]
    assert one_period is not None and off(motion) < 0.5 * off(one_period)
    alone = by_period_alone(motion)
    assert not len(motion.parts[1].beside)
    assert motion.parameters == alone.parameters  # physics plays the mean breath
    for stamp in (round(1e9 * (motion.start - 0.5)), round(1e9 * (motion.end + 0.5))):
        np.testing.assert_array_equal(motion.paths(stamp), alone.paths(stamp))
    learnt = LearntMotion(motion, motion.points[:5], MotionSearchConfig(), "cpu")
    np.testing.assert_allclose(learnt.motion.paths(frames[40].stamp_ns), motion.paths(frames[40].stamp_ns), atol=1e-8)


@pytest.mark.thorough
@pytest.mark.slow
def test_what_an_irregular_breath_leaves_over_is_no_heart_and_hides_none():
    for heart in (0.0, 0.002):
        motion, text = watched(with_one_lens(filmed(0.008, heart, 140, 10.0, breaths=(3.0, 4.5, 2.5, 4.0))))
        assert motion is not None and "not regular" in text
        assert [part.name for part in motion.parts] == ["breathing", "heartbeat"][: 1 + (heart > 0)]
        assert not heart or abs(motion.parts[1].period / 0.9 - 1) < 0.01


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
    other = np.random.default_rng(0).integers(0, 256, image.shape, np.uint8)
    with_two = [dataclasses.replace(frame, right=other, baseline=BASELINE) for frame in black]
    assert watched(with_two)[1].endswith("too few points could be followed for long")
    assert watched(black)[1].endswith("one lens that stays where it is sees no depth")
