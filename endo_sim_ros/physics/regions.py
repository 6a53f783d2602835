"""Painted regions: parts of the tissue that are made of something else, such as a tumour or a vessel.

A region is written as one line of text, so that it fits a YAML file and a ROS parameter (an array of strings):

    box X Y Z X Y Z …                 between two opposite corners, metres, world
    sphere X Y Z RADIUS …             metres, world
    mask IMAGE CAMERAS NUMBER …       all tissue that shows, or hides, behind the non-zero pixels of a mask image,
                                      seen by a camera (counted from 0) of a cameras.json
    … young_modulus=3e4 poisson_ratio=0.4 density=1050

Quotes keep a path with spaces together. At least one property is given; the others stay as they are.
"""

import math
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike

from endo_sim_ros.core.cameras import Camera, load_cameras
from endo_sim_ros.core.config import ConfigError

MAX_POISSON_RATIO = 0.49  # as PhysicsConfig has it; at 0.5 the sound speed is infinite
ASPECT_TOLERANCE = 0.01

_FORMS = {
    "box": "box X Y Z X Y Z PROPERTY=VALUE …",
    "sphere": "sphere X Y Z RADIUS PROPERTY=VALUE …",
    "mask": "mask IMAGE CAMERAS NUMBER PROPERTY=VALUE …",
}


@dataclass(frozen=True)
class TissueProperties:
    """What each of M nodes is made of, float64.

    Args:
        young_modulus: Stiffness [M], Pa, above zero.
        poisson_ratio: Compressibility [M], 0 to 0.49.
        density: Mass density [M], kg/m³, above zero.

    Raises:
        ConfigError: If shapes disagree, or a value is not finite or out of its range.
    """

    young_modulus: np.ndarray
    poisson_ratio: np.ndarray
    density: np.ndarray

    def __post_init__(self):
        shape = np.shape(self.young_modulus)
        for each in fields(self):
            values = np.array(getattr(self, each.name), np.float64)
            if values.ndim != 1 or values.shape != shape:
                raise ConfigError(f"tissue properties: {each.name} has shape {values.shape}, expected one number per node, {shape}")
            good = _in_range(each.name, values)
            if not good.all():
                node = int(np.argmin(good))
                raise ConfigError(f"tissue properties: {each.name} of node {node} is {values[node]:g}, but must be {_RANGES[each.name]}")
            values.flags.writeable = False
            object.__setattr__(self, each.name, values)

    def __len__(self) -> int:
        return len(self.young_modulus)

    @classmethod
    def uniform(cls, count: int, young_modulus: float, poisson_ratio: float, density: float) -> "TissueProperties":
        """The same everywhere; Pa, 1, kg/m³."""
        return cls(*(np.full(count, value, np.float64) for value in (young_modulus, poisson_ratio, density)))

    def painted(self, where: np.ndarray, **properties: float) -> "TissueProperties":
        """The same with other properties, by their names, where `where` [M] is true.

        Raises:
            ConfigError: If `where` is not bool [M], or a value is out of its range.
        """
        where = np.asarray(where)
        if where.dtype != bool or where.shape != (len(self),):
            raise ConfigError(f"tissue properties: where is {where.dtype} {where.shape}, expected bool ({len(self)},)")
        return replace(self, **{name: np.where(where, value, getattr(self, name)) for name, value in properties.items()})


_PROPERTIES = tuple(each.name for each in fields(TissueProperties))
_RANGES = {
    "young_modulus": "finite and above 0 Pa",
    "poisson_ratio": f"between 0 and {MAX_POISSON_RATIO}",
    "density": "finite and above 0 kg/m³",
}


def _in_range(name: str, values: np.ndarray) -> np.ndarray:
    if name == "poisson_ratio":
        return (values >= 0) & (values <= MAX_POISSON_RATIO)
    return (values > 0) & np.isfinite(values)


