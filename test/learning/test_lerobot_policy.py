"""Policies of lerobot: what trains them, and what is said where they cannot be used."""

import contextlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from endo_sim_command import endo_sim, endo_sim_here

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.learning.config import DemonstrationConfig, ImitationConfig, SightConfig
from endo_sim_ros.learning.dataset import IMAGE, IMAGE_RIGHT
from endo_sim_ros.learning.demonstrations import demonstrate
from endo_sim_ros.learning.lerobot_policy import LeRobotPolicy, available, write_training
from endo_sim_ros.learning.policies import make_policy
from endo_sim_ros.learning.scenes import load_scene
from endo_sim_ros.learning.task_batch import TaskBatch
from endo_sim_ros.learning.train import play


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory):
    """Two patients, both eyes."""
    out = tmp_path_factory.mktemp("demonstrations") / "two"
    config = DemonstrationConfig(episodes=4, environments=2, images="png")
    demonstrate("retraction", ["phantom:0", "phantom:1"], out, config, SightConfig(image_width=40, eyes=2), device="cpu")
    return out


def test_the_configuration_names_what_the_policy_may_see(demonstrations, tmp_path):
    for policy in ("act", "diffusion"):
        training = json.loads(write_training(demonstrations, tmp_path / policy, ImitationConfig(policy=policy, steps=50)).read_text())
        told = training["policy"]
        assert told["type"] == policy and told["n_action_steps"] == 8
        assert told["input_features"] == {
            IMAGE: {"type": "VISUAL", "shape": [3, 32, 40]},
            IMAGE_RIGHT: {"type": "VISUAL", "shape": [3, 32, 40]},
            "observation.state": {"type": "STATE", "shape": [11]},
        }
        assert told["output_features"] == {"action": {"type": "ACTION", "shape": [4]}}
        assert (training["steps"], training["dataset"]["root"]) == (50, str(demonstrations))


def test_without_lerobot_the_command_says_what_to_install(demonstrations, tmp_path):
    if available():
        pytest.skip("lerobot is installed, and would train")
    done = endo_sim_here("imitate", demonstrations, tmp_path / "act", "--policy", "act", "--steps", 100)
    assert done.returncode == 0, done.stderr
    assert "pip install 'lerobot[training,diffusion]==0.6.*'" in done.stdout
    assert f"lerobot-train --config_path={tmp_path / 'act/train_config.json'}" in done.stdout


def test_datasets_that_cannot_be_learned_from_are_told(demonstrations, tmp_path):
    with pytest.raises(SequenceError, match="nothing is no LeRobot dataset that can be read; give the folder that `endo-sim demonstrate`"):
        write_training(tmp_path / "nothing", tmp_path / "out", ImitationConfig())
    info = json.loads((demonstrations / "meta/info.json").read_text())
    info["features"]["action"]["shape"] = [7]
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(SequenceError, match="as what `endo-sim export` writes has; give what `endo-sim demonstrate` wrote, or train on"):
        write_training(tmp_path, tmp_path / "out", ImitationConfig())
    (tmp_path / "meta/info.json").write_text(json.dumps(info | {"codebase_version": "v2.1"}))
    with pytest.raises(SequenceError, match="is a LeRobot dataset v2.1; give one of v3.0"):
        write_training(tmp_path, tmp_path / "out", ImitationConfig())
    (tmp_path / "out/lerobot").mkdir(parents=True)
    with pytest.raises(ConfigError, match="lerobot exists already; choose another folder or remove it first"):
        write_training(demonstrations, tmp_path / "out", ImitationConfig())
    (tmp_path / "out/lerobot").rmdir()
    for name, policy in (("train_config.json", "keypoints"), ("policy.npz", "keypoints"), ("policy.npz", "act"), ("keypoints.npz", "act")):
        (tmp_path / "out" / name).touch()
        for words in (("imitate", demonstrations, tmp_path / "out", "--policy", policy), ("train", tmp_path / "out")):
            done = endo_sim_here(*words)
            assert done.returncode == 2 and f"out/{name} exists already; choose another folder or remove it first" in done.stderr
        (tmp_path / "out" / name).unlink()
    assert not any((tmp_path / "out").iterdir())


def test_options_that_no_policy_has_are_refused(demonstrations, tmp_path):
    for words, sentence in (
        (("--policy", "diffusion", "--chunk", 10), "chunk is 10; of a diffusion policy it is a multiple of 8"),
        (("--policy", "act", "--executed", 32), "executed is 32, but only 16 actions are predicted at once; give at most chunk"),
        (
            ("--policy", "act", "--device", "cpu"),
            "device has no effect while policy is act: lerobot takes the GPU",
        ),
        (("--chunk", 32), "chunk has no effect while policy is keypoints; set policy to act or diffusion"),
    ):
        done = endo_sim_here("imitate", demonstrations, tmp_path / "out", *words)
        assert done.returncode != 0 and sentence in done.stderr and not (tmp_path / "out").exists()
    done = endo_sim_here("imitate", demonstrations, demonstrations)
    assert done.returncode == 2 and "is a dataset; give the policy a folder of its own" in done.stderr


