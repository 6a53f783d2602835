"""Grasping: what a closed jaw holds, how it pulls back, turns, slips and lets go."""

import numpy as np
import pytest
from tissue_scene import TIP, curved_sheet, depth_of_dent, free_block, pose_at, simulate, steps


def test_closed_jaw_holds_tissue_that_follows_and_pulls_back():
    simulation = simulate()
    assert simulation.set_grasp("PSM1", pose_at(TIP), True)
    held = simulation.held_nodes("PSM1")
    for i in range(1, 11):
        simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.001 * i]), True)
        simulation.step()
    moved = (simulation.state().positions - simulation.nodes.rest)[held]
    np.testing.assert_allclose(moved, np.tile([0, 0, -0.01], (len(held), 1)), atol=1e-3)
    force, _ = simulation.reaction("PSM1")
    assert force[2] > 0.05 and np.linalg.norm(force[:2]) < 0.3 * force[2]  # the tissue pulls the jaw back, away from the camera
    assert simulation.in_reach("PSM1") and simulation.faults == 0


def test_reaction_of_a_grasp_grows_with_stiffness():
    pulls = []
    for modulus in (5e3, 10e3):
        simulation = simulate(young_modulus=modulus)
        simulation.set_grasp("PSM1", pose_at(TIP), True)
        simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.002]), True)
        steps(simulation, 10)
        pulls.append(simulation.reaction("PSM1")[0][2])
    assert pulls[1] / pulls[0] == pytest.approx(2, rel=0.1)


@pytest.mark.slow
def test_what_a_jaw_feels_hardly_depends_on_how_many_nodes_there_are():
    pulls = []
    for count, layers in ((1000, 3), (4000, 3), (12000, 5)):
        simulation = simulate(curved_sheet(12000), node_count=count, layers=layers)
        simulation.set_grasp("PSM1", pose_at(TIP), True)
        simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.003]), True)
        held = simulation.held_nodes("PSM1")
        steps(simulation, 15)
        lag = np.linalg.norm(simulation.state().positions[held] - simulation.nodes.rest[held] + [0, 0, 0.003], axis=1)
        assert lag.mean() < 0.1 * 0.003
        pulls.append(simulation.reaction("PSM1")[0][2])
    assert max(pulls) < 1.35 * min(pulls)


def test_turning_free_tissue_steadily_takes_no_torque():
    simulation = free_block(force_radius=0.006)
    centre = simulation.nodes.rest.mean(0).astype(float)
    pose, torques = pose_at(centre), []
    simulation.set_grasp("PSM1", pose, True)
    for step in range(40):
        c, s = np.cos(0.02 * step), np.sin(0.02 * step)
        pose[:2, :2] = [[c, -s], [s, c]]
        simulation.set_grasp("PSM1", pose, True)
        simulation.step()
        torques.append(simulation.reaction("PSM1")[1][2])
    assert np.abs(torques[30:]).max() < 0.02 * np.abs(torques).max()  # which was to set it going


def test_turning_the_jaw_turns_the_tissue_and_is_resisted():
    simulation = simulate()
    simulation.set_grasp("PSM1", pose_at(TIP), True)
    held = simulation.held_nodes("PSM1")
    pose = pose_at(TIP)
    angle = 0.2
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    simulation.set_grasp("PSM1", pose, True)
    steps(simulation, 5)
    state, rest = simulation.state(), simulation.nodes.rest
    expected = (rest[held] - TIP) @ pose[:3, :3].T + TIP
    np.testing.assert_allclose(state.positions[held], expected, atol=4e-4)
    assert simulation.reaction("PSM1")[1][2] < -1e-4


def test_tissue_is_handed_from_jaw_to_jaw_without_a_jerk():
    simulation, aside = simulate(), TIP + [0.0048, 0, 0]
    for closed in (False, True):
        for tool in ("PSM1", "PSM2"):
            assert simulation.set_grasp(tool, pose_at(TIP), closed)
    held = simulation.held_nodes("PSM1")

    def follow(tool):
        for _ in range(3):
            simulation.step()
            moved = (simulation.state().positions - simulation.nodes.rest)[held].mean(0)
            yield *moved, simulation.reaction(tool)[0][0]

    for part in np.linspace(0, 1, 6):  # both hold it, and only one goes away
        simulation.set_grasp("PSM1", pose_at(TIP + part * (aside - TIP)), True)
        simulation.step()
    assert np.abs(list(follow("PSM1"))[-1]).max() < 1e-4  # it has nothing yet
    simulation.set_grasp("PSM2", pose_at(TIP), False)
    given = np.array(list(follow("PSM1")))
    np.testing.assert_allclose(given[:, :3], np.tile(aside - TIP, (3, 1)), atol=1e-4)
    assert given[-1, 3] < -0.5 and abs(given[0, 3]) < 1.1 * abs(given[-1, 3])
    simulation.set_grasp("PSM2", pose_at(aside), True)
    simulation.set_grasp("PSM1", pose_at(aside), False)
    back = np.array(list(follow("PSM2")))
    np.testing.assert_allclose(back[:, :3], given[:, :3], atol=1e-4)
    assert back[:, 3] == pytest.approx(given[-1, 3], rel=0.15) and not simulation.reaction("PSM1")[0].any()


