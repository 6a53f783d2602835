"""Tasks as Gymnasium environments, one and many at once."""

import os
import re
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from played_tasks import IDS, VARIED, digest, first_steps, make, play
from thorough import mostly_thorough

from endo_sim_ros.cli import demonstrate, scene, train
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.learning import environments
from endo_sim_ros.learning.config import Randomisation, SightConfig
from endo_sim_ros.learning.policies import scripted_policy
from endo_sim_ros.learning.scenes import Scene, load_scene
from endo_sim_ros.learning.task_batch import TaskBatch
from endo_sim_ros.learning.tasks import TASKS, find_task, moving
from endo_sim_ros.physics import MotionConfig, TissueSimulation

ROOT = Path(__file__).parents[2]


# Each task with each space that depends on it: what an arm measures on how many there are and whether they move the endoscope.
CHECKED = [(task, "both") for task in TASKS] + [("retraction", kind) for kind in ("state", "image", "sensors")]
CHECKED += [("tension", "sensors"), ("camera", "sensors")]


@pytest.mark.slow
@pytest.mark.parametrize("task, observations", mostly_thorough(reversed(CHECKED), 7))
def test_gymnasium_finds_nothing_to_complain_about(task, observations):
    eyes = 1 if observations == "state" else 2
    shown = {"eyes": eyes, "segmentation": observations != "state", "render_mode": "rgb_array", "randomisation": VARIED}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(task, observations=observations, **shown).unwrapped)
        if task == "retraction":
            check_env(make(task, observations=observations).unwrapped)


def test_observations_have_names_and_units():
    environment = make()
    names = environment.unwrapped.batch.task.observation_names
    assert environment.observation_space.shape == (len(names),) and len(set(names)) == len(names)
    observation, _ = environment.reset(seed=1)
    o = dict(zip(names, observation))
    np.testing.assert_allclose(o["distance"], np.linalg.norm([o[f"spot_from_tip_{axis}"] for axis in "xyz"]), rtol=1e-5)
    assert o["time_left"] == 1 and o["jaw"] == -1 and o["force"] == 0
    tip = 0.02 * np.array([o[f"tip_{axis}"] for axis in "xyz"])
    after = dict(zip(names, environment.step(np.array([1, -0.5, -1, -1], np.float32))[0]))
    expected = np.clip(tip + [0.002, -0.001, -0.002], environment.unwrapped.batch.task.low, environment.unwrapped.batch.task.high)
    np.testing.assert_allclose([0.02 * after[f"tip_{axis}"] for axis in "xyz"], expected, atol=1e-7)


@pytest.mark.thorough
@pytest.mark.dds
def test_the_same_seed_and_actions_give_the_same_bytes_whatever_the_process_and_the_threads(monkeypatch):
    code = "from played_tasks import TASKS, digest; print(*map(digest, TASKS))"
    variables = os.environ | {"ENDO_SIM_THREADS": "2", "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "test/learning")])}
    monkeypatch.setenv("ENDO_SIM_THREADS", "1")
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=variables) as other:
        here = [digest(task) for task in TASKS]  # meanwhile
        there, errors = other.communicate()
    assert other.returncode == 0, errors
    assert there.split() == here and len(set(here)) == len(TASKS)


@pytest.mark.slow
@pytest.mark.parametrize("task", mostly_thorough(TASKS, 3))
def test_each_of_many_environments_is_the_single_one_with_its_seed(task):
    count, seed, steps = 2, 20, first_steps(task)
    options = {"observations": "both", "randomisation": VARIED, "device": "cpu"}
    many = gymnasium.make_vec(IDS[task], num_envs=count, vectorization_mode="vector_entry_point", **options)
    policy = scripted_policy(task, count)
    observations, _ = many.reset(seed=seed)
    recorded = []
    for _ in range(steps):
        observations, rewards, terminated, truncated, _ = many.step(policy.act(observations["state"]))
        recorded.append((observations, rewards, terminated | truncated))
        if (terminated | truncated).any():
            break
    assert len(recorded) > 10
    single = make(task, observations="both", randomisation=VARIED)
    seen, rewards, _ = play(single, scripted_policy(task), seed + 1, len(recorded))
    assert all(re.search(r"\d|report|holds", line) and "nan" not in line for line in single.unwrapped.batch.task.goal_lines())
    for k, reward in enumerate(rewards):
        for kind in ("state", "image"):
            np.testing.assert_array_equal(recorded[k][0][kind][1], seen[k + 1][kind])
        assert recorded[k][1][1] == reward


