"""Reactions between steps: what is published, with which stamp, and when."""

import time

import numpy as np
import pytest
import rclpy
from ros_bench import Bench, S, send_model, send_tip, send_wrench, start_ros
from std_srvs.srv import Trigger

from endo_sim_ros import messages
from endo_sim_ros.nodes.base import EndoNode, quality
from endo_sim_ros.nodes.physics_node import PhysicsNode
from endo_sim_ros.nodes.reactions import ReactionTopics

pytestmark = pytest.mark.dds

RATE, STEP = 500.0, 20_000_000  # Hz, ns
REACTION = messages.tool_reaction("PSM1")


@pytest.fixture
def bench():
    given = {
        "mode": "lockstep",
        "reaction_rate": RATE,
        "step_duration": 0.02,
        "node_count": 300,
        "force_radius": 0.02,
        "device": "cpu",
        "link_contact": "false",
    }
    start_ros(physics_node=given)
    bench = Bench()
    yield bench
    bench.close()
    rclpy.try_shutdown()


@pytest.fixture
def topics(bench):
    """Makes `ReactionTopics` of a node, and returns them with what is heard: (time of publication, stamp, force along z)."""
    made = []

    def make(lockstep, rate=RATE):
        heard = []

        def note(message, info):
            heard.append((info["source_timestamp"], messages.stamp_to_ns(message.header.stamp), message.wrench.force.z))

        node = bench.add(lambda: EndoNode("tissue"))
        made.append(ReactionTopics(node, ("PSM1",), rate, lockstep))
        bench.user.create_subscription(messages.ros_class(REACTION.type), REACTION.name, note, quality(REACTION, 1000))
        bench.until(lambda: node.count_subscribers(REACTION.name), "a subscriber")
        bench.spin(0.3)  # until both ends know of each other
        return made[-1], heard

    yield make
    for each in made:
        each.stop()


def force(z):
    return {"PSM1": np.array([0, 0, z, 0, 0, 0.0])}


def test_in_lockstep_the_reactions_since_the_step_before_come_together(bench, topics):
    reactions, heard = topics(lockstep=True)
    for stamp, value in ((5 * S, 0.0), (5 * S + STEP, 1.0), (5 * S + 2 * STEP, -1.0), (9 * S, 4.0), (5 * S, 0.0), (5 * S + STEP, 2.0)):
        reactions.publish(force(value), stamp, 0.02)
    bench.until(lambda: len(heard) >= 33, lambda: f"33 messages: {heard}")
    bench.spin(0.1)
    stamps, forces = ([row[k] for row in heard] for k in (1, 2))
    tenth = STEP // 10
    one_step = [5 * S + k * tenth for k in range(1, 11)]
    assert stamps == [5 * S, *one_step, *(stamp + STEP for stamp in one_step), 9 * S, 5 * S, *one_step]
    rising = np.linspace(0.1, 1.0, 10)
    np.testing.assert_allclose(forces, [0.0, *rising, *(1 - 2 * rising), 4.0, 0.0, *(2 * rising)], atol=1e-12)
    assert [forces[k] for k in (10, 20, 21)] == [1.0, -1.0, 4.0]  # those of steps to the last bit


def test_without_a_rate_each_step_has_one_reaction_at_once(bench, topics):
    reactions, heard = topics(lockstep=False, rate=0.0)
    for k in range(5):
        reactions.publish(force(float(k)), 5 * S + k * STEP, 0.02)
    bench.until(lambda: len(heard) == 5, "5 messages")
    assert [row[1:] for row in heard] == [(5 * S + k * STEP, float(k)) for k in range(5)]


def test_in_real_time_reactions_are_published_while_the_callbacks_are_busy(bench, topics):
    reactions, heard = topics(lockstep=False)
    begin = bench.user.now_ns()
    for k in range(6):
        reactions.publish(force(float(k)), begin + k * 10 * STEP, 0.2)
    asleep = time.time_ns(), time.sleep(0.8), time.time_ns()  # no callback of any node runs
    bench.until(lambda: len(heard) >= 501, lambda: f"501 messages, not {len(heard)}")
    published, stamps = np.array([row[:2] for row in heard]).T
    assert ((published > asleep[0]) & (published < asleep[2])).sum() > 50
    assert (np.diff(published) >= 0).all() and (published - stamps >= 1.25 * 0.2 * S - 1e6).all()
    np.testing.assert_allclose(np.diff(stamps), S / RATE, atol=2)
    np.testing.assert_allclose([row[2] for row in heard], (stamps - begin) / (10 * STEP), atol=1e-6)


def test_a_clock_that_goes_back_leaves_no_reaction_of_the_future_waiting(bench, topics):
    reactions, heard = topics(lockstep=False)
    now = bench.user.now_ns()
    reactions.publish(force(9.0), now + 3600 * S, 0.02)
    reactions.publish(force(1.0), now, 0.02)
    bench.until(lambda: heard, "the reaction of now")
    assert [row[1:] for row in heard] == [(now, 1.0)]


def test_physics_node_in_lockstep_gives_the_same_reactions_between_steps_in_every_run(bench):
    heard = []
    bench.user.subscribe(REACTION, heard.append, depth=1000)  # those of several steps may come at once
    bench.add(PhysicsNode)
    send_model(bench)
    bench.until(lambda: "lockstep" in bench.status("physics_node", "lockstep")[1], "the model")
    runs = []
    for _ in range(2):
        assert bench.call(Trigger, "/physics_node/reset").success
        heard.clear()
        for k in range(1, 6):
            stamp = 5 * S + k * STEP
            send_tip(bench, stamp=stamp)
            send_wrench(bench, (0, 0, -0.2 * k), stamp=stamp)
        bench.until(lambda: heard and messages.stamp_to_ns(heard[-1].header.stamp) == 5 * S + 5 * STEP, "the last step")
        runs.append([(messages.stamp_to_ns(m.header.stamp), m.wrench.force.x, m.wrench.force.y, m.wrench.force.z) for m in heard])
    assert runs[0] == runs[1] and len(runs[0]) == 50
    at_steps = {stamp: z for stamp, _, _, z in runs[0]}
    np.testing.assert_allclose([at_steps[5 * S + k * STEP] for k in range(1, 6)], 0.2 * np.arange(1, 6), atol=1e-9)
    np.testing.assert_allclose(at_steps[5 * S + 3 * STEP // 2], 0.3, atol=1e-9)
