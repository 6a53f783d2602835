"""identification_node: touches of a tool in, a map of stiffness out, and parameters for physics_node."""

import threading

import numpy as np
import pytest
import rclpy
from ros_bench import SMALL, Bench, S, send_model, sheet, start_ros
from std_srvs.srv import Trigger

from endo_sim_ros import messages
from endo_sim_ros.messages import ERROR, OK
from endo_sim_ros.nodes.identification_node import IdentificationNode
from endo_sim_ros.nodes.physics_node import PhysicsNode
from endo_sim_ros.physics import PhysicsConfig, TissueSimulation

pytestmark = [pytest.mark.dds, pytest.mark.slow]
ARM, BEGIN, TRUTH = "ROBOT", 1000 * S, 14e3  # Pa; physics_node has no such arm, so that it does not answer
# Heavy tissue takes a third as many substeps, and stiff tissue is pressed slowly.
TISSUE = {"node_count": 300, "step_duration": 0.04, "contact_radius": 0.01, "force_radius": 0.02, "density": 8000.0}
STEPS, SETTLE = 30, 14


def simulated(modulus):
    """Tips [T, 3] of a press in the middle of the sheet, and what tissue of a modulus exerts on the tool [T, 3]."""
    physics = PhysicsConfig(**TISSUE, young_modulus=modulus, device="cpu")
    simulation = TissueSimulation(sheet(), np.zeros(3), physics)
    down = np.interp(np.arange(STEPS), [0, 12, 18, STEPS - 1], [-0.02, 0.005, 0.005, -0.02])
    depths = np.concatenate([np.full(SETTLE, -0.02), down, np.full(2 * SETTLE, -0.02)])
    tips = np.array([0.0, 0, 0.1 - simulation.contact_radius]) + depths[:, None] * [0, 0, 1]
    forces = []
    for tip in tips:
        simulation.set_grasp(ARM, pose_at(tip), False)
        simulation.step()
        forces.append(simulation.reaction(ARM)[0])
    return tips, np.array(forces)


def pose_at(tip):
    pose = np.eye(4)
    pose[:3, 3] = tip
    return pose


@pytest.fixture(scope="module")
def press():
    return simulated(TRUTH)


@pytest.fixture
def graph():
    """A bench with identification_node, which knows control nodes, and physics_node."""
    options = TISSUE | {"arms": f"[{ARM}]", "apply": "true", "device": "cpu"}
    start_ros(identification_node=options, physics_node=SMALL["physics_node"] | {"contact_radius": 0.01})
    bench = Bench()
    try:
        bench.hear(messages.STIFFNESS_MAP)
        node, physics = bench.add(IdentificationNode), bench.add(PhysicsNode)
        bench.status("identification_node", "waiting for a model")
        send_model(bench)
        bench.until(lambda: node.nodes is not None and physics.simulation is not None, "control nodes", 60)
        yield bench, node, physics
    finally:
        bench.close()
        rclpy.try_shutdown()


def tell(bench, tips, forces, begin=BEGIN, noise=0.0):
    rng = np.random.default_rng(0)
    for step, (tip, force) in enumerate(zip(tips, forces)):
        stamp = begin + step * S // 25
        bench.publish(messages.tool_pose(ARM), messages.encode_pose(pose_at(tip), stamp, "world"))
        felt = force + noise * rng.normal(size=3)
        bench.publish(messages.tool_reaction(ARM), messages.encode_wrench(felt, np.zeros(3), stamp, ARM))
        for _ in range(5):  # both are heard before the next, beside what timers have to do: what is lost looks like a clock that is off
            bench.executor.spin_once(timeout_sec=0.002)


def test_touches_become_a_map_that_physics_takes_and_more_touches_refine_it(graph, press):
    bench, node, physics = graph
    assert physics.config.young_modulus == 10e3
    _, text, values = bench.status("identification_node", "waiting for a touch of ROBOT, and for its end", OK)
    assert (values["state"], values["experiments"]) == ("collecting", "0")
    tell(bench, *press, noise=0.05)
    (first,) = bench.until(lambda: bench.heard["stiffness_map"], "a map", 40)
    found = messages.decode_stiffness(first)
    assert messages.stamp_to_ns(first.header.stamp) == 5 * S and first.header.frame_id == "world"
    np.testing.assert_array_equal(found.positions, node.nodes.rest)
    assert found.known.all() and np.ptp(found.young_modulus) == 0
    assert found.low[0] < TRUTH < found.high[0] and found.young_modulus[0] == pytest.approx(TRUTH, rel=0.2)
    bench.until(lambda: physics.config.young_modulus == pytest.approx(found.young_modulus[0], rel=1e-4), "physics_node to take it")
    _, text, values = bench.status("identification_node", "young_modulus")
    assert float(values["young_modulus"]) == pytest.approx(found.young_modulus[0], rel=1e-4) and float(values["known"]) == 1
    tell(bench, *press, begin=BEGIN + 10 * S, noise=0.05)
    bench.until(lambda: len(bench.heard["stiffness_map"]) == 2, "a second map", 40)
    assert len(node.experiments) == 2
    second = messages.decode_stiffness(bench.heard["stiffness_map"][-1])
    width = lambda each: np.log(each.high[0] / each.low[0])
    assert width(second) < 1.02 * width(found)
    assert bench.call(Trigger, "/identification_node/reset").message == "2 experiments are forgotten"
    assert not node.experiments and node.found is None


