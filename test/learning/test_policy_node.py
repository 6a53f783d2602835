"""Tasks over topics are, bit for bit, those of the environment."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import rclpy
from blue_seeker import BlueSeeker
from forked_nodes import ForkedNodes
from played_tasks import joint_policy, linear_policy, make
from ros_bench import Bench
from waiting import wait_until

from endo_sim_ros import messages
from endo_sim_ros.learning.config import DemonstrationConfig, ImitationConfig, SightConfig
from endo_sim_ros.learning.demonstrations import demonstrate
from endo_sim_ros.learning.graph_files import save_scene
from endo_sim_ros.learning.keypoint_policy import KeypointPolicy, train_keypoints
from endo_sim_ros.learning.policies import make_policy, scripted_policy
from endo_sim_ros.learning.scenes import load_scene
from endo_sim_ros.learning.task_batch import TaskBatch
from endo_sim_ros.learning.tasks import TASKS
from endo_sim_ros.physics import MotionConfig

pytestmark = pytest.mark.dds

SEED = 4


PICTURES = {"image": messages.RENDERED_IMAGE, "image_right": messages.RENDERED_RIGHT_IMAGE, "segmentation": messages.RENDERED_SEGMENTATION}


def assert_same_as_environment(record, policy, episodes, environment):
    """The steps in a file are, bit for bit, those of an environment; returns what it shows in the last episode, the first at rest."""
    heard, k = np.load(record), 0
    state = lambda seen: seen["state"] if isinstance(seen, dict) else seen
    for episode in range(episodes):
        seen, _ = environment.reset(seed=SEED + episode)
        observation, images = state(seen), [seen]
        policy.reset([0])
        ended = False
        while not ended:
            action = policy.act(observation[None])[0]
            assert heard["observations"][k].tobytes() == observation.tobytes(), k
            assert heard["actions"][k].tobytes() == action.tobytes(), k
            seen, reward, terminated, truncated, info = environment.step(action)
            observation = state(seen)
            ended = terminated or truncated
            assert heard["rewards"][k] == reward and heard["success"][k] == info["success"], k
            images.append(seen)
            k += 1
    assert k == len(heard["rewards"])
    return images


def step_number(message):
    """Which step of an episode a message is of."""
    return messages.stamp_to_ns(message.header.stamp) / 40_000_000


def episodes_of(received):
    """Messages by episode: at the beginning of each the tissue is reset, and stamps go back."""
    begins = [i for i, (a, b) in enumerate(pairwise(received), 1) if step_number(b) < step_number(a)]
    return [received[i:j] for i, j in pairwise([0, *begins, len(received)])]


def compare(part, name, images):
    """Steps of an episode whose messages are the pictures of an environment's, and those whose messages are not."""
    decode = messages.decode_labels if name == "segmentation" else messages.decode_image
    pictures = {step_number(message): decode(message, "rendered") for message in part}
    # The last of several pictures at rest has the tool where the episode begins. It was missed if the next one was, too.
    rested = sum(step_number(message) < 1 for message in part) > 1 and 1 in pictures
    same = {
        k: np.array_equal(picture.squeeze(), images[int(k)][name].squeeze())
        for k, picture in pictures.items()
        if (rested or k >= 1) and k < len(images)
    }
    return [k for k, equal in same.items() if equal], [k for k, equal in same.items() if not equal]


def shows(part, name, images):
    """Whether messages of an episode are the pictures of an environment's, and at least half of them."""
    same, differing = compare(part, name, images)
    return len(same) > len(images) / 2 and not differing


def all_said(user, folder):
    """What nodes logged, and what they said last on /diagnostics: the log has only what they waited for when they began."""
    return [(log.name, log.read_text()[-800:]) for log in folder.iterdir()], {name: said[-1] for name, said in user.statuses.items()}


@pytest.fixture
def user():
    """Somebody who listens to the graph."""
    rclpy.init()
    user = Bench()
    yield user
    user.close()
    rclpy.try_shutdown()