def inside_box(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Which points [M, 3] lie between two corners [3], faces included: bool [M]. Metres, one frame."""
    points = np.asarray(points, np.float64)
    return np.asarray(((points >= low) & (points <= high)).all(1))


def inside_sphere(points: np.ndarray, centre: ArrayLike, radius: float) -> np.ndarray:
    """Which points [M, 3] lie within a distance of a centre [3], surface included: bool [M]. Metres, one frame."""
    return np.asarray(((np.asarray(points, np.float64) - np.asarray(centre)) ** 2).sum(1) <= radius**2)


def seen_in_mask(points: np.ndarray, camera: Camera, mask: np.ndarray) -> np.ndarray:
    """Which points project into non-zero pixels, at any depth: a mask paints the whole column of tissue behind it.

    Args:
        points: [M, 3], metres, world. Those behind the camera or outside its image are not seen.
        camera: The camera in which the mask was painted.
        mask: [H, W], bool or uint8. A mask of another size than the camera's image is scaled to it.

    Returns:
        bool [M].

    Raises:
        ConfigError: If the mask is not an image of one channel or its aspect ratio is more than 1 % off the camera's.
    """
    mask = np.asarray(mask)
    if mask.ndim != 2 or not mask.size:
        raise ConfigError(f"the mask has shape {mask.shape}, expected [H, W]")
    height, width = mask.shape
    if abs(width * camera.height / (height * camera.width) - 1) > ASPECT_TOLERANCE:
        raise ConfigError(
            f"the mask has {width}×{height} pixels and the camera's image {camera.width}×{camera.height}, whose aspect ratio is different"
        )
    camera = camera.resized(width, height)  # instead of the image: the nearest pixel of the mask counts
    pixels, depths = camera.project(np.asarray(points, np.float64))
    seen = camera.contains(pixels, depths)
    u, v = np.where(seen[:, None], pixels, 0).astype(int).T
    return seen & (mask[v, u] != 0)


@dataclass(frozen=True)
class Region:
    """A part of space and what the tissue there is made of.

    Args:
        text: As it was written, for messages.
        properties: Those of `TissueProperties` that differ there, by their names.
        contains: Tells which points [M, 3] (m, world) lie in it: bool [M].
    """

    text: str
    properties: dict[str, float]
    contains: Callable[[np.ndarray], np.ndarray] = field(repr=False, compare=False)


def parse_region(text: str) -> Region:
    """Read a region from its text; the module's header describes the form. A mask's files are read at once.

    Raises:
        ConfigError: If the text cannot be understood, a value is out of its range, or a file is not what it should be;
            the message names the text, what is wrong and how it should look.
    """
    form = " or ".join(f"'{each}'" for each in _FORMS.values())

    def wrong(what: str) -> ConfigError:
        return ConfigError(f"region {text!r}: {what}; it should look like {form}")

    try:
        shape, *words = shlex.split(text) or [""]
    except ValueError as error:  # of quotes
        raise wrong(str(error).lower()) from error
    if shape not in _FORMS:
        raise wrong(f"there is no shape {shape!r}")
    form = f"'{_FORMS[shape]}'"
    needed = _FORMS[shape].split().index("PROPERTY=VALUE") - 1
    place, assignments = words[:needed], words[needed:]
    if len(place) < needed or any(word.partition("=")[0] in _PROPERTIES for word in place):
        raise wrong(f"a {shape} takes {needed} values before its properties")
    properties = {}
    for word in assignments:
        name, equals, value = word.partition("=")
        if name not in _PROPERTIES or not equals:
            raise wrong(f"{word!r} is no property, which are {', '.join(_PROPERTIES)}")
        if name in properties:
            raise wrong(f"{name} is given twice")
        properties[name] = _number(value)
        if not _in_range(name, np.array(properties[name])):
            raise wrong(f"{name} is {value!r}, but must be {_RANGES[name]}")
    if not properties:
        raise wrong(f"it changes nothing without one of {', '.join(_PROPERTIES)}")

    if shape == "mask":
        image, cameras, number = place
        try:
            camera, mask = _read_camera(cameras, number), _read_mask(image)
            seen_in_mask(np.zeros((0, 3)), camera, mask)  # sizes must fit
        except ValueError as error:
            raise wrong(str(error)) from error
        return Region(text, properties, lambda points: seen_in_mask(points, camera, mask))
    values = [_number(word) for word in place]
    if not np.isfinite(values).all():
        raise wrong(f"{place[int(np.argmin(np.isfinite(values)))]!r} is not a number of metres")
    if shape == "sphere":
        *centre, radius = values
        if radius <= 0:
            raise wrong(f"its radius is {radius:g} m, but must be above 0")
        return Region(text, properties, lambda points: inside_sphere(points, centre, radius))
    low, high = np.minimum(values[:3], values[3:]), np.maximum(values[:3], values[3:])
    return Region(text, properties, lambda points: inside_box(points, low, high))


def read_regions(texts: Iterable[str]) -> list[Region]:
    """Regions of their texts, see :func:`parse_region`; an empty text is none, as ROS cannot set an array to an empty one."""
    return [parse_region(text) for text in texts if text]


def paint_regions(properties: TissueProperties, points: np.ndarray, regions: Sequence[str]) -> TissueProperties:
    """Paint regions, as :func:`read_regions` reads them, in order: where they overlap, the last one counts.

    Args:
        properties: What the M nodes are made of.
        points: Nodes at rest [M, 3], metres, world.
        regions: One text each.

    Raises:
        ConfigError: If a region cannot be read or contains no node.
    """
    points = np.asarray(points, np.float64)
    if points.shape != (len(properties), 3):
        raise ConfigError(f"paint_regions: points have shape {points.shape}, expected ({len(properties)}, 3)")
    for region in read_regions(regions):
        where = region.contains(points)
        if not where.any():
            low, high = (" ".join(f"{x:.4g}" for x in corner) for corner in (points.min(0), points.max(0)))
            raise ConfigError(f"region {region.text!r} contains none of the nodes, which lie between {low} and {high} (metres, world)")
        properties = properties.painted(where, **region.properties)
    return properties


def _number(word: str) -> float:
    """The number that a word says, NaN if none."""
    try:
        return float(word)
    except ValueError:
        return math.nan


def _read_camera(path: str, number: str) -> Camera:
    cameras = load_cameras(Path(path).expanduser())
    if not number.isdecimal() or int(number) >= len(cameras):
        raise ConfigError(f"{path} has cameras 0 to {len(cameras) - 1}, not {number!r}" if cameras else f"{path} has no cameras")
    return cameras[int(number)]


def _read_mask(path: str) -> np.ndarray:
    """Mask image [H, W], of whatever depth so that small labels count."""
    try:
        data = np.fromfile(Path(path).expanduser(), np.uint8)
    except OSError as error:
        raise ConfigError(f"mask image {path} cannot be read ({error.strerror})") from error
    try:
        mask = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH) if data.size else None
    except cv2.error:  # its size is beyond OPENCV_IO_MAX_IMAGE_PIXELS
        raise ConfigError(f"{path} has over 64 megapixels, or is damaged; make the image smaller") from None
    if mask is None:
        raise ConfigError(f"{path} is not an image")
    return mask
