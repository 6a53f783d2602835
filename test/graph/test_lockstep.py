"""Lockstep: one command, one step, one state, one image, all with the command's stamp; run after run the same bytes."""

import re
import subprocess
import sys
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rclpy
from forked_nodes import ForkedNodes
from ros_bench import HEIGHT, WIDTH, Bench, K, report, send_camera, send_model, sheet, start_ros
from std_srvs.srv import SetBool, Trigger
from waiting import wait_until

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera, save_cameras
from endo_sim_ros.core.gaussians import save_ply
from endo_sim_ros.core.tissue_motion import PeriodicMotion, TissueMotion
from endo_sim_ros.messages import ERROR, OK
from endo_sim_ros.nodes import base
from endo_sim_ros.nodes.physics_node import PhysicsNode
from endo_sim_ros.nodes.rendering_node import RenderingNode
from endo_sim_ros.sequences.bag import BagReader

pytestmark = pytest.mark.dds

MODEL_STAMP, STEP = 5_000_000_000, 20_000_000  # ns
PARAMETERS = {
    "physics_node": {
        "node_count": 300,
        "step_duration": 0.02,
        "force_radius": 0.02,
        "mode": "lockstep",
        "device": "cpu",
        "link_contact": False,
    },
    "rendering_node": {"mode": "lockstep", "device": "cpu"},
}
IMAGES = messages.RENDERED_IMAGE
POSE, WRENCH = messages.tool_pose_command("PSM1"), messages.tool_wrench("PSM1")
SHOWN = (messages.RENDERED_IMAGE, messages.RENDERED_DEPTH, messages.RENDERED_SEGMENTATION)  # recorded only where they are named
STATES = (messages.CONTROL_NODES, messages.tool_reaction("PSM1"), messages.CLOCK, *messages.RENDERED_TOPICS)


@pytest.fixture(scope="module", autouse=True)
def ros():
    start_ros(**PARAMETERS | {"physics_node": PARAMETERS["physics_node"] | {"arm_source": "commanded"}})
    yield
    rclpy.try_shutdown()


@pytest.fixture
def bench():
    bench = Bench()
    for topic in (*STATES, messages.tool_pose("PSM1"), messages.tool_jaw_state("PSM1"), messages.TOOL_MARKERS):
        bench.hear(topic)
    yield bench
    bench.close()


@pytest.fixture
def graph(bench):
    """Physics and rendering in this process, with a model and a camera."""
    bench.add(PhysicsNode)
    bench.add(RenderingNode)
    send_camera(bench)
    send_model(bench, sheet(tilt=0.3), MODEL_STAMP)
    await_images(bench, 1)  # the first observation
    return bench


def stamps(bench, topic):
    found = bench.heard[topic.name]
    return [messages.stamp_to_ns(m.clock if topic is messages.CLOCK else m.header.stamp) for m in found]


def await_images(bench, count):
    bench.until(lambda: len(bench.heard[IMAGES.name]) >= count, lambda: f"{count} images: {bench.statuses}", 40)


def command(bench, stamp, force=(0.0, 0.0, -1.0), parts=(POSE, WRENCH)):
    pose = np.eye(4)
    pose[:3, 3] = 0, 0, 0.1
    made = {
        POSE: messages.encode_pose(pose, stamp, "world"),
        WRENCH: messages.encode_wrench(np.array(force), np.zeros(3), stamp, "world"),
    }
    for part in parts:
        bench.publish(part, made[part])


def test_each_command_is_one_step_and_one_image_with_its_stamp(graph):
    assert stamps(graph, IMAGES) == [MODEL_STAMP]
    sent = [MODEL_STAMP + k * STEP for k in range(1, 21)]
    for k, stamp in enumerate(sent):  # all at once: none may be lost, whatever the order of the parts
        command(graph, stamp, parts=(POSE, WRENCH) if k % 2 else (WRENCH, POSE))
    await_images(graph, 21)
    graph.until(lambda: len(graph.heard["PSM1/body/measured_cf"]) == 21)
    for topic in STATES:
        expected = sent if topic is messages.CLOCK else [MODEL_STAMP, *sent]
        assert stamps(graph, topic) == expected, topic.name
    images = [messages.decode_image(image).astype(int) for image in graph.heard[IMAGES.name]]
    assert np.abs(images[-1] - images[0]).max() > 8  # each shows its own state
    force, _ = messages.decode_wrench(graph.heard["PSM1/body/measured_cf"][-1], "")
    np.testing.assert_allclose(force, [0, 0, 1], atol=1e-9)
    answer = graph.call(Trigger, "/physics_node/step")
    assert answer.success and answer.message == f"time {21 * STEP * 1e-9:.4f} s"


