"""The task in which actions move the endoscope."""

from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from played_tasks import make
from scipy.spatial.transform import Rotation

from endo_sim_ros.core.cameras import invert_pose
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.light import SURFACE
from endo_sim_ros.instruments import load_arm, place_arm
from endo_sim_ros.learning.actions import arm_commands, command_names
from endo_sim_ros.learning.config import DemonstrationConfig, Randomisation, SightConfig
from endo_sim_ros.learning.dataset import COMMAND
from endo_sim_ros.learning.demonstrations import demonstrate
from endo_sim_ros.learning.policies import scripted_policy
from endo_sim_ros.learning.scenes import Scene, load_scene
from endo_sim_ros.learning.task_batch import TaskBatch
from endo_sim_ros.learning.tasks import Camera

RIGHT, UP, NEAR, TURN = np.eye(4)


@pytest.fixture(scope="module")
def batch():
    """Two episodes, with pictures of the right eye too."""
    return TaskBatch("camera", load_scene(), 2, "both", sight=SightConfig(image_width=200, eyes=2, segmentation=True), device="cpu")


def start(batch, seed=0):
    batch.reset([0, 1], [np.random.default_rng(seed + b) for b in range(2)])
    return batch.observe()


def in_picture(batch, b=0):
    """Where the tip of an episode is in the picture, pixels, and its depth, m."""
    uv, z = batch.pictures.camera.at(batch.pictures.poses[b]).project(batch.task.tips()[b : b + 1])
    return uv[0], z[0]


def test_the_endoscope_is_on_an_ecm_about_its_remote_centre(batch):
    """As `place_arm` puts one, and whatever is done its shaft goes through that point."""
    start(batch)
    task, camera = batch.task, load_scene().camera
    arm = load_arm("ECM")
    placed = place_arm("ECM", arm, camera, load_scene().depth)
    for _ in range(5):
        batch.step(np.random.default_rng(1).uniform(-1, 1, (2, 4)))
    poses = task.endoscopes()
    np.testing.assert_allclose(poses, placed.base @ arm.tip_pose(task.joints), atol=1e-12)
    centre = np.array([(invert_pose(pose) @ np.append(placed.base[:3, 3], 1))[:3] for pose in poses])
    np.testing.assert_allclose(centre[:, :2], 0, atol=1e-12)


def test_actions_turn_slide_and_roll_as_the_picture_shows(batch):
    for action, change in ((RIGHT, (-1, 0)), (UP, (0, 1))):  # the tip goes to the left, and down
        start(batch)
        before, _ = in_picture(batch)
        own = batch.task.tips()[0].copy()
        batch.step(np.stack([action, action]))
        pose = batch.pictures.poses[0]
        after, _ = batch.pictures.camera.at(pose).project(own[None])
        moved = (after[0] - before) / batch.pictures.camera.K[0, 0]
        assert moved @ change > 0.015 and abs(moved @ change[::-1]) < 0.25 * abs(moved @ change), "whatever the roll is"
    start(batch)
    depth, joints = in_picture(batch)[1], batch.task.joints.copy()
    batch.step(np.stack([NEAR, TURN]))
    assert in_picture(batch)[1] == pytest.approx(depth - Camera.step_length, abs=1.5e-3), "the tip moves as well"
    np.testing.assert_allclose(batch.task.joints - joints, [[0, 0, Camera.step_length, 0], [0, 0, 0, Camera.roll]], atol=1e-12)


