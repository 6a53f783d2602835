"""COLMAP: images of one eye beside the model that structure from motion made of them before."""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2  # (before pycolmap, whose own image library would otherwise break cv2.imwrite)
import numpy as np

from endo_sim_ros.core.cameras import Camera, invert_pose
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.words import counted
from endo_sim_ros.sequences.images import check_size, image_size, numbered_files, read_image
from endo_sim_ros.sequences.masks import UNMASKED, Borders, MaskFiles, find_borders
from endo_sim_ros.sequences.pose_files import rigid
from endo_sim_ros.sequences.recording import DEFAULT_FPS, Recording, check_folder, keep_posed, select, spread, stamp_ns, tell_lacking
from endo_sim_ros.sequences.rectification import Rectification
from endo_sim_ros.sequences.structure_from_motion import scale_to_metres

logger = logging.getLogger(__name__)

_FILES = ("cameras.bin", "images.bin", "points3D.bin"), ("cameras.txt", "images.txt", "points3D.txt")
_LOOKED_AT = 50  # images, which tell the median depth: each has thousands of points
_LENSES = "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"  # whose coefficients are the first of OpenCV's


def find_models(root: Path) -> list[Path]:
    """The folders of COLMAP's models in that of a recording: `sparse/0` and so on, or else `sparse`, or else itself."""
    held = lambda place: any(all((place / name).is_file() for name in names) for names in _FILES)
    parts = sorted(place for place in (root / "sparse").glob("*/") if held(place))
    return parts or [place for place in (root / "sparse", root) if held(place)][:1]


def read_colmap(
    path: Path | str,
    *,
    start: int | None = None,
    stop: int | None = None,
    step: int = 1,
    scale: float | None = None,
    mask_polarity: str = "tissue",
    mask_border: bool = True,
    fps: float | None = None,
) -> Recording:
    """Read a folder with `images/`, the model in `sparse/0/`, and maybe `masks/`, as COLMAP leaves them.

    Args:
        path: The folder.
        start, stop: First frame number, and the one to stop before; the last number in the name of an image is its own.
        step: Take every step-th frame.
        scale: The median depth of the points in its images, m, as a model has no unit; None takes a usual one, and says so.
        mask_polarity: What white means in the masks: `tool`, `tissue`, or `auto` to find out.
        mask_border: Ignore the black border and round vignette around the image, and burnt-in writing or a logo.
        fps: Frames per second; None = 25.

    Returns:
        Undistorted frames, and the points of the model as scene points; images that the model has not are skipped.

    Raises:
        SequenceError: If a file is missing or wrong, or a lens is of a kind that cannot be undistorted.
    """
    root = check_folder(path, fps=fps, scale=scale)
    files, places = numbered_files(root / "images"), find_models(root)
    if not places:
        raise SequenceError(f"{root}: holds no model of COLMAP; cameras, images and points3D (.bin or .txt) belong in sparse/0")
    if not files:
        raise SequenceError(f"{root / 'images'}: holds no images named like 000001.png")
    models = [_read_model(place) for place in places]
    counts = [model.num_reg_images() for model in models]
    largest = int(np.argmax(counts))
    place, model = places[largest], models[largest]
    if len(places) > 1:
        logger.warning(
            "%s: holds %d models, which COLMAP could not join; %s has the most images, %d, and is read",
            root, len(places), place.name, counts[largest],
        )  # fmt: skip
    named = {image.name: image for image in model.images.values() if image.has_pose}
    placed = {number: named[file.name] for number, file in files.items() if file.name in named}
    if not placed:
        raise SequenceError(
            f"{place}: none of its {counted(len(named), 'image')} is in {root / 'images'}, such as {min(named, default='')!r}"
        )
    views = {number: np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for number, image in placed.items()}
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    colors = np.array([point.color for point in model.points3D.values()]).reshape(-1, 3) / 255
    if not len(points):
        raise SequenceError(f"{place}: has no points; run COLMAP's mapper, or point_triangulator with known poses")
    factor = scale_to_metres([], None, scale, _depths(model, placed, views))[0]
    poses = {number: rigid(invert_pose(view), f"{place}: pose of {files[number].name}") for number, view in views.items()}
    for pose in poses.values():
        pose[:3, 3] *= factor

    numbers = keep_posed(select(files, root / "images", start, stop, step), poses, place)
    size = image_size(read_image(files[numbers[0]]))
    lenses = {camera: _rectification(model.cameras[camera], size, place) for camera in {placed[n].camera_id for n in numbers}}
    rate = fps or DEFAULT_FPS
    stamp_ns(numbers[-1], rate)  # one that cannot be said is refused before the long work
    mask_files = numbered_files(root / "masks")
    tell_lacking(numbers, mask_files, root / "masks", UNMASKED)
    masks = MaskFiles(mask_files, root / "masks", mask_polarity)
    read = lambda number: check_size(read_image(files[number]), size, files[number])
    sampled = lambda: find_borders(root, ((n, read(n), None) for n in spread(numbers, 10)), [poses[n] for n in numbers])
    borders = sampled() if mask_border else Borders()

    def frames() -> Iterator[Frame]:
        for number in numbers:
            image, lens = borders.left(read(number)), lenses[placed[number].camera_id]
            mask, tissue = borders.lit(image), masks.of(number, size)
            if tissue is not None:
                mask = cv2.bitwise_and(mask, tissue)
            camera = Camera(lens.K, *size, lens.pose(poses[number]))
            yield Frame(stamp_ns(number, rate), lens.left(image), camera, mask=lens.mask(mask))

    return Recording(frames, len(numbers), lambda: (factor * points, colors), source=root / "images")


def _read_model(place: Path) -> Any:
    import pycolmap  # heavy, and needed here only

    try:
        return pycolmap.Reconstruction(str(place))
    except (ValueError, RuntimeError, IndexError, MemoryError) as error:
        raise SequenceError(f"{place}: not a readable model of COLMAP ({str(error).splitlines()[0]}); copy it again") from None


def _depths(model: Any, placed: dict[int, Any], views: dict[int, np.ndarray]) -> np.ndarray:
    """Depths, in the model's unit, at which some of the images show its points."""
    found = []
    for number in spread(sorted(placed), _LOOKED_AT):
        seen = np.array([model.points3D[p.point3D_id].xyz for p in placed[number].points2D if p.has_point3D()]).reshape(-1, 3)
        found.append(seen @ views[number][2, :3] + views[number][2, 3])
    depths = np.concatenate(found)
    return depths[depths > 0] if (depths > 0).any() else np.ones(1)


def _rectification(camera: Any, size: tuple[int, int], place: Path) -> Rectification:
    """What undistorts images of a camera of the model."""
    if camera.model_name not in _LENSES:
        raise SequenceError(
            f"{place}: its lens is {camera.model_name}, which is not undistorted here; run `colmap image_undistorter` and pass its folder"
        )
    if (camera.width, camera.height) != size:
        raise SequenceError(
            f"{place}: its camera is {camera.width}×{camera.height}, but images are {size[0]}×{size[1]}; give those of that size"
        )
    distortion = [camera.params[index] for index in camera.extra_params_idxs()]
    return Rectification.mono(camera.calibration_matrix(), distortion, size, place)
