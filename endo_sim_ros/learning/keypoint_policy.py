"""A small policy that sees: a network that finds points in the images of both eyes, and acts by where they are.

It learns from a LeRobot dataset of demonstrations within minutes, from random weights, with torch alone. The points are the expected
places of a softmax over each map of a convolutional network (Finn et al. 2016, Deep Spatial Autoencoders). How far a point is between
the eyes tells its depth. Beside the action the network is taught to tell the state of the task, which demonstrations hold and a policy
does not see: without, it learns far slower where to look.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import Progress
from torch import Tensor, nn

from endo_sim_ros.core.device import pick_device
from endo_sim_ros.core.folders import written_whole
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.learning.actions import ARM_NAMES, CARTESIAN_SIZES, Actions
from endo_sim_ros.learning.config import ImitationConfig, SightConfig
from endo_sim_ros.learning.dataset import ACTION, ENVIRONMENT_STATE, IMAGE, IMAGE_RIGHT, STATE, read_dataset, read_options
from endo_sim_ros.learning.pictures import IMAGE as SEEN, IMAGE_RIGHT as SEEN_RIGHT
from endo_sim_ros.learning.task_batch import ARM_STATE

FILE = "keypoints.npz"
_CHANNELS, _POINTS, _HIDDEN = 48, 32, 256
_DILATIONS = 1, 2, 4, 1  # of the blocks: an output sees 100 pixels around
_SIGHT = {"shown_tool": "tool", "instrument": "instrument", "baseline": "baseline", "dye": "dye"}  # options of what it was trained on
_DISPARITY = 20.0  # factor, so that differences between the eyes are as large as places
_STEPS, _RATE = 3000, 2e-3
_AVERAGED = 0.99  # share of the averaged weights that a step keeps
_NEAREST = 1e-3  # m from the eye to a tip
_CORNER = 0.1  # of the loss: below it an error counts by its square
# How much training varies an image: contrast, brightness, colour, and noise of each pixel.
_CONTRAST, _BRIGHTNESS, _HUE, _NOISE = 0.3, 0.3, 0.1, 0.02


class _Block(nn.Module):
    """Two convolutions beside the identity."""

    def __init__(self, channels: int, dilation: int):
        super().__init__()
        first = nn.Conv2d(channels, channels, 3, padding=dilation, dilation=dilation)
        layers = (nn.GroupNorm(8, channels), nn.SiLU(), first, nn.GroupNorm(8, channels), nn.SiLU())
        self.layers = nn.Sequential(*layers, nn.Conv2d(channels, channels, 3, padding=1))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x)


def with_projections(arm: Tensor) -> Tensor:
    """What arms measure of themselves [B, 11 A], and where the tip of each is seen: x / z, y / z and 1 / z, 1/m; together [B, 14 A]."""
    tips = arm.unflatten(1, (-1, len(ARM_NAMES)))[..., :3]
    nearness = 1 / tips[..., 2:].clamp_min(_NEAREST)
    return torch.cat([arm, torch.cat([tips[..., :2] * nearness, nearness], -1).flatten(1)], 1)


class KeypointNetwork(nn.Module):
    """Points of images, and the actions and the state that follow from them.

    Args:
        eyes: Images of a sample, 1 or 2.
        arm, state, action: How many numbers these have.
    """

    arm_mean: Tensor
    arm_spread: Tensor

    def __init__(self, eyes: int, arm: int, state: int, action: int):
        super().__init__()
        self.eyes, self.action = eyes, action
        self.image = nn.Sequential(
            *(nn.Conv2d(3, _CHANNELS // 2, 5, 2, 2), nn.GroupNorm(8, _CHANNELS // 2), nn.SiLU()),
            nn.Conv2d(_CHANNELS // 2, _CHANNELS, 3, 2, 1),
            *(_Block(_CHANNELS, dilation) for dilation in _DILATIONS),
            *(nn.GroupNorm(8, _CHANNELS), nn.SiLU()),
        )
        self.maps, self.features = nn.Conv2d(_CHANNELS, _POINTS, 1), nn.Conv2d(_CHANNELS, _POINTS, 1)
        known = arm // len(ARM_NAMES) * (len(ARM_NAMES) + 3)
        sizes = [(3 * eyes + (eyes == 2)) * _POINTS + known, _HIDDEN, _HIDDEN, _HIDDEN]
        hidden = [layer for pair in zip(sizes, sizes[1:]) for layer in (nn.Linear(*pair), nn.SiLU())]
        self.head = nn.Sequential(*hidden, nn.Linear(_HIDDEN, action + state))
        self.register_buffer("arm_mean", torch.zeros(known))
        self.register_buffer("arm_spread", torch.ones(known))

    def forward(self, images: Tensor, arm: Tensor) -> tuple[Tensor, Tensor]:
        """Actions [B, action], and states [B, state] as parts of their spread.

        Args:
            images: Of all eyes [B, E, 3, H, W], 0 to 1.
            arm: What the arms measure of themselves [B, arm].
        """
        x = self.image((images.flatten(0, 1) - 0.5) * 4)
        where = self.maps(x).flatten(2).float().softmax(-1)  # [B E, K, h w]
        y, x_ = (torch.linspace(-1, 1, size, device=x.device) for size in x.shape[-2:])
        places = where @ torch.stack([part.flatten() for part in torch.meshgrid(x_, y, indexing="xy")], 1)  # [B E, K, 2]
        found = (where * self.features(x).flatten(2).float()).sum(-1, keepdim=True)
        parts = [torch.cat([places, found], -1).reshape(len(images), -1), (with_projections(arm) - self.arm_mean) / self.arm_spread]
        if self.eyes == 2:
            left, right = places[..., 0].reshape(-1, 2, _POINTS).unbind(1)
            parts.append((left - right) * _DISPARITY)
        out = self.head(torch.cat(parts, 1))
        return out[:, : self.action], out[:, self.action :]


def train_keypoints(dataset: Path, out: Path, config: ImitationConfig, device: str = "auto") -> None:
    """Train a policy on a LeRobot dataset of demonstrations, and write it into a folder.

    Raises:
        SequenceError: If there is no such dataset, or its columns are not those of demonstrations, or a policy was trained there.
        RuntimeError: If pyarrow is not installed.
    """
    if (out / FILE).exists():
        raise SequenceError(f"{out / FILE} exists already; choose another folder or remove it first")
    device = pick_device(device)
    columns, shown = read_dataset(dataset, (STATE, ENVIRONMENT_STATE, ACTION), (IMAGE, IMAGE_RIGHT))
    arms = columns[STATE].shape[1] / len(ARM_NAMES)
    if not arms.is_integer() or columns[ACTION].shape[1] not in [arms * size for size in CARTESIAN_SIZES]:
        raise SequenceError(f"{dataset} has other columns than `endo-sim demonstrate` writes")
    options = read_options(dataset)
    torch.manual_seed(config.seed)
    arm, state, action = (torch.from_numpy(columns[name]).to(device) for name in (STATE, ENVIRONMENT_STATE, ACTION))
    images = torch.from_numpy(np.stack(list(shown.values()), 1)).permute(0, 1, 4, 2, 3)  # [T, E, 3, H, W], in host memory
    mean, spread = state.mean(0), state.std(0).clamp_min(1e-3)
    network = KeypointNetwork(images.shape[1], arm.shape[1], state.shape[1], action.shape[1]).to(device)
    known = with_projections(arm)
    network.arm_mean.copy_(known.mean(0))
    network.arm_spread.copy_(known.std(0).clamp_min(1e-3))
    steps, rate = config.steps or _STEPS, config.learning_rate or _RATE
    optimizer = torch.optim.AdamW(network.parameters(), rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, steps + 1, pct_start=0.1)
    averaged = torch.optim.swa_utils.AveragedModel(network, avg_fn=_average)
    loss_of = lambda found, true: nn.functional.smooth_l1_loss(found.float(), true, beta=_CORNER)
    with Progress() as bar:
        progress = bar.add_task("training", total=steps)
        for rows in _batches(len(images), steps, config):
            seen, own = _varied(images[rows].to(device).float() / 255), rows.to(device)
            with torch.autocast(torch.device(device).type, torch.bfloat16):
                acted, told = network(seen, arm[own])
            told_loss = loss_of(told, (state[own] - mean) / spread)
            loss = loss_of(acted, action[own]) + told_loss
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            schedule.step()
            averaged.update_parameters(network)
            bar.advance(progress)
    weights: dict[str, Any] = {name: value.float().cpu().numpy() for name, value in averaged.module.state_dict().items()}
    out.mkdir(parents=True, exist_ok=True)
    with written_whole(out / FILE) as partial, partial.open("wb") as file:
        about: dict[str, Any] = {
            "task": options.get("task", ""),
            "action": action.shape[1],
            "sight": {name: options[key] for key, name in _SIGHT.items() if key in options},
        }
        np.savez(file, about=np.array(json.dumps(about)), image_size=np.array(images.shape[-2:]), eyes=np.array(images.shape[1]), **weights)


def _average(averaged: Tensor, weights: Tensor, steps: Tensor | int) -> Tensor:
    """Averaged weights, a little nearer to those of a step; in the first steps more, so that a short training forgets its beginning."""
    return torch.lerp(averaged, weights, 1 - min(_AVERAGED, (1 + int(steps)) / (10 + int(steps))))


def _batches(count: int, steps: int, config: ImitationConfig) -> Iterator[Tensor]:
    """Rows of each step [B]."""
    generator = torch.Generator().manual_seed(config.seed)
    for _ in range(steps):
        yield torch.randint(count, (config.batch_size,), generator=generator)


def _varied(images: Tensor) -> Tensor:
    """Images [B, E, 3, H, W] in another light, the same for both eyes."""
    factor = lambda spread, colors: 1 + spread * (2 * torch.rand(len(images), 1, colors, 1, 1, device=images.device) - 1)
    mean = images.mean((1, 2, 3, 4), keepdim=True)
    lit = ((images - mean) * factor(_CONTRAST, 1) + mean) * factor(_BRIGHTNESS, 1) * factor(_HUE, 3)
    return (lit + _NOISE * torch.randn_like(lit)).clamp(0, 1)


class KeypointPolicy:
    """What `train_keypoints` trained.

    Args:
        folder: Where.
        device: auto (the GPU when there is one), cpu, cuda or cuda:N.

    Raises:
        ValueError: If there is no such policy, or it is damaged; the message names the file.
    """

    actions: Actions = "cartesian"

    def __init__(self, folder: str | Path, device: str = "auto"):
        path = Path(folder) / FILE
        self._device = pick_device(device)
        try:
            with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
                about = json.loads(str(file["about"]))
                values = {name: torch.from_numpy(file[name]) for name in file.files if name != "about"}
            self._size, self._eyes = values.pop("image_size").tolist(), int(values.pop("eyes"))
            arms, outputs = len(values["arm_mean"]) // (len(ARM_NAMES) + 3), len(values["head.6.bias"])
            self._known, action = arms * len(ARM_NAMES), int(about["action"])
            network = KeypointNetwork(self._eyes, self._known, outputs - action, action)
            network.load_state_dict(values)
        except OSError as error:
            raise ValueError(f"{path}: not a readable policy ({error})") from error
        except Exception as error:  # zipfile, numpy and torch have a type each
            text = f"{path} is no policy of `endo-sim imitate --policy keypoints`, or it is damaged or of an older version; train it again"
            raise ValueError(text) from error
        self._network = network.to(self._device).eval()
        self.sight = SightConfig(**about["sight"] | {"image_width": self._size[1], "eyes": self._eyes})
        self.task: str = about["task"]
        """Of the demonstrations; empty if that is not known."""

    def reset(self, episodes: Sequence[int]) -> None:
        """Nothing to do: the network has no memory."""

    @torch.no_grad()
    def act(self, observations: dict[str, np.ndarray]) -> np.ndarray:
        """Actions [B, 4 A] of A arms for observations of ``sensors``.

        Raises:
            ValueError: If images have another size than those that it was trained on, or there are more or fewer arms.
        """
        seen = np.stack([observations[name] for name in (SEEN, SEEN_RIGHT)[: self._eyes]], 1)
        if list(seen.shape[2:4]) != self._size:
            (height, width), (h, w) = self._size, seen.shape[2:4]
            raise ValueError(f"images have {w}×{h} pixels, but the policy was trained on {width}×{height}; set image_width {width}")
        arm, known = observations[ARM_STATE], self._known
        if arm.shape[1] != known:
            raise ValueError(f"the arms measure {arm.shape[1]} numbers, but the policy was trained with {known}; it is of another task")
        images = torch.from_numpy(seen).to(self._device).permute(0, 1, 4, 2, 3).float() / 255
        return self._network(images, torch.from_numpy(arm).to(self._device))[0].double().cpu().numpy()