@pytest.mark.slow
@pytest.mark.parametrize(
    "task, episodes, instrument, contact, motion",
    [
        ("retraction", 2, True, "point", MotionConfig()),
        pytest.param("palpation", 1, False, "point", MotionConfig(breathing=0.004, heartbeat=0.001), marks=pytest.mark.thorough),
        pytest.param("tracking", 1, False, "point", MotionConfig(), marks=pytest.mark.thorough),
        pytest.param("tension", 1, True, "links", MotionConfig(), marks=pytest.mark.thorough),
        pytest.param("handover", 1, True, "point", MotionConfig(), marks=pytest.mark.thorough),
        pytest.param("camera", 1, True, "point", MotionConfig(), marks=pytest.mark.thorough),
        pytest.param("clip", 1, True, "point", MotionConfig(breathing=0.003), marks=pytest.mark.thorough),
        pytest.param("dissect", 1, True, "point", MotionConfig(), marks=pytest.mark.thorough),
    ],
)
def test_over_topics_observations_images_and_actions_are_bit_for_bit_those_of_the_environment(
    task, episodes, instrument, contact, motion, user, tmp_path
):
    sight = SightConfig(instrument=instrument)
    save_scene(load_scene(), tmp_path, task, seed=SEED, sight=sight, motion=motion, contact=contact)
    heard = {name: [] for name in PICTURES}
    for name, topic in PICTURES.items():
        user.user.subscribe(topic, heard[name].append, depth=1000)  # all that come while this process does not spin
    commands: list = []  # of the first run: who listens when it begins hears all
    user.user.subscribe(messages.tool_pose_command("PSM1"), commands.append, depth=1000)
    outcomes: list = []
    user.user.subscribe(messages.TASK_OUTCOME, outcomes.append, depth=1000)
    with ForkedNodes(tmp_path / "logs") as group:
        parameters = ("--params-file", str(tmp_path / "parameters.yaml"))
        logs = lambda: all_said(user, tmp_path / "logs")  # noqa: E731

        def run(record, **options):
            node = group.start("policy_node", *parameters, record=record, episodes=episodes, **options)
            if "reconstruction_node" not in group.nodes:
                group.start("reconstruction_node", *parameters, output_dir=tmp_path)
            user.until(lambda: node.exit_status is not None, logs, 120)  # by itself; images come meanwhile
            assert node.exit_status == 0 and record.exists(), logs()

        group.start("physics_node", *parameters, device="cpu")
        group.start("rendering_node", *parameters, device="cpu")
        user.until(lambda: user.user.count_publishers("rendered/image_raw"), "the rendering node", 60)
        run(tmp_path / "scripted.npz")
        given = len(np.load(tmp_path / "scripted.npz")["rewards"]) + episodes  # and where each episode begins
        user.until(lambda: len(commands) == given, lambda: f"{len(commands)} of {given} commands")
        user.until(lambda: len(outcomes) == given - episodes, lambda: f"{len(outcomes)} of {given - episodes} outcomes")
        told = np.array([messages.decode_outcome(outcome, "task_outcome") for outcome in outcomes])
        scene = tmp_path if TASKS[task].roams else None  # the edge of a larger model is seen a little otherwise
        pictured = make(
            task, scene=scene, observations="both", eyes=2, segmentation=True, instrument=instrument, motion=motion, contact=contact
        )
        images = assert_same_as_environment(tmp_path / "scripted.npz", scripted_policy(task), episodes, pictured)
        # They may come late; an earlier episode, or some pictures of one, may be missed.
        shown = lambda name: any(shows(part, name, images) for part in episodes_of(heard[name]))
        came = lambda: (
            {
                name: (list(map(step_number, got)), [compare(part, name, images)[1] for part in episodes_of(got)])
                for name, got in heard.items()
            }
            | {"renderer": user.statuses["rendering_node"][-1]}
        )
        user.until(lambda: all(map(shown, heard)), came, 40)
        if episodes > 1:
            linear_policy().save(tmp_path / "policy.npz")
            run(tmp_path / "learned.npz", policy=tmp_path / "policy.npz")
            joint_policy().save(tmp_path / "by_joints.npz")
            run(tmp_path / "joints.npz", policy=tmp_path / "by_joints.npz")
            other = group.start("policy_node", scene=tmp_path, task="palpation")  # for which other tissue is needed
            wait_until(lambda: "is not that of the scene and the task" in other.log.read_text(), 60, logs)
            assert other.exit_status is None
    scripted = np.load(tmp_path / "scripted.npz")
    assert scripted["success"][-1] and (TASKS[task].thing() is None or "closed on nothing" not in str(logs()))
    for column, name in ((0, "rewards"), (2, "success")):
        np.testing.assert_array_equal(told[:, column], scripted[name])
    np.testing.assert_array_equal(told[:, 1], np.append(np.diff(scripted["episode"]), 1))  # an episode ends before the next begins
    np.testing.assert_array_equal(told[:, 3], SEED + scripted["episode"])
    assert (images[-1]["segmentation"] > 1).any() == instrument
    if episodes > 1:
        assert_same_as_environment(tmp_path / "learned.npz", linear_policy(), episodes, make(task))
        assert np.load(tmp_path / "learned.npz")["success"][-1]
        assert_same_as_environment(tmp_path / "joints.npz", joint_policy(), episodes, make(task, actions="joints"))
        felt = np.load(tmp_path / "joints.npz")["observations"][:, TASKS[task].observation_names.index("force")]
        assert (felt > 0.1).any(), "it holds tissue"


