"""Sequences as cells use them: what is read, what is kept, and how much memory it takes."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from peak_memory import peak_of
from rich.progress import Progress

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.evaluation.cells import list_cells
from endo_sim_ros.evaluation.config import EvaluationConfig
from endo_sim_ros.evaluation.preparation import prepare_sequence
from endo_sim_ros.sequences.bag import read_bag, write_bag

WIDTH, HEIGHT = 128, 96


def long_bag(path: Path, count: int, tissue: bool = True) -> Path:
    """A bag of a camera that moves sideways; every tenth frame is masked whole, or each."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (4, HEIGHT, WIDTH, 3), np.uint8)
    camera = Camera(intrinsic_matrix(125, 125, WIDTH / 2, HEIGHT / 2), WIDTH, HEIGHT)

    def frame(number: int) -> Frame:
        pose = np.eye(4)
        pose[0, 3] = 1e-4 * number
        mask = np.full((HEIGHT, WIDTH), 255 * (tissue and number % 10 != 9), np.uint8)
        return Frame((number + 1) * 40_000_000, images[number % 4], camera.at(pose), depth=np.full((HEIGHT, WIDTH), 0.1), mask=mask)

    write_bag(path, map(frame, range(count)))
    return path


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags")
    return [long_bag(folder / str(count), count) for count in (75, 150)]


def prepared(bag, folder, splits=("two-views", "1:49"), **options):
    config = EvaluationConfig(splits=splits, presets=("default",), lpips=(), set=("image_width=64", "device=cpu"), **options)
    cells, _ = list_cells([str(bag)], config)
    folder.mkdir()
    return prepare_sequence(cells, Progress(disable=True), folder)


def test_black_and_overexposed_frames_are_left_out_and_told(tmp_path, caplog):
    frames = list(read_bag(long_bag(tmp_path / "whole", 30)))
    for number, level in ((3, 2), (7, 2), (12, 255)):
        frames[number] = dataclasses.replace(frames[number], image=np.full((HEIGHT, WIDTH, 3), level, np.uint8))
    write_bag(tmp_path / "bag", frames)
    found = prepared(tmp_path / "bag", tmp_path / "out", splits=("two-views",))
    assert found.count == len(frames) - 3 - 3
    for text in ("2 frames left out: black", "1 frame left out: overexposed", "3 frames left out: masked"):
        assert caplog.text.count(text) == 1


@pytest.mark.thorough
@pytest.mark.slow
def test_memory_of_an_evaluation_does_not_grow_with_the_recording(bags, tmp_path):
    short, long = (peak_of(lambda bag=bag: prepared(bag, tmp_path / bag.name, held_out=5)) for bag in bags)
    assert long < short + 0.1 * 75 * WIDTH * HEIGHT * 8 / 1e6, "a tenth of the 75 frames more"


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("held_out", [20, 1000])
def test_frames_that_cells_need_are_kept_at_the_size_that_they_need(bags, tmp_path, held_out):
    found = prepared(bags[1], tmp_path / "frames", held_out=held_out)
    assert found.count == 135 and found.depth_source == "recorded"
    assert (len(found.frames) < 100) == (held_out == 20)
    for number in (0, 50, 134):
        frame = found.frames[number].load()
        assert frame.camera.width == WIDTH
        np.testing.assert_allclose(frame.camera.position[0], 1e-4 * (number // 9 * 10 + number % 9))
    assert {frame.camera.width for number, frame in found.frames.items() if number not in (0, 50, 100, 134)} == {64}
    assert found.carried().frames[0].content


@pytest.mark.slow
def test_a_sequence_without_right_images_is_told_before_anything_trains(bags, tmp_path, caplog):
    prepared(bags[0], tmp_path / "frames", splits=("two-views", "stereo"), held_out=3)
    assert "75 has no right images, so all of its cells with split stereo fail; leave that split out" in caplog.messages


def test_masks_that_leave_no_tissue_are_one_sentence(tmp_path, caplog):
    bag = long_bag(tmp_path / "black", 3, tissue=False)
    assert f"{bag}: every pixel of every view is masked, so nothing can be reconstructed" in caplog.text
    with pytest.raises(SequenceError, match="black: no view shows tissue; a mask has 255 where there is some"):
        prepared(bag, tmp_path / "frames")