def test_step_takes_as_many_steps_as_asked_for_and_pause_is_refused(graph):
    command(graph, MODEL_STAMP + STEP)
    assert graph.set("physics_node", step_count=3)[0]
    assert graph.call(Trigger, "/physics_node/step").success
    await_images(graph, 5)
    assert stamps(graph, IMAGES) == [MODEL_STAMP + k * STEP for k in range(5)]
    answer = graph.call(SetBool, "/physics_node/pause", data=True)
    assert not answer.success and "nothing to pause" in answer.message
    assert not graph.set("physics_node", mode="realtime")[0]


def test_reset_gives_the_first_observation_and_time_begins_anew(graph):
    for k in range(1, 4):
        command(graph, MODEL_STAMP + k * STEP)
    await_images(graph, 4)
    assert graph.call(Trigger, "/physics_node/reset").success
    await_images(graph, 5)
    command(graph, 7)  # nanoseconds: earlier than before
    await_images(graph, 6)
    assert stamps(graph, IMAGES)[-2:] == [MODEL_STAMP, 7]
    first, again = (messages.decode_image(graph.heard[IMAGES.name][k]) for k in (0, 4))
    np.testing.assert_array_equal(first, again)


def test_resets_that_the_renderer_has_not_shown_yet_give_one_image(bench):
    bench.add(PhysicsNode)
    rendering = bench.add(RenderingNode)
    send_model(bench, sheet(tilt=0.3), MODEL_STAMP)  # there is no camera yet
    bench.until(lambda: stamps(bench, messages.CONTROL_NODES) == [MODEL_STAMP], "the state at rest")
    for _ in range(5):
        assert bench.call(Trigger, "/physics_node/reset").success
    command(bench, 100)
    assert bench.call(Trigger, "/physics_node/reset").success  # after a command: another episode
    bench.until(lambda: len(stamps(bench, messages.CONTROL_NODES)) == 8, "all states")
    bench.spin(0.3)
    send_camera(bench)
    await_images(bench, 3)
    bench.until(lambda: not rendering._states, "the end of what waits")
    bench.spin(0.3)
    assert stamps(bench, IMAGES) == [MODEL_STAMP, 100, MODEL_STAMP]


def test_a_cut_is_shown_with_the_states_that_have_it_and_the_same_bytes_come_again(graph):
    surfaces, runs = graph.hear(messages.CUT_SURFACE), []
    assert graph.set("physics_node", blade_length=0.05)[0]
    graph.until(lambda: graph.nodes[1].simulation.config.blade_length == 0.05)
    for _ in range(2):
        first = len(graph.heard[IMAGES.name])
        assert graph.call(Trigger, "/physics_node/reset").success
        await_images(graph, first + 1)
        for k in range(1, 22):
            pose = np.eye(4)
            pose[:3, 3] = 0.0, 0.004 * (k - 11), 0.13  # the blade goes right through
            if k == 20:  # then the tool pulls at one side
                pose[:3, 3] = 0.02, 0, 0.1
            graph.publish(POSE, messages.encode_pose(pose, k * STEP, "world"))
            force = np.array([1.0, 0, 0]) * (k >= 20)
            if k == 2:
                graph.publish(messages.tool_cut("PSM1"), messages.encode_cut(True, k * STEP))
                graph.until(lambda: graph.nodes[1].arms["PSM1"].cutting)
            if k == 20:
                graph.publish(messages.tool_cut("PSM1"), messages.encode_cut(False, k * STEP))
                graph.until(lambda: not graph.nodes[1].arms["PSM1"].cutting)
            graph.publish(WRENCH, messages.encode_wrench(force, np.zeros(3), k * STEP, "world"))
            await_images(graph, first + 1 + k)
        states = [messages.decode_control_nodes(message) for message in graph.heard["control_nodes"][-22:]]
        numbers = [state.cut for state in states]
        assert numbers[0] == numbers[1] == 0 and len(set(numbers)) > 10 and numbers[-2] == numbers[-1]
        assert messages.cut_number(messages.decode_cut_surface(surfaces[-1])) == numbers[-1]
        renderer = graph.nodes[2].tissue.bound.renderer
        assert renderer.skinning.cuts.shape == (len(graph.nodes[1].simulation.cuts), 3, 3)
        assert len(renderer.model) > len(graph.nodes[2].tissue.model)  # flesh
        assert np.abs(states[-1].positions - states[-1].rest).max() > 1e-3
        runs.append([bytes(message.data) for message in graph.heard[IMAGES.name][-22:]])
    assert runs[0] == runs[1]