def test_links_that_are_not_there_or_that_cut_are_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match="leave instrument at true"):
        save_scene(load_scene(), tmp_path / "scene", "retraction", sight=SightConfig(instrument=False), contact="links")
    with pytest.raises(ValueError, match="dissect cuts with the edges of points"):
        save_scene(load_scene(), tmp_path / "scene", "dissect", contact="links")
    assert not (tmp_path / "scene").exists()


def play(user, folder, task, policy, sight, episodes, mode="lockstep", **options):
    """Let policy_node play in the graph that `endo-sim scene` writes; returns it, what it wrote, and the outcomes that were heard."""
    save_scene(load_scene(), folder, task, seed=SEED, sight=sight, mode=mode)
    outcomes: list = []
    user.user.subscribe(messages.TASK_OUTCOME, outcomes.append, depth=1000)
    with ForkedNodes(folder / "logs") as group:
        parameters, record = ("--params-file", str(folder / "parameters.yaml")), folder / "episodes.npz"
        logs = lambda: all_said(user, folder / "logs")  # noqa: E731
        node = group.start("policy_node", *parameters, policy=policy, record=record, episodes=episodes, **options)
        for name in ("physics_node", "rendering_node"):
            group.start(name, *parameters, device="cpu")
        group.start("reconstruction_node", *parameters, output_dir=folder)
        user.until(lambda: node.exit_status is not None, logs, 120)
    heard = np.load(record) if record.exists() else None
    if heard is not None:
        user.until(lambda: len(outcomes) >= len(heard["rewards"]), lambda: f"{len(outcomes)} outcomes")
    return node, heard, [messages.decode_outcome(outcome, "task_outcome") for outcome in outcomes]


def imitate(task, folder):
    """The folder of a keypoint policy that learned hardly anything: what it does depends on each picture all the same."""
    pytest.importorskip("pyarrow", reason="datasets need pyarrow")
    config, sight = DemonstrationConfig(episodes=1, environments=1), SightConfig(image_width=40, eyes=2)
    demonstrate(task, ["phantom:0"], folder / "demonstrations", config, sight, device="cpu")
    train_keypoints(folder / "demonstrations", folder / "policy", ImitationConfig(steps=3, batch_size=4), device="cpu")
    return str(folder / "policy")


