"""From posed frames to a scene that can be trained on, by named stages.

Every stage is a function of a scene, the options and a `StageProgress`; it returns a scene, and does nothing where the options or the
recording do not ask for it. Inside, a stage gives the algorithm views, its own options and the progress to report to.
"""

import logging
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from endo_sim_ros.core.cameras import invert_pose
from endo_sim_ros.core.config import unused_options
from endo_sim_ros.core.device import pick_device
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.tissue_motion import TissueMotion
from endo_sim_ros.core.words import counted
from endo_sim_ros.reconstruction import photometry
from endo_sim_ros.reconstruction.camera_errors import CameraErrors, change_of, displacement
from endo_sim_ros.reconstruction.capacity_trial import choose_capacity, choose_start, stripped_of_depth
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.dynamic_mask import mask_motion
from endo_sim_ros.reconstruction.gloss import start_films, start_gloss
from endo_sim_ros.reconstruction.initialization import guessed_depth, initial_model, rough_depth
from endo_sim_ros.reconstruction.keyframes import USUAL_DEPTH
from endo_sim_ros.reconstruction.lens_calibration import calibrated_lens
from endo_sim_ros.reconstruction.pose_check import misposed
from endo_sim_ros.reconstruction.pose_correction import CorrectedPoses, corrected_poses
from endo_sim_ros.reconstruction.priors.extrapolation import SeenTissue, brightness_ratio, extrapolate, light_ratio
from endo_sim_ros.reconstruction.priors.multi_view import refine_depth
from endo_sim_ros.reconstruction.priors.plane_sweep import sweep_depth
from endo_sim_ros.reconstruction.priors.sources import borrow_depth, depth_source, estimate_depth
from endo_sim_ros.reconstruction.priors.stereo import of_other_moments, right_view, row_shifts
from endo_sim_ros.reconstruction.progress import OnProgress, StageProgress
from endo_sim_ros.reconstruction.scene import PreparedScene, ScenePoints, TrainingView, resized_depth, shrink, unusable, useless_right
from endo_sim_ros.reconstruction.stage_configs import PhotometryConfig
from endo_sim_ros.reconstruction.still_frames import stilled, unstilled
from endo_sim_ros.reconstruction.trainer import Trainer
from endo_sim_ros.reconstruction.triangulation import match_features, points_in_view, recorded_scale, triangulate

log = logging.getLogger(__name__)
_DEPTHS = 1_000_000  # of Gaussians in views, whose median is that of the scene
_NEAREST, _FARTHEST = 0.002, 1.0  # m; no endoscope sees nearer or farther, and nothing nearer than 1 mm is drawn
_MOST_TILTED = 1.0  # tilt of the light; of a lamp that stands aside by as much as the tissue is away it is 0.9
_MOSTLY_KNOWN = 0.5  # share of the tissue; where depth of less is known users are warned
_ALONE = {"right": None, "baseline": None, "right_K": None}  # of a view without the other eye
_WHATEVER = 1e6  # of most_turning: reflections whatever views show
_FEWEST_VIEWS = 3  # of two views, a pixel left out of one is seen by the other alone, and any depth fits it


def prepare(
    frames: Iterable[Frame],
    config: ReconstructionConfig,
    points: ScenePoints | tuple | None = None,
    on_progress: OnProgress | None = None,
    motion: TissueMotion | None = None,
    without_depth: bool | None = None,
) -> PreparedScene:
    """Everything that a training needs, of posed frames.

    Args:
        frames: Training views; every one is used (see `select_keyframes`). Of many large ones give an iterator: it does not hold them
            longer than they are needed.
        config: Options.
        points: Scene points: positions [N, 3] (m, world), RGB [N, 3] in [0, 1] and, if known, error (see `ScenePoints`), for
            instance of structure from motion with more views than these; None triangulates these views.
        on_progress: Called as ``on_progress(stage, done, total)``, several times a second and from several threads; it cancels by
            raising `Cancelled`.
        motion: How the tissue moves by itself (see `MotionWatch`), which is undone in the frames. None: it is at rest.
        without_depth: Whether the training has no depth that one lens tells, as its checkpoint says. None: a trial decides.

    Raises:
        SequenceError: If there are no views, all pixels are masked or white, or scene points that are given are not finite.
        Cancelled: If the callback raised it.
    """
    scene = PreparedScene(tuple(shrink(frame, config.widest) for frame in frames), motion=motion, without_depth=without_depth)
    scene = _without_useless_rights(scene, config, StageProgress("usable views", on_progress))
    if points is not None:
        scene = replace(scene, points=_checked(points), given_points=True)
    if not scene.frames:
        raise SequenceError("there are no views to reconstruct from; check the image, camera_info and pose topics")
    if motion is not None:
        scene, motion = _by_poses_of(motion, scene, config)
        scene = _stilled(scene, motion, config, StageProgress("depth prior", on_progress))
    handed_over = [scene]
    del scene  # a stage lets go of what it replaces
    for name, stage in STAGES.items():
        progress = StageProgress(name, on_progress)
        progress.check()
        handed_over.append(stage(handed_over.pop(), config, progress))
    scene = handed_over.pop()
    if motion is None:
        return scene
    views = tuple(at_their_time(view, scene.recorded[view.stamp_ns], motion) for view in scene.views)
    return replace(scene, views=views, recorded={}, still_depth={})


