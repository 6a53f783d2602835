"""Masks of the tissue: instruments left out, the black border that optics and rectification leave, and what is burnt in."""

import functools
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.sequences.eyes import Halves
from endo_sim_ros.sequences.images import image_size, read_mask_image, same_shape
from endo_sim_ros.sequences.recording import spread

logger = logging.getLogger(__name__)

_LITTLE = 0.25  # of the images: round ones without their border are 0.44 of a wide one, and instruments hide a part
_LIFTED = 10  # grey level to which compression and stray light lift a black border
_DARK = 16  # grey levels above black, below which a pixel is dark
_USUAL = 0.25  # share of pictures that optics show at least: round ones fill 0.44 of a wide picture
_RIM = 0.02  # fraction of the width by which the edge of the picture may be from where it is in other frames
_FEWEST = 5  # pictures; in fewer, tissue looks alike by chance
_NOISE = 3.0  # grey levels, standard deviation; compression leaves less where a picture stays the same
_CONTRAST = 8.0  # grey levels a pixel, of an edge; what is burnt in is there to be read
_STEADY = 0.3  # largest standard deviation of an edge, as a share of its mean slope: writing stays, but the tissue around it changes
_BORDER = 3  # pixels from black to the picture: half a slope's, and what scaling and rectification mix
_TOGETHER = 3  # pixels; one or two on an edge stay the same by chance
_SIDES = 1.5  # length of its edges over the side of a square as large; of one in a corner two sides are seen, of a speck none
_PARALLEL = 0.8  # share of a part's edges that run one way, less those across; a plain bar nine times as long as high has as much
_MOVED = 2e-3, 1e-2  # m, and of the axes; where most poses differ by less, tissue stays where it is in the pictures
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