@pytest.mark.slow
def test_tissue_of_a_task_tears_and_each_of_many_as_the_single_one(monkeypatch):
    kind = TASKS["retraction"]
    fragile = replace(kind.physics("cpu"), tear_strain=0.1)
    monkeypatch.setattr(kind, "physics", lambda device="cpu": fragile)
    many = gymnasium.make_vec(IDS["retraction"], num_envs=2, vectorization_mode="vector_entry_point", observations="both", device="cpu")
    policy, recorded = scripted_policy("retraction", 2), []
    observations, _ = many.reset(seed=20)
    for _ in range(25):
        observations, *_ = many.step(policy.act(observations["state"]))
        recorded.append(observations)
    single = make(observations="both")
    seen, _, _ = play(single, scripted_policy("retraction"), 21, len(recorded))
    assert single.unwrapped.batch.tissue.tearing[0].count > 0
    for here, there in zip(recorded, seen[1:]):
        for name in ("state", "image"):
            np.testing.assert_array_equal(here[name][1], there[name])


BREATH = {"breathing": 0.004, "breathing_period": 1.5, "heartbeat": 0.001}


def test_the_script_retracts_tissue_that_breathes_and_each_episode_has_the_bits_and_the_phase_of_its_seed():
    options = {"observations": "both", "motion": BREATH, "device": "cpu"}
    many = gymnasium.make_vec(IDS["retraction"], num_envs=4, vectorization_mode="vector_entry_point", **options)
    policy = scripted_policy("retraction", 4)
    observations, info = many.reset(seed=20)
    phases, recorded, solved = info["phases"], [observations], np.zeros(4, bool)
    assert phases.shape == (4, 2) and len(np.unique(phases)) == 8
    while not solved.all() and len(recorded) < 40:
        observations, _, terminated, _, info = many.step(policy.act(observations["state"]))
        recorded.append(observations)
        solved |= info["success"]
        if terminated.any():
            break
    assert len(recorded) > 10 and solved.any()
    single = make("retraction", observations="both", motion=BREATH)
    for b in range(2):
        seen, _, info = play(single, scripted_policy("retraction"), 20 + b)
        assert info["success"] and info["phases"] == pytest.approx(phases[b], abs=0)
        for ours, theirs in zip(recorded, seen):
            np.testing.assert_array_equal(ours["state"][b], theirs["state"])
            np.testing.assert_array_equal(ours["image"][b], theirs["image"])


def test_motion_changes_no_task_and_without_it_the_bits_are_the_same():
    own = TASKS["tracking"].physics()
    assert moving(own, MotionConfig()) == own and moving(own, MotionConfig(breathing=0.002)).motion.breathing == 0.002
    with pytest.raises(ValueError, match="motion.breathing_period has no effect while motion.breathing and motion.heartbeat are 0"):
        make("retraction", motion={"breathing_period": 2.0})
    seen = [make("retraction", motion=motion).reset(seed=3)[0] for motion in (None, {"breathing": 0.0}, BREATH)]
    np.testing.assert_array_equal(seen[0], seen[1])
    names = list(TASKS["retraction"].observation_names)
    tip, spot = (names.index(name) for name in ("tip_x", "spot_moved_x"))
    np.testing.assert_array_equal(seen[0][tip : tip + 3], seen[2][tip : tip + 3])
    assert not seen[0][spot : spot + 3].any() and seen[2][spot : spot + 3].any()  # the spot is where the breath has it
    with pytest.raises(ConfigError, match="more travel"):
        make("retraction", motion={"breathing": 0.03})
    with pytest.raises(ConfigError, match="no option depth"):
        make("retraction", motion={"depth": 0.03})
    with pytest.raises(ValueError, match="motion must be a MotionConfig or its values in a dict"):
        make("retraction", motion=3)  # type: ignore[arg-type]


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize(("task", "count"), [("retraction", 32), ("palpation", 2)])
def test_the_scripts_solve_the_tasks_with_links_that_touch_and_each_episode_has_the_bits_of_its_seed(task, count):
    ends = []
    for first, b in ((50, count), (51, 1)):
        batch = TaskBatch(task, load_scene(), b, device="cpu", contact="links")
        batch.reset(range(b), [np.random.default_rng(first + i) for i in range(b)])
        policy, states, rewards, solved = scripted_policy(task, b), [batch.observe()], [], np.zeros(b, bool)
        for _ in range(batch.task.horizon):
            state, outcome = batch.step(policy.act(states[-1]))
            states.append(state)
            rewards.append(outcome.reward)
            solved |= outcome.success
        ends.append((np.array(states), np.array(rewards), solved, batch))
    (many, rewards, solved, batch), (single, reward, *_) = ends
    assert solved.mean() >= 0.95 and not batch.tissue.tools.faults.any()
    np.testing.assert_array_equal(many[:, 1], single[:, 0])
    np.testing.assert_array_equal(rewards[:, 1], reward[:, 0])


