"""physics_node: good and bad models and commands, and when they come and go."""

import time

import numpy as np
import pytest
import torch
from bad_messages import truncate
from rclpy.parameter import Parameter
from ros_bench import (
    HEIGHT,
    WIDTH,
    K,
    S,
    await_image,
    await_nodes,
    moved,
    nodes_of,
    pull,
    send_camera,
    send_model,
    send_tip,
    send_wrench,
    sheet,
)
from std_srvs.srv import SetBool, Trigger

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera, make_pose
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.messages import ERROR, OK, WARN
from endo_sim_ros.nodes.base import MOST_LOGGED
from endo_sim_ros.nodes.physics_node import PhysicsNode
from endo_sim_ros.nodes.rendering_node import RenderingNode
from endo_sim_ros.physics.control_nodes import build_control_nodes
from endo_sim_ros.rendering import render_depth

pytestmark = pytest.mark.dds


def cloud(change=lambda message: None, model=None):
    message = messages.encode_gaussians(sheet(8) if model is None else model, 5 * S, "world")
    change(message)
    return message


def drop_field(message):
    message.fields = [field for field in message.fields if field.name != "opacity"]


def not_finite():
    model = sheet(8)
    model.means[7, 1] = float("nan")
    return cloud(model=model)


BAD_MODELS = {
    "empty_cloud": (lambda: cloud(model=sheet(8).select(torch.zeros(0, dtype=int))), "the model is empty"),
    "truncated_cloud": (lambda: cloud(truncate), "the cloud is truncated"),
    "missing_field": (lambda: cloud(drop_field), "missing field opacity"),
    "non_finite_mean": (not_finite, "means of Gaussian 7 is not finite"),
    "unknown_frame": (lambda: cloud(lambda m: setattr(m.header, "frame_id", "map")), "unknown frame 'map'"),
}


@pytest.mark.parametrize("name", BAD_MODELS)
def test_bad_model_is_one_sentence_for_physics_and_rendering_and_a_good_one_still_works(bench, physics, name):
    bench.add(RenderingNode)
    bench.hear(messages.RENDERED_IMAGE)
    make, sentence = BAD_MODELS[name]
    bench.publish(messages.GAUSSIANS, make())
    for node in ("physics_node", "rendering_node"):
        bench.refused(node, sentence, "gaussians")
    send_model(bench, stamp=6 * S)
    send_camera(bench)
    await_nodes(bench, 6 * S)
    await_image(bench, lambda image: image.max() > 100, "tissue in the picture")


def test_a_model_that_cannot_be_made_soft_says_so_until_a_better_one_comes(bench, physics):
    send_model(bench, sheet(8).select(torch.arange(2)), stamp=5 * S)
    bench.refused("physics_node", "tissue needs at least 4", "physics")
    bench.until(lambda: physics.failure)
    assert physics.status()[0] == ERROR
    send_model(bench, stamp=6 * S)
    await_nodes(bench, 6 * S)
    assert physics.status()[0] == OK


BAD_WRENCHES = {
    "nan": (dict(force=(float("nan"), 0, 0)), "the wrench is not finite"),
    "infinite": (dict(force=(0, float("inf"), 0)), "the wrench is not finite"),
    "beyond_any_unit": (dict(force=(0, 0, -1e12)), "PSM1: a wrench of more than 1e+09 N or N·m; is it in newtons?"),
    "unknown_frame": (dict(force=(0, 0, 1.0), frame="tool0"), "unknown frame 'tool0'"),
}


@pytest.mark.parametrize("name", BAD_WRENCHES)
def test_bad_wrench_is_one_sentence_and_a_good_one_still_moves_tissue(bench, physics, name):
    fields, sentence = BAD_WRENCHES[name]
    send_model(bench)
    await_nodes(bench, 5 * S)
    send_tip(bench)
    send_wrench(bench, **fields)
    bench.refused("physics_node", sentence, "PSM1/body/servo_cf")
    assert moved(bench) == 0
    pull(bench, lambda: moved(bench) > 1e-3)


def test_a_wrench_or_jaw_before_any_pose_is_one_sentence(bench, physics):
    send_wrench(bench, (0, 0, 1.0))
    bench.refused("physics_node", "a wrench came before any pose on PSM1/measured_cp", "PSM1/body/servo_cf")
    bench.publish(messages.tool_jaw("PSM2"), messages.encode_jaw(0.0, S))
    bench.refused("physics_node", "a jaw command came before any pose on PSM2/measured_cp")
    send_model(bench)
    await_nodes(bench, 5 * S)
    pull(bench, lambda: moved(bench) > 1e-3)


