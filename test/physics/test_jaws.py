"""Jaws of instruments: what they hold, with what force, and how it slips out."""

from dataclasses import replace

import numpy as np
import pytest
from instrument_scene import LENGTH, Instrument, opened, plain_jaws
from thorough import mostly_thorough
from tissue_scene import TIP, pose_at, simulate, specimen, steps

from endo_sim_ros.physics import PhysicsConfig, TissueSimulation

# A strip along x that is held at x = 0; jaws that point to -x and close across it come from its other end.
TOWARDS_STRIP = np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]]).T


def strip(**overrides) -> tuple[TissueSimulation, np.ndarray]:
    """The strip, and the pose of jaws that reach 8 mm over its end."""
    nodes = specimen((25, 5, 3), 0.0025, lambda x: x[:, 0] < 1e-6, lambda x: np.ones(len(x), bool))
    config = PhysicsConfig(device="cpu", **{"young_modulus": 50e3, "travel": 0.2, **overrides})
    simulation, end, pose = TissueSimulation.from_nodes(nodes, config), nodes.rest.max(0), np.eye(4)
    simulation.set_instrument("PSM1", plain_jaws())
    pose[:3, :3], pose[:3, 3] = TOWARDS_STRIP, [end[0] + 0.002, end[1] / 2, end[2] / 2]
    return simulation, pose


@pytest.mark.slow
@pytest.mark.parametrize("friction, grip", mostly_thorough([(0.4, 0.5), (0.2, 0.5), (0.2, 1.5)]))
def test_a_strip_slips_out_of_the_jaws_at_twice_friction_times_the_force_of_the_grip(friction, grip):
    simulation, start = strip(friction=friction, grip_force=grip)
    bound, pulls, pose = 2 * friction * grip, [], start.copy()
    assert simulation.set_grasp("PSM1", pose, True, opened(pose, 0.0))
    while simulation.in_reach("PSM1"):
        pose[0, 3] += 0.0005
        simulation.set_grasp("PSM1", pose, True, opened(pose, 0.0))
        assert simulation.slips == 0
        simulation.step()
        pulls.append(-simulation.reaction("PSM1")[0][0])
    pulls = np.array(pulls)
    assert pulls.max() < 1.005 * bound
    sliding = pulls[pulls > 0.9 * bound]
    assert len(sliding) > 10 and sliding.mean() == pytest.approx(bound, rel=0.02)
    assert simulation.slips == 1 and simulation.faults == 0
    slid = pose[0, 3] - start[0, 3] - pulls.max() / pulls[0] * 0.0005  # beside what the strip stretches
    assert 0.005 < slid < 0.03
    steps(simulation, 200)
    np.testing.assert_allclose(simulation.state().positions, simulation.nodes.rest, atol=3e-4)  # it is the same tissue as before


def test_a_weak_pull_and_a_grip_without_limit_do_not_slip():
    for grip, pulled in ((1.5, 0.003), (0.0, 0.02)):
        simulation, pose = strip(grip_force=grip)
        simulation.set_grasp("PSM1", pose, True, opened(pose, 0.0))
        held = simulation.held_nodes("PSM1")
        for _ in range(10):
            pose[0, 3] += pulled / 10
            assert simulation.set_grasp("PSM1", pose, True, opened(pose, 0.0))
            simulation.step()
        moved = (simulation.state().positions - simulation.nodes.rest)[held, 0]
        assert simulation.slips == 0 and moved.mean() == pytest.approx(pulled, rel=0.05)
        np.testing.assert_array_equal(simulation.held_nodes("PSM1"), held)


@pytest.mark.parametrize("before", [0.0, 0.8])
def test_jaws_hold_what_lies_between_them_and_a_bare_tip_what_is_near_it(before):
    simulation, instrument = simulate(node_count=3000), Instrument("PROGRASP_FORCEPS")
    simulation.set_instrument("PSM1", instrument.capsules)
    length, tilt = 0.0175, 1.2
    hinge = TIP - 0.6 * length * np.array([np.sin(tilt), 0, np.cos(tilt)])
    pose, links = instrument.at(hinge, tilt, before)
    simulation.set_grasp("PSM1", pose, False, links)
    simulation.step()
    x = simulation.nodes.rest + simulation.solver.displacements()
    pose, links = instrument.at(hinge, tilt, 0.0)
    assert simulation.set_grasp("PSM1", pose, True, links)
    held = simulation.held_nodes("PSM1")
    along = (x - hinge) @ pose[:3, 2]
    off = np.linalg.norm(x - hinge - np.clip(along, 0, length)[:, None] * pose[:3, 2], axis=1)
    reach = 1.34 * simulation._tools.thinnest  # half a distance between nodes past a capsule 1.5 of them thick
    near = np.clip(along / length, 0, 1) * length * np.sin(before / 2) + reach
    skin = simulation.nodes.is_skin & ~simulation.nodes.pinned & (along >= 0)
    assert set(np.flatnonzero(skin & (off < 0.9 * near))) <= set(held) <= set(np.flatnonzero(skin & (off < 1.1 * near + 5e-4)))
    assert len(held) > 4
    bare = simulate(node_count=3000)
    assert bare.set_grasp("PSM1", pose, True)
    ball = np.linalg.norm(bare.nodes.rest - hinge, axis=1) <= bare.config.force_radius
    np.testing.assert_array_equal(bare.held_nodes("PSM1"), np.flatnonzero(ball & bare.nodes.is_skin & ~bare.nodes.pinned))


