"""A scene is prepared in stages, each of which reports its progress, can be cancelled, and leaves what was recorded alone."""

import dataclasses
import math
import re
import threading
import time
import weakref
from pathlib import Path

import numpy as np
import pytest
from thorough import mostly_thorough

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.reconstruction import Cancelled, ReconstructionConfig, Trainer, pipeline, prepare, reconstruct
from endo_sim_ros.reconstruction.pipeline import STAGES
from endo_sim_ros.reconstruction.priors.stereo import of_other_moments
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import PreparedScene
from endo_sim_ros.reconstruction.stage_configs import InterpolationConfig
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence


@pytest.fixture(scope="module")
def frames():
    """Four frames with stereo and exact depth."""
    return list(phantom_sequence(PhantomConfig(width=160, height=128, frames=4, travel=0.02)))


@pytest.fixture(scope="module")
def stereo(frames):
    """The same without depth."""
    return [dataclasses.replace(frame, depth=None) for frame in frames]


# From so few neighbours depth is continued in a fifth of the time: how many there are is nothing to the order of things.
SHORT = {"max_gaussians": 1500, "image_width": 80, "device": "cpu", "iterations": 5, "interpolation": InterpolationConfig(neighbours=4)}


def options(**changes):
    return ReconstructionConfig(**(SHORT | changes))


def bits(scene: PreparedScene) -> list[bytes]:
    tensors = [tensor.numpy().tobytes() for tensor in scene.model.tensors().values()]
    return [*tensors, *(view.depth_prior.tobytes() for view in scene.views), scene.light.tobytes(), scene.exposures.tobytes()]


# --------------------------------------------------------------------------------------------- the whole pipeline


@pytest.mark.slow
def test_what_was_measured_stays_and_the_prior_is_another_field(frames):
    scene = prepare(frames, options(depth="stereo"))
    for view, frame in zip(scene.views, frames):
        assert view.depth_prior.shape == view.depth.shape == view.image.shape[:2] == (64, 80)
        exact = frame.depth[1::2, 1::2]
        assert np.abs(view.depth - exact).max() < 0.01 * exact.max()
        assert np.abs(view.depth_prior - view.depth)[view.depth_prior > 0].max() > 1e-5


@pytest.mark.slow
def test_full_size_images_are_let_go_of_as_soon_as_they_are_not_needed(stereo):
    """Of an iterator nobody else holds the frames; an image is an array of its own, known by whether it is still there."""
    left, right, alive = [], [], {}

    def given():
        for frame in stereo:
            copy = dataclasses.replace(frame, image=frame.image.copy(), right=np.roll(frame.right, 1, 0))  # rows that differ make no copy
            left.append(weakref.ref(copy.image))
            right.append(weakref.ref(copy.right))
            yield copy

    def on_progress(stage, done, total):
        alive.setdefault(stage, [sum(image() is not None for image in images) for images in (left, right)])

    prepare(given(), options(), on_progress=on_progress)
    assert alive["checking poses by stereo"] == [len(stereo), len(stereo)]
    assert alive["multi-view refinement"] == [len(stereo), len(stereo)]
    assert alive["dynamic mask"] == [0, 0]


@pytest.mark.slow
@pytest.mark.parametrize("prepared, trained, matched", [(80, 60, 80), (60, 80, 80), (500, 60, 160)])
def test_views_are_prepared_in_no_larger_size_than_asked_for(stereo, monkeypatch, prepared, trained, matched):
    widths = []
    match = pipeline.match_features
    monkeypatch.setattr(
        pipeline, "match_features", lambda frames, *rest: widths.extend(each.camera.width for each in frames) or match(frames, *rest)
    )
    scene = prepare(stereo, options(prepared_width=prepared, image_width=trained))
    assert {*widths} == {matched} and {view.camera.width for view in scene.views} == {trained}


@pytest.mark.slow
def test_stages_report_in_order(stereo):
    reports = []
    prepare(stereo, options(), on_progress=lambda *report: reports.append(report))
    assert list(dict.fromkeys(stage for stage, _, _ in reports)) == list(STAGES)


def test_the_page_lists_the_stages_in_order():
    page = (Path(__file__).parents[2] / "docs" / "reconstruction.md").read_text()
    table = page.split("| stage | what it does |")[1].split("\n\n")[0]
    assert re.findall(r"^\| (\w.*?) \|", table, re.M) == list(STAGES)


