"""The needle of the hand-over: where it lies, who holds it, and that it is seen."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from endo_sim_ros.learning.config import SightConfig
from endo_sim_ros.learning.policies import scripted_policy
from endo_sim_ros.learning.scenes import load_scene
from endo_sim_ros.learning.task_batch import TaskBatch
from endo_sim_ros.learning.tasks import TASKS, find_task, norm

NEEDLE = 12  # its label, after those of two arms


@pytest.fixture
def task():
    """Four episodes without a simulation: nothing is felt, and the skin is at rest."""
    kind, scene = find_task("handover"), load_scene()
    task = kind(scene.nodes(kind.physics("cpu")), scene.camera.pose, 4)
    for b in range(4):
        task.reset(b, np.random.default_rng(b))
    observe(task)
    return task


def observe(task):
    return dict(zip(task.observation_names, task.observe(task.rest[task.sites].astype(np.float32), np.zeros((task.count, 2, 3))).T))


def put(task, tips, closed):
    """The tips of PSM1 and PSM2 at places [4, 3], task frame, their jaws closed or not."""
    task.go(np.stack(tips, 1), np.tile(np.where(closed, 1.0, -1.0), (task.count, 1)))
    return observe(task)


def marks(task):
    return np.moveaxis(task.find(task.tips()) + task._ways, 1, 0)


def test_the_needle_is_40_mm_long_and_lies_on_the_skin(task):
    line = task._line
    assert norm(np.diff(line, axis=0)).sum() == pytest.approx(0.04, rel=1e-3)
    np.testing.assert_allclose(np.linalg.det(task.turned), 1)
    parts, capsules = task.thing()
    assert parts[0].link == "needle" == capsules[0].link and np.ptp(parts[0].vertices[:, 0]) == pytest.approx(np.ptp(line[:, 0]), abs=1e-3)
    for b in range(4):
        places, skin = task._places(np.array([b]), line)[0], task._over[b]
        above = places[:, 2] - skin[((places[:, None, :2] - skin[:, :2]) ** 2).sum(2).argmin(1), 2]
        assert -0.003 < above.min() < 0.002 and above.max() < 0.008, "it touches the skin, and lies flat"
    first, second = marks(task)
    assert (first[:, 0] > second[:, 0] + 0.005).all(), "PSM1 comes from the right"


def test_a_jaw_that_closes_on_it_takes_it_and_one_that_closes_beside_it_or_before_does_not(task):
    first, second = marks(task)
    away = [0, 0, 0.004]
    assert not put(task, [first + away, second], [True, False])["PSM1.holds"].any()
    assert not put(task, [first, second], [True, False])["PSM1.holds"].any(), "it was closed before it came"
    put(task, [first, second], [False, False])
    assert put(task, [first, second], [True, False])["PSM1.holds"].all()
    before = task.needle.copy()
    raised = put(task, [first + away, second], [True, False])
    np.testing.assert_allclose(task.needle - before, np.tile(away, (4, 1)), atol=1e-12)
    np.testing.assert_allclose(raised["height"], 0.004 / 0.02, atol=1e-6)
    let_go = put(task, [first + away, second], [False, False])
    assert not let_go["PSM1.holds"].any() and not let_go["height"].any()
    np.testing.assert_allclose(task.needle, before, atol=1e-12)


def test_it_is_given_while_both_hold_it_and_a_pull_of_the_second_arm_loses_it(task):
    (first, second), up, wide = marks(task), np.array([0, 0, 0.011]), np.array([0, 0.004, 0])
    put(task, [first, second], [True, False])
    put(task, [first + up, second + up], [True, False])
    both = put(task, [first + up, second + up], [True, True])
    assert both["given"].all() and both["PSM2.holds"].all() and not task.judge().success.any()
    assert not put(task, [first + up, second + up + wide], [True, True])["PSM2.holds"].any()
    put(task, [first + up, second + up], [True, False])
    put(task, [first + up, second + up], [True, True])
    place = task.needle.copy()
    for step in range(task.hold):
        alone = put(task, [first + up, second + up + step * np.array([-0.001, 0, 0])], [False, True])
        assert alone["given"].all() and not alone["PSM1.holds"].any()
        assert task.judge().success.all() == (step == task.hold - 1)
    np.testing.assert_allclose(task.needle - place, np.tile([-0.004, 0, 0], (4, 1)), atol=1e-12)
    dropped = put(task, [first + up, second + up], [False, False])
    assert not dropped["given"].any() and not dropped["height"].any()


def test_the_arm_that_receives_is_paid_while_it_holds(task):
    """Else its jaw could open again, and the first arm would lose all by letting go."""
    (first, second), up = marks(task), np.array([0, 0, 0.011])
    step = lambda lifted, closed: [put(task, [first + lifted, second + lifted], closed), task.judge().reward][1]
    step(0 * up, [True, False])
    step(up, [True, False])
    assert (step(up, [True, True]) > 0.9).all() and (step(up, [True, False]) < -0.9).all()
    step(up, [True, True])
    assert (step(up, [False, True]) > 0.9).all()


def test_it_turns_with_the_jaws_that_lead_and_keeps_the_direction_in_which_it_falls(task):
    (first, second), up = marks(task), np.array([0, 0, 0.012])
    put(task, [first, second], [True, False])
    put(task, [first + up, second + up], [True, False])
    before, turn = task.turned.copy(), Rotation.from_rotvec([0.3, -0.2, 0.4]).as_matrix()
    turn_of = lambda matrix: task.axes @ matrix @ task.axes.transpose(0, 2, 1)  # world to task frame
    task.rotations = task.rotations.copy()
    task.rotations[:, 1] = turn  # that of PSM2 holds nothing
    observe(task)
    np.testing.assert_allclose(task.turned, before, atol=1e-12)
    task.rotations[:, 0] = turn
    seen = observe(task)
    np.testing.assert_allclose(task.turned, turn_of(turn) @ before, atol=1e-12)
    np.testing.assert_allclose(marks(task)[0], first + up, atol=1e-12)  # the jaw still holds the same place
    assert (norm(marks(task)[1] - second - up) > 0.003).all() and seen["PSM1.holds"].all()
    first, second = marks(task)
    put(task, [first, second], [True, True])
    put(task, [first, second], [False, True])
    task.rotations[:, 1] = np.eye(3)
    observe(task)
    np.testing.assert_allclose(task.turned, before, atol=1e-12)
    np.testing.assert_allclose(marks(task)[1], second, atol=1e-12)
    put(task, [first, second], [False, False])
    np.testing.assert_allclose(task.turned, before, atol=1e-12)
    np.testing.assert_allclose(task.thing_poses()["needle"][:, :3, :3], task.axes.transpose(0, 2, 1) @ before, atol=1e-12)


def test_a_needle_that_psm1_has_not_lifted_is_not_given(task):
    (first, second), up = marks(task), np.array([0, 0, 0.011])
    put(task, [first, second], [True, True])
    assert not put(task, [first + up, second + up], [False, True])["given"].any(), "it was tapped where it lay"
    for _ in range(task.hold):
        put(task, [first + up, second + up], [False, True])
        assert not task.judge().success.any()


def test_the_needle_is_seen_where_it_is():
    sight = SightConfig(image_width=128, segmentation=True)
    batch = TaskBatch("handover", load_scene(), 2, "both", sight=sight, device="cpu")
    batch.reset(range(2), [np.random.default_rng(seed) for seed in range(2)])
    script, seen = scripted_policy("handover", 2), batch.observe()
    for step in range(26):
        if step in (0, 25):
            for b, labels in enumerate(seen["segmentation"][..., 0]):
                places = batch.task.thing_poses()["needle"][b] @ np.append(batch.task._line, np.ones((len(batch.task._line), 1)), 1).T
                pixels = batch.pictures.camera.K @ (batch.pictures.camera.viewmat @ places)[:3]
                pixels = (pixels[:2] / pixels[2]).T
                shown = np.argwhere(labels == NEEDLE)[:, ::-1] + 0.5
                assert len(shown) > 20
                off = np.linalg.norm(shown[:, None] - pixels, axis=2)
                assert off.min(1).max() < 2.5 and np.median(off.min(0)) < 2.5
        seen, _ = batch.step(script.act(seen["state"]))
    assert batch.task.holds.any() and TASKS["handover"].dyed_spots(batch.task, 0) == ()
