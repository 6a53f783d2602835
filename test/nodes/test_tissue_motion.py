"""physics_node: tissue that breathes, as parameters and a topic have it."""

import dataclasses

import numpy as np
import pytest
import yaml
from ros_bench import S, await_nodes, nodes_of, pull, send_model, sheet
from std_srvs.srv import SetBool, Trigger

from endo_sim_ros import messages
from endo_sim_ros.core.tissue_motion import PeriodicMotion, TissueMotion
from endo_sim_ros.messages import OK, WARN
from endo_sim_ros.nodes import base
from endo_sim_ros.nodes.parameters import beside_parameters
from endo_sim_ros.physics import MotionConfig

pytestmark = pytest.mark.dds
ALONG = np.array([1, 0, -0.5]) / np.hypot(1, 0.5)


@pytest.fixture
def breathing(bench, physics):
    bench.hear(messages.TISSUE_MOTION)
    send_model(bench)
    await_nodes(bench, 5 * S)
    bench.until(lambda: bench.heard["tissue_motion"])
    return bench, physics


def send(bench, **values):
    bench.publish(messages.TISSUE_MOTION_COMMAND, messages.encode_motion_command(values, S))


def motion(bench):
    message = bench.heard["tissue_motion"][-1]
    return dict(zip(message.name, message.position)), dict(zip(message.name, message.velocity))


def test_a_command_moves_held_tissue_and_the_state_tells_how(breathing):
    bench, physics = breathing
    simulation = physics.simulation
    assert motion(bench)[0] == dict.fromkeys(("breathing", "heartbeat", "breathing_phase", "heartbeat_phase"), 0.0)
    send(bench, breathing=0.004, breathing_period=1.0, fade=0.1)
    bench.until(lambda: motion(bench)[0]["breathing"] > 0.0035, "a breath")
    assert physics.simulation is simulation  # no tissue had to be built for it
    assert physics.get_parameter("motion.breathing").value == 0.004
    bench.until(lambda: bench.heard["tissue_motion"][-1].header.stamp == bench.heard["control_nodes"][-1].header.stamp)
    state, (positions, velocities) = nodes_of(bench), motion(bench)
    held = (state.positions - state.rest)[simulation.nodes.pinned]
    np.testing.assert_allclose(held, np.tile(positions["breathing"] * ALONG, (len(held), 1)), atol=3e-8)
    assert positions["breathing_phase"] == pytest.approx(0.5, abs=0.15) and velocities["breathing_phase"] == 1.0
    assert abs(velocities["breathing"]) < np.pi * 0.004
    send(bench, breathing=0.0)
    bench.until(lambda: physics.simulation.resting, "the tissue to rest")
    assert np.abs(nodes_of(bench).positions - nodes_of(bench).rest).max() < 1e-4
    pull(bench, lambda: np.abs(nodes_of(bench).positions - nodes_of(bench).rest).max() > 1e-3)