@pytest.mark.slow
def test_preparing_twice_gives_the_same_bits_and_a_trainer_changes_nothing(stereo, monkeypatch):
    monkeypatch.setenv("ENDO_SIM_THREADS", "2")
    config = options()
    first, second = prepare(stereo, config), prepare(stereo, config)
    assert bits(first) == bits(second)
    Trainer(first, config).run()
    assert bits(first) == bits(second)


@pytest.mark.slow
def test_reconstructing_is_preparing_and_training_with_progress_and_cancellation(frames):
    config, stages = options(), []
    model = reconstruct(frames, config, on_progress=lambda *report: stages.append(report))
    assert stages[-1] == ("training", 5, 5) and stages[0][0] == next(iter(STAGES))
    other = Trainer(prepare(frames, config), config).run()
    assert all((a == b).all() for a, b in zip(model.tensors().values(), other.tensors().values()))

    def cancel_training(stage, *_):
        if stage == "training":
            raise Cancelled

    with pytest.raises(Cancelled):
        reconstruct(frames, config, on_progress=cancel_training)


# ------------------------------------------------------------------------------------------------------- decisions


@pytest.mark.slow
def test_decisions_are_told(frames):
    blind = dataclasses.replace(frames[1], mask=np.zeros((128, 160), np.uint8))
    scene = prepare([frames[0], blind, *frames[2:]], options())
    assert len(scene.views) == 3
    left_out, *kept = scene.decisions
    assert left_out == f"view at {blind.stamp_ns * 1e-9:.3f} s left out: masked"
    ratio, wanted = r"\d+\.\d\d", ("light as it was fitted: in it, views differ", "tissue may reflect: views would differ")
    assert all(any(re.search(f"{what} {ratio} times as much", sentence) for sentence in kept) for what in wanted), kept


@pytest.mark.thorough
@pytest.mark.slow
def test_whether_brightness_tells_depth_is_told_with_the_ratio_that_decides(frames, monkeypatch):
    told = {}
    for ratio in (0.5, 0.95, math.inf):
        monkeypatch.setattr(pipeline, "brightness_ratio", lambda *_, ratio=ratio, **__: ratio)
        told[ratio] = [sentence for sentence in prepare(frames, options()).decisions if sentence.startswith("brightness")]
    differ = "depth where no point is near: with it, views differ {} times as much in colour as without"
    assert told == {
        0.5: ["brightness tells " + differ.format("0.50")],
        0.95: ["brightness does not tell " + differ.format("0.95")],
        math.inf: [],
    }


