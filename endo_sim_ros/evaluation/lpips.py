"""LPIPS, the learned perceptual distance of Zhang et al. 2018 (version 0.1), from weights that are on this machine."""

import importlib.util
import math
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

Backbone = Literal["alex", "vgg"]

# Layers of torchvision's trunks: convolutions as (number in `features`, stride, padding, whether its output is compared),
# or None for max pooling.
_TRUNKS: dict[str, list[tuple[int, int, int, bool] | None]] = {
    "alex": [(0, 4, 2, True), None, (3, 1, 2, True), None, (6, 1, 1, True), (8, 1, 1, True), (10, 1, 1, True)],
    "vgg": [
        (0, 1, 1, False), (2, 1, 1, True), None,
        (5, 1, 1, False), (7, 1, 1, True), None,
        (10, 1, 1, False), (12, 1, 1, False), (14, 1, 1, True), None,
        (17, 1, 1, False), (19, 1, 1, False), (21, 1, 1, True), None,
        (24, 1, 1, False), (26, 1, 1, False), (28, 1, 1, True),
    ],
}  # fmt: skip
_POOLING = {"alex": (3, 2), "vgg": (2, 2)}  # size and stride
_FILES = {"alex": "alexnet*.pth", "vgg": "vgg16*.pth"}  # as torchvision names them
_HEADS = {"lpips": "weights/v0.1", "torchmetrics": "functional/image/lpips_models"}  # packages that bring the authors' heads
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_SMALLEST = {"alex": 31, "vgg": 16}  # side of an image that reaches the last layer, pixels


class WeightsError(ValueError):
    """Weights that are not there or not readable; the message says where to put them."""


class Lpips:
    """A distance between images: 0 is alike; at least 31 pixels a side (16 with vgg).

    Args:
        backbone: Network whose features are compared.
        weights: Folder with the trunk (`alexnet*.pth` or `vgg16*.pth`, torchvision's) and, if it is to be taken from there,
            the head (`alex.pth` or `vgg.pth`, the authors'); None takes the trunk from torch's cache. A head that is not in
            the folder is taken from the installed package `lpips` or `torchmetrics`, of which nothing is imported.
        device: Where to compute.

    Raises:
        WeightsError: If weights are missing or damaged.
    """

    def __init__(self, backbone: Backbone, weights: Path | None = None, device: str = "cpu"):
        self.backbone, self.device = backbone, device
        trunk, head = _trunk_file(backbone, weights), _head_file(backbone, weights)
        try:
            self._layers = _trunk_layers(backbone, _load(trunk, device))
            heads = _load(head, device)
            self._heads = [heads[f"lin{i}.model.1.weight"].float() for i in range(5)]
        except KeyError as error:
            raise WeightsError(f"{trunk} and {head}: no weights of LPIPS {backbone}, {error} is not in them") from error
        self._shift, self._scale = (torch.tensor(v, device=device).view(1, 3, 1, 1) for v in (_SHIFT, _SCALE))

    @torch.no_grad()
    def __call__(self, image: np.ndarray, reference: np.ndarray, *masks: np.ndarray | None) -> tuple[float, ...]:
        """Distances of images [H, W, 3] uint8: over all pixels, or over each mask [H, W] (not 0), for which the networks run once.

        Pixels outside the first mask are black in both images. A mean over a mask weighs each place of a layer by its share
        of the mask; NaN where the mask is empty or the image is too small.
        """
        masks = masks or (None,)
        height, width = image.shape[:2]
        if min(height, width) < _SMALLEST[self.backbone]:
            return (math.nan,) * len(masks)
        weights = [np.ones((height, width), bool) if mask is None else mask > 0 for mask in masks]
        pair = np.stack([image, reference]).astype(np.float32) * weights[0][..., None]
        shares = [torch.as_tensor(each, dtype=torch.float32, device=self.device)[None, None] for each in weights]
        x = torch.as_tensor(pair, device=self.device).permute(0, 3, 1, 2) / 127.5 - 1
        x, sums = (x - self._shift) / self._scale, [torch.zeros((), device=self.device) for _ in masks]
        heads = iter(self._heads)
        for layer in self._layers:
            if layer is None:
                x = functional.max_pool2d(x, *_POOLING[self.backbone])
                continue
            kernel, bias, stride, padding, compared = layer
            x = functional.conv2d(x, kernel, bias, stride, padding).relu_()
            if compared:
                unit = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
                distance = functional.conv2d((unit[:1] - unit[1:]).square(), next(heads))
                for i, share in enumerate(shares):
                    share = functional.interpolate(share, distance.shape[2:], mode="area")
                    sums[i] = sums[i] + (distance * share).sum() / share.sum()
        return tuple(float(each) for each in sums)


def _trunk_layers(backbone: str, state: dict[str, Tensor]) -> list[tuple | None]:
    """Layers as in _TRUNKS, each number replaced by the weight and the bias."""
    state = {name.removeprefix("features."): tensor.float() for name, tensor in state.items()}
    return [layer and (state[f"{layer[0]}.weight"], state[f"{layer[0]}.bias"], *layer[1:]) for layer in _TRUNKS[backbone]]


def _trunk_file(backbone: str, folder: Path | None) -> Path:
    place = Path(torch.hub.get_dir()) / "checkpoints" if folder is None else Path(folder)
    found = sorted(place.glob(_FILES[backbone]))
    if not found:
        raise WeightsError(f"LPIPS {backbone}: no {_FILES[backbone]} (torchvision's) in {place}; put it there, or name its folder")
    return found[0]


def _head_file(backbone: str, folder: Path | None) -> Path:
    files = [] if folder is None else [Path(folder) / f"{backbone}.pth"]
    for package, place in _HEADS.items():
        found = importlib.util.find_spec(package)
        if found and found.origin:
            files.append(Path(found.origin).parent / place / f"{backbone}.pth")
    for file in files:
        if file.is_file():
            return file
    advice = f"`pip install --no-deps lpips` brings it, or put the authors' {backbone}.pth beside the trunk"
    raise WeightsError(f"LPIPS {backbone}: no linear head; {advice}")


def _load(path: Path, device: str) -> dict[str, Tensor]:
    try:
        return torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # a damaged file can make the unpickler raise anything
        raise WeightsError(f"{path}: not readable weights ({type(error).__name__}); download them again") from error
