"""Masks of the tissue: instruments left out, and the black border that optics and rectification leave."""

import functools
import logging
from collections.abc import Iterable, Mapping
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.images import read_mask_image
from endo_sim_ros.sequences.recording import spread

logger = logging.getLogger(__name__)

_LITTLE = 0.25  # of the images: round ones without their border are 0.44 of a wide one, and instruments hide a part
_DARK = 16  # grey level below which a pixel is dark; compression and stray light lift a black border to about ten
_USUAL = 0.25  # share of pictures that optics show at least: round ones fill 0.44 of a wide picture
_RIM = 0.02  # fraction of the width by which the edge of the picture may be from where it is in other frames
_LEAST_WHITE = 16  # black of masks from a compressed video is below it, labels of organs and tools are, too
POLARITIES = ("auto", "tool", "tissue")
UNMASKED = "tools stay visible in these"
"""What comes of a frame without a mask."""


def white_of(masks: Iterable[np.ndarray], source: Path) -> float:
    """The number that is white in masks [H, W], of which these are a sample: 255, or that of masks of 0 and 1 and of 16 bits.

    Raises:
        SequenceError: If they hold labels.
    """
    most = float(max((mask.max() for mask in masks), default=0))
    if 1 < most < _LEAST_WHITE:
        raise SequenceError(
            f"{source}: the masks hold no number above {most:g}, as labels do; masks have 0 and 255, or 0 and 1: write some in which "
            "tissue is 255"
        )
    return 255.0 if most == 0 or _LEAST_WHITE <= most <= 255 else most


def tool_is_white(masks: Iterable[np.ndarray], source: Path, polarity: str = "auto", white: float = 255.0) -> bool:
    """Whether white in these masks means instrument rather than tissue.

    Instruments cover less of an image than tissue does, so the colour in the minority over all masks is taken for
    the instruments. The decision is logged, because it cannot be checked. What is known is warned of where it leaves little tissue.

    Args:
        masks: A sample of the masks [H, W].
        source: Their folder, for messages.
        polarity: `auto`, or what white is known to be: `tool` or `tissue`.
        white: The number that is white.
    """
    if polarity not in POLARITIES:
        raise SequenceError(f"{source}: mask polarity must be one of {', '.join(POLARITIES)}, got {polarity!r}")
    share = float(np.mean([np.mean(mask > white / 2) for mask in masks]))
    if polarity != "auto":
        tool, other = polarity == "tool", "tissue" if polarity == "tool" else "tool"
        if (left := 1 - share if tool else share) < _LITTLE:
            text = "%s: these masks leave %.0f %% of the images as tissue, as white is said to be %s; state mask_polarity=%s if it is not"
            logger.warning(text, source, 100 * left, polarity, other)
        elif left == 1:
            logger.info("%s: these masks hide nothing", source)
        return tool
    tool = share <= 0.5
    unsure, nothing = 0.4 < share < 0.6, share in (0, 1)
    logger.log(
        logging.WARNING if unsure else logging.INFO,
        "%s: white covers %.0f %% of the masks, so white is taken for %s%s",
        source, 100 * share, "tools" if tool else "tissue",
        "; this is close, state the polarity if it is wrong" if unsure else "; these masks hide nothing" if nothing else "",
    )  # fmt: skip
    return tool


def tissue_mask(mask: np.ndarray, *, white_is_tool: bool, size: tuple[int, int], white: float = 255.0) -> np.ndarray:
    """A mask [H, W] with 255 = tissue and 0 = ignore at an image's size (width, height), of one in which `white` is that number."""
    tissue = np.where((mask > white / 2) ^ white_is_tool, np.uint8(255), np.uint8(0))
    return tissue if tissue.shape[::-1] == size else cv2.resize(tissue, size, interpolation=cv2.INTER_NEAREST)