BAD = {
    "nan": ({"breathing": float("nan")}, "expected a finite position for each name"),
    "negative_period": ({"breathing_period": -4.0}, "breathing_period must lie in"),
    "too_far": ({"breathing": 0.02, "heartbeat": 0.01}, "more travel"),
    "beyond_its_range": ({"breathing": 1.0}, "breathing must lie in"),
    "unknown": ({"breathing": 0.001, "depth": 1.0}, "no option depth"),
    "file": ({"file": 1.0}, "a motion file is no number"),
    "nothing": ({}, "expected a finite position for each name"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_command_is_one_sentence_and_leaves_the_motion_as_it_was(breathing, name):
    bench, physics = breathing
    send(bench, breathing=0.003)
    bench.until(lambda: physics.simulation.config.motion == MotionConfig(breathing=0.003))
    values, text = BAD[name]
    send(bench, **values)
    assert bench.refused("physics_node", text).count("set_tissue_motion") == 1
    assert physics.simulation.config.motion == physics.config.motion == MotionConfig(breathing=0.003)
    bench.until(lambda: motion(bench)[0]["breathing"] > 0.001, "a breath")


def test_pause_stops_the_phase_and_reset_begins_anew(breathing):
    bench, physics = breathing
    assert bench.set("physics_node", **{"motion.breathing": 0.003, "motion.breathing_phase": 0.25})[0]
    bench.until(lambda: motion(bench)[0]["breathing_phase"] > 0.1)
    assert bench.call(SetBool, "/physics_node/pause", data=True).success
    bench.spin(0.1)
    phase, count = motion(bench)[0]["breathing_phase"], len(bench.heard["tissue_motion"])
    bench.until(lambda: len(bench.heard["tissue_motion"]) > count + 3)
    assert motion(bench)[0]["breathing_phase"] == phase
    assert bench.call(Trigger, "/physics_node/reset").success
    bench.until(lambda: motion(bench)[0]["breathing_phase"] == 0.25)
    assert motion(bench)[0]["breathing"] == pytest.approx(0.0015)
    state = nodes_of(bench)
    np.testing.assert_allclose(state.positions - state.rest, np.tile(0.0015 * ALONG, (len(state.rest), 1)), atol=3e-8)


def test_other_tissue_goes_on_in_the_phase(breathing):
    bench, physics = breathing
    send(bench, breathing=0.003, breathing_period=1.0)
    bench.until(lambda: motion(bench)[0]["breathing"] > 0.002)
    count = len(bench.heard["tissue_motion"])
    assert bench.set("physics_node", young_modulus=20e3)[0]
    bench.until(lambda: physics.simulation.config.young_modulus == 20e3, "stiffer tissue")
    bench.until(lambda: motion(bench)[0]["breathing"] < 0.001)
    phases = [message.position[2] for message in bench.heard["tissue_motion"][count - 1 :]]
    steps = np.diff(phases) % 1.0
    assert steps.max() < 0.021  # one step of 0.02 s after the other, of a period of 1 s
    assert bench.set("physics_node", **{"travel": 0.1, "motion.breathing": 0.03, "motion.heartbeat": 0.01})[0]
    bench.until(lambda: physics.simulation.config.travel == 0.1)
    bench.until(lambda: motion(bench)[0]["breathing"] > 0.02)


def save_motion(folder, model):
    """A breath of 1 s and 4 mm at most, of which the tissue on the right goes more; returns it and its parameters of physics_node."""
    points = model.means[::3].double().numpy()
    way, shares = np.array([[0.002, 0.0, 0.0], [0.0, 0.0, 0.0]]), 0.5 + 10 * (points[:, 0] - points[:, 0].min())
    found = TissueMotion(3.0, points, (PeriodicMotion("breathing", 1.0, 1.0, 5.0, way, shares / shares.max()),))
    found.save(folder, model)
    values = yaml.safe_load((folder / "motion.yaml").read_text())["/**/physics_node"]["ros__parameters"]
    return found, values | {"motion.file": str(folder / "motion.npz")}


def test_tissue_goes_as_it_was_found_to_and_as_commands_scale_that(breathing, tmp_path):
    bench, physics = breathing
    found, values = save_motion(tmp_path, sheet())
    assert bench.set("physics_node", **values)[0]
    bench.until(lambda: physics.simulation.config.motion.file, "tissue with a motion that was found")
    bench.until(lambda: motion(bench)[0]["breathing_phase"] > 0.4)
    bench.until(lambda: bench.heard["tissue_motion"][-1].header.stamp == bench.heard["control_nodes"][-1].header.stamp)
    state, along = nodes_of(bench), motion(bench)[0]["breathing"]
    held = (state.positions - state.rest)[physics.simulation.nodes.pinned]
    shares = found.shares(state.rest[physics.simulation.nodes.pinned].astype(float))[:, 0]
    way = abs(np.cos(2 * np.pi * motion(bench)[0]["breathing_phase"])) * 0.002
    assert abs(along) == pytest.approx(values["motion.breathing"] / 2 * way / 0.002, rel=1e-4)
    np.testing.assert_allclose(np.abs(held[:, 0]), shares * way, atol=1e-4)
    assert np.ptp(held[:, 0]) > 2e-4
    simulation = physics.simulation
    send(bench, breathing=0.0, fade=0.1)
    bench.until(lambda: physics.simulation.resting, "the tissue to rest")
    assert physics.simulation is simulation
    state = nodes_of(bench)
    assert np.abs(state.positions - state.rest).max() < 1e-4
    assert bench.set("physics_node", **{"motion.file": ""})[0]
    bench.until(lambda: not physics.simulation.config.motion.file, "tissue without")


def test_tissue_follows_the_motion_that_was_found_of_its_model_unless_a_file_was_given(breathing, tmp_path):
    bench, physics = breathing
    moving = sheet().select(np.arange(300))
    found, values = save_motion(tmp_path, moving)
    tell = lambda path: bench.publish(messages.FOUND_MOTION, messages.encode_text(str(path)))  # noqa: E731
    tell(tmp_path / "motion.npz")  # before the model that it is of
    bench.spin(0.2)
    assert not physics.config.motion.file
    send_model(bench, moving, 6 * S)
    bench.until(lambda: physics.simulation.config.motion.file, "tissue with the motion that was found")
    assert physics.simulation.config.motion == MotionConfig().replaced({n.removeprefix("motion."): v for n, v in values.items()})
    bench.until(lambda: motion(bench)[0]["breathing_phase"] > 0.4)
    tell("")
    send_model(bench, stamp=7 * S)
    bench.until(lambda: physics.simulation.config.motion == MotionConfig(), "tissue at rest")
    tell(tmp_path / "elsewhere.npz")
    bench.status("physics_node", "elsewhere.npz: this machine does not have it; copy it here and set motion.file", WARN)
    fast, _ = save_motion(tmp_path, moving)
    dataclasses.replace(fast, parts=(dataclasses.replace(fast.parts[0], period=0.2),)).save(tmp_path, moving)
    send_model(bench, moving, 8 * S)
    tell(tmp_path / "motion.npz")
    bench.status("physics_node", "breathing_period", WARN)
    bench.until(lambda: physics.simulation.config.motion == MotionConfig() and len(physics.simulation.nodes), "tissue at rest")
    save_motion(tmp_path, moving)
    assert bench.set("physics_node", **{"motion.breathing": 0.001})[0]
    tell(tmp_path / "motion.npz")
    bench.until(lambda: physics.simulation.config.motion.file, "tissue with the shares that were found")
    assert physics.simulation.config.motion.breathing == 0.001
    assert bench.set("physics_node", **{"motion.file": ""})[0]
    bench.until(lambda: physics.simulation.config.motion == MotionConfig(breathing=0.001), "tissue as it was told to move")
    tell(tmp_path / "motion.npz")
    bench.spin(0.3)
    assert not physics.config.motion.file


def test_a_file_that_is_no_motion_of_the_model_is_refused(breathing, tmp_path):
    bench, physics = breathing
    simulation, (_, values) = physics.simulation, save_motion(tmp_path, sheet().select(np.arange(20)))
    (tmp_path / "cameras.json").write_text("{}")
    bad = {
        values["motion.file"]: "this is the motion of another model, of 20 Gaussians",
        str(tmp_path / "cameras.json"): "this is no motion that a reconstruction has written (it is no .npz file)",
        str(tmp_path / "nothere.npz"): "there is no such file",
    }
    for file, reason in bad.items():
        done, told = bench.set("physics_node", **{"motion.file": file})
        assert not done and told.startswith(file) and reason in told and "trust" not in told, told
    assert physics.simulation is simulation and physics.config.motion == simulation.config.motion == MotionConfig()


def test_a_motion_that_is_not_that_of_the_next_model_is_told_and_the_tissue_before_goes_on(breathing, tmp_path, monkeypatch):
    monkeypatch.setattr(base, "_ERROR_SHOWN", 1.0)  # what comes after an error is told sooner
    bench, physics = breathing
    _, values = save_motion(tmp_path, sheet())
    assert bench.set("physics_node", **values)[0]
    bench.until(lambda: physics.simulation.config.motion.file, "tissue with a motion that was found")
    simulation = physics.simulation
    send_model(bench, sheet().select(np.arange(200)))
    bench.refused("physics_node", "this is the motion of another model", "the model here has 200 Gaussians")
    bench.status("physics_node", "the model before goes on")
    assert physics.simulation is simulation
    assert bench.set("physics_node", **{"motion.file": "", "motion.breathing": 0.0})[0]
    since = len(bench.statuses["physics_node"])
    bench.status("physics_node", "running", OK, since)


def test_a_file_is_sought_beside_the_parameters_that_name_it(tmp_path, monkeypatch):
    (tmp_path / "motion.yaml").write_text("physics_node: {ros__parameters: {motion.file: motion.npz}}")
    (tmp_path / "other.yaml").write_text("/**: {ros__parameters: {motion: {file: found/motion.npz}}}")
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs/physics_node.yaml").write_text("/*: {ros__parameters: {motion.file: motion.npz}}")  # handed on, and not beside it
    (tmp_path / "found").mkdir()
    for name in ("motion.npz", "found/motion.npz"):
        (tmp_path / name).touch()
    files = [word for name in ("motion", "other", "logs/physics_node") for word in ("--params-file", str(tmp_path / f"{name}.yaml"))]
    monkeypatch.setattr("sys.argv", ["physics_node", "--ros-args", *files])
    assert beside_parameters("motion.file", "motion.npz") == str(tmp_path / "motion.npz")
    assert beside_parameters("motion.file", "found/motion.npz") == str(tmp_path / "found/motion.npz")
    for name in ("", "elsewhere.npz", "/motion.npz"):
        assert beside_parameters("motion.file", name) == name
