"""Multi-view refinement: depth priors corrected by other images of the same tissue, the right one of the same view and other views.

The lenses of a stereo endoscope are millimetres apart, its views centimetres: by how many pixels tissue in one view
lies beside where another view's depth and pose expect it tells that depth several times better than the pair of lenses.
"""

import dataclasses
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import torch

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import cpu_threads, return_freed_memory
from endo_sim_ros.core.tissue_motion import TissueMotion
from endo_sim_ros.reconstruction.priors.flow import EyeImage, FlowCorrection, eye_image, flow_correction, prepare_flow
from endo_sim_ros.reconstruction.priors.interpolation import inverse_distance_weighted
from endo_sim_ros.reconstruction.priors.inverse_depth import blur, correct, prepare_smoothing, scaled, smooth
from endo_sim_ros.reconstruction.priors.stereo import right_view
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import ScenePoints, TrainingView, pixels_of, resized_depth, shrink
from endo_sim_ros.reconstruction.stage_configs import InterpolationConfig, MultiViewConfig, StereoConfig
from endo_sim_ros.reconstruction.triangulation import nearest_views

_MANY = 4  # views for each core, from which on views alone keep all cores busy


def refine_depth(
    views: Iterable[TrainingView],
    points: ScenePoints,
    source: str,
    options: MultiViewConfig = MultiViewConfig(),
    stereo: StereoConfig = StereoConfig(),
    interpolation: InterpolationConfig = InterpolationConfig(),
    width: int = 0,
    device: str = "cpu",
    progress: StageProgress = StageProgress(),
    motion: TissueMotion | None = None,
) -> list[TrainingView]:
    """The views, without right images, with their depth prior corrected by scene points and by what neighbouring views show.

    A view's image is predicted from each neighbour's with the view's depth; the optical flow between prediction and
    image, along the direction in which depth moves a pixel, is a correction of inverse depth that is the more precise the
    farther apart the views are. Corrections and prior are averaged by their precision; where there is none, that of
    the surroundings counts; what ripples are left within edges is smoothed. Before it, the prior of matching with a view's
    right image is corrected likewise by that image. Reflections of the light count between the eyes alone. Holes stay holes.

    Args:
        views: Views with a depth prior; if only an iterator holds them, full-size colours are let go of first, depth once corrected.
        points: Scene points.
        source: Where the prior is from, as `depth_source` tells, on which its error depends.
        options: Errors, and what flow to believe.
        stereo: How right images were matched.
        interpolation: How holes are filled, for what lies beside them.
        width: Views come back shrunk to it, pixels; 0 leaves them as they are.
        device: Where depth is smoothed.
        progress: Reported to by views.
        motion: How the tissue moves in them; points are in their mean positions. None: it is at rest, or in its mean position.
    """
    views, points_at = list(views), points.moved_by(motion)
    free = return_freed_memory if len(views) > cpu_threads() else lambda: None  # of few there is little
    prepare_smoothing(device)
    prepare_flow(device)
    near, priors = nearest_views(views, options.neighbours), [view.depth_prior for view in views]
    pairs: list[tuple[EyeImage, EyeImage, float] | None] = [None] * len(views)

    def look(i: int) -> EyeImage:
        free()  # what the view before took
        view, image = views[i], eye_image(views[i], options)
        if source == "stereo" and view.right is not None:
            assert view.baseline is not None
            right = right_view(view, stereo)
            # Between the eyes reflections hardly move.
            pairs[i] = image.with_matte(view.tissue), eye_image(right, options).with_matte(right.tissue), view.baseline
        view = dataclasses.replace(view, depth_prior=None, right=None, right_K=None, baseline=None)
        views[i] = shrink(view, width) if width else view  # grey images are all that is needed of the full size, and of the other eye
        return image

    images = progress.map(look, range(len(views)))

    def corrected(i: int) -> np.ndarray | None:
        prior, pair, camera = priors[i], pairs[i], images[i].camera
        priors[i] = pairs[i] = None
        if prior is None or not (prior > 0).any():
            return prior
        known = prior > 0
        inverse = (known / np.where(known, prior, 1)).astype(np.float32)[..., None]
        inverse = inverse_distance_weighted(inverse, known, camera.width, interpolation)[..., 0]
        error = (options.points_error if source == "points" else options.prior_error) * inverse
        if pair is not None:
            inverse, error = _refine_by_eyes(inverse, *pair, options, stereo, device)
        total, weight = _point_corrections(camera, inverse, error, points_at(views[i].stamp_ns), options)
        given = torch.from_numpy(inverse).to(device, torch.float32)
        ways = motion and motion.ways_from(camera, 1 / inverse.clip(1e-3), views[i].stamp_ns)

        def told_by(j: int) -> FlowCorrection | None:
            progress.check()
            return flow_correction(given, images[i], images[j], options, ways and ways(views[j].stamp_ns))

        of_views = torch.zeros(2, *given.shape, device=device)
        for found in several(told_by, near[i]):
            if found is not None:
                of_views += torch.stack([found.precision * found.correction, found.precision])
        total, weight = np.stack([total, weight]) + of_views.cpu().numpy()
        inverse = correct(inverse, total, weight, error, options.continuation, options.max_correction)
        inverse = smooth(inverse, options.smoothing, options.edge, device)
        good = known & np.isfinite(inverse) & (inverse > 0)
        return np.where(good, 1 / np.where(good, inverse, 1), 0).astype(np.float32)

    def refine(i: int) -> None:
        free()
        depth, camera = corrected(i), views[i].camera
        depth = None if depth is None else resized_depth(depth, camera.width, camera.height)
        views[i] = dataclasses.replace(views[i], depth_prior=depth)

    with ThreadPoolExecutor(cpu_threads(), "endo_sim") as neighbours:
        # Few views leave cores idle; of many, several neighbours at a time would only take memory.
        several = neighbours.map if len(views) < _MANY * cpu_threads() else map
        progress.map(refine, range(len(views)))
    return views


