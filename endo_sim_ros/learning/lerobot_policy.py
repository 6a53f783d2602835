"""Policies of lerobot: what trains one on a dataset, and its checkpoint as a policy of the tasks.

lerobot needs Python 3.12, torchvision, and older torch and numpy than this package takes by default. It trains in an environment of
its own, or in this one where its versions are installed.
"""

import importlib.util
import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.folders import make_writable, written_whole
from endo_sim_ros.learning.actions import ARM_NAMES, CARTESIAN_SIZES, Actions
from endo_sim_ros.learning.config import ImitationConfig, SightConfig
from endo_sim_ros.learning.dataset import (
    ACTION,
    IMAGE,
    IMAGE_RIGHT,
    STATE,
    check_dataset,
    learned_from,
    no_demonstrations,
    read_info,
    unreadable,
)
from endo_sim_ros.learning.pictures import IMAGE as SEEN, IMAGE_RIGHT as SEEN_RIGHT
from endo_sim_ros.learning.policy_folder import check_free
from endo_sim_ros.learning.task_batch import ARM_STATE

PACKAGES = "lerobot[training,diffusion]==0.6.*"
CONFIG = "train_config.json"
_LEARNED_FROM = "learned_from.json"  # beside it: what lerobot does not keep of the demonstrations
_PICTURES = {IMAGE: SEEN, IMAGE_RIGHT: SEEN_RIGHT}
_WEIGHTS = "pretrained_model"  # folder of a checkpoint
_LAST = Path("lerobot/checkpoints/last") / _WEIGHTS  # where `write_training` has the last one

_STEPS, _RATE = 10_000, 1e-4
_CHECKPOINTS = 5  # of a training; the last one is used
# Of diffusion policies: how much images are enlarged, as the last layer of the network has one place for 32 pixels; a network that acts
# in real time without a GPU, in place of one of 260 million weights for any robot; and steps in which an action is denoised, in place of
# 100. Images are whole: lerobot would crop each eye elsewhere, which hides how deep things are, and where they are beside the arm.
_ENLARGED, _CHANNELS, _DENOISED = 2, [128, 256, 512], 10
_HALVED = 2 ** len(_CHANNELS)  # its network halves a chunk as often as it has sizes

log = logging.getLogger(__name__)

Kind = Literal["act", "diffusion"]


def available() -> bool:
    """Whether lerobot is installed here."""
    return importlib.util.find_spec("lerobot") is not None