@pytest.mark.thorough
def test_a_hundred_commands_at_once_are_all_taken_and_shown(graph):
    physics, rendering = graph.nodes[1:3]
    for k in range(1, 101):
        command(graph, MODEL_STAMP + k * STEP)
    graph.until(lambda: (physics.steps, rendering.images) == (100, 101), lambda: (physics.steps, rendering.images), 60)


def test_a_new_model_in_the_middle_loses_no_image_of_the_old_one(graph):
    send_model(graph, sheet(tilt=0.2), MODEL_STAMP + 10**9)
    sent = [k * STEP for k in range(1, 9)]
    for stamp in sent:
        command(graph, stamp)
    graph.until(lambda: MODEL_STAMP + 10**9 in stamps(graph, IMAGES), lambda: stamps(graph, IMAGES), 40)
    command(graph, 10 * STEP)
    graph.until(lambda: stamps(graph, IMAGES)[-1] == 10 * STEP, lambda: stamps(graph, IMAGES))
    assert sorted(set(stamps(graph, IMAGES))) == sorted({MODEL_STAMP, MODEL_STAMP + 10**9, *sent, 10 * STEP})
    assert stamps(graph, messages.CONTROL_NODES) == stamps(graph, IMAGES)


def test_an_image_may_wait_for_the_camera_of_its_stamp(graph, monkeypatch):
    monkeypatch.setattr(base, "_ERROR_SHOWN", 1.0)  # what comes after an error is told sooner
    rendering = graph.nodes[2]
    rendering.options = replace(rendering.options, lockstep_camera=True)
    assert graph.call(Trigger, "/physics_node/reset").success
    await_images(graph, 2)  # the first observation waits for no camera
    for k in (1, 2, 3):
        command(graph, k * STEP)
    graph.spin(0.3)
    assert len(graph.heard[IMAGES.name]) == 2
    for k in (1, 3):  # that of the second step never comes
        pose = np.eye(4)
        pose[0, 3] = 0.01 * k
        graph.publish(messages.CAMERA_POSE, messages.encode_pose(pose, k * STEP, "world"))
    await_images(graph, 4)
    assert stamps(graph, IMAGES)[-2:] == [STEP, 3 * STEP]
    shown = messages.decode_pose(graph.heard["rendered/camera_pose"][-1], "world", "")
    assert shown[0, 3] == pytest.approx(0.03)
    graph.refused("rendering_node", "is not shown: it has no pose with its stamp on ECM/measured_cp")
    graph.publish(messages.CAMERA_POSE, messages.encode_pose(np.eye(4), 9 * STEP, "world"))  # its command never comes
    graph.spin(0.3)
    assert graph.call(Trigger, "/physics_node/reset").success
    await_images(graph, 5)
    command(graph, STEP)
    graph.spin(0.3)
    graph.publish(messages.CAMERA_POSE, messages.encode_pose(np.eye(4), STEP, "world"))
    await_images(graph, 6)
    assert stamps(graph, IMAGES)[-1] == STEP
    command(graph, 2 * STEP)  # its camera never comes
    graph.status("rendering_node", "1 states wait for a pose on ECM/measured_cp of 0.040000 s", OK)
    assert graph.call(Trigger, "/physics_node/reset").success
    await_images(graph, 7)
    assert stamps(graph, IMAGES)[-1] == MODEL_STAMP
    graph.refused("rendering_node", "is not shown: it has no pose", "0.040000 s")

    def commanded(k: int, x: float) -> None:
        pose = np.eye(4)
        pose[0, 3] = x
        graph.publish(messages.CAMERA_POSE, messages.encode_pose(pose, k * STEP, "world"))
        command(graph, k * STEP)

    show, rendering.show_states = rendering.show_states, lambda: None  # it lags: the next episode begins before it shows this one
    for k in (1, 2, 3):
        commanded(k, 0.01 * k)
    graph.spin(0.3)
    assert graph.call(Trigger, "/physics_node/reset").success
    commanded(1, 0.05)
    graph.spin(0.3)
    rendering.show_states = show
    commanded(2, 0.06)
    await_images(graph, 13)
    assert stamps(graph, IMAGES)[-6:] == [STEP, 2 * STEP, 3 * STEP, MODEL_STAMP, STEP, 2 * STEP]
    shown = [messages.decode_pose(message, "world", "")[0, 3] for message in graph.heard["rendered/camera_pose"][-6:]]
    assert shown[:3] + shown[4:] == pytest.approx([0.01, 0.02, 0.03, 0.05, 0.06])


