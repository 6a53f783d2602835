"""The small policy that sees: it learns what demonstrations hold, and says what it cannot read."""

import itertools
import shutil

import numpy as np
import pytest
import torch
from made_recordings import lockstep
from torch.nn import functional

from endo_sim_ros.cli.imitate import Command
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.learning import keypoint_policy
from endo_sim_ros.learning.config import DemonstrationConfig, ImitationConfig, SightConfig
from endo_sim_ros.learning.dataset import ACTION, ENVIRONMENT_STATE, IMAGE, IMAGE_RIGHT, STATE, read_dataset
from endo_sim_ros.learning.demonstrations import demonstrate
from endo_sim_ros.learning.keypoint_policy import FILE, KeypointPolicy, disparities, train_keypoints
from endo_sim_ros.learning.lerobot import export_lerobot
from endo_sim_ros.learning.policies import make_policy

pytest.importorskip("pyarrow", reason="datasets need pyarrow")


def make_dataset(out, images, episodes=3):
    """A few episodes with both eyes."""
    config = DemonstrationConfig(episodes=episodes, environments=episodes, images=images)
    demonstrate("retraction", ["phantom:0"], out, config, SightConfig(image_width=40, eyes=2), device="cpu")
    return out


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return make_dataset(tmp_path_factory.mktemp("demonstrations") / "png", "png")


def test_videos_are_read_as_pictures_are(dataset, tmp_path):
    shown = [read_dataset(path, (ACTION,), (IMAGE, IMAGE_RIGHT))[1] for path in (dataset, make_dataset(tmp_path / "video", "video"))]
    for name in (IMAGE, IMAGE_RIGHT):
        exact, read = (each[name].astype(int) for each in shown)
        assert exact.shape == read.shape and exact.shape[1:] == (32, 40, 3)
        assert np.abs(exact - read).mean() < 4 < np.abs(exact[:-1] - exact[1:]).max()  # of 255, and what is shown moves


def test_disparities_are_those_of_what_both_eyes_see():
    noise = torch.rand(1, 3, 102, 512, generator=torch.Generator().manual_seed(0))
    scene = functional.avg_pool2d(noise, 9, 1, 4)  # wider than a pixel of the images, as texture of tissue is
    scene = (scene - scene.mean()) / scene.std() * 0.1 + 0.5
    left = functional.avg_pool2d(scene[..., 100:356], (1, 2))
    for shift in (5, 9, 14, 35):  # halves of pixels
        right = functional.avg_pool2d(scene[..., 100 + shift : 356 + shift], (1, 2))
        for seen in (right, right * 0.8 * torch.tensor([1.0, 0.9, 0.7])[:, None, None]):  # in another light, too
            found, sure = disparities(left, seen)[0, :, 10:-10, 30:-10]
            error = (found * 128 - shift / 2).abs()
            assert error.median() < 0.25 and error.quantile(0.95) < 0.6 and sure.median() > 0.8  # pixels
    _, sure = disparities(left, torch.rand(1, 3, 102, 128, generator=torch.Generator().manual_seed(1)))[0]
    assert sure.median() < 0.6
    assert disparities(torch.full_like(left, 0.5), torch.full_like(left, 0.5)).isfinite().all()


@pytest.mark.thorough
def test_one_eye_is_enough_to_train(dataset, tmp_path, monkeypatch):
    both = read_dataset(dataset, (STATE, ENVIRONMENT_STATE, ACTION), (IMAGE, IMAGE_RIGHT))
    monkeypatch.setattr(keypoint_policy, "read_dataset", lambda *_: (both[0], {IMAGE: both[1][IMAGE]}))
    train_keypoints(dataset, tmp_path, ImitationConfig(steps=2, batch_size=4), device="cpu")
    policy = KeypointPolicy(tmp_path, "cpu")
    assert policy.sight.eyes == 1
    assert policy.act({"image": both[1][IMAGE][:3], "arm": both[0][STATE][:3]}).shape == (3, 4)