@pytest.mark.slow
def test_links_push_tissue_that_a_point_leaves_alone():
    moved = []
    for contact in ("point", "links"):
        environment = make("retraction", contact=contact)
        environment.reset(seed=0)
        for _ in range(16):
            environment.step(np.array([0, 0, -1.0, -1.0]))  # open jaws, straight down
        moved.append(float(environment.unwrapped.batch.tissue.displacements.abs().max()))
    assert moved[0] == 0 and moved[1] > 2e-3


def test_contact_that_there_is_not_is_refused():
    with pytest.raises(ValueError, match="contact must be point or links, got 'capsule'"):
        make("retraction", contact="capsule")
    with pytest.raises(ValueError, match="contact is links, which all episodes share, but randomisation gives each its tool"):
        make("retraction", contact="links", randomisation={"tool": 0.5})


def test_a_spot_of_dye_shows_where_the_task_is():
    """Without it, and without the tool, all episodes begin with one picture, and nobody could tell from it what to do."""
    batch = TaskBatch("retraction", load_scene(), 8, "image", sight=SightConfig(instrument=False), device="cpu")
    plain = TaskBatch("retraction", load_scene(), 8, "image", sight=SightConfig(instrument=False, dye=False), device="cpu")
    for each in (batch, plain):
        each.reset(range(8), [np.random.default_rng(seed) for seed in range(8)])
    images, without = batch.images().astype(int), plain.images().astype(int)
    assert (without == without[0]).all() and len(np.unique(images, axis=0)) == 8
    camera = batch.pictures.camera
    where = np.linalg.inv(camera.pose) @ np.append(batch.task.origin, np.ones((8, 1)), 1).T
    places = (camera.K @ where[:3] / where[2])[:2].T
    for image, before, place in zip(images, without, places):
        v, u = np.nonzero(image[..., 2] - image[..., 0] > 40)
        assert np.abs(np.array([u.mean() + 0.5, v.mean() + 0.5]) - place).max() < 2.0, "it is 7 pixels wide"
        assert 10 < (np.abs(image - before).max(-1) > 20).sum() < 120, "the rest stays as it was"