HERE = Path(__file__).parent
BLUE_SEEKER = f"{HERE / 'blue_seeker.py'}:BlueSeeker"
SHORT = f"{HERE / 'short_tasks.py'}:Short"


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize(
    "task, episodes, imitated",
    [
        pytest.param("retraction", 2, False, id="retraction"),
        pytest.param(f"{SHORT}Camera", 1, True, id="camera", marks=pytest.mark.thorough),
        pytest.param(f"{SHORT}Handover", 1, True, id="handover", marks=pytest.mark.thorough),
    ],
)
def test_a_policy_that_sees_acts_over_topics_as_in_the_environment(task, episodes, imitated, user, tmp_path):
    named = imitate(task, tmp_path) if imitated else BLUE_SEEKER
    policy = make_policy(named, task, device="cpu")
    assert isinstance(policy, KeypointPolicy) == imitated and policy.sight is not None
    node, heard, _ = play(user, tmp_path, task, named, policy.sight, episodes, device="cpu")
    assert node.exit_status == 0 and heard is not None and "learned from" not in node.log.read_text(), node.log.read_text()
    k, scene = 0, load_scene(tmp_path)
    batch = TaskBatch(task, scene, 1, "sensors", sight=policy.sight, device="cpu")
    for episode in range(episodes):
        batch.reset([0], [np.random.default_rng(SEED + episode)])
        seen, ended = batch.observe(), False
        while not ended:
            action = policy.act(seen)
            assert heard["actions"][k].tobytes() == action[0].tobytes(), k
            seen, outcome = batch.step(action)
            assert heard["rewards"][k] == outcome.reward[0] and heard["success"][k] == outcome.success[0], k
            ended = bool(outcome.terminated[0] | outcome.truncated[0])
            k += 1
    assert k == len(heard["rewards"]) and np.ptp(heard["actions"], 0).max() > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "task, policy",
    [
        pytest.param("handover", "scripted", id="handover-scripted", marks=pytest.mark.thorough),
        pytest.param(f"{SHORT}Retraction", BLUE_SEEKER, id="retraction-seeker"),
    ],
)
def test_in_real_time_a_policy_acts_on_the_newest_state_until_its_episodes_end(task, policy, user, tmp_path):
    node, heard, told = play(user, tmp_path, task, policy, BlueSeeker.sight, 2, mode="realtime")
    assert node.exit_status == 0 and heard is not None, node.log.read_text()
    ends = np.append(np.diff(heard["episode"]), 1)
    for column, values in ((0, heard["rewards"]), (1, ends), (2, heard["success"]), (3, SEED + heard["episode"])):
        np.testing.assert_array_equal(np.array(told)[:, column], values)
    assert ends.sum() == 2 and (policy != "scripted" or heard["success"].sum() == 2)


@pytest.mark.slow
def test_a_policy_that_fails_ends_the_node_with_a_sentence_and_the_episodes_before_are_kept(user, tmp_path):
    other = replace(BlueSeeker.sight, tool="MARYLAND_BIPOLAR_FORCEPS", dye=False, baseline=0.01)
    node, heard, _ = play(user, tmp_path, "retraction", BLUE_SEEKER.replace("BlueSeeker", "Lost"), other, 3)
    text = node.log.read_text()
    for told in (
        *("pictures with dye: yes; here it is no", "pictures with distance between the eyes, mm: 4.14; here it is 10"),
        "pictures with tool of PSM1: PROGRASP_FORCEPS; here it is MARYLAND_BIPOLAR_FORCEPS",
    ):
        assert text.count(told) == 1, text
    assert node.exit_status == 1 and "retraction: the action of episode 0 is not finite" in text and "Traceback" not in text, text
    assert heard is not None and set(heard["episode"]) == {0}