def jaws_over_tissue(gap: float, tilt: float) -> tuple[Instrument, np.ndarray]:
    """An instrument, and where its hinge is when its closed jaws, tilted from z towards x, are a gap above `curved_sheet`, m."""
    instrument = Instrument("PROGRASP_FORCEPS")
    jaws = [each for each in instrument.capsules if each.link.startswith("jaw")]
    _, links = instrument.at(np.zeros(3), tilt)
    near = np.inf
    for each in jaws:
        for share in np.linspace(0, 1, 9):
            x, y, z = links[each.link][:3, :3] @ (each.start + share * (each.end - each.start)) + links[each.link][:3, 3]
            slope = np.array([x + 0.18 * np.cos(60 * x), y])
            surface = 0.12 + 0.5 * (x**2 + y**2) + 0.003 * np.sin(60 * x)
            near = min(near, surface - z - (gap + each.radius) * np.sqrt(1 + slope @ slope))
    return instrument, np.array([0.0, 0.0, near])


@pytest.mark.parametrize("tilt", [0.0, 0.6, 1.2])
@pytest.mark.parametrize("count", [1500, 4000])
@pytest.mark.parametrize(("gap", "opening", "holds"), [
    (0.008, 0.8, False), (0.004, 0.0, False), (0.002, 0.0, False), (0.002, 0.8, False),
    (0.0, 0.0, True), (0.0, 0.8, True), (-0.004, 0.8, True),
])  # fmt: skip
def test_jaws_hold_what_they_touch_and_nothing_that_they_are_above(tilt, count, gap, opening, holds):
    simulation = simulate(node_count=count)
    instrument, hinge = jaws_over_tissue(gap, tilt)
    simulation.set_instrument("PSM1", instrument.capsules)
    pose, links = instrument.at(hinge, tilt, opening)
    for _ in range(3):
        simulation.set_grasp("PSM1", pose, False, links)
        simulation.step()
    pose, links = instrument.at(hinge, tilt)
    assert simulation.set_grasp("PSM1", pose, True, links) == holds
    for _ in range(5):
        simulation.step()
    assert (len(simulation.held_nodes("PSM1")) > 4) == holds and simulation.in_reach("PSM1") == holds


def test_jaws_that_closed_on_nothing_hold_nothing_until_they_open():
    simulation = simulate(node_count=1500)
    instrument, hinge = jaws_over_tissue(-0.003, 0.6)
    simulation.set_instrument("PSM1", instrument.capsules)
    for above in (0.01, 0.01, 0.005, 0.0, 0.0):
        pose, links = instrument.at(hinge - [0, 0, above], 0.6)
        assert not simulation.set_grasp("PSM1", pose, True, links)
        simulation.step()
        assert not simulation.in_reach("PSM1")
    assert simulation.reaction("PSM1")[0].any()  # closed jaws push
    move(simulation, instrument, hinge, 0.8)
    assert simulation.set_grasp("PSM1", pose, True, links)


@pytest.mark.parametrize("depth", [0.001, 0.004])
@pytest.mark.parametrize("gap", [0.0, 0.01])
@pytest.mark.parametrize(("beyond", "holds"), [(0.005, False), (0.001, True), (-0.006, True)])
def test_jaws_beside_an_edge_of_the_skin_or_in_a_gap_do_not_touch_it(beyond, gap, depth, holds):
    spacing, width = 0.0025, 0.03
    nodes = specimen((25, 13, 4), spacing, lambda x: x[:, 2] > 2.5 * spacing, lambda x: x[:, 2] < spacing / 2)
    rest = nodes.rest.copy()
    rest[rest[:, 0] > width + spacing / 2, 0] += (gap or 0.1) - spacing  # another edge, far away unless there is a gap
    nodes = replace(nodes, rest=rest, seen_from=np.array([0.03, 0.015, -0.1]))
    simulation = TissueSimulation.from_nodes(nodes, PhysicsConfig(device="cpu"))
    simulation.set_instrument("PSM1", plain_jaws())
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]]).T  # jaws point into the tissue
    for closed in (False, True):
        pose[:3, 3] = width + beyond, 0.015, depth - LENGTH - (0.02 if not closed else 0)
        holding = simulation.set_grasp("PSM1", pose, closed, opened(pose, 0.0))
        simulation.step()
    assert holding == holds and bool(len(simulation.held_nodes("PSM1"))) == holds


