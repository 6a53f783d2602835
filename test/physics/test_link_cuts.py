"""Instruments that cut: scissors that close, and the wire of a hook."""

import numpy as np
import pytest
import torch
from instrument_scene import Instrument, opened
from tissue_scene import TIP, simulate, specimen, steps

from endo_sim_ros.instruments import Capsule
from endo_sim_ros.physics import PhysicsConfig, TissueBatch, TissueSimulation
from endo_sim_ros.physics.cutting.geometry import separated
from endo_sim_ros.physics.links import ToolLinks

SPACING, AT = 0.0025, 0.0313  # m; no node lies at x = AT
BLADES = [
    Capsule(link, np.array([0.0, y, 0.0]), np.array([0.02, y, 0.0]), 0.0008, cuts=True)
    for link, y in (("jaw_left", 0.0005), ("jaw_right", -0.0005))
]
# Blades along y that close across z.
ACROSS_STRIP = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]).T


def strip(capsules=BLADES, **overrides) -> tuple[TissueSimulation, np.ndarray]:
    """A strip along x that is held at x = 0, and the pose of open scissors around it."""
    nodes = specimen((25, 5, 3), SPACING, lambda x: x[:, 0] < 1e-6, lambda x: np.ones(len(x), bool))
    simulation, pose = TissueSimulation.from_nodes(nodes, PhysicsConfig(device="cpu", travel=0.2, **overrides)), np.eye(4)
    simulation.set_instrument("PSM1", capsules)
    pose[:3, :3], pose[:3, 3] = ACROSS_STRIP, [AT, -0.006, SPACING]
    return simulation, pose


def close(simulation, pose, angles):
    for angle in angles:
        assert simulation.set_grasp("PSM1", pose, angle == 0, opened(pose, angle))
        simulation.step()


def parted(simulation) -> np.ndarray:
    """Which of the links along x between neighbouring nodes are cut [24, 5, 3]."""
    nodes = simulation.nodes.rest.reshape(25, 5, 3, 3)
    return separated(nodes[:-1].reshape(-1, 3), nodes[1:].reshape(-1, 3), simulation.cuts).reshape(24, 5, 3)


@pytest.mark.parametrize("angles", [[1.4, 0.0], np.linspace(1.4, 0.0, 12)], ids=["at once", "slowly"])
def test_scissors_that_close_cut_a_strip_in_two_along_their_blades(angles):
    simulation, pose = strip(gravity_x=1.0)
    close(simulation, pose, angles[:1])
    assert not len(simulation.cuts)
    close(simulation, pose, angles[1:])
    cut = parted(simulation)
    column = int(AT / SPACING)
    assert cut[column].all() and not np.delete(cut, (column - 1, column, column + 1), axis=0).any()
    assert not simulation.in_reach("PSM1") and simulation.faults == 0
    steps(simulation, 5)
    x = (simulation.state().positions - simulation.nodes.rest)[:, 0].reshape(25, 15).mean(1)
    assert x[column + 2 :].min() > 10 * x[: column - 1].max()  # what is cut off falls


def test_scissors_that_stand_open_or_close_in_the_air_and_jaws_that_close_cut_nothing():
    simulation, pose = strip()
    close(simulation, pose, [1.0, 1.2, 1.4, 1.4])
    away = pose.copy()
    away[0, 3] += 0.1
    close(simulation, away, [1.4, 0.7, 0.0, 0.0])
    assert not len(simulation.cuts)
    simulation, pose = strip([Capsule(each.link, each.start, each.end, each.radius) for each in BLADES])
    close(simulation, pose, [1.4, 0.7, 0.1])
    assert not len(simulation.cuts)
    with pytest.raises(ValueError, match="tissue with kinematics current cannot be cut; set kinematics to rest"):
        strip(kinematics="current")