@pytest.mark.slow
def test_length_and_capacity_follow_the_views_unless_they_are_given(frames):
    # Neither takes part in this, and both take long.
    config = options(iterations=0, max_gaussians=0, extrapolation=0.0).replaced({"capacity.iterations": 0})
    scene = prepare(frames, config)
    assert (scene.iterations, scene.max_gaussians) == (3000, 4 * 80 * 64 // 2)
    assert scene.decisions[0] == "4 views of 0.0205 million pixels: 3000 iterations, 10240 Gaussians at most"
    scene = prepare(frames, config.replaced({"training.least_pixels": 0.1}))
    assert scene.max_gaussians == 60_000
    by_views = {"training.iterations_per_view": 9, "training.min_iterations": 1}
    by_pixels = {"training.pixels_per_gaussian": 16, "training.min_gaussians": 1}
    scene = prepare(frames, config.replaced(by_views | by_pixels))
    assert (scene.iterations, scene.max_gaussians) == (4 * 9, 4 * 80 * 64 // 16)
    most = {"training.max_iterations": 7, "training.max_gaussians": 900}
    scene = prepare(frames, config.replaced(by_views | by_pixels | most))
    trainer = Trainer(scene, config)
    assert len(trainer.run()) <= 900 and trainer.progress.iteration == 7


@pytest.mark.slow
def test_thresholds_of_usable_views_are_options(frames):
    dim = [dataclasses.replace(frame, image=(frame.image // 20).astype(np.uint8)) for frame in frames]
    with pytest.raises(SequenceError, match="every view is black"):
        prepare(dim, options().replaced({"views.black": 20}))
    assert len(prepare(dim, options().replaced({"views.black": 0, "views.even": 0})).views) == 4


@pytest.mark.slow
def test_pictures_of_one_colour_are_no_views(frames):
    blue = np.clip(np.random.default_rng(0).normal([0, 0, 250], 0.8, frames[0].image.shape), 0, 255).astype(np.uint8)
    scene = prepare([dataclasses.replace(frames[0], image=blue), *frames[1:]], options())
    assert len(scene.views) == 3 and any("left out: of one colour" in text for text in scene.decisions)
    with pytest.raises(SequenceError, match="every view is of one colour; check the cable"):
        prepare([dataclasses.replace(frame, image=blue) for frame in frames], options())


@pytest.mark.slow
@pytest.mark.parametrize("right", mostly_thorough(["the left ones once more", "black"]))
def test_right_images_that_tell_nothing_are_left_out(stereo, right):
    """As of a covered lens, or of a recorder that writes one eye twice: matched, they put tissue anywhere."""
    useless = {"black": lambda frame: np.zeros_like(frame.image), "the left ones once more": lambda frame: frame.image}[right]
    scene = prepare([dataclasses.replace(frame, right=useless(frame)) for frame in stereo], options())
    assert any(text.startswith(f"THE RIGHT IMAGES of 4 views are {right}, and left out") for text in scene.decisions)
    alone = prepare([dataclasses.replace(frame, right=None) for frame in stereo], options())
    assert scene.depth_source == alone.depth_source == "points" and bits(scene) == bits(alone)


@pytest.mark.thorough
@pytest.mark.slow
def test_right_images_of_other_moments_are_left_out(stereo):
    """As two recorders write that began one after the other: matched, they put tissue anywhere."""
    assert of_other_moments(stereo) == [False] * 4
    late = [dataclasses.replace(frame, right=later.right) for frame, later in zip(stereo, [*stereo[1:], stereo[0]])]
    assert of_other_moments(late) == [True] * 4
    scene = prepare(late, options())
    assert any(text.startswith("THE RIGHT IMAGES of 4 views are of other moments") for text in scene.decisions)
    assert scene.depth_source == "points"
    scene = prepare([late[0], *stereo[1:]], options())
    assert any(text.startswith("THE RIGHT IMAGES of 1 view are of other moments") for text in scene.decisions)
    assert scene.depth_source == "stereo"


def test_rows_that_all_pairs_have_apart_are_of_one_moment(stereo):
    """A wrong principal point is another fault."""
    lower = [dataclasses.replace(frame, right=np.roll(frame.right, 4, axis=0)) for frame in stereo]
    assert of_other_moments(lower) == [False] * 4


# ----------------------------------------------------------------------------------------------------------- progress


@pytest.mark.slow
def test_cancelling_reaches_all_threads_and_begins_nothing_more(monkeypatch):
    monkeypatch.setenv("ENDO_SIM_THREADS", "2")
    begun, ended, both = [], [], threading.Barrier(2)
    progress = StageProgress("work", lambda *_: cancel())

    def cancel():
        if len(begun) == 2 and threading.current_thread() is threading.main_thread():
            raise Cancelled

    def work(item):
        begun.append(item)
        both.wait(120)
        try:
            while True:
                progress.check()
                time.sleep(0.001)
        except Cancelled:
            ended.append(item)
            raise

    with pytest.raises(Cancelled):
        progress.map(work, range(9))
    assert sorted(begun) == sorted(ended) == [0, 1]


@pytest.mark.slow
def test_an_interrupt_reaches_the_threads(monkeypatch):
    """Ctrl-C arrives in the main thread, while others work."""
    monkeypatch.setenv("ENDO_SIM_THREADS", "2")
    running = threading.Event()
    progress = StageProgress("work", lambda *_: interrupt())

    def interrupt():
        if running.is_set() and threading.current_thread() is threading.main_thread():
            raise KeyboardInterrupt

    def work(item):
        running.set()
        while True:
            progress.check()
            time.sleep(0.001)

    with pytest.raises(KeyboardInterrupt):
        progress.map(work, range(2))


def test_an_error_of_one_item_ends_the_others(monkeypatch):
    monkeypatch.setenv("ENDO_SIM_THREADS", "2")
    progress = StageProgress()

    def work(item):
        if item == 0:
            raise ValueError("the first one")
        while True:
            progress.check()
            time.sleep(0.001)

    with pytest.raises(ValueError, match="the first one"):
        progress.map(work, range(4))


def test_results_come_in_order():
    seen = []
    progress = StageProgress("squares", lambda *report: seen.append(report))
    assert progress.map(lambda x: x * x, range(5)) == [0, 1, 4, 9, 16]
    assert seen[0] == ("squares", 0, 5) and seen[-1] == ("squares", 5, 5)