def _refine_by_eyes(
    inverse: np.ndarray,
    left: EyeImage,
    right: EyeImage,
    baseline: float,
    options: MultiViewConfig,
    stereo: StereoConfig,
    device: str,
) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth [H, W] (1/m) of matching, corrected by the flow that it leaves between the eyes, and its error [H, W].

    Semi-global matching prefers whole pixels and goes in steps; optical flow does neither, but errs wildly where there is little to
    see.
    """
    pixel = left.camera.K[0, 0] * baseline  # a disparity of one pixel is 1 / pixel
    width, matched = left.camera.width, np.full(inverse.shape, stereo.disparity_error / pixel, np.float32)
    inverse = smooth(inverse, options.matched_window, options.matched_edge, device)
    found = flow_correction(torch.from_numpy(inverse).to(device, torch.float32), left, right, options)
    if found is None:
        return inverse, matched
    correction, precision = (part.cpu().numpy() for part in found)
    precision = np.where(np.abs(correction) * pixel < scaled(options.max_step, width), precision, 0)
    correction = np.where(precision > 0, correction, 0)
    corrected = correct(inverse, precision * correction, precision, matched, options.continuation, options.max_correction)
    # Where flow tells nothing, far and wide, the error stays that of matching.
    share = np.minimum(2 * blur(precision > 0, options.continuation, width), 1)
    error = (stereo.disparity_error + (options.refined_disparity_error - stereo.disparity_error) * share) / pixel
    return smooth(corrected, options.smoothing, options.eyes_edge, device), error


def _point_corrections(
    camera: Camera, inverse: np.ndarray, error: np.ndarray, points: ScenePoints, options: MultiViewConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Σ precision × correction and Σ precision [H, W] of inverse depth [H, W] (1/m) of an error [H, W] by the scene points around.

    Some points are wrong, more than their own error tells: they count the less (Cauchy) the more their depth and the prior disagree.
    """
    total, weight = np.zeros(inverse.shape, np.float32), np.zeros(inverse.shape, np.float32)
    if len(points.positions):
        index, v, u, z = pixels_of(camera, points.positions)
        there = inverse[v, u]
        correction = 1 / z - there
        near = np.abs(correction) < options.max_correction * there
        u, v, there, correction = u[near], v[near], there[near], correction[near]
        precision = 1 / (np.broadcast_to(points.error, len(points.positions))[index][near] * there) ** 2
        precision /= 1 + (correction / (options.doubt * error[v, u])) ** 2
        np.add.at(total, (v, u), precision * correction)
        np.add.at(weight, (v, u), precision)
        side = 2 * round(scaled(options.point_window, camera.width) / 2) + 1
        total, weight = (cv2.boxFilter(array, -1, (side, side), normalize=False) for array in (total, weight))
    return total, weight
