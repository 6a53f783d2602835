"""COLMAP's matching and mapping, in a process of their own: `python -m endo_sim_ros.sequences.colmap_process JOB`.

It prints a line `stage done total` for each step, at the end `models`, and writes the largest model to the job's folder.
"""

import json
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

DATABASE, MODEL = "features.db", "model"  # in the job's folder

_NEAR = 10  # images before and after each one that it is matched with: COLMAP's overlap of sequences
_FAR = 30  # images, spread over all, that are matched with one another, so that a camera that comes back is recognised
_NEAR_EYES = 2  # stereo pairs after each one that both of its eyes are matched with
_LEAST_TRIALS = 30  # of RANSAC; nearly all matches that pass the ratio test are right, and where they are not it goes on until it is sure
_TRACKS = 200  # points of each image by which global mapping places it; what it costs grows with them, and all are placed after it
_ROWS = 1.0  # pixels; well calibrated pairs have about half a pixel or less, most of it noise of features
_FIELD_OF_VIEW = 70.0  # degrees across the width, of a guessed focal length: in the middle of what laparoscopes have, 60 to 90
_POLL = 0.5  # seconds between looks at how far the matching is
_SEED = 0  # of random sampling


@dataclass(frozen=True)
class ColmapJob:
    """What to do.

    Args:
        folder: Holds the database of features, whose images are named `left/000000`, `right/000000`; gets the model.
            Its camera is PINHOLE where the focal length is known or guessed, else SIMPLE_RADIAL.
        count: Left images.
        fixed: The intrinsics are known and stay as they are.
        stereo: Each left image has a right one.
        threads: -1 uses all cores.
    """

    folder: str
    count: int
    fixed: bool
    stereo: bool
    threads: int


