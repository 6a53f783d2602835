"""Every algorithm of the preparation reports its progress, and stops when it is cancelled."""

import dataclasses
import threading

import numpy as np
import pytest
import torch
from short_training import options
from training_views import unknown, with_prior

from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.reconstruction.dynamic_mask import mask_motion
from endo_sim_ros.reconstruction.initialization import initial_model
from endo_sim_ros.reconstruction.photometry import fit_light
from endo_sim_ros.reconstruction.pose_check import misposed
from endo_sim_ros.reconstruction.priors.extrapolation import extrapolate
from endo_sim_ros.reconstruction.priors.multi_view import refine_depth
from endo_sim_ros.reconstruction.priors.sources import estimate_depth
from endo_sim_ros.reconstruction.progress import Cancelled, StageProgress
from endo_sim_ros.reconstruction.scene import Matches, ScenePoints
from endo_sim_ros.reconstruction.triangulation import match_features, triangulate

POINTS = np.random.default_rng(0).uniform([-0.03, -0.03, 0.09], [0.03, 0.03, 0.11], (400, 3))
SCENE_POINTS = ScenePoints(POINTS, np.full((400, 3), 0.5))
MATCHES = [Matches((0, 1), *np.random.default_rng(0).uniform(0, 128, (2, 60, 2)))] * 2
MODEL = GaussianModel.from_points(torch.from_numpy(POINTS).float(), torch.full((400, 3), 0.5), torch.full((400,), 1e-3), 0.5)

STAGES = {
    "matching": lambda frames, progress: match_features(frames, progress=progress),
    "triangulation": lambda frames, progress: triangulate(frames, MATCHES, progress=progress),
    "pose check": lambda frames, progress: misposed(frames, MATCHES, progress=progress),
    "stereo": lambda frames, progress: estimate_depth(unknown(frames), SCENE_POINTS, options(depth="stereo"), progress),
    "points": lambda frames, progress: estimate_depth(unknown(frames), SCENE_POINTS, options(depth="points"), progress),
    "multi-view refinement": lambda frames, progress: refine_depth(with_prior(frames), SCENE_POINTS, "network", progress=progress),
    "dynamic mask": lambda frames, progress: mask_motion(with_prior(frames), 0.05, progress=progress),
    "initial model": lambda frames, progress: initial_model(with_prior(frames), POINTS, SCENE_POINTS.colors, 0.05, 2000, progress=progress),
    "light": lambda frames, progress: fit_light(with_prior(frames), POINTS, 0.1, 0.05, progress=progress),
    "extrapolation": lambda frames, progress: extrapolate(
        MODEL, with_prior(frames), POINTS, np.zeros(4), np.zeros((len(frames), 3)), 0.1, 0.3, 4000, progress=progress
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_reports_and_can_be_cancelled_at_any_report(small, stage):
    frames, reports = list(small[:3]), []
    STAGES[stage](frames, StageProgress(stage, lambda *report: reports.append(report)))
    assert reports and {name for name, _, _ in reports} == {stage}
    assert all(0 <= done <= total or total == 0 for _, done, total in reports)
    for last in {0, len(reports) // 2}:
        seen = []

        def cancel(*report):
            seen.append(report)
            if len(seen) > last:
                raise Cancelled

        with pytest.raises(Cancelled):
            STAGES[stage](frames, StageProgress(stage, cancel))
    STAGES[stage](frames, StageProgress())  # one that was cancelled leaves nothing behind


@pytest.mark.slow
def test_nobody_waits_for_what_runs_when_the_work_is_cancelled():
    """A call of OpenCV can take seconds, and cannot be stopped."""
    running, released, ended = threading.Event(), threading.Event(), []

    def item(_):
        running.set()
        released.wait()
        ended.append(True)

    def cancel(*_):
        if running.is_set():
            raise Cancelled

    with pytest.raises(Cancelled):
        StageProgress("endless", cancel).map(item, range(3))
    assert not ended
    released.set()


def test_a_stage_leaves_the_views_it_is_given_as_they_are(small):
    views = with_prior(small[:3])
    before = [{name: np.copy(getattr(view, name)) for name in ("image", "depth_prior", "mask")} for view in views]
    refine_depth(views, SCENE_POINTS, "network")
    mask_motion(views, 0.05)
    estimate_depth([dataclasses.replace(view, depth=view.depth_prior) for view in views], SCENE_POINTS, options(depth="topic"))
    for view, arrays in zip(views, before):
        assert all((getattr(view, name) == value).all() for name, value in arrays.items())