@pytest.mark.slow
def test_pictures_are_those_of_the_moved_endoscope(batch):
    """The jaws are around the place where the tip is to be seen, and a still picture at the same place is the same."""
    observation, script = start(batch, 3), scripted_policy("camera", 2)
    for _ in range(12):
        observation, _ = batch.step(script.act(observation["state"]))
    for b in range(2):
        (u, v), _ = in_picture(batch, b)
        jaws = np.argwhere(observation["segmentation"][b, ..., 0] >= 4)
        assert np.linalg.norm(jaws - [v, u], axis=1).min() < 8
    scene = load_scene()
    for b, pose in enumerate(batch.task.endoscopes()):
        there = Scene(scene.whole, (scene.camera.at(pose),))
        still = TaskBatch("retraction", there, 1, "image", sight=SightConfig(image_width=200, instrument=False, dye=False), device="cpu")
        still.reset([0], [np.random.default_rng(0)])
        tissue = observation["segmentation"][b, ..., 0] == 1
        differ = np.abs(still.images()[0].astype(int) - observation["image"][b])[tissue].max(1)
        assert np.quantile(differ, 0.5) <= 1, "but for the shadow of the tool"
    assert (observation["image"] != observation["image_right"]).any()
    assert SURFACE < 1 and (observation["segmentation"] == 0).mean() < 0.02, "the patient goes on beyond the scene"


@pytest.mark.thorough
@pytest.mark.slow
def test_a_demonstration_tells_where_the_endoscope_is_and_goes(tmp_path):
    config = DemonstrationConfig(episodes=1, environments=1, images="png", noise=0.0)
    varied = Randomisation(camera_position=0.002, camera_angle=2.0)
    of = "camera", ["phantom:0"], tmp_path / "out"
    demonstrate(*of, replace(config, license="cc0-1.0"), SightConfig(image_width=32), varied, device="cpu")
    card = (tmp_path / "out/README.md").read_text()
    assert "| absolute pose of" not in card and "license: cc0-1.0\n" in card and "| license | cc0-1.0 |" in card
    assert "`action.cartesian_absolute` | [7] | the same as absolute pose of the endoscope on the ECM" in card and "ECM.qw |" in card
    assert "each tip moves" not in card and "simulated ECM of a da Vinci" in card
    with pytest.raises(SequenceError, match="was begun with license 'cc0-1.0'; continue it with the same options"):
        demonstrate(*of, config, SightConfig(image_width=32), varied, device="cpu")
    (path,) = (tmp_path / "out").glob("data/*/*.parquet")
    table = pq.read_table(path, columns=["observation.endoscope", "command.endoscope", "action", "observation.camera_pose", COMMAND])
    joints, wanted, actions, seen, told = (np.array(column.to_pylist()) for column in table.columns)
    np.testing.assert_allclose(wanted[:, 2] - joints[:, 2], Camera.step_length * actions[:, 2].clip(-1, 1), atol=1e-6)
    np.testing.assert_allclose(seen[1:], told[:-1], atol=1e-6, err_msg="pictures are from where the endoscope was told to go")
    assert np.ptp(seen[:, 0]) > 1e-4
    assert np.abs(joints[-1, 3]) < Camera.level and np.abs(joints[0, 3]) > Camera.level


def test_what_is_commanded_is_where_the_endoscope_goes():
    sight, varied = SightConfig(image_width=16), Randomisation(camera_position=0.01, camera_angle=5.0)
    batch = TaskBatch("camera", load_scene(), 2, "image", varied, sight, "cpu")
    batch.reset([0, 1], [np.random.default_rng(seed) for seed in (0, 1)])
    actions = np.array([[1.0, -0.5, 0.3, 1.0], [-1.0, 1.0, -1.0, -0.2]])
    assert batch.pictures is not None
    told = arm_commands(batch.task, actions, batch.pictures.moved)
    before = batch.pictures.poses.copy()
    batch.step(actions)
    np.testing.assert_allclose(told[:, :3], batch.pictures.poses[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(Rotation.from_quat(told[:, 3:]).as_matrix(), batch.pictures.poses[:, :3, :3], atol=1e-9)
    assert np.abs(told[:, :3] - before[:, :3, 3]).max() > 1e-3 and len(command_names(batch.task)) == told.shape[1] == 7


def test_actions_of_the_joints_of_the_tool_are_refused():
    with pytest.raises(ValueError, match="camera acts by the joints of the endoscope, not by those of the tool; leave actions"):
        make("camera", actions="joints")
