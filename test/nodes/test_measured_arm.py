"""The instrument of a robot's arm: its links follow the pose that the robot measures."""

import numpy as np
import pytest
from ros_bench import S, send_tip, tissue_bench

from endo_sim_ros import messages
from endo_sim_ros.instruments import link_poses, load_arm, solve_inverse

pytestmark = pytest.mark.dds

BASE = "0.1 0.05 0.0 0 1 0 0"  # half a turn about y: the shaft of PSM2 points along z of the camera at position zero


@pytest.fixture(scope="module")
def graph():
    links = map(messages.tool_links, ("PSM1", "PSM2", "PSM3"))
    with tissue_bench(*links, arms="[PSM1, PSM2, PSM3]", frames=f"['PSM2_base {BASE}']") as bench:
        yield bench


@pytest.mark.parametrize("arm", ["PSM1", "PSM2"])
def test_links_follow_a_measured_pose_and_jaw(graph, arm):
    graph.spin(0.1)
    assert not any(message.poses for message in graph.heard[f"{arm}/link_poses"]), "nobody knows its pose yet"
    send_tip(graph, (0.01, -0.01, 0.09), arm)
    links = graph.heard[f"{arm}/link_poses"]
    graph.until(lambda: links and links[-1].poses, "links")
    base = graph.nodes[1].arms[arm].base
    if arm == "PSM2":
        np.testing.assert_allclose(base[:3, 3], [0.1, 0.05, 0.0])
    pose, psm = np.eye(4), load_arm("PSM", "LARGE_NEEDLE_DRIVER")
    pose[:3, 3] = 0.01, -0.01, 0.09
    graph.publish(messages.tool_jaw(arm), messages.encode_jaw(0.4, S))
    reach = solve_inverse(psm, np.linalg.inv(base) @ pose, graph.nodes[1].arms[arm].joints)
    expected = base @ np.stack(list(link_poses(psm, reach.joints, 0.4).values()))
    graph.until(lambda: np.allclose(messages.decode_poses(links[-1], ""), expected, atol=1e-6), "links of that pose and jaw")
    assert reach.reached


@pytest.mark.parametrize("depth, sentence", [
    (0.6, "PSM2: PSM stops 3"), (80.0, "PSM2: the pose is 80 m from the base, and the whole arm is 1.1 m long; is it in metres?"),
    (1e200, "PSM2: the pose is 1e+200 m from the base"),
])  # fmt: skip
def test_a_measured_pose_that_the_arm_cannot_have_is_a_warning_as_long_as_it_is_there(graph, depth, sentence):
    errors = graph.nodes[1].error_count
    send_tip(graph, (0.01, -0.01, depth), "PSM2")
    since = len(graph.statuses["physics_node"])
    _, text, _ = graph.status("physics_node", sentence, 1, since)
    assert text.startswith("running; ") and ("PSM2_base in frames" in text or depth > 1)
    send_tip(graph, (0.01, -0.01, 0.09), "PSM2")
    graph.until(lambda: not graph.nodes[1].arms["PSM2"].missing, "a pose in reach")
    assert graph.nodes[1].error_count == errors


def test_an_arm_without_a_place_says_so_and_is_a_tip(graph):
    graph.status("physics_node", "there is no default place for PSM3, only for PSM1, PSM2 and ECM; give its base in frames", 1)
    send_tip(graph, (0, 0, 0.09), "PSM3")
    graph.until(lambda: graph.nodes[1].arms["PSM3"].pose is not None)
    graph.spin(0.1)
    assert not any(message.poses for message in graph.heard["PSM3/link_poses"])