def write_training(dataset: Path, out: Path, config: ImitationConfig) -> Path:
    """Write what ``lerobot-train --config_path`` trains a policy by, and return its path.

    The policy sees the images of the dataset and what the arm measures of itself, not the state of the task, which knows the goal.

    Args:
        dataset: Folder of a LeRobot dataset of demonstrations.
        out: Folder; the checkpoints come into ``lerobot/checkpoints`` in it.
        config: Options.

    Raises:
        SequenceError: If there is no such dataset, or it is damaged, or has other columns than demonstrations.
        ConfigError: If no policy has such chunks, or a policy was trained there.
    """
    if config.executed > config.chunk:
        raise ConfigError(f"executed is {config.executed}, but only {config.chunk} actions are predicted at once; give at most chunk")
    if config.policy == "diffusion" and config.chunk % _HALVED:
        raise ConfigError(f"chunk is {config.chunk}; of a diffusion policy it is a multiple of {_HALVED}")
    info = read_info(dataset)
    features = info["features"]
    try:
        shapes = {key: features[key]["shape"] for key in (*_PICTURES, STATE, ACTION) if key in features}
        missing = {IMAGE, STATE, ACTION} - shapes.keys()
    except (KeyError, TypeError) as error:
        raise unreadable(dataset, error) from error
    if missing or not _arms(shapes[ACTION]) or shapes[STATE] != [len(ARM_NAMES) * _arms(shapes[ACTION])]:
        raise no_demonstrations(dataset)
    check_free(out, CONFIG)  # which is written anew
    check_dataset(dataset, info, shapes)
    steps, rate = config.steps or _STEPS, config.learning_rate or _RATE
    inputs = {key: {"type": "VISUAL", "shape": [shape[2], *shape[:2]]} for key, shape in shapes.items() if key in _PICTURES}
    inputs[STATE] = {"type": "STATE", "shape": shapes[STATE]}
    policy: dict[str, Any] = {
        "type": config.policy,
        "push_to_hub": False,
        "input_features": inputs,
        "output_features": {ACTION: {"type": "ACTION", "shape": shapes[ACTION]}},
        "pretrained_backbone_weights": config.backbone_weights or None,
        "n_action_steps": config.executed,
        "optimizer_lr": rate,
    }
    if config.policy == "act":
        policy |= {"chunk_size": config.chunk, "optimizer_lr_backbone": rate}
    else:
        height, width, _ = shapes[IMAGE]
        policy |= {
            "horizon": config.chunk,
            "n_obs_steps": 1,  # what moves is in the state
            "drop_n_last_frames": 0,  # the last steps of an episode are learned from, too
            "resize_shape": [_ENLARGED * height, _ENLARGED * width],
            "use_group_norm": not config.backbone_weights,
            "down_dims": _CHANNELS,
            "noise_scheduler_type": "DDIM",
            "num_inference_steps": _DENOISED,
        }
    training = {
        "dataset": {"repo_id": f"local/{dataset.resolve().name}", "root": str(dataset.resolve()), "use_imagenet_stats": False},
        "policy": policy,
        "output_dir": str((out / "lerobot").resolve()),
        "job_name": out.resolve().name,
        "seed": config.seed,
        "batch_size": config.batch_size,
        "steps": steps,
        "save_freq": max(steps // _CHECKPOINTS, 1),
        "log_freq": max(steps // 50, 1),
        "num_workers": config.workers,
        "wandb": {"enable": False},
    }
    make_writable(out)
    for name, values in ((_LEARNED_FROM, learned_from(dataset)), (CONFIG, training)):
        with written_whole(out / name) as partial:
            partial.write_text(json.dumps(values, indent=4) + "\n", "utf8")
    return out / CONFIG


class LeRobotPolicy:
    """A checkpoint of lerobot: ACT, a diffusion policy, or any other that takes the images and the state of demonstrations.

    Args:
        folder: The one that `write_training` was given, or that of the checkpoint.
        device: auto (the GPU when there is one), cpu, cuda or cuda:N.

    Raises:
        ValueError: If there is no checkpoint, or it takes or gives other things, or what it learned from cannot be read.
        RuntimeError: If lerobot is not installed.
    """

    actions: Actions = "cartesian"

    def __init__(self, folder: str | Path, device: str = "auto"):
        folder = Path(folder)
        below = (Path(*_LAST.parts[first:]) for first in range(len(_LAST.parts), -1, -1))  # from the checkpoint up to `endo-sim imitate`'s
        places = [place for place in (folder / path for path in below) if (place / "config.json").exists()]
        if not places:
            trained = f"{folder / 'policy.npz'}, as `endo-sim train` wrote it, or " if (folder / "policy.npz").exists() else ""
            raise ValueError(f"{folder} has no checkpoint of lerobot; give {trained}the folder of `endo-sim imitate` after the training")
        path = places[0]
        self._inputs, sight = _features(path)
        about = _learned_from(path)
        if not about["task"]:
            unknown = "which task it is for, and what its pictures showed, is not known, and it is played with the defaults in any"
            log.warning("%s: %s; copy the %s along that `endo-sim imitate` wrote", folder, unknown, _LEARNED_FROM)
        self.sight = SightConfig(**about["sight"] | sight)
        self.task: str = about["task"]
        """Of the demonstrations; empty if that is not known."""
        self.digest: str = about["digest"]
        """Of the task, see `task_digest`; empty if that is not known."""
        if not available():
            raise RuntimeError(f"{folder}: to run this policy lerobot is needed; pip install '{PACKAGES}'")
        import torch
        from lerobot.configs.policies import PreTrainedConfig  # pyright: ignore[reportMissingImports]  (optional)
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors  # pyright: ignore[reportMissingImports]  (optional)

        from endo_sim_ros.core.device import pick_device

        self._torch, self._device = torch, pick_device(device)
        config: Any = PreTrainedConfig.from_pretrained(path)
        config.device = self._device
        self._policy: Any = get_policy_class(config.type).from_pretrained(path, config=config)
        self._policy.to(self._device).eval()
        overrides = {"device_processor": {"device": self._device}}
        self._before, self._after = make_pre_post_processors(config, str(path), preprocessor_overrides=overrides)
        self._policy.reset()

    def reset(self, episodes: Sequence[int]) -> None:
        """All episodes begin anew: what the policy remembers is of all."""
        self._policy.reset()

    def act(self, observations: dict[str, np.ndarray]) -> np.ndarray:
        """Actions [B, 4 A] for observations of ``sensors``.

        Raises:
            ValueError: If images have another size than those that it was trained on.
        """
        tensors, torch = {}, self._torch
        for key, shape in self._inputs.items():
            name = _PICTURES.get(key, ARM_STATE)
            values = torch.from_numpy(np.ascontiguousarray(observations[name])).to(self._device)
            if key in _PICTURES:
                values = values.permute(0, 3, 1, 2).float() / 255
                if list(values.shape[1:]) != shape:
                    (_, height, width), (_, h, w) = shape, values.shape[1:]
                    raise ValueError(f"images have {w}×{h} pixels, but the policy was trained on {width}×{height}; set image_width {width}")
            tensors[key] = values
        with torch.inference_mode():
            actions = self._after(self._policy.select_action(self._before(tensors)))
        return actions.double().cpu().numpy()


def _arms(action: list[int]) -> int:
    """How many arms actions of a shape are for; 0 for those that no task takes."""
    fitting = [sum(action) // size for size in CARTESIAN_SIZES if sum(action) % size == 0]
    return fitting[0] if fitting and len(action) == 1 else 0  # below 20 numbers, which are more than two arms take, one fits at most


def _learned_from(path: Path) -> dict[str, Any]:
    """What `write_training` kept in a folder above a checkpoint; empty if it is not there, as of what another trained."""
    for folder in (path, *path.absolute().parents[:4]):
        if (file := folder / _LEARNED_FROM).exists():
            try:
                about = json.loads(file.read_text("utf8"))
                SightConfig(**about["sight"])
                return {"task": str(about["task"]), "digest": str(about.get("digest", "")), "sight": about["sight"]}
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise ValueError(f"{file} is not what `endo-sim imitate` wrote ({error}); train the policy again") from error
    return {"task": "", "digest": "", "sight": {}}


def _features(path: Path) -> tuple[dict[str, list[int]], dict[str, int]]:
    """What a checkpoint takes, with the shapes, and the size and number of its pictures as options of `SightConfig`."""
    try:
        config = json.loads((path / "config.json").read_text("utf8"))
        inputs = {key: list(feature["shape"]) for key, feature in config["input_features"].items()}
        given = {key: list(feature["shape"]) for key, feature in config["output_features"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path / 'config.json'} is no configuration of a policy of lerobot") from error
    other, arms = inputs.keys() - _PICTURES.keys() - {STATE}, _arms(given.get(ACTION, []))
    measured = [len(ARM_NAMES) * arms]
    if other or IMAGE not in inputs or arms and inputs.get(STATE, measured) != measured:
        raise ValueError(f"{path}: the policy takes {', '.join(inputs)}; those of `endo-sim imitate` take {IMAGE} and {STATE}")
    if given.keys() != {ACTION} or not arms:
        raise ValueError(f"{path}: the policy gives {given}; a task takes {' or '.join(map(str, CARTESIAN_SIZES))} numbers, {ACTION!r}")
    return inputs, {"image_width": inputs[IMAGE][2], "eyes": 2 if IMAGE_RIGHT in inputs else 1}