def read_mask(file: Path, size: tuple[int, int], halves: Halves | None = None) -> np.ndarray:
    """The mask [H, W] in a file that belongs to an image of a size (width, height), and may be smaller.

    Of pictures that hold both eyes it may be that of the whole picture, or of the left eye.

    Raises:
        SequenceError: If it cannot be read, or has not the shape of the image.
    """
    mask = read_mask_image(file)
    if halves and same_shape(image_size(mask), halves.whole):
        return halves.cut(mask)[0]
    if not same_shape(image_size(mask), size):
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
        halves: Where the pictures hold both eyes; None where they do not.

    Raises:
        SequenceError: If one of these cannot be read, or they hold labels.
    """

    def __init__(self, files: Mapping[int, Path], source: Path, polarity: str, halves: Halves | None = None):
        self._files, self._halves = files, halves
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
        mask = read_mask(self._files[number], size, self._halves)
        return tissue_mask(mask, white_is_tool=self._white_is_tool, size=size, white=self._white)


def _brightest(image: np.ndarray) -> np.ndarray:
    """The brightest colour [H, W] of each pixel of an image [H, W, 3]."""
    return functools.reduce(cv2.max, cv2.split(image))  # ten times as fast as image.max(-1)


def black_level(images: Sequence[np.ndarray]) -> float:
    """Grey level of the black around what the optics show, from a sample of RGB images; 0 where it is as dark as black should be.

    Some recorders lift it, as those that take the 16 of video for a grey level. Then two corners or more are of one level in all
    images, and next to nothing is darker, as parts of tissue would be. In fewer than five images that cannot be told.

    Args:
        images: RGB images [H, W, 3] of one size, uint8, spread over the recording.
    """
    if len(images) < _FEWEST:
        return 0.0
    values = np.array([_brightest(image) for image in images])
    side = max(round(_RIM * values.shape[2]), 1)
    ends = slice(side), slice(-side, None)
    corners = [values[:, rows, columns] for rows in ends for columns in ends]
    # By quartiles, because of a title or a flash. Where light falls off towards the corners, they are not of one level.
    levels = sorted(float(np.median(corner)) for corner in corners if np.subtract(*np.percentile(corner, (75, 25))) <= _NOISE)
    if len(levels) < 2 or levels[0] <= _LIFTED or levels[1] > levels[0] + _NOISE or np.percentile(values, 1) < levels[0] - _NOISE:
        return 0.0
    return levels[0]


def lit_area(images: Iterable[np.ndarray], black: float = 0.0) -> np.ndarray:
    """Mask [H, W] (255 = seen, 0 = black) of what the optics show, from a sample of RGB images.

    Black means dark in all images but one in ten (a title, a flash) and connected to the image's edge: vignette or
    rectification border. Dark tissue in the middle of the image stays in.

    Args:
        images: RGB images [H, W, 3] of one size, uint8.
        black: Grey level of black, see `black_level`.

    Raises:
        ValueError: If there are no images.
    """
    values = [_brightest(image) for image in images]
    if not values:
        raise ValueError("lit_area: no images")
    usual = len(values) - 1 - len(values) // 10
    dark = (np.partition(values, usual, 0)[usual] < black + _DARK).astype(np.uint8)
    count, labels = cv2.connectedComponents(dark, connectivity=4)
    border = np.zeros(count, np.uint8)
    border[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = 1
    border[0] = 0  # what is not dark
    outside = cv2.dilate(border[labels], np.ones((5, 5), np.uint8))  # the fall-off beside the border is not tissue colour
    return np.where(outside > 0, np.uint8(0), np.uint8(255))


def burnt_in(images: Sequence[np.ndarray], lit: np.ndarray) -> np.ndarray:
    """Mask [H, W] (255 = burnt in) of writing, logos and bars in pictures of a lens that moves, from a sample of RGB images.

    These are pixels that stay the same, within edges that stay, too. Overexposed and black tissue may stay the same, but its edges do not,
    except those along which the lens moves: edges that all run one way tell nothing.
    Where half of all edges stay, the lens stands still, and nothing is found; nor is it in fewer than five images.

    Args:
        images: RGB images [H, W, 3] of one size, uint8, spread over the recording.
        lit: `lit_area` of them; what is outside is not looked at.
    """
    none = np.zeros_like(lit)
    if len(images) < _FEWEST:
        return none
    same = _mean_and_variance(images)[1].max(-1) <= _NOISE**2
    slope, change = np.complex64(0), np.float32(0)
    for x, unit in ((1, np.complex64(1)), (0, np.complex64(1j))):
        mean, variance = _mean_and_variance(cv2.Scharr(image, cv2.CV_32F, x, 1 - x) / np.float32(32) for image in images)
        slope, change = slope + unit * mean, change + variance.sum(-1)
    steepness = (np.abs(slope) ** 2).sum(-1)
    within = cv2.erode(lit, np.ones((2 * _BORDER + 1,) * 2, np.uint8)) > 0  # the edge of the picture itself stays, too
    edges = within & (steepness + change > _CONTRAST**2)
    still = edges & (change <= _STEADY**2 * steepness)
    if still.sum() > edges.sum() / 2:
        return none
    labels = cv2.connectedComponents((same & (lit > 0)).astype(np.uint8), connectivity=4)[1]
    area, of_part, of_part_still = (np.bincount(labels[these & same], minlength=labels.max() + 1) for these in (lit > 0, edges, still))
    around = of_part_still >= np.maximum(_TOGETHER, _SIDES * np.sqrt(area))
    here = still & same
    turned = (slope[here] ** 2).sum(-1) / steepness[here]  # by twice the angle, which is the same for both sides of a line
    parallel = np.hypot(*(np.bincount(labels[here], weights, len(area)) for weights in (turned.real, turned.imag)))
    found = (around & (of_part_still > of_part / 2) & (parallel < _PARALLEL * of_part_still))[labels]
    return cv2.dilate(np.where(found, np.uint8(255), none), np.ones((5, 5), np.uint8))  # its rim is mixed with tissue


def _mean_and_variance(arrays: Iterable[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Of arrays of one shape."""
    count, total, squares = 0, np.float32(0), np.float32(0)
    for array in map(np.float32, arrays):
        count, total, squares = count + 1, total + array, squares + array * array
    return total / count, np.maximum(squares / count - (total / count) ** 2, 0)