@pytest.mark.parametrize("force", [float("nan"), -1e12])
def test_a_command_with_a_wrench_that_cannot_be_takes_its_step_without_it(graph, force):
    command(graph, 100, (0.0, 0.0, force))
    await_images(graph, 2)
    graph.refused("physics_node", "PSM1/body/servo_cf")
    assert stamps(graph, IMAGES)[-1] == 100


def test_mistakes_in_stamps_are_told_and_the_next_command_acts(graph, monkeypatch):
    monkeypatch.setattr(base, "_ERROR_SHOWN", 1.0)  # what comes after an error is told sooner
    command(graph, 100)
    await_images(graph, 2)
    command(graph, 100)
    graph.refused("physics_node", "is not after the last step", "stamps must grow", "PSM1")
    command(graph, 0)
    graph.refused("physics_node", "a stamp of zero; in lockstep", "PSM1")
    command(graph, 200, parts=(POSE,))
    graph.status("physics_node", "waiting for PSM1's wrench of the command of", OK)
    command(graph, 300)
    graph.status("physics_node", "is given up", ERROR)
    await_images(graph, 3)
    assert stamps(graph, IMAGES)[-2:] == [100, 300]


def test_a_commanded_arm_answers_like_a_robot_and_shows_its_markers(graph):
    graph.publish(messages.tool_jaw("PSM1"), messages.encode_jaw(0.5, 1))
    command(graph, 100)
    graph.publish(messages.tool_jaw("PSM1"), messages.encode_jaw(0.7, 1))  # not part of a command: acts at once
    graph.until(lambda: graph.nodes[1].arms["PSM1"].angle == 0.7)
    command(graph, 200)
    graph.until(lambda: len(graph.heard["PSM1/jaw/measured_js"]) == 3)
    pose = messages.decode_pose(graph.heard["PSM1/measured_cp"][-1], "world", "")
    np.testing.assert_allclose(pose[:3, 3], [0, 0, 0.1])
    assert messages.decode_jaw(graph.heard["PSM1/jaw/measured_js"][-1], "") == 0.7
    assert stamps(graph, messages.tool_pose("PSM1")) == [MODEL_STAMP, 100, 200]  # first at its start
    tip, force, reaction, held, *_ = graph.heard["tool_markers"][-1].markers
    assert (tip.ns, tip.header.frame_id, tip.action) == ("PSM1", "world", tip.ADD)
    arrow = np.array([[p.x, p.y, p.z] for p in force.points])
    np.testing.assert_allclose(arrow[1] - arrow[0], [0, 0, -0.01])
    assert reaction.points[1].z > tip.pose.position.z and len(held.points) > 2