def test_what_is_swept_just_above_tissue_parts_nothing():
    for above, parts in ((0.001, False), (-0.004, True)):
        simulation, instrument = simulate(node_count=1500), Instrument("CURVED_SCISSORS")
        simulation.set_instrument("PSM1", instrument.capsules)
        for angle in (0.6, 0.0):
            pose, links = instrument.at(TIP + [0, 0, -0.015 - above], 0.0, angle)
            simulation.set_grasp("PSM1", pose, angle == 0, links)
            simulation.step()
        assert len(simulation.cuts) and (simulation.parted_links > 0) == parts
        simulation.reset()
        assert simulation.parted_links == 0


def test_open_scissors_close_around_what_they_cut_instead_of_pushing_it_away():
    simulation, instrument = simulate(node_count=3000), Instrument("CURVED_SCISSORS")
    simulation.set_instrument("PSM1", instrument.capsules)
    for step in range(14):
        pose, links = instrument.at(TIP + [0, 0, -0.02 + 0.001 * min(step, 10)], 0.0, 0.9)
        simulation.set_grasp("PSM1", pose, False, links)
        simulation.step()
    assert np.abs(simulation.state().positions - simulation.nodes.rest).max() < 2e-3
    for angle in (0.6, 0.3, 0.0):
        pose, links = instrument.at(TIP + [0, 0, -0.01], 0.0, angle)
        simulation.set_grasp("PSM1", pose, angle == 0, links)
        simulation.step()
    assert len(simulation.cuts) and simulation.faults == 0
    middle = simulation.cuts.reshape(-1, 3)
    assert np.abs(middle[:, :2] - TIP[:2]).max() < 0.01 and middle[:, 2].max() < TIP[2] + 0.008


@pytest.mark.parametrize("tool", ["PERMANENT_CAUTERY_HOOK", "CURVED_SCISSORS"])
def test_a_tool_without_jaws_that_grasp_holds_nothing(tool):
    simulation, instrument = simulate(node_count=1000), Instrument(tool)
    simulation.set_instrument("PSM1", instrument.capsules)
    pose, links = instrument.at(TIP + [0.0, 0.0, -0.003])
    if tool == "PERMANENT_CAUTERY_HOOK":
        assert not simulation.set_grasp("PSM1", pose, True, links)
    batch = TissueBatch(simulation.nodes, simulation.config, 2, capsules=len(instrument.capsules))
    own = ToolLinks(instrument.capsules)
    batch.tools.set_links(0, own, own.order("PSM1", links).expand(2, -1, -1, -1))
    batch.tools.tips[:, 0], batch.tools.rotations[:, 0] = torch.from_numpy(pose[:3, 3].copy()), torch.from_numpy(pose[:3, :3].copy())
    batch.tools.present[:], batch.tools.closed[:] = 1, 1
    batch.step()
    simulation.step()
    assert not simulation.in_reach("PSM1") and not batch.tools.gripping.any()


def test_a_hook_cuts_with_its_wire_which_does_not_push_while_it_does():
    instrument, cuts = Instrument("PERMANENT_CAUTERY_HOOK"), []
    for cutting in (False, True):
        simulation = simulate(node_count=3000)
        simulation.set_instrument("PSM1", instrument.capsules)
        for step in range(20):
            pose, links = instrument.at(TIP + [0.0, 0.001 * (step - 10), -0.008])  # its wire is 4 mm deep
            simulation.set_cut("PSM1", pose, cutting)
            simulation.set_grasp("PSM1", pose, False, links)
            simulation.step()
        cuts.append(len(simulation.cuts))
        moved = np.abs(simulation.state().positions - simulation.nodes.rest).max()
        assert simulation.faults == 0 and (moved < 2e-3 if cutting else moved > 3e-3)
    assert cuts[0] == 0 and cuts[1] > 10
    deepest = simulation.cuts[..., 2].max()
    assert deepest == pytest.approx(TIP[2] + 0.004, abs=1.5e-3) and np.ptp(simulation.cuts[..., 1]) > 0.015