def test_an_absurd_wrench_is_undone_and_told_and_a_moderate_one_still_works(bench, physics):
    send_model(bench)
    await_nodes(bench, 5 * S)
    for force in (1e6, 1e30, 1e300):
        said = len(bench.statuses["physics_node"])
        pull(bench, lambda: any(s[0] == ERROR for s in bench.statuses["physics_node"][said:]), (0, 0, force))
        assert np.isfinite(nodes_of(bench).positions).all() and moved(bench) < 0.06
    send_wrench(bench, (0, 0, 0))
    bench.until(lambda: moved(bench) < 1e-3, "the tissue to come back")
    pull(bench, lambda: moved(bench) > 1e-3)


def test_a_wrench_in_the_air_says_that_it_has_no_effect(bench, physics):
    send_model(bench)
    await_nodes(bench, 5 * S)
    for position in ((0, 0, -5.0), (1e30, 0, 0)):
        pull(bench, lambda: any("has no effect" in s[1] for s in bench.statuses["physics_node"]), position=position)
        assert moved(bench) == 0
    bench.refused("physics_node", "has no effect", "force_radius", "PSM1")


def test_two_arms_act_and_each_hears_its_own_reaction(bench, physics):
    reactions = bench.hear(messages.tool_reaction("PSM1")), bench.hear(messages.tool_reaction("PSM2"))
    send_model(bench)
    await_nodes(bench, 5 * S)

    def both():
        send_tip(bench, (0.02, 0, 0.1), "PSM1")
        send_tip(bench, (-0.02, 0, 0.1), "PSM2")
        send_wrench(bench, (0, 0, -0.5), "PSM1")
        send_wrench(bench, (0, 0, 0.25), "PSM2", frame="PSM2")
        for _ in range(10):
            bench.executor.spin_once(timeout_sec=0.005)
        newest = [messages.decode_wrench(heard[-1], "")[0][2] if heard else 0.0 for heard in reactions]
        return np.allclose(newest, [0.5, -0.25], atol=1e-3)

    bench.until(both, "minus the wrenches as reactions")
    bench.until(lambda: moved(bench) < 1e-4, "the tissue to be released after command_timeout")


def test_a_rigid_tool_pushes_the_tissue_and_feels_it(bench, physics):
    reactions = bench.hear(messages.tool_reaction("PSM1"))
    send_model(bench)
    await_nodes(bench, 5 * S)
    assert bench.set("physics_node", contact_radius=0.015, friction=0.1)[0]
    bench.until(lambda: physics.simulation.contact_radius >= 0.015)

    def feels():
        send_tip(bench, (0, 0, 0.09), "PSM1")
        bench.spin(0.03)
        return reactions and messages.decode_wrench(reactions[-1], "")[0][2] < -0.02 and moved(bench) > 1e-3

    bench.until(feels, "the tissue to be pushed away from the camera, and to push back")
    assert physics.simulation.faults == 0


def test_what_cannot_be_cut_says_so_and_the_tool_goes_on(bench, physics):
    send_model(bench)
    await_nodes(bench, 5 * S)
    bench.publish(messages.tool_cut("PSM1"), messages.encode_cut(True, S))
    bench.refused("physics_node", "PSM1/cut: a cut came before any pose on PSM1/measured_cp")
    message = messages.encode_cut(True, S)
    message.buttons = []
    bench.publish(messages.tool_cut("PSM1"), message)
    bench.refused("physics_node", "PSM1/cut: expected a button")
    assert bench.set("physics_node", kinematics="current")[0]
    bench.until(lambda: physics.simulation.config.kinematics == "current")
    send_tip(bench, (0, 0, 0.1), "PSM1")
    bench.until(lambda: physics.arms["PSM1"].pose is not None)
    bench.publish(messages.tool_cut("PSM1"), messages.encode_cut(True, S))
    bench.refused("physics_node", "kinematics current cannot be cut; set kinematics to rest")
    pull(bench, lambda: moved(bench) > 1e-3)


def test_tissue_that_tears_says_where_and_shows_it_as_a_cut(bench, physics):
    surfaces = bench.hear(messages.CUT_SURFACE)
    send_model(bench)
    await_nodes(bench, 5 * S)
    assert bench.set("physics_node", tear_strain=0.05)[0]
    bench.until(lambda: physics.simulation.config.tear_strain == 0.05)
    pull(bench, lambda: physics.simulation.tears > 0, what="a tear")
    _, told, values = bench.status("physics_node", "the tissue tore", WARN)
    assert "tear_strain is 0.05" in told and values["errors"] == "0"
    bench.until(lambda: surfaces and messages.decode_torn(surfaces[-1]).any(), "the tear on cut_surface")
    assert bench.set("physics_node", kinematics="current")[0]
    bench.status("physics_node", "its cuts have healed")  # beside an error, if what tore went too far meanwhile