def pairs(count: int, stereo: bool) -> list[tuple[str, str]]:
    """Names of the images to match: left ones near in time, spread left ones with one another, and both eyes of stereo pairs.

    A stereo pair has its own eyes matched, and both with both of the pairs just after it: views of the rig that differ by its
    baseline as well. More pairs with the right eyes bring little: a feature of theirs is in the track of the left one.
    Up to `_FAR` images these are all left pairs; beyond, their number grows with the images, not with their square.
    """
    spread = -(-count // _FAR)
    left = [
        (f"left/{i:06d}", f"left/{j:06d}")
        for i in range(count)
        for j in range(i + 1, count)
        if j - i <= _NEAR or i % spread == j % spread == 0
    ]
    right = [(f"left/{i:06d}", f"right/{i:06d}") for i in range(count)]
    for i in range(count):
        for j in range(i + 1, min(i + _NEAR_EYES, count - 1) + 1):
            right += [(f"{one}/{i:06d}", f"{other}/{j:06d}") for one, other in (("left", "right"), ("right", "left"), ("right", "right"))]
    return left + right if stereo else left


def run(job: ColmapJob, report: Callable[[str, int, int], None]) -> int:
    """Match, map, and write the largest model; returns how many models came out.

    Few images leave focal length and distortion open. Where their estimate is useless, a guessed focal length is held in its place.
    """
    import cv2  # noqa: F401  (before pycolmap, see structure_from_motion.py)
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value  # what comes out at the end tells if it failed
    pycolmap.set_random_seed(_SEED)
    root = Path(job.folder)
    _match(pycolmap, job, root, report)
    # A right eye that is free is placed where it explains a part of how tissue moves between pairs, which puts depth off by a fifth.
    free = job.stereo and _rows_apart(pycolmap, job, root) > _ROWS
    models = _models(pycolmap, job, root, free, report)
    best = max(models, key=_placed, default=None)
    if not job.fixed and (best is None or 2 * _placed(best) < job.count or folds(best)):
        _guess_focal_length(pycolmap, root)
        guess = replace(job, fixed=True)
        _match(pycolmap, guess, root, report)
        guessed = _models(pycolmap, guess, root, free, report)
        if 2 * max(map(_placed, guessed), default=0) >= job.count:
            models = guessed
    if models:
        report("mapping", job.count, job.count)
        (root / MODEL).mkdir()
        model = max(models, key=_placed)
        if job.stereo and not free:
            _adjust(pycolmap, model)
        model.write(root / MODEL)
    return len(models)


def folds(model: Any) -> bool:
    """Whether the estimated distortion of a model is that of no lens.

    A radial distortion k1 < 0 reaches no farther than 2 / √(−27 k1) from the middle, in focal lengths: beyond, it would fold the picture.
    Nine tenths of the features must lie within, wherever the picture ends in a black border; corners may not.
    """
    f, cx, cy, k1 = next(iter(model.cameras.values())).params
    features = np.array([point.xy for image in model.images.values() for point in image.points2D])
    reach = np.quantile(np.hypot(*(features - (cx, cy)).T), 0.9)
    return bool(k1 < -4 / 27 / (reach / f) ** 2)


def _guess_focal_length(pycolmap: Any, root: Path) -> None:
    """Give the cameras a usual focal length and no distortion; forget what geometry of pairs was found without."""
    with pycolmap.Database.open(root / DATABASE) as database:
        for camera in database.read_all_cameras():
            f = camera.width / 2 / np.tan(np.radians(_FIELD_OF_VIEW) / 2)
            params = [f, f, camera.width / 2, camera.height / 2]
            held = pycolmap.Camera(model="PINHOLE", width=camera.width, height=camera.height, params=params, camera_id=camera.camera_id)
            held.has_prior_focal_length = True
            database.update_camera(held)
        database.clear_two_view_geometries()


def _models(pycolmap: Any, job: ColmapJob, root: Path, free: bool, report: Callable[[str, int, int], None]) -> list[Any]:
    """Models of the matches, of the mapping that places the most images."""
    models = []
    # Without intrinsics the global mapper would have to guess a focal length that it cannot correct.
    if job.fixed:
        report("mapping", 0, 0)
        models = _global_models(pycolmap, job, root, free)
    if max((_placed(model) for model in models), default=0) < job.count:
        models = max(models, _incremental_models(pycolmap, job, root, free, report), key=lambda m: max(map(_placed, m), default=0))
    return models


def _match(pycolmap: Any, job: ColmapJob, root: Path, report: Callable[[str, int, int], None]) -> None:
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = _SEED
    verification.detect_watermark = False  # a fixed vignette or overlay is masked, and watermarks are not pairs
    if job.fixed:  # without intrinsics, samples that lie in a plane tell nothing of the camera, and more are drawn
        verification.ransac.min_num_trials = _LEAST_TRIALS
    todo = pairs(job.count, job.stereo)
    (root / "pairs.txt").write_text("".join(f"{first} {second}\n" for first, second in todo))
    # A block's size is also the number of images whose features COLMAP keeps at hand: those that one image is matched with.
    pairing = pycolmap.ImportedPairingOptions(block_size=2 * _NEAR + _FAR, match_list_path=root / "pairs.txt")
    report("matching", 0, len(todo))
    with ThreadPoolExecutor(1) as pool, pycolmap.Database.open(root / DATABASE) as database:
        matched = pool.submit(
            pycolmap.match_image_pairs, root / DATABASE, pycolmap.FeatureMatchingOptions(num_threads=job.threads),
            pairing_options=pairing, verification_options=verification, device=pycolmap.Device.cpu,
        )  # fmt: skip
        while not wait([matched], _POLL).done:
            report("matching", database.num_matched_image_pairs(), len(todo))
        matched.result()


def _rows_apart(pycolmap: Any, job: ColmapJob, root: Path) -> float:
    """How far, in the median, features of right images lie above or below the rows of left ones, pixels; 0 where no pair has any."""
    apart = [np.empty(0)]
    with pycolmap.Database.open(root / DATABASE) as database:
        numbers = {image.name: image.image_id for image in database.read_all_images()}
        for i in range(job.count):
            left, right = numbers[f"left/{i:06d}"], numbers.get(f"right/{i:06d}")
            if right is not None and database.exists_two_view_geometry(left, right):
                matches = database.read_two_view_geometry(left, right).inlier_matches
                rows = database.read_keypoints(left)[matches[:, 0], 1], database.read_keypoints(right)[matches[:, 1], 1]
                apart.append(np.abs(rows[1] - rows[0]))
    each = np.concatenate(apart)
    return float(np.median(each)) if len(each) else 0.0


def _global_models(pycolmap: Any, job: ColmapJob, root: Path, free: bool) -> list[Any]:
    """Models of global mapping (GLOMAP, Pan et al. 2024), which places all images at once."""
    options = pycolmap.GlobalPipelineOptions(num_threads=job.threads, random_seed=_SEED)
    mapper = options.mapper
    mapper.num_threads = job.threads
    mapper.random_seed = mapper.rotation_averaging.random_seed = mapper.global_positioning.random_seed = _SEED
    mapper.bundle_adjustment.refine_focal_length = mapper.bundle_adjustment.refine_extra_params = False
    mapper.refine_sensor_from_rig = free
    mapper.track_required_tracks_per_view = _TRACKS
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
    (root / "global").mkdir()
    try:
        return list(pycolmap.global_mapping(root / DATABASE, root, root / "global", options).values())
    except RuntimeError:  # its checks of what it was given; incremental mapping is more patient
        return []


def _incremental_models(pycolmap: Any, job: ColmapJob, root: Path, free: bool, report: Callable[[str, int, int], None]) -> list[Any]:
    options = pycolmap.IncrementalPipelineOptions(num_threads=job.threads, random_seed=_SEED, min_model_size=2)
    options.extract_colors = False
    options.ba_refine_sensor_from_rig = free
    options.mapper.random_seed = options.triangulation.random_seed = _SEED
    options.mapper.num_threads = job.threads
    if job.fixed:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    placed = 0

    def next_image() -> None:
        nonlocal placed
        placed = min(placed + 1, job.count)
        report("mapping", placed, job.count)

    (root / "incremental").mkdir(exist_ok=True)
    models = pycolmap.incremental_mapping(root / DATABASE, root, root / "incremental", options, next_image_callback=next_image)
    return list(models.values())


def _adjust(pycolmap: Any, model: Any) -> None:
    """Adjust poses and points once more. Mapping fixes the scale by a second camera; the distance of eyes that are held fixes it, too."""
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.use_gpu = False
    moving = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        moving.add_image(image)
    for camera in model.cameras:
        moving.set_constant_cam_intrinsics(camera)
    for rig in model.rigs.values():
        for sensor in rig.non_ref_sensors:
            moving.set_constant_sensor_from_rig_pose(sensor)
    pycolmap.create_default_bundle_adjuster(options, moving, model).solve()


def _placed(model: Any) -> int:
    """Left images that have a pose."""
    return sum(image.has_pose and image.name.startswith("left/") for image in model.images.values())


def _end_with_parent() -> None:
    sys.stdin.read()  # ends when the parent does, however it ended
    os._exit(1)


def main() -> None:
    """Do the job of the command line."""
    threading.Thread(target=_end_with_parent, daemon=True).start()

    def report(stage: str, done: int, total: int) -> None:
        print(stage, done, total, flush=True)

    models = run(ColmapJob(**json.loads(sys.argv[1])), report)
    report("models", models, models)


if __name__ == "__main__":
    main()