def read_mask(file: Path, size: tuple[int, int]) -> np.ndarray:
    """The mask [H, W] in a file that belongs to an image of a size (width, height), and may be smaller.

    Raises:
        SequenceError: If it cannot be read, or has not the shape of the image.
    """
    mask = read_mask_image(file)
    if abs(mask.shape[1] * size[1] / (mask.shape[0] * size[0]) - 1) > 0.01:
        raise SequenceError(
            f"{file}: is {mask.shape[1]}×{mask.shape[0]}, but the images are {size[0]}×{size[1]}; "
            "a mask may be smaller than its image, but not of another shape"
        )
    return mask


class MaskFiles:
    """Masks in files, one per frame; not every frame need have one.

    Args:
        files: Image files by frame number.
        source: Their folder, for messages.
        polarity: What white means in them: `tool`, `tissue`, or `auto` to find out from 20 of them.

    Raises:
        SequenceError: If one of these cannot be read, or they hold labels.
    """

    def __init__(self, files: Mapping[int, Path], source: Path, polarity: str):
        self._files = files
        sample = [read_mask_image(files[number]) for number in spread(sorted(files), 20)]
        self._white = white_of(sample, source)
        self._white_is_tool = bool(files) and tool_is_white(sample, source, polarity, self._white)

    def of(self, number: int, size: tuple[int, int]) -> np.ndarray | None:
        """Mask [H, W] of a frame at an image's size (width, height), 255 = tissue; None where it has no file.

        Raises:
            SequenceError: If it cannot be read, or has not the shape of the image.
        """
        if number not in self._files:
            return None
        return tissue_mask(read_mask(self._files[number], size), white_is_tool=self._white_is_tool, size=size, white=self._white)


def lit_area(images: Iterable[np.ndarray]) -> np.ndarray:
    """Mask [H, W] (255 = seen, 0 = black) of what the optics show, from a sample of RGB images.

    Black means dark in all images but one in ten (a title, a flash) and connected to the image's edge: vignette or
    rectification border. Dark tissue in the middle of the image stays in.

    Args:
        images: RGB images [H, W, 3] of one size, uint8.

    Raises:
        ValueError: If there are no images.
    """
    values = [functools.reduce(cv2.max, cv2.split(image)) for image in images]  # ten times as fast as image.max(-1)
    if not values:
        raise ValueError("lit_area: no images")
    usual = len(values) - 1 - len(values) // 10
    dark = (np.partition(values, usual, 0)[usual] < _DARK).astype(np.uint8)
    count, labels = cv2.connectedComponents(dark, connectivity=4)
    border = np.zeros(count, np.uint8)
    border[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = 1
    border[0] = 0  # what is not dark
    outside = cv2.dilate(border[labels], np.ones((5, 5), np.uint8))  # the fall-off beside the border is not tissue colour
    return np.where(outside > 0, np.uint8(0), np.uint8(255))


def lit_part(source: Path, images: Iterable[np.ndarray]) -> np.ndarray:
    """As `lit_area`, of a recording; a warning tells of one whose optics show less than the usual share of its pictures."""
    lit = lit_area(images)
    if (share := float((lit > 0).mean())) < _USUAL:
        _warn_of_border(source, f"{1 - share:.0%}")
    return lit


@functools.cache  # a recording is read several times
def _warn_of_border(source: Path, share: str) -> None:
    logger.warning("%s: %s of its pictures is dark to their edges and left out; mask_border=false keeps it if it is tissue", source, share)


def lit_now(lit: np.ndarray, image: np.ndarray) -> np.ndarray:
    """A recording's lit area [H, W] without the rim that is black in this RGB image [H, W, 3].

    Round pictures wander on the sensor as the camera head turns on the endoscope, by a hundredth of the width or two.
    What is dark there, border or tissue, is left out; what is dark farther inside is tissue.

    Args:
        lit: `lit_area` of the recording, uint8.
        image: One of its images.
    """
    if lit.all():
        return lit
    side = 2 * max(round(_RIM * lit.shape[1]), 1) + 1
    rim = cv2.erode(lit, np.ones((side, side), np.uint8)) == 0
    return np.where(rim & (lit_area([image]) == 0), np.uint8(0), lit)