@pytest.mark.thorough
def test_an_interrupt_leaves_what_was_learned_by_then(dataset, tmp_path, monkeypatch, caplog):
    batches = keypoint_policy._batches
    for name, done, kept in (("late", 3, True), ("early", 1, False)):

        def interrupted(*given, done=done):
            yield from itertools.islice(batches(*given), done)
            raise SystemExit(143)

        monkeypatch.setattr(keypoint_policy, "_batches", interrupted)
        with pytest.raises(SystemExit):
            Command(dataset, tmp_path / name, ImitationConfig(steps=20, batch_size=2), device="cpu").run()
        word = "is kept as it was after 3 of 20 steps" if kept else "is not there, and nothing is kept: fewer than 10% of the steps"
        assert (tmp_path / name / FILE).exists() == kept and f"{name}/{FILE} {word}" in caplog.text
    policy = KeypointPolicy(tmp_path / "late", "cpu")
    assert policy.training == "interrupted after 3 of 20 steps"
    images = np.zeros((1, 32, 40, 3), np.uint8)
    assert np.isfinite(policy.act({"image": images, "image_right": images, "arm": np.full((1, 11), 0.1, np.float32)})).all()


@pytest.mark.thorough
def test_it_learns_what_was_demonstrated(dataset, tmp_path):
    train_keypoints(dataset, tmp_path, ImitationConfig(steps=100, batch_size=16), device="cpu")
    columns, shown = read_dataset(dataset, (STATE, ACTION), (IMAGE, IMAGE_RIGHT))
    policy = make_policy(str(tmp_path), "retraction", device="cpu")
    assert isinstance(policy, KeypointPolicy) and policy.sight.eyes == 2 and policy.sight.image_width == 40
    acted = policy.act({"image": shown[IMAGE], "image_right": shown[IMAGE_RIGHT], "arm": columns[STATE]})
    error = np.abs(acted - columns[ACTION]).mean(0)
    plain = np.abs(np.median(columns[ACTION], 0) - columns[ACTION]).mean(0)  # the best that looks at nothing
    assert (error < 0.5 * plain).all(), (error, plain)


def test_what_cannot_be_used_is_told(dataset, tmp_path):
    export_lerobot([lockstep(tmp_path / "bag")], tmp_path / "export", "t", images="png")
    with pytest.raises(SequenceError, match="as what `endo-sim export` writes has; give what `endo-sim demonstrate` wrote, or train on"):
        train_keypoints(tmp_path / "export", tmp_path / "out", ImitationConfig(steps=1), device="cpu")
    with pytest.raises(SequenceError, match="nothing is no LeRobot dataset that can be read; give the folder that"):
        train_keypoints(tmp_path / "nothing", tmp_path / "out", ImitationConfig(steps=1), device="cpu")
    shutil.copytree(dataset, tmp_path / "cut")
    (last := max((tmp_path / "cut" / "data").rglob("*.parquet"))).write_bytes(last.read_bytes()[:200])
    with pytest.raises(SequenceError, match=r"cut: data/chunk-000/file-002.parquet cannot be read; copy the dataset again"):
        train_keypoints(tmp_path / "cut", tmp_path / "out", ImitationConfig(steps=1), device="cpu")
    (tmp_path / FILE).write_bytes(b"no policy")
    with pytest.raises(ValueError, match="keypoints.npz is no policy of `endo-sim imitate --policy keypoints`, or it is damaged"):
        make_policy(str(tmp_path), "retraction")
    with pytest.raises(ConfigError, match="keypoints.npz exists already; choose another folder or remove it first"):
        train_keypoints(dataset, tmp_path, ImitationConfig(steps=1), device="cpu")
    train_keypoints(dataset, tmp_path / "new", ImitationConfig(steps=1, batch_size=2), device="cpu")
    policy = KeypointPolicy(tmp_path / "new", "cpu")
    assert policy.sight == SightConfig(image_width=40, eyes=2) and not policy.training
    with pytest.raises(ValueError, match="new was trained on demonstrations of retraction, not of tracking; give a policy of this task"):
        make_policy(str(tmp_path / "new"), "tracking")
    small = np.zeros((1, 16, 20, 3), np.uint8)
    with pytest.raises(ValueError, match="images have 20×16 pixels, but the policy was trained on 40×32; set image_width 40"):
        policy.act({"image": small, "image_right": small, "arm": np.zeros((1, 11), np.float32)})
    with pytest.raises(ValueError, match="the arms measure 22 numbers, but the policy was trained with 11; it is of another task"):
        policy.act(
            {"image": np.zeros((1, 32, 40, 3), np.uint8), "image_right": np.zeros((1, 32, 40, 3), np.uint8), "arm": np.zeros((1, 22))}
        )