def test_a_commanded_arm_moves_in_its_time_and_tells_its_state(graph):
    """The client's way: move, wait until the arm is no longer busy, pause, resume."""
    told, setpoints = graph.hear(messages.tool_state("PSM1")), graph.hear(messages.tool_setpoint("PSM1"))
    jaws = graph.hear(messages.tool_jaw_setpoint("PSM1"))
    saying = lambda: [report(message) for message in told]  # noqa: E731

    def send(text):
        graph.publish(messages.tool_state_command("PSM1"), messages.encode_report(text, 1))

    graph.until(lambda: saying() == ["ENABLED"], "the state that was told before anybody listened")
    send("enable")  # the clients of CRTK wait for an answer, though it says nothing new
    graph.until(lambda: saying() == ["ENABLED"] * 2, "an answer")
    told.clear()
    command(graph, 100)
    graph.until(lambda: setpoints, "a first pose")
    assert graph.set("physics_node", move_speed=0.05, turn_speed=10.0, step_count=3)[0]
    goal = np.eye(4)
    goal[:3, 3] = 0.003, 0, 0.1
    graph.publish(messages.tool_move("PSM1"), messages.encode_pose(goal, 1, "world"))
    graph.publish(messages.tool_jaw_move("PSM1"), messages.encode_jaw(0.5, 1))
    graph.until(lambda: set(saying()) == {"ENABLED BUSY"} and graph.nodes[1].arms["PSM1"].angle_goal, "the arm to be busy")
    told.clear()
    assert graph.call(Trigger, "/physics_node/step").success
    graph.until(lambda: len(setpoints) == len(jaws) == 4 and saying() == ["ENABLED"], lambda: f"the end of the move; {saying()}")
    ways = [messages.decode_pose(message, "world", "")[0, 3] for message in setpoints]
    np.testing.assert_allclose(ways, [0, 0.001, 0.002, 0.003], atol=1e-9)  # 5 cm a second, 20 ms a step
    np.testing.assert_allclose([messages.decode_jaw(jaw, "") for jaw in jaws], [1.0, 0.8, 0.6, 0.5])
    send("pause")
    graph.until(lambda: saying()[1:] == ["PAUSED"])
    graph.publish(messages.tool_move("PSM1"), messages.encode_pose(np.eye(4), 1, "world"))
    graph.refused("physics_node", "PSM1/move_cp: PSM1 is PAUSED; send resume on PSM1/state_command")
    send("enable")
    graph.refused("physics_node", "PSM1/state_command: enable is not possible while PSM1 is PAUSED")
    send("resume")
    graph.until(lambda: saying()[2:] == ["PAUSED", "ENABLED"])


def record(tmp_path, name, model, **physics):
    """A scripted episode with the graph in processes of its own; all output as bytes, by topic."""
    bench, bag = Bench(), tmp_path / name
    bench.hear(IMAGES)
    try:
        with ForkedNodes(tmp_path / "logs") as group:
            group.environment |= {"ENDO_SIM_THREADS": "2" if name == "second" else "1"}
            group.start("recorder_node", bag=bag, topics=["all", *(topic.name for topic in SHOWN)])
            group.start("physics_node", **PARAMETERS["physics_node"], **physics)
            group.start("rendering_node", **PARAMETERS["rendering_node"])
            bench.status("recorder", "recording", OK)
            for node in ("physics_node", "rendering_node"):
                bench.status(node, "waiting for a model")
            wait_until(lambda: len(bench.user.get_publishers_info_by_topic(IMAGES.name)), 20, "the renderer")
            send_camera(bench)
            group.start("reconstruction_node", mode="lockstep", model_file=model, output_dir=tmp_path)
            await_images(bench, 1)

            def recorded():  # the recorder finds one publisher after another; first observations until it has found all
                bench.call(Trigger, "/physics_node/reset")
                bench.spin(0.5)
                return int(bench.statuses["recorder"][-1][2]["messages"]) > 30

            bench.until(recorded, "the recorder to hear the graph", 60)
            seen = len(bench.heard[IMAGES.name])
            for k in range(1, 9):
                poses = messages.tool_pose("PSM1")
                pose = np.eye(4)
                pose[:3, 3] = 0, 0, 0.1
                bench.publish(poses, messages.encode_pose(pose, k * STEP, "world"))
                command(bench, k * STEP, (0.3, 0.1 * k, -1.0), (WRENCH,))
                await_images(bench, seen + k)
            bench.spin(1.0)
    finally:
        bench.close()
    with BagReader(bag) as reader:
        found = defaultdict(list)
        for raw in reader.raw_messages(list(reader.topics)):
            found[raw.topic].append(bytes(raw.data))
    return found