def at_their_time(view: TrainingView, recorded: TrainingView, motion: TissueMotion) -> TrainingView:
    """A view of tissue in its mean position with the image that was recorded, and depth prior and mask as they were then."""
    prior, mask = unstilled(view.camera, view.depth_prior, view.mask, view.stamp_ns, motion)
    if mask is not None and recorded.mask is not None:
        mask = np.minimum(mask, recorded.mask)
    prior = prior if recorded.depth_prior is None else recorded.depth_prior
    return replace(view, image=recorded.image, depth_prior=prior, mask=mask, paths=motion.paths(view.stamp_ns))


def reconstruct(
    frames: Iterable[Frame],
    config: ReconstructionConfig,
    points: ScenePoints | tuple | None = None,
    on_progress: OnProgress | None = None,
    motion: TissueMotion | None = None,
) -> GaussianModel:
    """The trained model of posed frames; `prepare` and `Trainer` in one. Arguments and errors are those of `prepare`.

    Of a motion that is given, training learns a better one; take a `Trainer` to get that, too (`Trainer.motion`).
    """
    for text in unused_options(config):
        log.warning(text)
    trainer = Trainer(prepare(frames, config, points, on_progress, motion), config)
    return trainer.run(on_progress and (lambda progress: on_progress("training", progress.iteration, progress.iterations)))


# ------------------------------------------------------------------------------------------------------------- stages


