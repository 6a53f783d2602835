"""The task of cutting along a line: what counts as parted, what is lost, and that cuts are seen and heal."""

from dataclasses import replace

import numpy as np
import pytest
from played_tasks import make, play

from endo_sim_ros.core.cameras import rigid_pose
from endo_sim_ros.learning.config import SightConfig
from endo_sim_ros.learning.policies import scripted_policy
from endo_sim_ros.learning.scenes import Scene, load_scene
from endo_sim_ros.learning.task_batch import TaskBatch
from endo_sim_ros.learning.tasks import TASKS, Dissect, find_task
from endo_sim_ros.physics.cutting.geometry import sweep

COUNT = 4


@pytest.fixture
def task():
    """Episodes without a simulation: nothing is felt, and the skin is at rest."""
    kind, scene = find_task("dissect"), load_scene()
    task = kind(scene.nodes(kind.physics("cpu")), scene.camera.pose, COUNT)
    for b in range(COUNT):
        task.reset(b, np.random.default_rng(b))
    return task


def cut(task, b, first, last, down=0.004, aside=0.0):
    """A cut that follows the line from one of its parts to another, beside it, triangles at rest, world."""
    ends = task.line[b, [0, -1]]
    at = task.line[b] if first == 0 and last == 1 else ends[0] + np.linspace(first, last, 8)[:, None] * (ends[1] - ends[0])
    at = at + aside * task.across[b]
    edges = [np.array([0, 0, height]) + place for place in at for height in (-down, 0.002)]
    edges = np.array(edges).reshape(-1, 2, 3)
    triangles = np.concatenate([sweep(start, end) for start, end in zip(edges[:-1], edges[1:])])
    return (task.origin[b] + triangles @ task.axes[b]).astype(np.float32)


def hear(task, triangles, opening=0.0, pull=0.2):
    """Observe with these triangles in all episodes, the right side moved away from the left, and PSM2 pulling so hard, N."""
    places = task.rest[task.sites].copy()
    forces = np.zeros((COUNT, 2, 3))
    forces[:, 1] = [pull * (axes.T @ across) for axes, across in zip(task.axes, task.across)]
    task.observe(places.astype(np.float32), forces)
    half = places.shape[1] // 2
    for b in range(COUNT):
        task.hear_cuts(b, triangles[b])
        places[b, half:-1] += opening * (task.axes[b].T @ task.across[b])
    state = task.observe(places.astype(np.float32), forces)
    return dict(zip(task.observation_names, state.T))


def test_a_line_is_parted_where_a_cut_goes_through_it_deep_enough_and_solved_when_its_edges_are_apart(task):
    assert not hear(task, [[]] * COUNT)["parted"].any()
    half = hear(task, [cut(task, b, -0.1, 0.5) for b in range(COUNT)], 0.003)
    np.testing.assert_allclose(half["parted"], 6 / 11, atol=1e-6)
    assert not task.judge().success.any()
    all_of_it = [cut(task, b, 0, 1) for b in range(COUNT)]
    closed = hear(task, all_of_it)
    assert (closed["parted"] == 1).all() and not closed["astray"].any() and not task.judge().success.any(), "nobody pulls"
    opened = hear(task, all_of_it, 0.002)
    np.testing.assert_allclose(opened["opening"], 0.002 / task.opened, rtol=1e-3)
    assert task.judge().success.all()


def test_cutting_loose_tissue_loses(task):
    ends = hear(task, [cut(task, b, 0.93, 1.0) for b in range(COUNT)], 0.002, pull=0.05)
    assert (ends["parted"] > 0).all() and not task.judge().terminated.any(), "a station or two may part so"
    hear(task, [cut(task, b, 0, 1) for b in range(COUNT)], 0.002, pull=0.05)
    outcome = task.judge()
    assert not outcome.success.any() and outcome.terminated.all()


@pytest.mark.parametrize("wrong", [{"down": 0.002}, {"aside": 0.004}, {"aside": -0.004}])
def test_cuts_that_are_shallow_or_beside_the_line_part_nothing(task, wrong):
    heard = hear(task, [cut(task, b, 0, 1, **wrong) for b in range(COUNT)], 0.002)
    assert not heard["parted"].any() and not task.judge().success.any()
    assert (heard["astray"] > 1).all() == ("aside" in wrong)


