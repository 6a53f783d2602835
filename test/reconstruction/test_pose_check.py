"""Views whose poses contradict the others."""

import dataclasses
from itertools import combinations, islice

import cv2
import numpy as np
import pytest
from short_training import bare, options
from thorough import mostly_thorough

from endo_sim_ros.core.cameras import Camera, intrinsic_matrix, invert_pose, rigid_pose
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.reconstruction import prepare
from endo_sim_ros.reconstruction.pose_check import misposed
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import Matches
from endo_sim_ros.reconstruction.stage_configs import MatchingConfig, PosesConfig
from endo_sim_ros.reconstruction.triangulation import match_features, recorded_scale
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

QUICK = {"plane_sweep": False, "multi_view_refinement": False, "dynamic_mask": False, "extrapolation": 0.0}  # what comes after the check


@pytest.fixture(scope="module")
def large():
    """Five frames 480×384."""
    return list(phantom_sequence(PhantomConfig(width=480, height=384, frames=5, travel=0.02, stereo=False)))


FAULTS = {  # of view 2 of five: a rotation vector of its camera, and a movement along its axes in metres
    "turned": ([0.1, -0.08, 0.0], [0.0, 0.0, 0.0]),
    "rolled": ([0.0, 0.0, 0.1], [0.0, 0.0, 0.0]),
    "moved": ([0.0, 0.0, 0.0], [0.03, 0.02, 0.0]),
    "nearer": ([0.0, 0.0, 0.0], [0.0, 0.0, 0.01]),  # as a zoom would
    "farther": ([0.0, 0.0, 0.0], [0.0, 0.0, -0.01]),
}


def replace_pose(frame, pose):
    return dataclasses.replace(frame, camera=frame.camera.at(pose))


def misplaced(frame, fault):
    pose, (rotation, movement) = frame.camera.pose.copy(), FAULTS[fault]
    pose[:3, 3] += pose[:3, :3] @ np.array(movement)
    pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(np.array(rotation))[0]
    return replace_pose(frame, pose)


def shared(poses):
    """Posed frames, black, and points of a bent sheet that all pairs of them share."""
    K, sheet = intrinsic_matrix(200, 200, 80, 64), np.random.default_rng(0).uniform([-0.02, -0.02, 0.09], [0.02, 0.02, 0.11], (80, 3))
    seen = Camera(K, 160, 128, np.eye(4))
    frames = [Frame((i + 1) * 40_000_000, np.zeros((128, 160, 3), np.uint8), seen.at(pose)) for i, pose in enumerate(poses)]
    pixels = [frame.camera.project(sheet)[0] for frame in frames]
    return frames, [Matches((i, j), pixels[i], pixels[j]) for i, j in combinations(range(len(frames)), 2)]


def aside(count):
    """Poses of a lens that goes aside."""
    return [rigid_pose(np.eye(3), [0.005 * i, 0.002 * i * i, 0.0]) for i in range(count)]


ASIDE = aside(3)


def test_views_that_contradict_each_other_are_named_by_their_stamps(caplog):
    frames, matches = shared(ASIDE[:2])
    frames[1] = misplaced(frames[1], "turned")
    assert misposed(frames, matches) == []
    sentence = "the poses of the views at 0.040 s and 0.080 s contradict what these see; check these poses and their stamps, "
    sentence += "unless the tissue moved in between"
    assert [record.getMessage() for record in caplog.records] == [sentence]


def test_of_many_views_that_contradict_each_other_three_groups_are_named(caplog):
    frames, matches = shared(aside(5))
    turns = np.random.default_rng(0).normal(0, 0.2, (5, 3))
    frames = [
        replace_pose(frame, frame.camera.pose @ rigid_pose(cv2.Rodrigues(turn)[0], np.zeros(3))) for frame, turn in zip(frames, turns)
    ]
    assert misposed(frames, matches) == []
    named = "0.040 s and 0.080 s, 0.040 s and 0.120 s, 0.040 s and 0.160 s, and of 7 other groups of views, contradict"
    assert [named in record.getMessage() for record in caplog.records] == [True]


def test_views_whose_poses_are_all_inverse_are_refused_by_that_reason():
    frames, matches = shared(aside(4))
    inverse = [replace_pose(frame, invert_pose(frame.camera.pose)) for frame in frames]
    with pytest.raises(SequenceError, match="the poses do not fit the images, but would if they were world-to-camera: features of 6 pairs"):
        misposed(inverse, matches)


def test_all_of_the_check_can_be_cancelled():
    frames, matches = shared(ASIDE)
    reports = []
    assert misposed(frames, matches, progress=StageProgress("poses", lambda *report: reports.append(report))) == []
    # Three passes over matches or tracks are finished; tracks are looked for in three views, and votes are counted twice.
    assert sum(done == total for _, done, total in reports) == 3 + 3 + 2


@pytest.mark.slow
@pytest.mark.parametrize("fault", mostly_thorough(["moved", "turned", "rolled", "nearer", "farther"]))
def test_a_wrong_pose_among_good_ones_is_found(large, fault, caplog):
    frames = [bare(frame) for frame in large]
    assert misposed(frames, match_features(frames)) == [] and not caplog.text
    frames[2] = misplaced(frames[2], fault)
    assert misposed(frames, match_features(frames)) == [2]
    if fault == "moved":
        scene = prepare(frames, options(image_width=160, depth="points", **QUICK))
        assert len(scene.views) == 4 and "left out" in caplog.text