def select_usable(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Leave out views that show no tissue: those masked whole, mostly white, black, or of one colour."""
    kept, out = [], {}
    for frame, reason in zip(scene.frames, progress.map(lambda frame: unusable(frame, config.views), scene.frames)):
        (out.setdefault(reason, []) if reason else kept).append(frame)
    if not kept:
        advice = {
            "masked": "every pixel of every view is masked; a mask has 255 where there is tissue, and black pictures are masked whole",
            "overexposed": "every view is overexposed; lower the light or the camera's exposure",
            "black": "every view is black; switch on the light, or check the camera",
            "of one colour": "every view is of one colour; check the cable of the camera, and the recorder",
        }
        raise SequenceError(advice[max(out, key=lambda reason: len(out[reason]))])
    for reason, frames in out.items():
        scene = scene.decided(f"{_named(frames)} left out: {reason}")
    return _of_frames(scene, kept)


def _without_useless_rights(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """The scene without right images that tell no depth: matched, they would tell a wrong one."""
    scene = _without_rights(scene, progress.map(lambda frame: useless_right(frame, config.views), scene.frames))
    moments = of_other_moments(scene.frames, config.stereo, config.matching, progress)
    return _without_rights(scene, ["of other moments than the left ones, or not rectified: rows are apart" * other for other in moments])


def _without_rights(scene: PreparedScene, reasons: Sequence[str]) -> PreparedScene:
    """The scene without the right images that there is a reason against, and told so."""
    for reason in sorted(set(reasons) - {""}):
        scene = scene.decided(
            f"THE RIGHT IMAGES of {counted(reasons.count(reason), 'view')} are {reason}, and left out; look at a pair of images"
        )
    frames = tuple(replace(frame, **_ALONE) if reason else frame for frame, reason in zip(scene.frames, reasons))
    return replace(scene, frames=frames)


def match_views(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Match features between near views."""
    return replace(scene, matches=tuple(match_features(scene.frames, config.matching, progress)))


def calibrate_lens(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """See the views through the lens that features tell, where the recorded one is wrong.

    Not of moving tissue, whose features were moved back to rest by the lens as recorded.
    """
    if not config.lens.correct or scene.motion is not None:
        return scene
    found = calibrated_lens(scene.frames, scene.matches, config.lens, config.poses, config.matching, progress)
    if found is None:
        return scene
    lens, recorded = found.error, scene.frames[0].camera
    fx, fy = lens.focal * recorded.K[0, 0], lens.focal * lens.aspect * recorded.K[1, 1]
    told = f"focal lengths {lens.focal:.3f} times as long as recorded (fx, fy = {fx:.5g}, {fy:.5g} in pictures {recorded.width} wide)"
    if lens.right or lens.down:
        cx, cy = recorded.K[:2, 2] + np.array([lens.right, lens.down]) * recorded.K.diagonal()[:2]
        told += f", a principal point of cx, cy = {cx:.5g}, {cy:.5g} there"
    if lens.division:
        told += " and a distortion of k1, k2 = {:.3f}, {:.3f} as OpenCV has them".format(*lens.coefficients(recorded))
    given = "; scene points are those of these views alone" if scene.given_points else ""
    scene = replace(scene, given_points=False, camera_errors=CameraErrors(lens=lens))
    scene = _of_frames(scene, progress.map(lens.straight, scene.frames))
    return match_views(scene, config, progress).decided(
        f"THE LENS IS NOT AS RECORDED, or poses are all off alike: features of a view lie {found.before:.2g} pixels beside where the "
        f"other views have them. Training takes {told}, which leave {found.after:.2g} pixels{given}; calibrate the lens, or correct its "
        "recorded intrinsics"
    )


def correct_poses(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Move all cameras to where the features that they share say, if poses are off."""
    told = scene.camera_errors.mount.any()
    by_features = lambda start: corrected_poses(start.frames, start.matches, config.poses, config.matching, progress)
    start, found = scene, None
    if told:  # features tell it better once the breath is out of their way
        start = _by_recorded_poses(scene)
        found = by_features(start)
    if config.poses.correct and (found is None or not found.errors.mount.any()):
        start, found = scene, by_features(scene)
    if found is not None:
        scene = _with_poses(start, found, config, progress)
    elif told and scene.motion is not None:
        distance = rough_depth(scene.views, scene.motion.points)
        scene = scene.decided(
            "POSES ARE ALL OFF alike: by those as recorded the tissue breathes irregularly. "
            f"Training takes poses that {scene.camera_errors.told(distance)}; told beside a breath, these numbers are rough"
        )
    recorded = {stamp: shrink(replace(view, **_ALONE), config.image_width) for stamp, view in scene.recorded.items()}
    return replace(scene, recorded=recorded)


def _with_poses(scene: PreparedScene, found: CorrectedPoses, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """The scene with cameras where features have them, and told so."""
    errors, matches, motion = found.errors, scene.matches, scene.motion
    given = "; scene points are those of these views alone" if scene.given_points else ""
    there = lambda frame: replace(frame, camera=errors.corrected(frame.camera, frame.stamp_ns))
    scene = replace(scene, given_points=False, camera_errors=errors.after(scene.camera_errors))
    if motion is not None and scene.still_depth:  # views told it together, by poses that were off
        scene = _of_frames(scene, [there(scene.recorded[frame.stamp_ns]) for frame in scene.frames])
        scene = match_views(_stilled(scene, motion, config, progress), config, progress)
    else:
        scene = replace(_of_frames(scene, [there(frame) for frame in scene.frames]), matches=matches)
    return scene.decided(
        f"POSES ARE OFF, or all the tissue moves: features lie {found.before:.1f} pixels beside where right poses would have them at rest. "
        f"Training takes poses that {scene.camera_errors.told(found.distance)}. This leaves {found.after:.1f} pixels{given}"
    )


def _by_poses_of(motion: TissueMotion, scene: PreparedScene, config: ReconstructionConfig) -> tuple[PreparedScene, TissueMotion]:
    """The scene with the poses by which a motion was told, unless they are to stay, and that motion."""
    if motion.lens is None or not config.poses.correct:
        return replace(scene, motion=replace(motion, lens=None)), replace(motion, lens=None)
    errors, motion = CameraErrors(mount=change_of(motion.lens)), replace(motion, lens=None)
    frames = [replace(frame, camera=errors.corrected(frame.camera, frame.stamp_ns)) for frame in scene.frames]
    return replace(_of_frames(scene, frames), motion=motion, camera_errors=errors), motion


def _by_recorded_poses(scene: PreparedScene) -> PreparedScene:
    """The scene without the change of all poses by which its motion was told."""
    back = invert_pose(displacement(scene.camera_errors.mount))
    there = lambda view: replace(view, camera=view.camera.at(view.camera.pose @ back))
    scene = replace(scene, camera_errors=replace(scene.camera_errors, mount=np.zeros(6)))
    scene = replace(scene, recorded={stamp: there(view) for stamp, view in scene.recorded.items()})
    return replace(_of_frames(scene, [there(frame) for frame in scene.frames]), matches=scene.matches)


def check_poses(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Leave out views whose poses contradict the others, by their matches and by measured depth if there is any.

    With pairs of images, `check_poses_by_stereo` does this later: their depth tells more. Recorded depth of another scale than the poses
    takes theirs.
    """
    scene = _at_scale_of_poses(scene, config)
    if _checked_by_stereo(scene, config):
        return scene
    while wrong := _misposed(scene, [frame.depth for frame in scene.frames], config, progress):
        scene = match_views(_without(scene, wrong), config, progress)
    return scene


def _at_scale_of_poses(scene: PreparedScene, config: ReconstructionConfig) -> PreparedScene:
    """The scene with recorded depth that fits its poses: of another scale, it would have views left out and tear the surface."""
    scale = recorded_scale(scene.frames, scene.matches, config.matching) if depth_source(scene.frames, config) == "topic" else 1.0
    if scale == 1.0:
        return scene
    frames = [frame if frame.depth is None else replace(frame, depth=frame.depth / np.float32(scale)) for frame in scene.frames]
    scene = replace(_of_frames(scene, frames), matches=scene.matches)
    return scene.decided(
        f"RECORDED DEPTH IS {scale:.3g} TIMES what poses and views say: it is divided by that; correct its unit, or the scale of the poses"
    )


def find_points(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Triangulate scene points, unless they are given."""
    if not scene.given_points:
        scene = replace(scene, points=triangulate(scene.frames, scene.matches, config.matching, progress))
    return _told_if_far_or_near(scene, "SCENE POINTS ARE", rough_depth(scene.views, scene.points.positions))


def find_depth(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Give each view its depth prior, and a right image that is rectified well."""
    source = depth_source(scene.frames, config)
    if config.depth == "network_first" and source != "network" and scene.depth_source == "none":  # else it has been said
        scene = scene.decided(
            f"DEPTH IS NOT AS PUBLISHED: the method takes it from a network, and no checkpoint of one is here, so it is from {source}; "
            "give one as depth_model"
        )
    if scene.still_depth:
        found = [replace(view, depth_prior=scene.still_depth[view.stamp_ns]) for view in scene.views]
    else:
        found = estimate_depth(scene.views, scene.points, config, progress)
        if source == "stereo" and (scale := _scale_of_pairs(scene, found, config)) != 1:
            nearer = lambda some: tuple(replace(each, baseline=each.baseline and each.baseline / scale) for each in some)
            scene = replace(scene, frames=nearer(scene.frames), views=nearer(scene.views)).decided(
                f"PAIRS SEE THE TISSUE {scale:.2g} TIMES AS FAR AWAY as poses and views do: the distance of the eyes is divided by that, "
                f"and the model has the scale of the poses; if the baseline is right, read the recording with scale={scale:.2g}"
            )
            found = estimate_depth(scene.views, scene.points, config, progress)
    missing = [i for i, view in enumerate(found) if view.depth_prior is None]
    if missing and source != "none":
        found = borrow_depth(found, config)
        borrowed = [found[i] for i in missing if found[i].depth_prior is not None]
        if borrowed:
            scene = scene.decided(f"depth of the other views is taken where a view has none of its own: {_named(borrowed)}")
    scene = replace(scene, views=tuple(found), depth_source=source)
    nothing = all(view.depth_prior is None for view in found)
    if nothing or scene.depth_is_recorded or config.unmeasured_depth == 1 or not config.lambda_depth:
        return scene
    return scene.decided(f"depth is from {source}, not recorded: its loss has {config.unmeasured_depth:g} times its weight", logging.INFO)


def _scale_of_pairs(scene: PreparedScene, found: Sequence[TrainingView], config: ReconstructionConfig) -> float:
    """How many times as far away as poses do pairs of images see the tissue; 1 where principal points may explain it."""
    frames = [replace(frame, depth=view.depth_prior) for frame, view in zip(scene.frames, found)]
    scale = recorded_scale(frames, scene.matches, config.matching)
    return scale if max(scale, 1 / scale) > 1 + config.stereo.max_offset else 1.0


def sweep_planes(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Where no scene point is near, replace interpolated depth by what the views show on plane after plane; see `_sweep_smooth_pairs`."""
    if config.plane_sweep and scene.depth_source == "stereo":
        return _sweep_smooth_pairs(scene, config, progress)
    if not config.plane_sweep or scene.depth_source != "points" or len(scene.views) < 2:
        return scene
    options = config.depth_tolerance, config.sweep, config.matching, pick_device(config.device), progress, config.interpolation
    swept = sweep_depth(scene.views, scene.points.positions, *options)
    if max((view.surface > 0).mean() for view in swept) < config.extrapolated.min_coverage:  # stray matches are nothing to start from
        swept = [replace(view, depth_prior=None) for view in swept]
    pixels, after, other = np.sum([_depth_shares(*pair, config.depth_tolerance) for pair in zip(scene.views, swept)], 0)
    sentence = (
        f"depth is interpolated near scene points for {(after - other) / pixels:.0%} of the tissue, matched plane by plane for "
        f"{other / pixels:.0%}, and unknown for {1 - after / pixels:.0%}"
    )
    if guessed := 0 < after < _MOSTLY_KNOWN * pixels:
        sentence += ", for which it is guessed from what is around; a right image, recorded depth or views from other places would tell it"
    return replace(scene, views=tuple(swept)).decided(sentence, logging.WARNING if guessed else logging.INFO)


def check_poses_by_stereo(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """As `check_poses`, with the depth that each view's own pair of images tells, which does not depend on the poses.

    Frames as recorded are not needed after it, and let go of.
    """
    while _checked_by_stereo(scene, config):
        wrong = _misposed(scene, [view.depth_prior for view in scene.views], config, progress)
        if not wrong:
            break
        scene = _without(scene, wrong)
        # `_without` has dropped matches, points and depth. Every stage that finds them runs again, and `check_poses` if no pair is left.
        for stage in (match_views, check_poses, find_points, find_depth, sweep_planes):
            scene = stage(scene, config, progress)
    return replace(scene, frames=())


def refine_across_views(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Correct the depth prior by scene points and the other images of the same tissue."""
    if not config.multi_view_refinement or scene.depth_source in ("topic", "none"):
        return scene
    if scene.still_depth:  # it was corrected before
        return replace(scene, views=tuple(replace(view, **_ALONE) for view in scene.views))
    views = iter(scene.views)
    scene = replace(scene, views=())  # what holds them now is the iterator
    return replace(scene, views=tuple(_refined(views, scene, scene.depth_source, config.image_width, config, progress)))


def shrink_views(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Bring the views to the width that is trained on."""
    return replace(scene, views=tuple(shrink(view, config.image_width) for view in scene.views))


def mask_dynamic(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Mask what moved between the views."""
    if not config.dynamic_mask:
        return scene
    return replace(scene, views=tuple(mask_motion(scene.views, config.depth_tolerance, config.motion, progress)))


def size_training(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Decide how long to train and with how many Gaussians, where the options leave it to the views."""
    size, views = config.training, len(scene.views)
    pixels = sum(int((view.tissue > 0).sum()) for view in scene.views)
    within = lambda value, least, most: int(min(max(value, least), most))
    iterations = config.iterations or within(size.iterations_per_view * views, size.min_iterations, size.max_iterations)
    least = min(size.min_gaussians, max(pixels / size.least_pixels, 1))
    most = config.max_gaussians or within(pixels / size.pixels_per_gaussian, least, size.max_gaussians)
    scene = replace(scene, iterations=iterations, max_gaussians=most)
    if config.iterations and config.max_gaussians:
        return scene
    decided = f"{counted(iterations, 'iteration')}, {counted(most, 'Gaussian')} at most"
    return scene.decided(f"{counted(views, 'view')} of {pixels / 1e6:.3g} million pixels: {decided}", logging.INFO)


def place_gaussians(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """As `_placed`, and tell where depth that no scene point told is beyond an endoscope's."""
    placed = _placed(scene, config, progress)
    of_points = rough_depth(scene.views, scene.points.positions)
    if of_points < _NEAREST or of_points > _FARTHEST:  # it has been said
        return placed
    return _told_if_far_or_near(placed, "THE TISSUE IS", placed.depth)


def _placed(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Set `model` to the Gaussians that training starts from, `depth` to their median depth in the views, and `exposures` to zeros."""
    views, points = list(scene.views), scene.points
    fewest = config.matching.min_points
    if len(points.positions) >= fewest and (config.initialization == "points" or scene.depth_source == "none"):
        views = [replace(view, depth_prior=None) for view in views]
    elif sum(int((view.surface > 0).sum()) for view in views) < fewest:  # pixels
        scene, depths = _made_up_depths(scene, config)
        views = [replace(view, depth_prior=depth) for view, depth in zip(views, depths)]
    elif config.initialization == "points":
        scene = scene.decided(
            f"only {counted(len(points.positions), 'scene point')} could be found: training starts from the depth of the views"
        )
    model = initial_model(
        views,
        points.positions,
        points.colors,
        tolerance=config.depth_tolerance,
        max_gaussians=scene.max_gaussians,
        sh_degree=config.sh_degree,
        options=config.initial,
        progress=progress,
        device=pick_device(config.device),
        share=config.initial.seen_share if config.extrapolation else 1.0,
    )
    # Of many views some Gaussians tell the depth, as all of them in all views would take gigabytes.
    positions = model.means[:: math.ceil(len(model) * len(views) / _DEPTHS)].numpy().astype(np.float64)
    depths = np.concatenate(progress.map(lambda view: view.camera.project(positions)[1], views))
    return replace(scene, model=model, depth=float(np.median(depths[depths > 0])), exposures=np.zeros((len(views), 3)))


def fit_light(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Find the camera's tone curve, fit the light and each view's exposure, and take all three out of the Gaussians' colours."""
    if not (config.light or config.exposure):
        return scene
    shoulder = photometry.find_shoulder(scene.views, *_start_surface(scene, config), progress)
    scene = replace(scene, views=tuple(replace(view, shoulder=shoulder) for view in scene.views))
    if shoulder != config.photometry.shoulder:
        what = f"the camera's tone curve begins to flatten {shoulder:g} below white" if shoulder else "the camera clips at white"
        scene = scene.decided(f"{what}: with that, views agree best", logging.INFO)
    return _lit(scene, config, progress)


def _start_surface(scene: PreparedScene, config: ReconstructionConfig) -> tuple[np.ndarray, float, float, PhotometryConfig]:
    """What photometry compares views by: points, the distance at which colours are their own, the tolerance of depth, and its options."""
    return scene.model.means.numpy().astype(np.float64), scene.depth, config.depth_tolerance, config.photometry


def _lit(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """The scene with its light and exposures, as far as the options ask for them, which are taken out of the Gaussians' colours."""
    if not (config.light or config.exposure):
        return _without_light(scene, config, progress)
    surface = _start_surface(scene, config)
    fit = lambda light: photometry.fit_light(scene.views, *surface, light=light, exposure=config.exposure, progress=progress)
    chosen = fit(config.light)
    if config.light and len(scene.views) > 1:
        none, wrong = fit(False), ""
        # Where scene points or a recording tell depth, such light is true: a lens that looks past the middle of its picture makes it.
        told = scene.depth_is_recorded or len(scene.points.positions) >= config.matching.min_points
        if np.abs(chosen.light[2:]).max() > _MOST_TILTED and not told:
            wrong = "its lamp would stand farther aside than the tissue is away, and no scene point tells depth"
        else:
            ratio = light_ratio(_seen(replace(scene, light=chosen.light, exposures=chosen.exposures), config, progress), *none[:2])
            compared = f"in it, views differ {ratio:.2f} times as much in colour as in none"
            if not math.isfinite(ratio):
                sentence = "light is taken as it was fitted and not compared with none: views share too little tissue of known depth"
                scene = scene.decided(sentence, logging.INFO)
            elif ratio > 1:
                wrong = compared
            else:
                scene = scene.decided(f"training starts with the light as it was fitted: {compared}", logging.INFO)
        if wrong:
            scene = scene.decided(f"training starts without light; what explains known depth best is not taken: {wrong}", logging.INFO)
            chosen = none
    if chosen.fixed:
        scene = scene.decided("the exposure of the camera is fixed: that of each view by itself explains next to no more", logging.INFO)
    scene = replace(scene, light=chosen.light, exposures=chosen.exposures, fixed_exposure=chosen.fixed)
    return _without_light(scene, config, progress)


def try_capacity(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Let a trial tell whether fewer Gaussians do better, where the views are so few that their pixels do not."""
    if scene.without_depth is not None:  # a training that goes on, by what was decided then
        return scene
    size, pixels = config.training, sum(int((view.tissue > 0).sum()) for view in scene.views)
    if config.max_gaussians or not config.capacity.iterations or pixels > size.min_gaussians * size.pixels_per_gaussian:
        return scene
    start = lambda other: _restarted(other, scene, config, progress)
    chosen = choose_capacity(scene, config, start, progress)
    return chosen if chosen.max_gaussians == scene.max_gaussians else start(chosen)


def try_points(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Let a trial tell whether training does better from scene points alone than with the depth that one lens tells between them."""
    too_little = len(scene.views) < _FEWEST_VIEWS or len(scene.points.positions) < config.matching.min_points
    wanted = config.capacity.iterations and config.capacity.without_depth and config.initialization != "points"
    silent = StageProgress("", lambda *_: progress.check())
    start = lambda other: extrapolate_tissue(_restarted(other, scene, config, progress), config, silent)
    if scene.without_depth:  # so it was decided when the training began
        return start(stripped_of_depth(scene))
    if scene.without_depth is not None or too_little or scene.depth_source != "points" or not wanted:
        return scene
    chosen = choose_start(scene, config, start, progress)
    return start(chosen) if chosen.without_depth else chosen


def extrapolate_tissue(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Add Gaussians in the holes of the depth prior and beyond the pictures."""
    if not config.extrapolation or scene.without_depth:  # it starts from scene points alone
        return scene
    seen = _seen(scene, config, progress)
    ratio = brightness_ratio(seen)
    told = ratio < config.extrapolated.brightness_ratio
    if math.isfinite(ratio):
        what = f"brightness {'tells' if told else 'does not tell'} depth where no point is near"
        scene = scene.decided(f"{what}: with it, views differ {ratio:.2f} times as much in colour as without", logging.INFO)
    return replace(scene, model=extrapolate(seen, config.extrapolation, scene.max_gaussians, by_brightness=told))


def _seen(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> SeenTissue:
    seen = scene.model, scene.views, scene.points.positions, scene.light, scene.exposures, scene.depth
    return SeenTissue(*seen, config.extrapolated, config.interpolation, pick_device(config.device), progress)


def add_reflections(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Let the Gaussians reflect the light."""
    if not config.reflections:
        return scene
    if config.sh_degree:
        return scene.decided(
            "nothing reflects: colours that differ with the direction (sh_degree above 0) have highlights of their own", logging.INFO
        )
    glossy = start_gloss(scene.model, [view.camera for view in scene.views], config.gloss, progress)
    seen = scene.views, scene.light, scene.depth, config.depth_tolerance
    ratio = photometry.turning_ratio(glossy, *seen, config.gloss.facing, config.photometry, progress)
    differ = f"views would differ {ratio:.2f} times as much in brightness if tissue grew darker as it turns away"
    if untold := math.isnan(ratio):
        differ = "whether it does cannot be told where views share no tissue of known depth"
    # What one view shows at one place is as well its colour, and other views find fewer faults with that.
    if ratio > config.gloss.most_turning or untold and config.gloss.most_turning < _WHATEVER:
        return scene.decided(f"nothing reflects: {differ}", logging.INFO)
    model = start_films(glossy, _unlit_colors(scene, "cpu", config, progress), config.multi_view.reflection, config.gloss)
    assert model.gloss is not None and glossy.gloss is not None
    count = int((model.gloss != glossy.gloss).any(1).sum())
    sentence = f"tissue may reflect: {differ}; films of {counted(count, 'Gaussian')} face the lens, where views show highlights"
    return replace(scene, model=model).decided(sentence, logging.INFO)


STAGES: dict[str, Callable[[PreparedScene, ReconstructionConfig, StageProgress], PreparedScene]] = {
    "usable views": select_usable,
    "matching features": match_views,
    "calibrating the lens": calibrate_lens,
    "correcting poses": correct_poses,
    "checking poses": check_poses,
    "scene points": find_points,
    "depth prior": find_depth,
    "plane sweep": sweep_planes,
    "checking poses by stereo": check_poses_by_stereo,
    "multi-view refinement": refine_across_views,
    "shrinking views": shrink_views,
    "dynamic mask": mask_dynamic,
    "training size": size_training,
    "initial model": place_gaussians,
    "photometry": fit_light,
    "capacity trial": try_capacity,
    "trial without depth": try_points,
    "extrapolation": extrapolate_tissue,
    "reflections": add_reflections,
}
"""What `prepare` does, in this order, by the names that progress reports."""


# ------------------------------------------------------------------------------------------------------------ helpers


def _checked(given: tuple[Any, ...]) -> ScenePoints:
    """Scene points that somebody gave."""
    points = ScenePoints(*given)
    shape, error = np.shape(points.positions), np.asarray(points.error)
    if len(shape) != 2 or shape[1] != 3 or np.shape(points.colors) != shape or error.shape not in ((), shape[:1]):
        raise SequenceError("scene points: give positions and colours as arrays [N, 3], and errors [N] or one for all")
    if not (np.isfinite(points.positions).all() and np.isfinite(points.colors).all()):
        raise SequenceError("scene points: some positions or colours are not finite; leave those out")
    if not (np.isfinite(error) & (error > 0)).all():
        raise SequenceError("scene points: errors are relative and above zero; leave points without one out")
    return points


def _stilled(scene: PreparedScene, motion: TissueMotion, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """The scene with the tissue in its mean position, of frames that were recorded.

    What pairs of images tell is told before, as each shows the tissue at one time: warped, they would be apart by some tenths of a pixel
    more, which are millimetres of depth.
    """
    views = [TrainingView.of(frame) for frame in scene.frames]
    paired = depth_source(views, config) == "stereo"
    frames, depths, recorded = [], {}, {}
    told = views
    if paired:
        told = estimate_depth(views, scene.points, config, progress, motion)
        if config.multi_view_refinement:
            told = _refined(iter(told), scene, "stereo", 0, config, progress, motion)
    for view, depth in zip(views, [each.depth_prior for each in told]):
        if depth is not None:
            depth = resized_depth(depth, view.camera.width, view.camera.height)
        still = stilled(replace(view, depth=depth) if paired else view, motion, depth)
        depths[view.stamp_ns] = still.depth
        frames.append(replace(still, depth=None) if paired else still)
        recorded[view.stamp_ns] = replace(view, depth=None, depth_prior=depth)
    return replace(_of_frames(scene, frames), still_depth=depths if paired else {}, recorded=recorded)


def _refined(
    views: Iterable[TrainingView],
    scene: PreparedScene,
    source: str,
    width: int,
    config: ReconstructionConfig,
    progress: StageProgress,
    motion: TissueMotion | None = None,
) -> list[TrainingView]:
    """Views whose depth is corrected by `refine_depth`, in pictures that are not finer than that needs."""
    finest = config.multi_view.width_factor * config.image_width
    options = {"options": config.multi_view, "stereo": config.stereo, "interpolation": config.interpolation, "width": width}
    device = pick_device(config.device)
    return refine_depth(
        (shrink(view, finest) for view in views), scene.points, source, **options, device=device, progress=progress, motion=motion
    )


def _of_frames(scene: PreparedScene, frames: Sequence[Frame]) -> PreparedScene:
    """The scene with other frames, and nothing found in them yet."""
    views = tuple(TrainingView.of(frame) for frame in frames)
    points = scene.points if scene.given_points else ScenePoints.none()
    return replace(scene, frames=tuple(frames), views=views, matches=(), points=points)


def _without(scene: PreparedScene, wrong: Sequence[int]) -> PreparedScene:
    """The scene without the views of these indices, whose poses are wrong."""
    why = "what is shared with the others contradicts the poses, or much of the tissue moved"
    scene = scene.decided(f"{_named([scene.frames[index] for index in wrong])} left out: {why}")
    return _of_frames(scene, [frame for index, frame in enumerate(scene.frames) if index not in wrong])


def _depth_shares(view: TrainingView, swept: TrainingView, tolerance: float) -> tuple[int, int, int]:
    """Pixels of tissue, those with depth after a sweep, and those whose depth it has changed by more than that share."""
    known, apart = swept.surface > 0, np.abs(swept.surface - view.surface)
    return (view.tissue > 0).sum(), known.sum(), (known & (apart > tolerance * view.surface)).sum()


def _sweep_smooth_pairs(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """The scene, with depth of pairs whose eyes share too few features from a sweep of planes: small blocks of smooth tissue are alike.

    The other views are left out of it. In theirs the light has moved, which smooth tissue takes for a shift. There are as many planes in
    shrunk pictures as in whole ones: the eyes are so near together that tissue moves by a few of their pixels. So many are closer together.
    """
    fewest, points, views = config.matching.min_points, scene.points.positions, list(scene.views)

    def is_smooth(view: TrainingView) -> bool:
        if view.right is None or len(points_in_view(view.camera, points, config.matching)[0]) >= fewest:  # sooner told than features
            return False
        return len(row_shifts(view, config.stereo, config.matching)) < fewest

    smooth = np.flatnonzero(progress.map(is_smooth, views))
    if not len(smooth):
        return scene
    options = replace(config.sweep, min_planes=config.sweep.max_planes, same_surface=config.stereo.same_surface)
    device = pick_device(config.device)
    for index in smooth:
        left = replace(views[index], depth_prior=None)
        pair = left, TrainingView.of(right_view(left, config.stereo))
        views[index] = sweep_depth(pair, points, config.depth_tolerance, options, config.matching, device, progress)[0]
    pixels, known, _ = np.sum([_depth_shares(views[index], views[index], 0) for index in smooth], 0)
    sentence = (
        f"{len(smooth)} of {counted(len(views), 'view')} have too smooth a pair of images for block matching: they are matched plane by "
        f"plane, which gives {known / pixels:.0%} of their tissue depth"
    )
    return replace(scene, views=tuple(views)).decided(sentence, logging.INFO)


def _restarted(other: PreparedScene, scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """Another version of a scene with the Gaussians that its training starts from, in the light that was fitted, or in none."""
    silent = StageProgress("", lambda *_: progress.check())
    placed = replace(_placed(other, config, silent), depth=scene.depth)
    if other.without_depth:
        return _lit(placed, replace(config, light=False), silent)
    return _without_light(replace(placed, exposures=scene.exposures), config, silent)


def _without_light(scene: PreparedScene, config: ReconstructionConfig, progress: StageProgress) -> PreparedScene:
    """The scene with its light, exposures and tone curve taken out of the Gaussians' colours, where there are any."""
    if not (config.light or config.exposure or scene.views[0].shoulder):
        return scene
    seen = _unlit_colors(scene, pick_device(config.device), config, progress)
    return replace(scene, model=photometry.remove_light(scene.model, seen))


def _unlit_colors(scene: PreparedScene, device: str, config: ReconstructionConfig, progress: StageProgress) -> Iterable[photometry.Unlit]:
    """What the views show of the scene's Gaussians, without its light and exposures."""
    seen_in = scene.views, scene.light, scene.exposures, scene.depth, config.depth_tolerance
    return photometry.unlit_colors(scene.model.means.to(device), *seen_in, progress)


def _told_if_far_or_near(scene: PreparedScene, what: str, depth: float) -> PreparedScene:
    """The scene, with a decision if the depth (m) of something is beyond what endoscopes see, or nearer."""
    if depth > _FARTHEST:
        return scene.decided(
            f"{what} {depth:.3g} m AWAY: poses are in metres, these may be in millimetres or centimetres; endoscopes see a tenth of one"
        )
    if depth < _NEAREST:
        return scene.decided(
            f"{what} {1e3 * depth:.3g} mm AWAY: poses are in metres, and these may be in another unit; nothing nearer than 1 mm is drawn"
        )
    return scene


def _made_up_depths(scene: PreparedScene, config: ReconstructionConfig) -> tuple[PreparedScene, list[np.ndarray]]:
    """The scene, and the depths [H, W] (m) in its views that training starts from where next to no depth and few scene points are known.

    They are those of a plane before each view, and of a ball about a lens that only turns, whose planes would cut each other.
    """
    cameras, lone = [view.camera for view in scene.views], len(scene.views) == 1
    depth = rough_depth(scene.views, scene.points.positions)
    plane = lambda: [np.full((camera.height, camera.width), depth, np.float32) for camera in cameras]
    if np.isfinite(depth):
        sentence = f"no view sees enough scene points for a depth prior: training starts from a plane {depth:.3g} m away"
        return scene.decided(sentence), plane()
    depth = guessed_depth(cameras, config.initial.guessed_shift)
    if depth == USUAL_DEPTH and not lone:
        rays = [camera.backproject(np.ones((camera.height, camera.width))) - camera.position for camera in cameras]
        sentence = (
            f"NO DEPTH IS KNOWN, and none can be: the lens only turns. Training starts from a ball of {depth:.3g} m about it, which is a "
            "guess; give depth or a right image, or move the lens"
        )
        return scene.decided(sentence), [(depth / np.linalg.norm(ray, axis=-1)).astype(np.float32) for ray in rays]
    more = "or more views, from different positions" if lone else "views that overlap from different positions, or check the poses"
    sentence = (
        f"NO DEPTH IS KNOWN, neither measured nor of points that views share: training starts from a plane {depth:.3g} m away, which is a "
        f"guess; give depth or a right image, {more}"
    )
    return scene.decided(sentence), plane()


def _named(frames: Sequence[Frame]) -> str:
    return f"view{'s' * (len(frames) != 1)} at " + ", ".join(f"{frame.stamp_ns * 1e-9:.3f} s" for frame in frames)


def _misposed(
    scene: PreparedScene, depths: Sequence[np.ndarray | None], config: ReconstructionConfig, progress: StageProgress
) -> list[int]:
    return misposed(scene.frames, scene.matches, depths, options=config.poses, matching=config.matching, progress=progress)


def _checked_by_stereo(scene: PreparedScene, config: ReconstructionConfig) -> bool:
    """Whether the check of poses waits for the depth that pairs of images give."""
    paired = any(frame.right is not None for frame in scene.frames)
    return paired and config.depth in ("auto", "stereo", "network_first") and depth_source(scene.frames, config) != "network"