def test_services_in_every_state(bench, physics):
    call = lambda name: bench.call(Trigger, f"/physics_node/{name}")  # noqa: E731
    for name in ("reset", "step"):
        answer = call(name)
        assert not answer.success and answer.message == "there is no model yet"
    send_model(bench)
    await_nodes(bench, 5 * S)
    assert "running; call ~/pause with true first" in call("step").message
    pull(bench, lambda: moved(bench) > 1e-3)
    assert bench.call(SetBool, "/physics_node/pause", data=True).message == "paused"
    before = physics.simulation.time
    assert call("step").message == f"time {before + 0.02:.4f} s"
    assert call("reset").success and physics.simulation.time == 0
    bench.until(lambda: moved(bench) == 0, "the tissue at rest")
    assert bench.call(SetBool, "/physics_node/pause", data=False).success
    bench.until(lambda: physics.simulation.time > 0.05, "time to go on")


def test_a_model_without_training_cameras_is_seen_from_where_the_camera_is(bench, physics):
    send_model(bench, cameras=None)
    bench.status("physics_node", "waiting for training_cameras or ECM/measured_cp", WARN)
    send_camera_pose = messages.encode_pose(np.eye(4), S, "world")
    bench.publish(messages.CAMERA_POSE, send_camera_pose)
    await_nodes(bench, 5 * S)
    send_model(bench, stamp=6 * S, cameras=())  # an empty PoseArray
    await_nodes(bench, 6 * S)
    bench.publish(messages.GAUSSIANS, cloud(lambda m: setattr(m.header.stamp, "sec", 9)))  # cameras stay those of 6
    await_nodes(bench, 9 * S)


def test_tissue_is_left_out_where_the_training_cameras_see_through_it(bench, physics):
    """A small plate in front of a wide one, seen from both sides."""
    rng = np.random.default_rng(7)
    plates = [np.c_[rng.uniform(-half, half, (count, 2)), np.full(count, z)] for half, z, count in ((0.02, 0.1, 1000), (0.06, 0.16, 3000))]
    points = torch.from_numpy(np.concatenate(plates)).float()
    model = GaussianModel.from_points(points, torch.full((len(points), 3), 0.5), torch.full((len(points),), 0.003), opacity=0.95)
    poses = [make_pose(np.array([x, 0, 0]), np.array([1.0, 0, 0, 0])) for x in (-0.06, 0, 0.06)]
    bench.hear(messages.CONTROL_NODES)
    bench.publish(messages.TRAINING_CAMERA_INFO, messages.encode_camera_info(K, WIDTH, HEIGHT, 5 * S, "endoscope_left"))
    send_model(bench, model, cameras=poses)
    cameras = [Camera(K, WIDTH, HEIGHT, pose) for pose in poses]
    carved, whole = (build_control_nodes(model, np.stack(poses)[:, :3, 3], physics.config, seen, render_depth) for seen in (cameras, ()))
    assert len(carved) < len(whole)
    np.testing.assert_array_equal(await_nodes(bench, 5 * S).rest, carved.rest.astype(np.float32))


def test_a_new_model_replaces_the_old_one_while_it_is_touched(bench, physics):
    send_model(bench)
    await_nodes(bench, 5 * S)
    pull(bench, lambda: moved(bench) > 1e-3)
    send_model(bench, sheet(z=0.12), stamp=6 * S)
    pull(bench, lambda: nodes_of(bench).model_stamp_ns == 6 * S, position=(0, 0, 0.12), what="the new model")
    assert nodes_of(bench).rest[:, 2].min() > 0.11
    pull(bench, lambda: moved(bench) > 1e-3, position=(0, 0, 0.12), what="the new tissue to move")


def test_models_with_equal_or_zero_stamps_replace_each_other_too(bench, physics):
    bench.add(RenderingNode)
    bench.hear(messages.RENDERED_DEPTH)
    send_camera(bench)

    def depth():
        heard = bench.heard["rendered/depth/image"]
        return messages.decode_depth(heard[-1])[40, 48] if heard else 0

    for z in (0.1, 0.13, 0.16):
        send_model(bench, sheet(z=z), stamp=0)
        bench.until(lambda: bench.heard["control_nodes"] and abs(nodes_of(bench).rest[:, 2].min() - z) < 1e-3, f"nodes at {z}")
        bench.until(lambda: abs(depth() - z) < 0.005, f"a picture of the model at {z}")