@pytest.mark.slow
@pytest.mark.parametrize("scale", mostly_thorough([1.2, 1.0, 0.1, 10.0]))
def test_recorded_depth_of_another_scale_takes_that_of_the_poses(large, scale):
    frames = [bare(frame, depth=np.float32(scale) * frame.depth) for frame in large]
    scene = prepare(frames, options(image_width=160, **QUICK))
    told = [text for text in scene.decisions if text.startswith("RECORDED DEPTH IS")]
    assert len(told) == (scale != 1) and all(float(text.split()[3]) == pytest.approx(scale, rel=0.01) for text in told)
    assert len(scene.views) == 5
    for view, frame in zip(scene.views, large):
        middle = view.depth_prior[50:70, 70:90].mean() / frame.depth[150:210, 210:270].mean()
        assert middle == pytest.approx(1, abs=0.02)


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("scale", mostly_thorough([0.01, 1.0]))
def test_pairs_of_another_scale_than_the_poses_take_that_of_the_poses(scale):
    """As of poses in centimetres."""
    pairs = list(phantom_sequence(PhantomConfig(width=320, height=256, frames=5, travel=0.02)))
    scene = prepare([bare(frame, right=frame.right, baseline=scale * frame.baseline) for frame in pairs], options(image_width=160, **QUICK))
    told = [text for text in scene.decisions if text.startswith("PAIRS SEE THE TISSUE")]
    assert len(told) == (scale != 1) and all(float(text.split()[4]) == pytest.approx(scale, rel=0.05) for text in told)
    assert len(scene.views) == 5
    for view, frame in zip(scene.views, pairs):
        assert view.baseline == pytest.approx(frame.baseline, rel=0.02)
        assert np.median(view.depth_prior[50:70, 70:90]) == pytest.approx(np.median(frame.depth[100:140, 140:180]), rel=0.03)


def test_two_views_tell_another_unit_but_not_another_scale(large):
    """A wrong pose of one of them looks like a scale, too, but of less than five."""
    for scale, told in ((1.5, 1.0), (100.0, 100.0)):
        views = [bare(frame, depth=np.float32(scale) * frame.depth) for frame in large[::2][:2]]
        assert recorded_scale(views, match_features(views), MatchingConfig()) == pytest.approx(told, rel=0.01)


@pytest.mark.thorough
@pytest.mark.slow
def test_recorded_depth_keeps_its_scale_where_less_than_two_breaths_are_seen():
    """Poses and views that know of no breath say another scale, but each pair of views says another one."""
    patient = PhantomConfig(width=160, height=128, frames=60, fps=5, breathing=0.008, seed=0, rounds=0.5)
    frames = list(islice(phantom_sequence(patient), 28))
    for count in (8, 12):
        views = [frames[i] for i in np.linspace(0, 27, count).round().astype(int)]
        assert recorded_scale(views, match_features(views), MatchingConfig()) == 1


@pytest.mark.thorough
@pytest.mark.slow
def test_with_stereo_a_wrong_pose_among_three_is_left_out(caplog):
    views = list(phantom_sequence(PhantomConfig(width=320, height=256, frames=3, travel=0.02)))
    views = [dataclasses.replace(view, depth=None) for view in views]
    short = options(image_width=80, **QUICK)
    assert len(prepare(views, short).views) == 3 and "left out" not in caplog.text
    scene = prepare([views[0], misplaced(views[1], "farther"), views[2]], short)
    assert len(scene.views) == 2 and f"{views[1].stamp_ns * 1e-9:.3f} s left out" in caplog.text
    prepare([views[0], misplaced(views[1], "farther")], short)
    first, second = (f"{views[i].stamp_ns * 1e-9:.3f} s" for i in (0, 1))
    assert f"the poses of the views at {first} and {second} contradict" in caplog.text


@pytest.mark.slow
def test_swapped_poses_of_two_views_are_found(large):
    frames = [bare(frame) for frame in large]
    frames[1], frames[3] = (dataclasses.replace(frames[i], camera=frames[j].camera) for i, j in ((1, 3), (3, 1)))
    assert misposed(frames, match_features(frames)) == [1, 3]


@pytest.mark.slow
def test_of_two_views_neither_is_left_out(large, caplog):
    for first, second, fault in ((bare(large[0]), bare(large[1]), "turned"), (large[0], large[1], "nearer")):  # the latter takes depth
        frames = [first, misplaced(second, fault)]
        caplog.clear()
        assert misposed(frames, match_features(frames), [frame.depth for frame in frames]) == []
        stamps = " and ".join(f"{frame.stamp_ns * 1e-9:.3f} s" for frame in frames)
        assert f"the poses of the views at {stamps} contradict" in caplog.text


@pytest.mark.slow
def test_what_is_near_enough_is_an_option(large):
    frames = [bare(frame) for frame in large]
    frames[2] = misplaced(frames[2], "turned")
    matches = match_features(frames)
    assert misposed(frames, matches, options=PosesConfig(min_error=1.0, max_error=1.0)) == []
    assert misposed(frames, matches, matching=MatchingConfig(min_points=10_000)) == []