def test_opening_the_jaw_releases_the_tissue():
    simulation = simulate()
    simulation.set_grasp("PSM1", pose_at(TIP), True)
    simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.008]), True)
    steps(simulation, 5)
    pulled = depth_of_dent(simulation)
    assert simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.008]), False)
    steps(simulation, 100)
    assert pulled > 0.007 and depth_of_dent(simulation) < 0.1 * pulled
    assert not simulation.reaction("PSM1")[0].any() and not simulation.in_reach("PSM1")


def test_jaw_closed_in_the_air_holds_nothing_and_tissue_pulled_too_far_slips():
    simulation = simulate()
    assert not simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.05]), True)
    assert simulation.set_grasp("PSM1", pose_at(TIP), True)
    simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.06]), True)
    simulation.step()
    assert simulation.slips == 1 and not simulation.in_reach("PSM1") and simulation.faults == 0
    with pytest.raises(ValueError, match="must turn and shift, not scale or mirror"):
        simulation.set_grasp("PSM1", np.diag([2.0, 2.0, 2.0, 1.0]), True)
    with pytest.raises(ValueError, match="pose of tool 'PSM1' must be a finite"):
        simulation.set_grasp("PSM1", np.full((4, 4), np.nan), True)


@pytest.mark.parametrize("hold", ["jaw", "wrench", "capsule"])
def test_a_tool_that_is_withdrawn_lets_go_and_touches_nothing_until_it_comes_back(hold):
    simulation = simulate(contact_radius=0.015 if hold == "capsule" else 0.0)
    simulation.withdraw("PSM1")  # which it knows nothing of yet

    def act(depth):
        simulation.set_grasp("PSM1", pose_at(TIP + [0, 0, depth]), hold == "jaw")
        if hold == "wrench":
            simulation.set_wrench("PSM1", TIP, np.array([0, 0, -1.0]))
        simulation.step()

    for step in range(8):
        act(0.001 * step - (0.01 if hold == "capsule" else 0))
    assert np.linalg.norm(simulation.reaction("PSM1")[0]) > 0.01 and depth_of_dent(simulation) > 1e-3
    simulation.withdraw("PSM1")
    assert not simulation.reaction("PSM1")[0].any() and not simulation.in_reach("PSM1")
    steps(simulation, 60)
    assert depth_of_dent(simulation) < 3e-4 and not simulation.reaction("PSM1")[0].any()
    act(0.0)
    steps(simulation, 3)
    assert simulation.reaction("PSM1")[0].any()


def test_what_tools_were_told_last_is_what_acts():
    simulation, rng = simulate(), np.random.default_rng(1)
    poses, forces = {}, {}
    for _ in range(120):
        tool, deed = "ab"[rng.integers(2)], rng.integers(8)
        pose = poses.get(tool, pose_at(TIP))
        if deed < 4:  # moves, stays where it is, or opens or closes the jaw there
            poses[tool] = pose_at(TIP + 0.002 * rng.normal(size=3)) if deed == 0 else pose
            simulation.set_grasp(tool, poses[tool], bool(deed == 3))
        elif deed < 6:
            forces[tool] = forces.get(tool, np.zeros(3)) if deed == 4 else rng.integers(0, 2) * rng.normal(size=3)
            simulation.set_wrench(tool, pose[:3, 3], forces[tool])
        elif deed == 6:
            simulation.withdraw(tool)
            assert not simulation.in_reach(tool)
            poses.pop(tool, None)
            forces.pop(tool, None)
        elif rng.random() < 0.2:
            simulation.reset()
            poses, forces = {}, {}
        simulation.step()
        tools = simulation._tools
        for name, slot in simulation._slots.items():
            assert bool(tools.present[0, slot]) == (name in poses)
            if name in poses:
                np.testing.assert_array_equal(tools.tips[0, slot], poses[name][:3, 3])
            np.testing.assert_array_equal(tools.forces[0, slot], forces.get(name, np.zeros(3)))
            assert tools.closed[0, slot] or not tools.gripping[0, slot]
