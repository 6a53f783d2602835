"""physics_node: tissue that breathes, as parameters and a topic have it."""

import numpy as np
import pytest
from ros_bench import S, await_nodes, nodes_of, pull, send_model
from std_srvs.srv import SetBool, Trigger

from endo_sim_ros import messages
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
    "nothing": ({}, "expected a finite position for each name"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_command_is_one_sentence_and_leaves_the_motion_as_it_was(breathing, name):
    bench, physics = breathing
    send(bench, breathing=0.003)
    bench.until(lambda: physics.simulation.config.motion == MotionConfig(breathing=0.003))
    values, text = BAD[name]
    send(bench, **values)
    bench.refused("physics_node", text)
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