def move(simulation, instrument: Instrument, hinge: np.ndarray, jaw: float = 0.0) -> bool:
    """Have the jaws at an angle, closed at zero, for a step; returns whether they hold what they should."""
    pose, links = instrument.at(hinge, 0.6, jaw)
    holds = simulation.set_grasp("PSM1", pose, jaw == 0, links)
    simulation.step()
    return holds


def test_jaws_close_and_open_far_from_tissue_that_rests_too():
    simulation = simulate(node_count=1500)
    instrument, hinge = jaws_over_tissue(-0.003, 0.6)
    simulation.set_instrument("PSM1", instrument.capsules)
    far, near = hinge - [0, 0, 0.06], hinge - [0, 0, 0.005]
    move(simulation, instrument, far, 0.8)
    for closed_at in (far, near):
        assert not move(simulation, instrument, closed_at)
        assert not move(simulation, instrument, hinge) and not simulation.in_reach("PSM1")
        move(simulation, instrument, far)
        steps(simulation, 200)
        assert simulation.resting
        move(simulation, instrument, far, 0.8)
        assert move(simulation, instrument, hinge) and simulation.in_reach("PSM1")
        move(simulation, instrument, far, 0.8)


@pytest.mark.parametrize("known", [True, False])
def test_jaws_that_are_shut_stay_so_while_nobody_knows_their_links(known):
    simulation = simulate(node_count=1500)
    instrument, hinge = jaws_over_tissue(-0.003, 0.6)
    simulation.set_instrument("PSM1", instrument.capsules)
    assert not move(simulation, instrument, hinge - [0, 0, 0.06]) and simulation.is_closed("PSM1")
    if not known:
        simulation.set_instrument("PSM1", ())
    for _ in range(3):
        assert not simulation.set_grasp("PSM1", pose_at(TIP), True)
        simulation.step()
        assert not simulation.in_reach("PSM1") and simulation.is_closed("PSM1")
    simulation.set_grasp("PSM1", pose_at(TIP), False)
    assert not simulation.is_closed("PSM1")
    simulation.step()
    assert simulation.set_grasp("PSM1", pose_at(TIP), True)


@pytest.mark.parametrize("waiting", [0, 1, 3])
def test_jaws_that_tissue_slipped_out_of_hold_nothing_until_they_open_whatever_is_told_meanwhile(waiting):
    simulation, start = strip(grip_force=0.5)
    pose = start.copy()
    while simulation.slips == 0:
        simulation.set_grasp("PSM1", pose, True, opened(pose, 0.0))
        simulation.step()
        pose[0, 3] += 0.001
    steps(simulation, waiting)
    assert simulation.is_closed("PSM1")
    for _ in range(3):
        assert not simulation.set_grasp("PSM1", start, True, opened(start, 0.0))
        simulation.step()
        assert not simulation.in_reach("PSM1")
    simulation.set_grasp("PSM1", pose, False, opened(pose, 0.5))
    steps(simulation, 50)
    assert simulation.set_grasp("PSM1", start, True, opened(start, 0.0)) and simulation.slips == 1


def test_a_bare_tip_that_tissue_slipped_out_of_is_open_also_of_an_instrument():
    simulation = simulate(travel=0.01)
    simulation.set_instrument("PSM1", plain_jaws())
    for depth in range(12):
        if simulation.slips == 0:
            simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.001 * depth]), True)
            simulation.step()
    assert simulation.slips == 1 and not simulation.is_closed("PSM1") and not simulation.is_closed("PSM2")


def test_the_gap_at_which_jaws_hold_is_an_option():
    for widest, holds in ((1e-3, False), (5e-3, True)):
        simulation = simulate(node_count=4000, grasp_gap=widest)
        instrument, hinge = jaws_over_tissue(0.003, 0.6)
        simulation.set_instrument("PSM1", instrument.capsules)
        pose, links = instrument.at(hinge, 0.6)
        assert simulation.set_grasp("PSM1", pose, True, links) == holds


def test_jaws_close_on_nothing_in_the_air_and_let_go_when_they_open():
    simulation, pose = strip()
    away = pose.copy()
    away[0, 3] += 0.03
    assert not simulation.set_grasp("PSM1", away, True, opened(away, 0.0))
    assert simulation.set_grasp("PSM1", pose, True, opened(pose, 0.0))
    pose[0, 3] += 0.004
    for _ in range(5):
        assert simulation.set_grasp("PSM1", pose, True, opened(pose, 0.0))
        simulation.step()
    assert simulation.reaction("PSM1")[0][0] < -0.1
    simulation.set_grasp("PSM1", pose_at([0, 0, 1.0]), False)
    steps(simulation, 150)
    assert not simulation.held_nodes("PSM1").size and not simulation.reaction("PSM1")[0].any() and simulation.slips == 0
    np.testing.assert_allclose(simulation.state().positions, simulation.nodes.rest, atol=3e-4)