def test_the_same_commands_give_the_same_bytes_in_every_run(tmp_path):
    model = sheet(tilt=0.3)
    points, way = model.means[::3].double().numpy(), np.array([[0.002, 0.0, -0.001], [0.0, 0.0, 0.0]])
    TissueMotion(3.0, points, (PeriodicMotion("breathing", 4.0, 1.0, 5.0, way, 0.5 + 10 * points[:, 0]),)).save(tmp_path, model)
    physics = {"motion.file": tmp_path / "motion.npz", "motion.breathing": 0.004, "motion.heartbeat": 0.001}
    save_ply(model, tmp_path / "model.ply")
    first, second = (record(tmp_path, name, tmp_path / "model.ply", **physics) for name in ("first", "second"))
    for topic in (*STATES, messages.TISSUE_MOTION, *SHOWN, messages.RENDERED_COMPRESSED, messages.tool_links("PSM1")):
        ours, theirs = (episode[f"/{topic.name.lstrip('/')}"] for episode in (first, second))
        assert len(ours) >= 8 and ours[-8:] == theirs[-8:], topic.name
    assert len(set(first["/rendered/image_raw"][-8:])) == 8  # the tissue moves
    labels = np.frombuffer(first[f"/{messages.RENDERED_SEGMENTATION.name}"][-1], np.uint8)[-WIDTH * HEIGHT :]
    assert (labels >= 2).sum() > 50  # the instrument is in the picture


@pytest.mark.thorough
def test_the_same_bag_gives_the_same_model_in_every_run(tmp_path, small_bag):
    """Nothing in the model, not even its stamp, tells when or how fast it was made."""
    models = []
    for run in ("first", "second"):
        bench = Bench()
        heard = bench.hear(messages.GAUSSIANS)
        try:
            with ForkedNodes(tmp_path / run) as group:
                options = {"iterations": 30, "max_gaussians": 1500, "image_width": 48, "keyframes": 2, "start_after": 0.5, "device": "cpu"}
                group.start("reconstruction_node", mode="lockstep", output_dir=tmp_path / run, **options)
                bench.status("reconstruction_node", "collecting views", OK)
                group.start("bag_player_node", bag=small_bag)
                bench.until(lambda: heard, "a model", 60)
                bench.spin(0.5)
        finally:
            bench.close()
        assert len(heard) == 1  # the final one only
        models.append(heard[0])
    first, second = models
    assert first.header.stamp == second.header.stamp and messages.stamp_to_ns(first.header.stamp) > 0
    assert first.data == second.data


@pytest.mark.parametrize("last", ["policy", pytest.param("renderer", marks=pytest.mark.thorough)])
def test_the_policy_in_the_guide_runs(tmp_path, last):
    guide = (Path(__file__).parents[2] / "docs" / "graph.md").read_text()
    (code,) = re.findall(r"```python\n(.+?)```", guide, re.S)
    (tmp_path / "policy.py").write_text(code)
    save_ply(sheet(tilt=0.3), tmp_path / "model.ply")
    camera = Camera(K, WIDTH, HEIGHT, np.eye(4))
    save_cameras([camera], tmp_path / "cameras.json")
    bench = Bench()
    states = bench.hear(messages.CONTROL_NODES)
    try:
        with ForkedNodes(tmp_path / "logs") as group:
            group.start("physics_node", arm_source="commanded", **PARAMETERS["physics_node"])
            group.start("reconstruction_node", mode="lockstep", model_file=tmp_path / "model.ply", output_dir=tmp_path)
            if last == "policy":
                group.start("rendering_node", **PARAMETERS["rendering_node"])
            command = [sys.executable, tmp_path / "policy.py"]
            policy = subprocess.Popen(command, env=group.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            try:
                if last == "renderer":
                    bench.until(lambda: len(states) > 3, "resets by the policy", 60)
                    began, many = time.monotonic(), len(states)
                    bench.spin(3.0)
                    assert len(states) - many < 3 * (time.monotonic() - began)
                    group.start("rendering_node", **PARAMETERS["rendering_node"])
                deadline = time.monotonic() + 120
                while policy.poll() is None and time.monotonic() < deadline:
                    bench.spin(0.2)
            finally:
                policy.kill()
                output, errors = policy.communicate()
    finally:
        bench.close()
    assert policy.returncode == 0, errors
    assert int(output.split("pixels that changed:")[1]) > 20
