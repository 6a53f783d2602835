"""The task in which a clip is put on a vessel: what closed jaws leave there, what loses an episode, and what is seen."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from endo_sim_ros.learning.actions import arm_commands, tip_poses
from endo_sim_ros.learning.config import SightConfig
from endo_sim_ros.learning.policies import scripted_policy
from endo_sim_ros.learning.scenes import load_scene
from endo_sim_ros.learning.task_batch import TaskBatch
from endo_sim_ros.learning.tasks import Clip, norm
from endo_sim_ros.learning.vessels import RINGS, Ground, Vessels, gaps, run_over

VESSEL, OTHERS, CLIP = 7, 8, 9  # labels, after those of one arm
COUNT = 6


@pytest.fixture
def task():
    """Episodes without a simulation: nothing is felt, and the skin is at rest."""
    scene = load_scene()
    task = Clip(scene.nodes(Clip.physics("cpu")), scene.camera.pose, COUNT)
    for b in range(COUNT):
        task.reset(b, np.random.default_rng(b))
    observe(task)
    return task


def observe(task, moved=0.0):
    seen = task.observe((task.rest[task.sites] + moved).astype(np.float32), np.zeros((task.count, 3)))
    return dict(zip(task.observation_names, seen.T))


def put(task, closed=False, along=0.0, aside=0.0, turned=0.0):
    """The jaws where the clip belongs, but so far along the vessel, m, beside it along themselves, and turned, rad."""
    task.twisted = task.twisted + task._misaligned + turned
    task.act(np.zeros((task.count, 5)))
    observe(task)
    way = task.vessels.rings[:, 0, len(RINGS) // 2] - task.vessels.rings[:, 0, len(RINGS) // 2 - 1]
    way /= norm(way)[:, None]
    task.tip = task.tip + task._way + along * way + aside * task._frame[:, :, 2]
    return step(task, closed)


def step(task, closed, moves=0.0, moved=0.0):
    task.go(task.tip + moves, np.full(task.count, 1.0 if closed else -1.0))
    return observe(task, moved)


def test_a_clip_stays_on_the_vessel_and_goes_where_the_tissue_goes(task):
    assert put(task)["fits"].all() and not task._lost.any()
    for number in range(task.latch):
        assert not task._clipped.any(), number
        seen = step(task, True)
    assert seen["clipped"].all() and not task.judge().terminated.any(), "the jaws are still there"
    before = {name: poses.copy() for name, poses in task.thing_poses().items()}
    out = -0.26 * task.leave * task._frame[:, :, 2]
    for number in range(1, 6):
        step(task, False, out)
        assert task.judge().success.all() == (number > 3), number
    for name in ("clip_left", "clip_right", "clip_hinge"):
        np.testing.assert_allclose(task.thing_poses()[name], before[name], atol=1e-9)
    shift = np.array([0.001, -0.002, 0.003])
    step(task, False, 0.0, shift)
    np.testing.assert_allclose(
        task.thing_poses()["clip_left"][:, :3, 3] - before["clip_left"][:, :3, 3], np.tile(shift, (COUNT, 1)), atol=1e-7
    )
    np.testing.assert_allclose(
        task.vessels.rings[:, 0] - task.vessels.rest[:, 0],
        task._to_task(np.tile(shift, (COUNT, 1)))[:, None] + np.zeros_like(task.vessels.rest[:, 0]),
        atol=1e-7,
    )


@pytest.mark.parametrize("wrong", [{"turned": 0.5}, {"along": 0.004}, {"aside": -0.012}, {"aside": 0.009}])
def test_a_clip_that_does_not_belong_where_it_is_loses(task, wrong):
    put(task, **wrong)
    task._lost[:] = False  # how the jaws came there is not what this is about
    for _ in range(task.latch):
        step(task, True)
    assert task._lost.all() and not task._clipped.any()
    outcome = task.judge()
    assert outcome.terminated.all() and not outcome.success.any()


def test_closing_where_it_belongs_gains_and_elsewhere_costs_and_then_the_goal_is_away(task):
    put(task, aside=-0.012)
    task.judge()
    step(task, True)
    np.testing.assert_allclose(task.judge().reward, -0.5, atol=1e-9)
    put(task)
    task.judge()
    step(task, False)
    np.testing.assert_allclose(task.judge().reward, 0, atol=1e-9)  # to stay there, open
    gains = []
    for _ in range(task.latch):
        seen = step(task, True)
        gains.append(task.judge().reward)
    assert (gains[0] > 1).all() and (np.array(gains) > 0.1).all() and seen["clipped"].all()
    along, left = task._frame[:, :, 2], task.beyond * task.leave
    np.testing.assert_allclose(task._way, -left * along, atol=1e-9)
    np.testing.assert_allclose(seen["distance"], left / 0.02, rtol=1e-5)
    step(task, False, 0.5 * task._way)
    outcome = task.judge()
    np.testing.assert_allclose(outcome.reward, 2 * 0.5 * task.beyond, atol=1e-6)
    assert not outcome.success.any()
    step(task, False, task._way)
    assert task.judge().success.all()


def test_jaws_that_close_for_less_time_leave_nothing(task):
    put(task)
    for _ in range(task.latch - 1):
        step(task, True)
    assert not step(task, False)["clipped"].any() and not task._lost.any()


def test_a_jaw_that_touches_another_vessel_loses_and_so_does_one_that_presses_into_the_marked_one(task):
    middle = task.vessels.rings[:, 1, len(RINGS) // 2]
    there = np.flatnonzero(task.vessels.rest[:, 1, 0, 2] < 0.5)
    assert len(there) > COUNT / 2
    tip = middle - task._to_task((task.rotations @ task._open[1, 1][:, None])[..., 0])  # the end of the left jaw is in it
    task.tip[there] = tip[there]
    assert (step(task, False)["others_away"][there] < 0).all() and task._lost[there].all()
    for b in range(COUNT):
        task.reset(b, np.random.default_rng(b))
    observe(task)
    put(task)
    assert not task._lost.any()
    step(task, False, 0.006 * task._frame[:, :, 1])
    assert task._lost.all()


def test_the_jaws_that_touch_are_those_that_are_drawn():
    batch = TaskBatch("clip", load_scene(), COUNT, images=True, device="cpu")
    batch.reset(range(COUNT), [np.random.default_rng(b) for b in range(COUNT)])
    script, task = scripted_policy("clip", COUNT), batch.task
    for _ in range(12):
        batch.step(script.act(batch.state()))
    poses = batch.tools.posed(0, np.arange(COUNT))[0]
    drawn = [c for c in batch.tools.tools[0].shape[1] if c.link.startswith("jaw")]
    ends = [poses[c.link] @ np.append(end, 1.0) for c in drawn for end in (c.start, c.end)]
    expected = task.tips()[:, None] + (task.rotations[:, None] @ task._open.reshape(-1, 3, 1))[..., 0]
    np.testing.assert_allclose(np.stack(ends, 1)[..., :3], expected, atol=1e-6)


def test_a_fifth_number_turns_the_tip_about_the_line_of_sight():
    batch = TaskBatch("clip", load_scene(), 2, device="cpu")
    batch.reset([0, 1], [np.random.default_rng(b) for b in (0, 1)])
    task, action = batch.task, np.array([[0.5, 0, 0, -1, 1.0], [0, 0, 0, -1, -0.5]])
    before, told = task.rotations.copy(), arm_commands(task, action)
    tips = task.reach(action)
    batch.step(action)
    turn = task.rotations @ before.transpose(0, 2, 1)
    np.testing.assert_allclose(turn @ task.axes[:, 2, :, None], task.axes[:, 2, :, None], atol=1e-12)
    np.testing.assert_allclose((np.trace(turn, axis1=1, axis2=2) - 1) / 2, np.cos([task.twist, 0.5 * task.twist]), atol=1e-12)
    x = task.axes[:, 0]  # to the right in the picture: after a positive turn it points up, too
    assert (np.einsum("bi,bij,bj->b", task.axes[:, 1], turn, x) * [1, -1] > 0).all()
    np.testing.assert_allclose(told[:, :3], tips)
    np.testing.assert_allclose(task.tips(), tips, atol=1e-12)
    arm = batch.arm_state()
    np.testing.assert_allclose(Rotation.from_quat(told[:, 3:7]).as_matrix(), task.rotations, atol=1e-12)
    seen = task.endoscope[:3, :3].T @ task.rotations
    np.testing.assert_allclose(Rotation.from_quat(arm[:, 3:7]).as_matrix(), seen, atol=1e-6)
    np.testing.assert_allclose(tip_poses(task, task.tips())[:, :3, :3], task.rotations)
    with pytest.raises(ValueError, match=r"clip: actions must be 2 × 5 numbers, got the shape \(2, 4\)"):
        batch.step(np.zeros((2, 4)))
    for _ in range(60):
        batch.step(action)
    assert task.twisted.tolist() == [task.most_twist, -task.most_twist]


def test_the_first_picture_of_an_episode_is_the_same_before_its_first_observation():
    batch = TaskBatch("clip", load_scene(), 2, images=True, device="cpu")
    for seed in (0, 2):
        batch.reset(range(2), [np.random.default_rng(seed + b) for b in range(2)])
        first = batch.images()
        batch.observe()
        np.testing.assert_array_equal(first, batch.images())


@pytest.mark.thorough
def test_episodes_do_not_depend_on_how_many_there_are():
    seen = []
    for own in ([0, 1, 2], [1]):
        batch = TaskBatch("clip", load_scene(), len(own), "both", device="cpu")
        batch.reset(range(len(own)), [np.random.default_rng(seed) for seed in own])
        script = scripted_policy("clip", len(own))
        found = batch.observe()
        for _ in range(30):
            found, _ = batch.step(script.act(found["state"]))
        seen.append({name: values[own.index(1)].tobytes() for name, values in found.items()})
    assert seen[0] == seen[1]


def test_vessels_move_when_the_tissue_is_pressed():
    batch = TaskBatch("clip", load_scene(), 2, device="cpu")
    batch.reset([0, 1], [np.random.default_rng(b) for b in (0, 1)])
    task = batch.task
    task.tip[:] = [0.0, 0.0, 0.008]  # the ball nearly lies on the skin
    for _ in range(6):
        batch.step(np.tile([0, 0, -0.6, -1, 0.0], (2, 1)))
    batch.state()
    sunk = (task.vessels.rest - task.vessels.rings)[:, 0, len(RINGS) // 2, 2]
    assert (norm(task.force) > 0.1).all() and (sunk > 0.0005).all()


def test_what_is_seen_is_where_it_is_in_both_eyes():
    sight = SightConfig(image_width=160, segmentation=True, eyes=2)
    batch = TaskBatch("clip", load_scene("phantom:1"), 3, "both", sight=sight, device="cpu")
    batch.reset(range(3), [np.random.default_rng(seed) for seed in range(4, 7)])
    task, script, seen, clips = batch.task, scripted_policy("clip", 3), batch.observe(), 0
    pictures = batch.pictures
    to_pixels = lambda places, pose: pictures.camera.at(pose).project(places)[0]
    marks = task.origin + task._to_world(task.vessels.rings[:, 0, len(RINGS) // 2 - 1 : len(RINGS) // 2 + 1].mean(1))
    for eye, name in enumerate(("image", "image_right")):
        for b in range(3):
            column, row = to_pixels(marks[b : b + 1], pictures._poses[eye, b])[0].astype(int)
            around = seen[name][b, row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).astype(int)
            blue = around[:, 2] > around[:, 0] + 40
            assert blue.any(), (name, b)
    for _ in range(44):
        seen, _ = batch.step(script.act(seen["state"]))
    for b, labels in enumerate(seen["segmentation"][..., 0]):
        for label, vessels in ((VESSEL, [0]), (OTHERS, [1, 2])):
            rings = task.vessels.rings[b, [v for v in vessels if task.vessels.rest[b, v, 0, 2] < 0.5]]
            places = task.origin[b] + rings.reshape(-1, 3) @ task.axes[b]
            at, shown = to_pixels(places, pictures.poses[b]), np.argwhere(labels == label)[:, ::-1] + 0.5
            assert len(shown) > 50 and np.linalg.norm(shown[:, None] - at, axis=2).min(1).max() < 9
        clips += (labels == CLIP).any()
    assert task._clipped.all() and clips == 3 and Clip.dyed_spots(task, 0) == ()


def test_gaps_are_distances_between_surfaces():
    rng = np.random.default_rng(0)
    rings, starts, ends, radii = rng.uniform(-0.02, 0.02, (2, 20, 3)), *rng.uniform(-0.02, 0.02, (2, 3, 3)), np.array([0.001, 0.002, 0.0])
    share = np.linspace(0, 1, 200)[:, None]
    axes = [np.concatenate([a + share * (b - a) for a, b in zip(own, own[1:])]) for own in rings]
    jaws = [a + share * (b - a) for a, b in zip(starts, ends)]
    for axis, gap in zip(axes, gaps(rings, np.array([0.001, 0.003]), starts, ends, radii) + [0.001, 0.003]):
        sampled = min(np.linalg.norm(jaw[:, None] - axis[::2], axis=2).min() - r for jaw, r in zip(jaws, radii))
        assert gap == pytest.approx(sampled, abs=2e-4) and gap <= sampled + 1e-12


def test_a_tube_bridges_skin_and_enters_it_at_its_ends():
    at = np.linspace(-0.05, 0.05, 26)
    skin = np.stack(np.meshgrid(at, at), -1).reshape(-1, 2)
    skin = np.column_stack([skin, 0.1 * skin[:, 0]])  # a slope
    one = np.ones(1)
    (course,) = run_over(Ground(skin), np.zeros((1, 2)), 0.3 * one, 5 * one, 0.006 * one, 0.004 * one, np.array([[0.02, 0.026]]))
    above = course[:, 2] - 0.1 * course[:, 0]
    assert above.max() == pytest.approx(0.006, abs=2e-4) and above[[0, -1]].max() < -0.003
    assert np.interp(-0.02, RINGS, above) == pytest.approx(-0.004, abs=4e-4)
    vessels = Vessels(1, 1)
    vessels.lay(0, course[None], [0.002], course[None, [2, 6, 10, 13, 17, 21]])
    vessels.follow(np.where(np.arange(6)[:, None] < 3, [0, 0, 0.005], 0.0)[None, None])
    moved = (vessels.rings - vessels.rest)[0, 0, :, 2]
    assert moved[0] == pytest.approx(0.005, abs=1e-4) and moved[-1] < 1e-4 and (np.diff(moved) <= 1e-12).all()