def test_checkpoints_that_do_not_fit_are_told(tmp_path):
    with pytest.raises(ValueError, match="has no checkpoint of lerobot; give the folder of `endo-sim imitate` after the training"):
        make_policy(str(tmp_path), "retraction")
    place = tmp_path / "lerobot/checkpoints/last/pretrained_model"
    place.mkdir(parents=True)
    config = {
        "type": "act",
        "input_features": {IMAGE: {"type": "VISUAL", "shape": [3, 32, 40]}, "observation.state": {"type": "STATE", "shape": [11]}},
        "output_features": {"action": {"type": "ACTION", "shape": [4]}},
    }
    for key, features, sentence in (
        ("input_features", {"observation.environment_state": {"shape": [15]}}, "the policy takes observation.environment_state; those of"),
        ("output_features", {"action": {"shape": [14]}}, "the policy gives {'action': [14]}; a task takes 4 or 5 numbers, 'action'"),
        ("input_features", 3, "config.json is no configuration of a policy of lerobot"),
    ):
        (place / "config.json").write_text(json.dumps(config | {key: features}))
        with pytest.raises(ValueError) as told:
            LeRobotPolicy(tmp_path)
        assert sentence in str(told.value)
    (place / "config.json").write_text(json.dumps(config))
    for about in ("[]", '{"task": "retraction", "sight": {"eye": 1}}'):
        (tmp_path / "learned_from.json").write_text(about)
        with pytest.raises(ValueError, match="learned_from.json is not what `endo-sim imitate` wrote"):
            LeRobotPolicy(tmp_path)
    (tmp_path / "learned_from.json").unlink()
    if not available():
        with pytest.raises(RuntimeError, match="to run this policy lerobot is needed; pip install 'lerobot"):
            LeRobotPolicy(tmp_path)


def test_a_checkpoint_sees_what_it_learned_from_and_knows_its_task(tmp_path, caplog):
    dataset, out = tmp_path / "dataset", tmp_path / "act"
    config, sight = DemonstrationConfig(episodes=1, environments=1), SightConfig(image_width=40, tool="LARGE_NEEDLE_DRIVER", dye=False)
    demonstrate("retraction", ["phantom:0"], dataset, config, sight, device="cpu")
    training = json.loads(write_training(dataset, out, ImitationConfig(policy="act")).read_text())
    place = out / "lerobot/checkpoints/000010/pretrained_model"
    place.mkdir(parents=True)
    (place / "config.json").write_text(json.dumps(training["policy"]))
    (place.parent.with_name("last")).symlink_to("000010")
    for folder in (out, out / "lerobot", place.parent, place):
        policy = LeRobotPolicy.__new__(LeRobotPolicy)
        try:
            policy.__init__(folder, "cpu")
        except (RuntimeError, OSError):  # without lerobot, or without weights: what the pictures show is known before
            pass
        assert (policy.task, policy.sight) == ("retraction", sight) and not caplog.text
    (out / "learned_from.json").unlink()
    with contextlib.suppress(RuntimeError, OSError):
        LeRobotPolicy(place, "cpu")
    assert "which task it is for, and what its pictures showed, is not known" in caplog.text and "copy the learned_from.json" in caplog.text


def test_files_that_lerobot_could_not_read_are_told_before_the_training(demonstrations, tmp_path):
    names = "data/chunk-000/file-002.parquet", "meta/tasks.parquet", "meta/stats.json", "data/chunk-000/file-004.parquet"
    said = "file-002.parquet cannot be read; copy", *[r"is missing, or not that of this dataset; copy"] * 2, "more than the 4 episodes that"
    for name, sentence in zip(names, said):
        cut = tmp_path / Path(name).stem
        shutil.copytree(demonstrations, cut)
        (cut / name).unlink(missing_ok=True)
        for half in (False, True):
            if half:
                (cut / name).write_text('{"action": {}}PAR1'[: 14 if "stats" in name else None])
            if half or name != names[-1]:
                with pytest.raises(SequenceError, match=f"{cut}.*{sentence}"):
                    write_training(cut, tmp_path / "out", ImitationConfig(policy="act"))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["act", "diffusion"])
def test_lerobot_trains_and_its_checkpoint_plays(demonstrations, tmp_path, policy, monkeypatch):
    pytest.importorskip(
        "lerobot.scripts.lerobot_train", reason="lerobot is not installed; it wants Python 3.12 and other versions of torch"
    )
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    out = tmp_path / policy
    done = endo_sim("imitate", demonstrations, out, "--policy", policy, "--steps", 5, "--batch-size", 4, "--workers", 0)
    assert done.returncode == 0, done.stdout + done.stderr
    loaded = make_policy(str(out), "retraction", 2)
    assert loaded.sight == SightConfig(image_width=40, eyes=2)
    batch = TaskBatch("retraction", load_scene(), 2, "sensors", sight=loaded.sight)
    _, _, steps = play(batch, loaded, np.arange(2))
    assert (steps > 0).all()
    other = TaskBatch("retraction", load_scene(), 2, "sensors", sight=SightConfig(image_width=48, eyes=2))
    with pytest.raises(ValueError, match="images have 48×38 pixels, but the policy was trained on 40×32; set image_width 40"):
        play(other, loaded, np.arange(2))
