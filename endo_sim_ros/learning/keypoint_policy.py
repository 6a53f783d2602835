"""A small policy that sees: a network that finds points in the image of the left eye, and acts by where they are.

It learns from a LeRobot dataset of demonstrations within minutes, from random weights, with torch alone. The points are the expected
places of a softmax over each map of a convolutional network (Finn et al. 2016, Deep Spatial Autoencoders). How far each lies between the
eyes tells its depth: that is matched, not learned, as a network that shall learn it from demonstrations learns how deep tissue usually
is instead. Beside the action the network is taught to tell the state of the task, which demonstrations hold and a policy does not see:
without, it learns far slower where to look.
"""

import functools
import json
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import Progress, track
from torch import Tensor, nn
from torch.nn import functional

from endo_sim_ros.core.device import pick_device, single_threaded_torch
from endo_sim_ros.core.folders import written_whole
from endo_sim_ros.learning.actions import ARM_NAMES, CARTESIAN_SIZES, Actions
from endo_sim_ros.learning.config import ImitationConfig, SightConfig
from endo_sim_ros.learning.dataset import (
    ACTION,
    ENVIRONMENT_STATE,
    IMAGE,
    IMAGE_RIGHT,
    STATE,
    learned_from,
    no_demonstrations,
    read_dataset,
)
from endo_sim_ros.learning.pictures import IMAGE as SEEN, IMAGE_RIGHT as SEEN_RIGHT
from endo_sim_ros.learning.policy_folder import check_free
from endo_sim_ros.learning.task_batch import ARM_STATE

_logger = logging.getLogger(__name__)

FILE = "keypoints.npz"
_CHANNELS, _POINTS, _HIDDEN = 48, 32, 256
_STRIDE = 4  # pixels between neighbours in a map
_DILATIONS = 1, 2, 4, 1  # of the blocks: an output sees 100 pixels around
_WIDEST = 3 / 16  # of the width of an image: the greatest disparity that is looked for
_WINDOW = 7  # pixels: side of the patches that are matched; of 5, 7 and 9 it is nearest to the truth at dyed spots of six patients
_SHARP = 50.0  # factor on correlations, before the softmax that weighs disparities
_USUAL, _DIFFERS = (1 / 16, 0.5), (1 / 64, 1.0)  # of disparities and correlations: what inputs of the network are measured from, and in
_TOGETHER = 64  # images that are matched at once
_FLAT = 1e-4  # variance of a patch below which it is hardly matched; colours are 0 to 1
_STEPS, _RATE = 3000, 2e-3
KEPT_FROM = 0.1  # share of the steps from which on an interrupt leaves a policy: before it would hardly do more than be in the way
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


@torch.no_grad()
def disparities(left: Tensor, right: Tensor) -> Tensor:
    """How far what each pixel of left images shows lies to the left in the right ones, as a share of their width, and how alike they are.

    Patches of all disparities are compared by their normalised correlation, and the disparities weighed by a softmax over it.

    Args:
        left, right: Of both eyes [B, 3, H, W], 0 to 1.

    Returns:
        Disparity, and the greatest correlation, -1 to 1 [B, 2, H, W].
    """
    width = left.shape[-1]
    count = round(width * _WIDEST) + 1
    right = functional.pad(right, (count - 1, 0, 0, 0), mode="replicate")
    means = _smoothed(left), _smoothed(right)
    spreads = [(_covariance(eye, eye, mean, mean) + _FLAT).sqrt() for eye, mean in zip((left, right), means)]
    alike = []
    for disparity in range(count):
        own = slice(count - 1 - disparity, count - 1 - disparity + width)
        covariance = _covariance(left, right[..., own], means[0], means[1][..., own])
        alike.append(covariance / (spreads[0] * spreads[1][..., own]))
    scores = torch.cat(alike, 1)
    weights, each = (_SHARP * scores).softmax(1), torch.arange(count, device=left.device) / width
    return torch.cat([torch.einsum("bdhw,d->bhw", weights, each)[:, None], scores.amax(1, keepdim=True)], 1)


def _covariance(a: Tensor, b: Tensor, mean_a: Tensor, mean_b: Tensor) -> Tensor:
    """Of patches around each pixel [B, 1, H, W], over all colours; each colour has its own mean."""
    return _smoothed((a * b).mean(1, keepdim=True)) - (mean_a * mean_b).mean(1, keepdim=True)