def test_poses_in_the_frame_of_a_robots_base_are_turned_into_the_world(bench, physics):
    send_model(bench)
    await_nodes(bench, 5 * S)
    for wrong in (["base 0 0 0.1"], ["base 0 0 0.1 0 0 0 2"], ["base 0 0 nan 0 0 0 1"]):
        successful, reason = bench.set("physics_node", frames=wrong)
        assert not successful and "frames: 'base" in reason
    half = 0.5**0.5
    assert bench.set("physics_node", frames=[f"base 0 0 0.1 0 {half} 0 {half}"])[0]  # its z axis is the world's x axis
    bench.publish(messages.tool_pose("PSM1"), messages.encode_pose(np.eye(4), S, "base"))
    send_wrench(bench, (0, 0, 1.0), frame="base")
    bench.until(lambda: moved(bench) > 5e-4, "tissue to move")
    state = nodes_of(bench)
    shift = state.positions - state.rest
    assert shift[np.linalg.norm(shift, axis=1).argmax()].argmax() == 0  # along the world's x
    arm = physics.arms["PSM1"]
    for base, z in (("PSM2_base", 0.0), ("PSM1_base", 0.2)):  # a pose without a frame is in that of the arm, or in the world
        assert bench.set("physics_node", frames=[f"{base} 0 0 0.2 0 0 0 1"])[0]
        bench.publish(messages.tool_pose("PSM1"), messages.encode_pose(np.eye(4), S, ""))
        bench.until(lambda: arm.pose[2, 3] == z, f"a tip at {z} m")
    assert bench.set("physics_node", frames=["base 0 0 0.1 0 0 0 1"])[0]
    bench.publish(messages.tool_pose("PSM1"), messages.encode_pose(np.eye(4), S, "elsewhere"))
    bench.refused("physics_node", "unknown frame 'elsewhere'; this graph knows 'world' or 'base'")