def test_what_cannot_be_used_is_one_sentence_and_the_node_goes_on(graph, press):
    bench, node, _ = graph
    tips, forces = press
    tell(bench, tips, -forces)
    bench.refused("identification_node", "turn the sign round", "ROBOT/body/measured_cf")
    bench.publish(messages.tool_pose(ARM), messages.encode_pose(np.diag([1, 1, 1, 1.0]), BEGIN + 20 * S, "nowhere"))
    bench.refused("identification_node", "nowhere", "ROBOT/measured_cp")
    count = len(bench.statuses["identification_node"])
    tell(bench, tips, forces, begin=BEGIN + 30 * S)
    bench.until(lambda: bench.heard["stiffness_map"], "a map after all", 40)
    assert not any(level == ERROR and "unexpected" in text for level, text, _ in bench.statuses["identification_node"][count:])


@pytest.mark.thorough
def test_an_estimate_that_is_refused_takes_no_later_press_along(graph, press):
    bench, node, _ = graph
    tips, forces = press
    held = threading.Event()
    node._background._executor.submit(held.wait)  # as if the first estimate took long
    turned = forces @ np.array([[1, 0, 0], [0, np.sqrt(0.5), -np.sqrt(0.5)], [0, np.sqrt(0.5), np.sqrt(0.5)]])
    tell(bench, tips, turned, noise=0.05)
    bench.until(lambda: node._background.busy, "the first press to be estimated")
    tell(bench, *press, begin=BEGIN + 10 * S, noise=0.05)
    bench.until(lambda: node._gathered == 2, "a second press")
    held.set()
    bench.until(lambda: node.found is not None, "an estimate of the second press", 40)
    assert node.found["young_modulus"].low < TRUTH < node.found["young_modulus"].high and len(node.experiments) == 1
    assert any(level == ERROR for level, *_ in bench.statuses["identification_node"])


@pytest.mark.thorough
def test_time_that_begins_anew_keeps_what_was_felt(graph, press):
    bench, node, _ = graph
    assert bench.set("identification_node", new_touches=1000)[0]  # the first estimate, and no other
    tell(bench, *press)
    bench.until(lambda: len(node.experiments) == 1, "an experiment")
    tell(bench, *press, begin=10 * S)
    bench.until(lambda: len(node.experiments) == 2, "an experiment of the new time")


@pytest.mark.thorough
def test_touches_that_cannot_be_relied_on_are_left_out_and_told(graph, press):
    bench, node, _ = graph
    tips, forces = press
    late = np.roll(forces, 6, axis=0)
    tell(bench, tips, late, noise=0.05)
    bench.status("identification_node", "an experiment is left out of the estimate: measured forces come 0.2")
    assert not node.experiments and not node.found.any_known
    tell(bench, *press, begin=BEGIN + 10 * S, noise=0.05)
    bench.until(lambda: node.found.any_known, "an estimate of the good one alone", 40)
    first = node.found
    assert first["young_modulus"].low < TRUTH < first["young_modulus"].high and len(node.experiments) == 1
    tell(bench, tips, late, begin=BEGIN + 20 * S, noise=0.05)
    bench.until(lambda: node._used == 3, "an estimate of another late one", 40)
    assert node.found is first and len(node.experiments) == 1 and len(bench.heard["stiffness_map"]) == 2
    _, text, _ = bench.status("identification_node", "3 experiments")
    assert text.index("left out of the estimate") < text.index("tools act as balls") and text.endswith(
        "simulation of the same ones was recorded"
    )
    done, why = bench.set("identification_node", stiffness="inclusion")
    assert not done and "needs all presses together" in why and node.config.stiffness == "uniform"


@pytest.mark.thorough
def test_a_first_press_that_later_ones_contradict_is_left_out(graph, press):
    bench, node, _ = graph
    tips, forces = press
    tell(bench, tips, 0.5 * forces, noise=0.05)  # as of a sensor that is not calibrated
    bench.until(lambda: node._used == 1, "an estimate of the first one", 40)
    for number in (1, 2):
        tell(bench, *press, begin=BEGIN + 10 * number * S, noise=0.05)
        bench.until(lambda: node._used == number + 1, "an estimate of a good one", 60)
    assert len(node.experiments) == 2 and not node._doubted
    assert node.found["young_modulus"].low < TRUTH < node.found["young_modulus"].high and node.found.any_known
    bench.status("identification_node", "an experiment is left out of the estimate, which begins anew")