def _smoothed(images: Tensor) -> Tensor:
    """Means of patches around each pixel."""
    for size, margin in (((_WINDOW, 1), (_WINDOW // 2, 0)), ((1, _WINDOW), (0, _WINDOW // 2))):
        images = functional.avg_pool2d(images, size, 1, margin, count_include_pad=False)
    return images


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
        sizes = [(1 + 2 * eyes) * _POINTS + known, _HIDDEN, _HIDDEN, _HIDDEN]
        hidden = [layer for pair in zip(sizes, sizes[1:]) for layer in (nn.Linear(*pair), nn.SiLU())]
        self.head = nn.Sequential(*hidden, nn.Linear(_HIDDEN, action + state))
        self.register_buffer("arm_mean", torch.zeros(known))
        self.register_buffer("arm_spread", torch.ones(known))

    def forward(self, images: Tensor, near: Tensor, arm: Tensor) -> tuple[Tensor, Tensor]:
        """Actions [B, action], and states [B, state] as parts of their spread.

        Args:
            images: Of the left eye [B, 3, H, W], 0 to 1.
            near: What `matched` returns for both eyes.
            arm: What the arms measure of themselves [B, arm].
        """
        # What follows the convolutions would lose a quarter of a pixel to fewer bits.
        with torch.autocast(images.device.type, torch.bfloat16, enabled=self.training):
            x = self.image((images - 0.5) * 4)
            maps, features = self.maps(x).flatten(2), self.features(x).flatten(2)
        where = maps.float().softmax(-1)  # [B, K, h w]
        y, x_ = (torch.linspace(-1, 1, size, device=x.device) for size in x.shape[-2:])
        grid = torch.stack([part.flatten() for part in torch.meshgrid(x_, y, indexing="xy")], 1)
        parts = [where @ grid, (where * features.float()).sum(-1, keepdim=True), where @ near.flatten(2).mT]
        seen = torch.cat(parts, -1).flatten(1)
        out = self.head(torch.cat([seen, (with_projections(arm) - self.arm_mean) / self.arm_spread], 1))
        return out[:, : self.action], out[:, self.action :]


def matched(images: Tensor) -> Tensor:
    """Disparities and how sure they are, as the network takes them, at the size of its maps [B, 2, h, w]; of one eye [B, 0, h, w].

    Args:
        images: Of all eyes [B, E, 3, H, W], uint8.
    """
    size = [-(-side // _STRIDE) for side in images.shape[-2:]]
    if images.shape[1] == 1:
        return torch.zeros(len(images), 0, *size, device=images.device)
    found = functional.interpolate(disparities(*(images.float() / 255).unbind(1)), size, mode="area")
    usual, differs = (found.new_tensor(values)[:, None, None] for values in (_USUAL, _DIFFERS))
    return (found - usual) / differs


@single_threaded_torch()
def train_keypoints(dataset: Path, out: Path, config: ImitationConfig, device: str = "auto") -> None:
    """Train a policy on a LeRobot dataset of demonstrations, and write it into a folder; an interrupt leaves it as it was by then.

    Raises:
        SequenceError: If there is no such dataset, or its columns are not those of demonstrations.
        ConfigError: If a policy was trained there.
        RuntimeError: If pyarrow is not installed.
    """
    check_free(out)
    device = pick_device(device)
    columns, shown = read_dataset(dataset, (STATE, ENVIRONMENT_STATE, ACTION), (IMAGE, IMAGE_RIGHT))
    arms = columns[STATE].shape[1] / len(ARM_NAMES)
    if not arms.is_integer() or columns[ACTION].shape[1] not in [arms * size for size in CARTESIAN_SIZES]:
        raise no_demonstrations(dataset)
    torch.manual_seed(config.seed)
    arm, state, action = (torch.from_numpy(columns[name]).to(device) for name in (STATE, ENVIRONMENT_STATE, ACTION))
    eyes = [torch.from_numpy(each).permute(0, 3, 1, 2) for each in shown.values()]  # [T, 3, H, W] each, in host memory
    parts = list(zip(*(eye.split(_TOGETHER) for eye in eyes)))
    near = torch.cat([matched(torch.stack(part, 1).to(device)) for part in track(parts, "matching both eyes", transient=True)])
    images, count = eyes[0], len(eyes)
    del shown, eyes, parts  # what the right eye saw is not needed any more
    mean, spread = state.mean(0), state.std(0).clamp_min(1e-3)
    network = KeypointNetwork(count, arm.shape[1], state.shape[1], action.shape[1]).to(device)
    known = with_projections(arm)
    network.arm_mean.copy_(known.mean(0))
    network.arm_spread.copy_(known.std(0).clamp_min(1e-3))
    steps, rate = config.steps or _STEPS, config.learning_rate or _RATE
    optimizer = torch.optim.AdamW(network.parameters(), rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, steps + 1, pct_start=0.1)
    averaged = torch.optim.swa_utils.AveragedModel(network, avg_fn=_average)
    write = functools.partial(_write, out, averaged.module, dataset, (*images.shape[-2:], count), action.shape[1])
    loss_of = lambda found, true: functional.smooth_l1_loss(found, true, beta=_CORNER)
    try:
        with Progress() as bar:
            progress = bar.add_task("training", total=steps)
            for rows in _batches(len(images), steps, config):
                seen, own = _varied(images[rows].to(device).float() / 255), rows.to(device)
                acted, told = network(seen, near[own], arm[own])
                told_loss = loss_of(told, (state[own] - mean) / spread)
                loss = loss_of(acted, action[own]) + told_loss
                optimizer.zero_grad(set_to_none=True)
                loss.backward()
                nn.utils.clip_grad_norm_(network.parameters(), 1.0)
                optimizer.step()
                schedule.step()
                averaged.update_parameters(network)
                bar.advance(progress)
    except (KeyboardInterrupt, SystemExit):
        if (done := int(averaged.n_averaged)) >= KEPT_FROM * steps:
            write(f"interrupted after {done} of {steps} steps")
            _logger.warning("%s is kept as it was after %d of %d steps", out / FILE, done, steps)
        raise
    write()


def _write(out: Path, network: nn.Module, dataset: Path, seen: Sequence[int], action: int, training: str = "") -> None:
    """Write a network, trained on images (height, width, eyes) and actions of so many numbers of a dataset, into a folder, with what is
    to be told of its training."""
    weights: dict[str, Any] = {name: value.float().cpu().numpy() for name, value in network.state_dict().items()}
    about = np.array(json.dumps(learned_from(dataset) | {"action": action, "training": training}))
    out.mkdir(parents=True, exist_ok=True)
    with written_whole(out / FILE) as partial, partial.open("wb") as file:
        np.savez(file, about=about, image_size=np.array(seen[:2]), eyes=np.array(seen[2]), **weights)


def _average(averaged: Tensor, weights: Tensor, steps: Tensor | int) -> Tensor:
    """Averaged weights, a little nearer to those of a step; in the first steps more, so that a short training forgets its beginning."""
    return torch.lerp(averaged, weights, 1 - min(_AVERAGED, (1 + int(steps)) / (10 + int(steps))))


def _batches(count: int, steps: int, config: ImitationConfig) -> Iterator[Tensor]:
    """Rows of each step [B]."""
    generator = torch.Generator().manual_seed(config.seed)
    for _ in range(steps):
        yield torch.randint(count, (config.batch_size,), generator=generator)


def _varied(images: Tensor) -> Tensor:
    """Images [B, 3, H, W] in another light."""
    factor = lambda spread, colors: 1 + spread * (2 * torch.rand(len(images), colors, 1, 1, device=images.device) - 1)
    mean = images.mean((1, 2, 3), keepdim=True)
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
        self.training = str(about.get("training", ""))
        """What is to be told of it: whether it was interrupted."""
        self.digest = str(about.get("digest", ""))
        """Of the task, see `task_digest`; empty if that is not known."""

    def reset(self, episodes: Sequence[int]) -> None:
        """Nothing to do: the network has no memory."""

    @torch.no_grad()
    @single_threaded_torch()
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
        images = torch.from_numpy(seen).to(self._device).permute(0, 1, 4, 2, 3)
        near = torch.cat([matched(part) for part in images.split(_TOGETHER)])
        return self._network(images[:, 0].float() / 255, near, torch.from_numpy(arm).to(self._device))[0].double().cpu().numpy()
