"""Every stage of the preparation reports its progress, and stops when it is cancelled."""

import dataclasses
import platform
import threading

import numpy as np
import pytest
from short_training import options
from thorough import mostly_thorough
from training_views import with_prior

from endo_sim_ros.evaluation.measurement import status_kilobytes
from endo_sim_ros.reconstruction.dynamic_mask import mask_motion
from endo_sim_ros.reconstruction.pipeline import STAGES
from endo_sim_ros.reconstruction.priors.multi_view import refine_depth
from endo_sim_ros.reconstruction.priors.sources import estimate_depth
from endo_sim_ros.reconstruction.progress import Cancelled, StageProgress
from endo_sim_ros.reconstruction.scene import PreparedScene, ScenePoints

POINTS = np.random.default_rng(0).uniform([-0.03, -0.03, 0.09], [0.03, 0.03, 0.11], (400, 3))
SCENE_POINTS = ScenePoints(POINTS, np.full((400, 3), 0.5))
QUICK = ("shrinking views", "training size")  # stages that need not report


@pytest.fixture(scope="module")
def given(small):
    """Options, and the scenes that each stage is given: with right images, and without."""
    cases = []
    tried = {"training.min_gaussians": 2000, "capacity.iterations": 20, "capacity.share": 1.0}
    for source in ("stereo", "points"):
        config, scene, scenes = options(depth=source, max_gaussians=0).replaced(tried), PreparedScene(tuple(small[::4])), {}
        for name, stage in STAGES.items():
            scenes[name] = scene
            scene = stage(scene, config, StageProgress())
        cases.append((config, scenes))
    return cases


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly_thorough((name for name in STAGES if name not in QUICK), 6))
def test_a_stage_reports_and_can_be_cancelled_at_any_report(given, name):
    counts = []
    for config, scenes in given:
        reports = []
        STAGES[name](scenes[name], config, StageProgress(name, lambda *report: reports.append(report)))
        assert {stage for stage, _, _ in reports} <= {name}
        assert all(0 <= done <= total or total == 0 for _, done, total in reports)
        # At the first report, and at the first of the second half of the work: how many there are differs from run to run.
        for share in (0, 0.5) if reports else ():

            def cancel(_, done, total):
                if done >= share * total:
                    raise Cancelled

            with pytest.raises(Cancelled):
                STAGES[name](scenes[name], config, StageProgress(name, cancel))
        STAGES[name](scenes[name], config, StageProgress())  # one that was cancelled leaves nothing behind
        counts.append(len(reports))
    assert any(counts)


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


@pytest.mark.slow
def test_a_stage_leaves_the_views_it_is_given_as_they_are(small):
    views = with_prior(small[:3])
    before = [{name: np.copy(getattr(view, name)) for name in ("image", "depth_prior", "mask")} for view in views]
    refine_depth(views, SCENE_POINTS, "network")
    mask_motion(views, 0.05)
    estimate_depth([dataclasses.replace(view, depth=view.depth_prior) for view in views], SCENE_POINTS, options(depth="topic"))
    for view, arrays in zip(views, before):
        assert all((getattr(view, name) == value).all() for name, value in arrays.items())


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs glibc on Linux")
def test_threads_leave_no_freed_memory_behind(monkeypatch):
    monkeypatch.setenv("ENDO_SIM_THREADS", "2")

    def last(_) -> np.ndarray:  # after 20 MB, which it keeps from being given back by themselves
        return [np.ones(100_000, np.uint8) for _ in range(200)][-1]

    before = status_kilobytes("VmRSS")
    kept = StageProgress().map(last, range(4))
    assert len(kept) == 4 and status_kilobytes("VmRSS") - before < 10_000