def test_a_cut_elsewhere_or_too_deep_or_past_the_ends_loses_what_else_were_solved(task):
    along = [cut(task, b, 0, 1) for b in range(COUNT)]
    more = [
        cut(task, 0, 0.2, 0.8, aside=-0.006),
        cut(task, 1, 0.2, 0.8, down=0.02),
        cut(task, 2, 0.9, 1.6),
        cut(task, 3, -0.1, 1.1),  # a little longer does not matter
    ]
    hear(task, [np.concatenate(both) for both in zip(along, more)], 0.002)
    outcome = task.judge()
    assert outcome.success.tolist() == [False] * 3 + [True] and outcome.terminated.all()


def test_the_line_and_the_spot_are_in_the_picture_and_the_spot_is_on_its_left(task):
    camera = load_scene().camera
    for b in range(COUNT):
        spot, *line = (spot.place for spot in task.dyed_spots(b))
        assert len(line) == 11 and task.axes[b] @ (spot - task.origin[b]) @ task.across[b] < -0.008
        for place in (spot, *line):
            pixel = (camera.K @ place)[:2] / place[2]
            assert (pixel > 2).all() and (pixel < [camera.width - 2, camera.height - 2]).all()


@pytest.mark.thorough
def test_what_shows_a_cut_is_of_its_episode_alone_and_gone_in_the_next():
    sight = SightConfig(image_width=128, instrument=False, eyes=2, dye=False)
    batch = TaskBatch("dissect", load_scene(), 2, "both", sight=sight, device="cpu")
    begin = lambda: batch.reset(range(2), [np.random.default_rng(seed) for seed in (0, 1)])
    begin()
    rest, script, solved, k = batch.observe(), scripted_policy("dissect", 2), False, 0
    seen = rest
    while not solved:
        action = script.act(seen["state"])
        action[1] = [0, 0, 0, -1] * 2
        seen, outcome = batch.step(action)
        solved, k = bool(outcome.success[0]), k + 1
        assert k < batch.task.horizon
    for eye in ("image", "image_right"):
        np.testing.assert_array_equal(seen[eye][1], rest[eye][1])
        was, now = rest[eye][0].astype(int), seen[eye][0].astype(int)
        dark = (now.sum(2) < 0.6 * was.sum(2)) & (now[..., 0] > now[..., 2])  # fat and flesh for skin
        assert 20 < dark.sum() < 0.05 * dark.size
    assert len(batch.tissue.cuts(0)) and not len(batch.tissue.cuts(1))
    begin()
    again = batch.observe()
    assert all(np.array_equal(again[name], rest[name]) for name in rest)
    _, outcome = batch.step(np.tile([0, 0, 0, 1.0], (2, 2)))  # edges in the air
    assert not len(batch.tissue.cuts(0))


@pytest.mark.slow
def test_a_line_that_is_cut_without_tension_and_a_wild_edge_lose():
    class Lazy:
        actions, reset, script = "cartesian", lambda *_: None, scripted_policy("dissect")

        def act(self, states):
            told = states.copy()
            names = list(Dissect.observation_names)
            told[:, names.index("pull")] = 0.3  # as if PSM2 pulled
            told[:, names.index("PSM2.jaw")], told[:, names.index("PSM2.distance")] = 1.0, 0.1
            action = self.script.act(told)
            action[:, 4:] = 0, 0, 0, -1
            return action

    class Wild(Lazy):
        def act(self, states):
            action = super().act(states)
            inside = states[:, list(Dissect.observation_names).index("PSM1.cuts")] > 0
            action[inside, :4] = -1, 0, 0, 1  # across the line
            return action

    environment = make("dissect")
    _, _, info = play(environment, Lazy(), 0)
    task = environment.get_wrapper_attr("batch").task
    assert task.loose[0] > task.most_loose and not info["success"]
    _, rewards, info = play(environment, Wild(), 0)
    assert not info["success"] and len(rewards) < 60 and sum(rewards) < 2


def test_what_the_task_cannot_do_is_refused():
    with pytest.raises(ValueError, match="dissect cuts with the edges of points, which links have none of; leave contact at point"):
        TaskBatch("dissect", load_scene(), device="cpu", contact="links")
    scene, turn = load_scene(), np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    turned = Scene(scene.model, tuple(replace(camera, pose=rigid_pose(turn, np.zeros(3)) @ camera.pose) for camera in scene.cameras))
    kind = TASKS["dissect"]
    with pytest.raises(ValueError, match="dissect: edges cut along z of the world, but the endoscope looks elsewhere; turn the scene"):
        kind(scene.nodes(kind.physics("cpu")), turned.camera.pose)