def lit_part(source: Path, images: Iterable[np.ndarray], poses: Iterable[np.ndarray] | None = None) -> Callable[[np.ndarray], np.ndarray]:
    """What makes the mask [H, W] of each RGB image of a recording: `lit_now` without what is burnt in, see `burnt_in`.

    The log tells of lifted black and of what is burnt in, and a warning of optics that show less than the usual share of their pictures.

    Args:
        source: Its file or folder, for messages.
        images: A sample of its RGB images.
        poses: Those recorded [4, 4]: of a lens that hardly moves nothing is known to be burnt in. None: they are not known.
    """
    images = list(images)
    if black := black_level(images):
        _tell_black(source, round(black))
    lit = lit_area(images, black)
    now = functools.partial(lit_now, lit, black=black)
    if (share := float((lit > 0).mean())) < _USUAL:
        _warn_of_border(source, f"{1 - share:.0%}")
    if poses is not None and not _moves(np.array(list(poses))):
        return now
    burnt = burnt_in(images, lit) & lit
    if not burnt.any():
        return now
    _tell_burnt_in(source, f"{(burnt > 0).mean():.2%}")
    return lambda image: now(image) & ~burnt


class Borders(NamedTuple):
    """What keeps out of each image of a recording what the optics do not show.

    Args:
        lit: Makes the mask [H, W] of an RGB image [H, W, 3], uint8, of the left eye, or of the only one.
        left, right: Make lifted black around the optics black in such images of a pair, see `black_level`.
    """

    lit: Callable[[np.ndarray], np.ndarray] = lambda image: np.full(image.shape[:2], 255, np.uint8)
    left: Callable[[np.ndarray], np.ndarray] = lambda image: image
    right: Callable[[np.ndarray], np.ndarray] = lambda image: image


def find_borders(
    source: Path, sample: Iterable[tuple[int, np.ndarray, np.ndarray | None]], poses: Iterable[np.ndarray] | None = None
) -> Borders:
    """The borders of a recording.

    Args:
        source: As of `lit_part`.
        sample: Frame numbers, RGB images of the left eye, and of the right one, None of one eye.
        poses: As of `lit_part`.
    """
    sample = list(sample)
    lefts, rights = [left for _, left, _ in sample], [right for *_, right in sample if right is not None]
    lit = lit_part(source, lefts, poses)
    # A right eye has no mask, and is compared with the left one: what is black in both tells its border.
    return Borders(lit, _blackened(lefts), _blackened(rights)) if rights else Borders(lit)


def _blackened(images: Sequence[np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    """What makes lifted black black in each image of an eye, from a sample of them."""
    black = black_level(images)
    if not black:
        return Borders().left
    lit = lit_area(images, black)
    return lambda image: np.where(lit_now(lit, image, black)[..., None] > 0, image, np.uint8(0))


def _moves(poses: np.ndarray) -> bool:
    """Whether most of the poses [N, 4, 4] differ by more than trackers err; a lens that is pulled out once stands still."""
    low, high = np.percentile(poses, (10, 90), 0)
    return bool((high - low)[:3, 3].max() > _MOVED[0] or (high - low)[:3, :3].max() > _MOVED[1])


@functools.cache  # a recording is read several times
def _warn_of_border(source: Path, share: str) -> None:
    logger.warning("%s: %s of its pictures is dark to their edges and left out; mask_border=false keeps it if it is tissue", source, share)


@functools.cache
def _tell_black(source: Path, level: int) -> None:
    logger.info("%s: the black around what is seen has the grey level %d, and is left out; mask_border=false keeps it", source, level)


@functools.cache
def _tell_burnt_in(source: Path, share: str) -> None:
    text = "%s: %s of its pictures stays the same while the lens moves, as writing does, and is left out; mask_border=false keeps it"
    logger.info(text, source, share)


def lit_now(lit: np.ndarray, image: np.ndarray, black: float = 0.0) -> np.ndarray:
    """A recording's lit area [H, W] without the rim that is black in this RGB image [H, W, 3].

    Round pictures wander on the sensor as the camera head turns on the endoscope, by a hundredth of the width or two.
    What is dark there, border or tissue, is left out; what is dark farther inside is tissue.

    Args:
        lit: `lit_area` of the recording, uint8.
        image: One of its images.
        black: Grey level of black, see `black_level`.
    """
    if lit.all():
        return lit
    side = 2 * max(round(_RIM * lit.shape[1]), 1) + 1
    rim = cv2.erode(lit, np.ones((side, side), np.uint8)) == 0
    return np.where(rim & (lit_area([image], black) == 0), np.uint8(0), lit)