@pytest.mark.thorough
@pytest.mark.dds
def test_environments_in_processes_of_their_own_are_the_single_ones_also_when_forked():
    """In a process of its own, as a forked one may wait for ever for threads that only its parent has."""
    code = f"""
import sys
sys.path.insert(0, {str(ROOT / "test/learning")!r})
import gymnasium, numpy as np
from played_tasks import IDS, make
single = make("retraction", observations="both")  # whose threads a forked process has not
many = gymnasium.make_vec(
    IDS["retraction"], num_envs=2, vectorization_mode="async", device="cpu", observations="both", vector_kwargs={{"context": "fork"}}
)
seen, alone = many.reset(seed=3)[0], single.reset(seed=4)[0]
for _ in range(5):
    for name, value in alone.items():
        np.testing.assert_array_equal(seen[name][1], value)
    seen, alone = many.step(np.full((2, 4), 0.5, np.float32))[0], single.step(np.full(4, 0.5, np.float32))[0]
many.close()
print("same")
"""
    variables = os.environ | {"ENDO_SIM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, env=variables)
    assert done.stdout.strip() == "same", done.stderr


def test_many_environments_begin_anew_one_by_one_and_count_their_seeds():
    many = gymnasium.make_vec(IDS["retraction"], num_envs=2, vectorization_mode="vector_entry_point", device="cpu")
    first, _ = many.reset(seed=np.array([5, 8]))
    np.testing.assert_array_equal(first[1], many.reset(seed=7)[0][1])
    moved = many.step(np.ones((2, 4)))[0]
    again, _ = many.reset(seed=[3, 5], options={"reset_mask": np.array([False, True])})
    np.testing.assert_array_equal(again[0], moved[0])
    np.testing.assert_array_equal(again[1], first[0])
    with pytest.raises(ValueError, match="2 environments need as many seeds, got 1"):
        many.reset(seed=[1])
    with pytest.raises(ValueError, match="as many places in reset_mask, got 3"):
        many.reset(options={"reset_mask": np.ones(3, bool)})


@pytest.mark.slow
def test_ended_environments_begin_anew_at_the_next_step_and_others_go_on():
    many = gymnasium.make_vec(IDS["retraction"], num_envs=2, vectorization_mode="vector_entry_point", device="cpu")
    policy = scripted_policy("retraction")
    observations, _ = many.reset(seed=0)
    idle = np.array([0, 0, 0, -1.0])
    for _ in range(60):
        actions = policy.act(observations)
        actions[1] = idle
        observations, _, terminated, truncated, info = many.step(actions)
        if terminated[0]:
            break
    assert terminated.tolist() == [True, False] and info["success"].tolist() == [True, False]
    before = observations[1]
    observations, rewards, terminated, truncated, _ = many.step(np.tile(idle, (2, 1)))
    assert rewards[0] == 0 and not (terminated | truncated).any()
    o = dict(zip(many.unwrapped.batch.task.observation_names, observations.T))
    assert o["time_left"][0] == 1 and o["force"][0] == 0 and o["spot_moved_z"][0] == 0
    assert o["time_left"][1] < before[-1]


@pytest.mark.slow
def test_pulling_too_hard_ends_the_episode(monkeypatch):
    monkeypatch.setattr(TASKS["retraction"], "force_limit", 0.3)
    environment = make()
    _, rewards, info = play(environment, scripted_policy("retraction"), 0, 60)
    assert len(rewards) < 60 and not info["success"] and info["force"] > 0.3 and rewards[-1] < 0


@pytest.mark.slow
def test_an_inclusion_is_the_region_that_physics_node_would_paint():
    """A factor on each node's moduli gives the bits of painted properties: pins, contact and all."""
    batch = TaskBatch("palpation", load_scene(), 2, device="cpu")
    batch.reset([0, 1], [np.random.default_rng(s) for s in (5, 6)])
    regions = batch.task.regions()
    painted = TissueSimulation.from_nodes(batch.task.nodes, replace(batch.task.physics("cpu"), regions=regions))
    policy, observations = scripted_policy("palpation", 2), batch.observe()
    for _ in range(30):
        observations, _ = batch.step(policy.act(observations))
        pose = np.eye(4)
        pose[:3, 3] = batch.tissue.tools.tips[0, 0].numpy()
        painted.set_grasp("PSM1", pose, False)
        painted.step()
        np.testing.assert_array_equal(batch.tissue.displacements[0].numpy(), painted.solver.displacements())
    assert np.abs(painted.solver.displacements()).max() > 1e-4
    assert not np.array_equal(batch.task.stiffness(0), batch.task.stiffness(1))


def test_stiffness_beyond_what_the_substeps_were_planned_for_is_refused():
    solver = TaskBatch("palpation", load_scene(), 1, device="cpu").tissue.solver
    with pytest.raises(ValueError, match="not above 8"):
        solver.set_stiffness(slice(None), np.full((1, solver.node_count), 9.0))


@pytest.mark.slow
def test_randomisation_changes_what_it_names_and_nothing_else():
    scene = load_scene()

    def first(**kinds):
        batch = TaskBatch("retraction", scene, 1, "both", Randomisation(**kinds), device="cpu")
        batch.reset([0], [np.random.default_rng(3)])
        return batch, batch.observe()

    plain, observed = first()
    for kinds in ({"light": 0.5}, {"texture": 0.8}, {"camera_position": 0.01}, {"camera_angle": 10.0}):
        _, other = first(**kinds)
        assert np.abs(other["image"].astype(int) - observed["image"]).mean() > 1, kinds
        np.testing.assert_array_equal(other["state"], observed["state"])
    soft, other = first(stiffness=1.0)
    np.testing.assert_array_equal(other["image"], observed["image"])
    factors = soft.tissue.solver.scale.numpy()
    assert np.ptp(factors) == 0 and factors[0] != 1 and np.exp(-1) <= factors[0] <= np.e
    with pytest.raises(ConfigError, match=r"Randomisation has no option stifness \(did you mean stiffness\?\); it has stiffness, "):
        make("retraction", randomisation={"stifness": 0.1})
    with pytest.raises(ConfigError, match=r"Randomisation.light must lie in \[0, 0.9\]"):
        make(randomisation={"light": 2.0})


def test_a_task_is_seen_by_the_view_in_the_middle_as_in_the_graph():
    scene = load_scene()
    poses = [np.eye(4), scene.camera.pose, np.eye(4)]
    poses[0][0, 3], poses[2][1, 3] = 0.01, 0.02
    assert np.array_equal(Scene(scene.model, tuple(scene.camera.at(pose) for pose in poses)).camera.pose, poses[1])


@pytest.mark.slow
def test_what_was_felt_most_is_remembered():
    batch = TaskBatch("palpation", load_scene(), 2, device="cpu")
    batch.reset([0, 1], [np.random.default_rng(s) for s in (5, 6)])
    policy, observations = scripted_policy("palpation", 2), batch.observe()
    rows, tips = [], []
    for _ in range(60):
        observations, _ = batch.step(policy.act(observations))
        rows.append(dict(zip(batch.task.observation_names, observations[0].astype(np.float64))))
        tips.append(0.02 * np.array([rows[-1]["tip_x"], rows[-1]["tip_y"]]))
    forces = [row["force"] for row in rows]
    assert max(forces) > 0.3 and forces[-1] < max(forces)
    np.testing.assert_allclose(rows[-1]["most"], max(forces))
    where = tips[-1] + 0.02 * np.array([rows[-1]["most_from_tip_x"], rows[-1]["most_from_tip_y"]])
    np.testing.assert_allclose(where, tips[int(np.argmax(forces))], atol=1e-8)


def test_a_report_is_ten_steps_that_say_so():
    environment = make("palpation")
    environment.reset(seed=0)
    ended = [environment.step(np.array([0, 0, 0, sign]))[2] for sign in [1] * 9 + [-1] + [1] * 10]
    assert ended == [False] * 19 + [True]


@pytest.mark.parametrize(
    "options, sentence",
    [
        ({"task": "suturing"}, "there is no task 'suturing'; there are retraction, palpation"),
        ({"observations": "smell"}, "observations must be state, image, both or sensors, got 'smell'"),
        ({"render_mode": "human"}, "render_mode must be rgb_array or None, got 'human'"),
        ({"scene": "no/such/model.ply"}, "no/such/model.ply: no such file"),
        ({"device": "abacus"}, "unknown device 'abacus'"),
        ({"observations": "image", "image_width": 1}, "SightConfig.image_width must lie in [16, 8192] pixels, got 1"),
        ({"eyes": 2}, "eyes is 2, but observations is state, which has no images; ask for image or both"),
        ({"segmentation": True}, "segmentation is True, but observations is state, which has no images; ask for image or both"),
        ({"tool": "PERMANENT_CAUTERY_HOOK"}, "retraction closes the jaws of its tool, but PERMANENT_CAUTERY_HOOK has none; name a tool"),
        ({"task": "dissect", "observations": "image", "tool": "PERMANENT_CAUTERY_HOOK"}, "dissect closes the jaws of its tool, but PERMA"),
        ({"observations": "image", "eyes": 3}, "SightConfig.eyes must be one of 1, 2"),
        ({"observations": "image", "tool": "SPOON"}, "tool must be the path of a .json file or one of CURVED_SCISSORS_400178"),
    ],
)
def test_mistakes_are_one_sentence(options, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        environments.TaskEnvironment(**{"task": "retraction", "device": "cpu", **options})


@pytest.mark.parametrize(
    "actions, sentence",
    [
        (np.zeros((1, 4)), "retraction: actions must be 2 × 4 numbers, got the shape (1, 4)"),
        (np.array([[0, 0, 0, 1], [0, np.nan, 0, 1]]), "retraction: the action of episode 1 is not finite: [0.0, nan, 0.0, 1.0]"),
    ],
)
def test_a_wrong_action_is_one_sentence_and_changes_nothing(actions, sentence):
    environment = environments.VectorTaskEnvironment("retraction", 2, device="cpu")
    before, _ = environment.reset(seed=1)
    with pytest.raises(ValueError, match=re.escape(sentence)):
        environment.step(actions)
    np.testing.assert_array_equal(environment.batch.observe(), before)


def test_a_model_too_small_for_the_task_is_refused():
    scene = load_scene()
    near = (scene.model.means[:, :2].abs() < 0.012).all(1)
    small = Scene(scene.model.select(near), scene.cameras)
    with pytest.raises(ValueError, match="palpation: no skin node is 0.02 m from where tissue is held; the model is too small"):
        TaskBatch("palpation", small, 1, device="cpu")


@pytest.mark.thorough
@pytest.mark.dds
def test_without_gymnasium_one_sentence_says_what_to_install():
    code = "import sys; sys.modules['gymnasium'] = None; import endo_sim_ros.learning.train, endo_sim_ros.learning.environments"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stderr.rstrip().endswith("the environments need gymnasium, which is not installed; pip install 'endo_sim_ros[learning]'")


@pytest.mark.parametrize("task", TASKS)
def test_actions_mean_the_same_in_the_picture_in_all_episodes(task):
    scene, rolled = load_scene("phantom:0"), np.eye(4)
    rolled[:2, :2] = [[0.5, -(0.75**0.5)], [0.75**0.5, 0.5]]  # by 60° about the line of sight
    endoscope = scene.camera.pose @ rolled
    played = find_task(task)(scene.nodes(find_task(task).physics("cpu")), endoscope, 32)
    for b in range(32):
        played.reset(b, np.random.default_rng(b))
    looks = np.tile(endoscope, (32, 1, 1)) if played.turns or not played.roams else played.endoscopes()
    x, y, z = np.einsum("bij,bjk->ibk", played.axes, looks[:, :3, :3])
    np.testing.assert_allclose(np.cross(x, y), z, atol=1e-12)
    assert x[:, 0].min() > 0.9 and y[:, 1].max() < -0.9  # to the right, and up


@pytest.mark.parametrize("observations", ["state", "both"])
def test_a_tool_that_there_is_not_is_told_whether_pictures_show_it_or_not(observations):
    with pytest.raises(ValueError, match="SPOON"):
        make(observations=observations, tool="SPOON")


def test_options_without_an_effect_are_refused(tmp_path):
    for options in ({"tool": "LARGE_NEEDLE_DRIVER"}, {"randomisation": {"tool": 1.0}}):
        with pytest.raises(ValueError, match="tool has no effect while instrument is false; leave one of the two out"):
            make(observations="both", instrument=False, **options)
    make(observations="both", instrument=False, actions="joints", tool="LARGE_NEEDLE_DRIVER")  # whose joints these are
    out = tmp_path / "out"
    for command, sentence in (
        (train.Command(out, vary=Randomisation(light=0.5)), "vary.light has no effect on states, which this policy takes; leave it out"),
        (train.Command(out, vary=Randomisation(tool=1.0)), "vary.tool has no effect on states"),
        (scene.Command(out, instrument=False, tool="MARYLAND_BIPOLAR_FORCEPS"), "tool has no effect while instrument is false"),
        (demonstrate.Command("retraction", out, sight=SightConfig(baseline=0.01)), "baseline has no effect while eyes is 1; set eyes to 2"),
    ):
        with pytest.raises(ConfigError, match=sentence):
            command.run()
    assert not out.exists()