def test_physics_follows_a_simulated_clock(bench):
    clock = messages.encode_clock
    bench.hear(messages.CONTROL_NODES)
    node = bench.add(PhysicsNode)
    assert bench.set("physics_node", use_sim_time=True)[0]
    bench.publish(messages.CLOCK, clock(100 * S))
    send_model(bench)
    bench.until(lambda: node.simulation is not None, "the simulation")
    for k in range(100):  # a second of simulated time, however long it takes
        bench.publish(messages.CLOCK, clock(100 * S + k * S // 100))
        bench.spin(0.01)
    bench.spin(0.2)
    assert len(bench.heard["control_nodes"]) == pytest.approx(1 / node.simulation.step_duration, abs=2)
    assert node.simulation.time == pytest.approx(1.0, abs=2 * node.simulation.step_duration)
    assert messages.stamp_to_ns(bench.heard["control_nodes"][-1].header.stamp) <= 101 * S
    bench.publish(messages.CLOCK, clock(5 * S))  # another bag: the clock begins anew, and so does the rhythm
    count = len(bench.heard["control_nodes"])
    for k in range(20):
        bench.publish(messages.CLOCK, clock(5 * S + k * S // 100))
        bench.spin(0.01)
    assert len(bench.heard["control_nodes"]) >= count + 5


def test_physics_takes_the_steps_of_a_clock_that_leaps(bench, physics):
    send_model(bench)
    bench.until(lambda: physics.simulation is not None, "tissue")
    assert bench.set("physics_node", use_sim_time=True)[0]
    for tenth in range(10, 40):  # five steps each
        bench.publish(messages.CLOCK, messages.encode_clock(tenth * S // 10))
        bench.until(lambda: physics.now_ns() == tenth * S // 10, "the time")
        bench.spin(0.02)
    assert physics.speed.real_time_factor > 0.7


def test_a_clock_that_is_too_fast_is_blamed_for_missed_steps(bench, physics, monkeypatch):
    send_model(bench)
    bench.until(lambda: physics.simulation is not None, "tissue")
    monkeypatch.setattr(physics.speed, "note", lambda *_: None)
    physics.speed.real_time_factor, physics.speed.clock_speed = 0.3, 10.0
    bench.status("physics_node", "slower than real time; lower node_count", WARN)  # it follows no /clock
    assert bench.set("physics_node", use_sim_time=True)[0]
    bench.publish(messages.CLOCK, messages.encode_clock(S))
    bench.status("physics_node", "slower than /clock, which runs at 10.0 times real speed; let it run slower", WARN)
    physics.speed.clock_speed = 1.0
    bench.status("physics_node", "slower than real time; lower node_count", WARN)


def test_overloaded_physics_acts_on_the_newest_command(bench, physics, monkeypatch):
    """Each step takes longer than it should, and meanwhile three commands come, numbered by their force in millinewtons."""
    send_model(bench)
    await_nodes(bench, 5 * S)
    send_tip(bench)
    arm = physics.arms["PSM1"]
    bench.until(lambda: arm.pose is not None, "a tip")
    sent, delays, step = 1, [], physics.step

    def slow(simulation):
        nonlocal sent
        if arm.force is not None:
            delays.append(sent - round(-1e3 * arm.force[2]))
        step(simulation)
        for _ in range(3):
            sent += 1
            send_wrench(bench, (0, 0, -1e-3 * sent))
            time.sleep(0.03)

    send_wrench(bench, (0, 0, -1e-3))
    monkeypatch.setattr(physics, "step", slow)
    bench.until(lambda: len(delays) > 15, "steps", 60)
    assert max(delays) <= 6, delays  # the newest that had arrived: what is sent last may still be on its way


def test_parameters_act_or_are_refused_with_the_reason(bench, physics):
    send_model(bench)
    await_nodes(bench, 5 * S)
    for name, value, reason in (
        ("young_modulus", 5000, "expected 'Type.DOUBLE' got 'Type.INTEGER'"),
        ("young_modulus", -1.0, "out of range"),
        ("young_modulus", float("nan"), "out of range"),
        ("material", "jelly", "material must be one of"),
        ("device", "tpu", "unknown device 'tpu'"),
        ("arms", ["PSM3"], "arms: read at start only; restart the node"),
        ("regions", ["sphere 0 0"], "region 'sphere 0 0': a sphere takes 4 values"),
    ):
        successful, text = bench.set("physics_node", **{name: value})
        assert not successful and reason in text, (name, value, text)
    together = [Parameter("move_speed", value=0.123), Parameter("regions", value=["sphere 0 0"])]
    assert not physics.set_parameters_atomically(together).successful
    assert physics._options.move_speed != 0.123  # all act, or none
    assert bench.set("physics_node", arms=["PSM1", "PSM2"])[0]  # as it is already
    assert bench.set("physics_node", young_modulus=5000.0)[0]
    bench.until(lambda: physics.simulation.config.young_modulus == 5000.0, "softer tissue")
    painted = ["sphere 0 0 0.1 0.02 young_modulus=20000"]
    assert bench.set("physics_node", regions=painted)[0]
    bench.until(lambda: physics.simulation.config.regions == tuple(painted), "a stiffer region")
    assert bench.set("physics_node", regions=[""])[0]
    bench.until(lambda: physics.simulation.config.regions == ("",), "no region")
    assert bench.set("physics_node", substeps=1)[0]  # far too long for the material
    bench.refused("physics_node", "substep")
    count = len(bench.heard["control_nodes"])
    assert bench.set("physics_node", substeps=0)[0]
    bench.until(lambda: len(bench.heard["control_nodes"]) > count + 5 and not physics.failure, "steps to go on")


def test_a_warning_hides_no_error_and_counts_as_none(bench, physics):
    physics.report_warning("the tissue tore")
    assert "the tissue tore" in bench.status("physics_node", "the tissue tore", WARN)[1]
    physics.report_error("no such frame")
    assert bench.status("physics_node", "no such frame", ERROR)[2]["errors"] == "1"
    physics.report_warning("the tissue tore again")
    since = len(bench.statuses["physics_node"])
    physics.publish_diagnostics()
    assert bench.status("physics_node", "no such frame", ERROR, since)[1] == "no such frame; the tissue tore again"


def test_errors_at_500_hz_flood_neither_the_log_nor_diagnostics_nor_memory(bench, physics):
    logged = []
    physics.get_logger = lambda: type("Logger", (), {"error": staticmethod(logged.append)})
    for number in range(500):  # a force that grows
        physics.report_error(f"{number / 100:.3g} N are too much")
    assert logged == ["0 N are too much"]
    for number in range(500):  # every text is different
        physics.report_error("error " + "." * number)
    assert len(logged) == MOST_LOGGED == len(physics.logged)
    bench.until(lambda: any(s[2]["errors"] == "1000" for s in bench.statuses["physics_node"]), "the count of errors")
    assert len(bench.statuses["physics_node"]) < MOST_LOGGED + 10
    assert bench.statuses["physics_node"][-1][1] == "error " + "." * 499
    physics.report_error("x" * 2_000_000)  # a frame_id of that length, quoted
    bench.until(lambda: 1000 < len(bench.statuses["physics_node"][-1][1]) < 1010, "the beginning of a long error")
