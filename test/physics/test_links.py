"""Tools with an instrument: what their links push, feel and cost."""

import contextlib

import numpy as np
import pytest
import torch
from instrument_scene import Instrument, opened, plain_jaws
from tissue_scene import EYE, TIP, curved_sheet, free_block, pose_at, simulate, specimen, steps

from endo_sim_ros.core.kernels import compare_plain
from endo_sim_ros.instruments import Capsule
from endo_sim_ros.physics import PhysicsConfig, TissueBatch, TissueSimulation, ToolLinks, build_control_nodes


@pytest.mark.parametrize("backend", [contextlib.nullcontext, compare_plain], ids=["vectorised", "plain"])
def test_a_link_pushes_as_the_one_capsule_of_all_tools_bit_for_bit(backend):
    ends = []
    for linked in (False, True):
        with backend():
            simulation = simulate(contact_radius=0.016, contact_length=0.03, node_count=600)  # thicker than the least
        felt, rod = [], Capsule("rod", np.zeros(3), np.array([0.0, 0.0, -0.03]), 0.016)
        if linked:
            simulation.set_instrument("probe", [rod])
        for step in range(8):
            pose = pose_at(TIP + [0.0003 * step, 0, -0.016 + 0.0005 * step])
            simulation.set_grasp("probe", pose, False, {"rod": pose} if linked else None)
            simulation.step()
            felt.append(np.concatenate(simulation.reaction("probe")))
        ends.append((simulation.state().positions, np.array(felt)))
    for one, other in zip(*ends):
        np.testing.assert_array_equal(one, other)
    assert ends[0][1][-1, 2] < -0.1


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.013, -0.009)])
def test_a_thin_link_touches_the_skin_where_it_is_seen_to(place):
    simulation = simulate()
    rod = Capsule("rod", np.zeros(3), np.array([0.0, 0.0, -0.03]), 0.001)
    simulation.set_instrument("probe", [rod])
    model = curved_sheet().means.numpy()
    skin = model[((model[:, :2] - place) ** 2).sum(1).argmin(), 2]
    gap = 0.008
    while not simulation.reaction("probe")[0].any() and gap > -0.01:
        gap -= 0.0005
        pose = pose_at([*place, skin - rod.radius - gap])
        simulation.set_grasp("probe", pose, False, {"rod": pose})
        simulation.step()
    assert abs(gap) < 0.0015, f"touches at {1e3 * gap:.1f} mm"


@pytest.mark.parametrize("jaw", [0.0, 0.8])
@pytest.mark.parametrize("material", ["fixed_corotated", "fung"])
def test_an_instrument_does_not_pass_between_the_nodes_before_the_limit_of_its_force(material, jaw):
    simulation, instrument = simulate(node_count=2400, material=material), Instrument()
    simulation.set_instrument("PSM1", instrument.capsules)
    felt = most = 0.0
    for step in range(60):
        pose, links = instrument.at(TIP + [0, 0, -0.02 + 0.001 * step], 0.3, jaw)
        simulation.set_grasp("PSM1", pose, False, links)
        simulation.step()
        felt = np.linalg.norm(simulation.reaction("PSM1")[0])
        assert felt >= 0.7 * most, f"{felt:.1f} N after {most:.1f} N: it has passed"
        most = max(felt, most)
        if felt > 10.0:
            break
    assert felt > 10.0 and simulation.faults == 0


@pytest.mark.slow
@pytest.mark.parametrize("closed", [False, True])
def test_what_links_feel_together_is_the_momentum_that_the_tissue_gets(closed):
    simulation, instrument = free_block(friction=0.3, grip_force=2.0), Instrument()
    simulation.set_instrument("PSM1", instrument.capsules)
    centre, given, turned, touched = simulation.nodes.rest.mean(0), np.zeros(3), np.zeros(3), 0
    for step in range(16):
        hinge = centre + [-0.03 + 0.0005 * step, 0.001, (-0.014 if closed else -0.019) + 0.001 * step]
        pose, links = instrument.at(hinge, np.pi / 2, 0.0 if closed else 0.8 - 0.02 * step)
        simulation.set_grasp("PSM1", pose, closed, links)
        simulation.step()
        force, torque = simulation.reaction("PSM1")
        touched += np.linalg.norm(force) > 0
        given -= simulation.step_duration * force
        turned -= simulation.step_duration * (torque + np.cross(hinge, force))
    linear, angular = simulation.solver.momentum()
    np.testing.assert_allclose(given, linear, atol=3e-4 * np.linalg.norm(linear))
    # The moment is that about where nodes are; what the grid makes of it may lie off by a part of a cell.
    np.testing.assert_allclose(turned, angular, atol=0.5 * simulation.solver.cell_size * np.linalg.norm(linear))
    assert touched > 1 and np.linalg.norm(linear) > 1e-4 and simulation.faults == 0


@pytest.mark.slow
@pytest.mark.parametrize("kinematics", ["rest", "current"])
def test_the_plain_kernels_agree_with_the_vectorised_ones_on_instruments(kinematics):
    ends = []
    for backend in (contextlib.nullcontext, compare_plain):
        with backend():
            simulation = simulate(node_count=800, grip_force=1.0, kinematics=kinematics)
        instrument, felt = Instrument("PROGRASP_FORCEPS"), []
        for tool in ("PSM1", "PSM2"):
            simulation.set_instrument(tool, instrument.capsules)
        for step in range(14):
            deep = min(step, 5) - 2.0 * max(step - 6, 0)
            pose, links = instrument.at(TIP + [0, 0, -0.02 + 0.001 * deep], 0.0, 0.6 if step < 6 else 0.0)
            simulation.set_grasp("PSM1", pose, step >= 6 and (step == 6 or simulation.in_reach("PSM1")), links)
            simulation.set_grasp("PSM2", *_lying(instrument, 0.0004 * step))
            simulation.step()
            felt.append(np.concatenate([*simulation.reaction("PSM1"), *simulation.reaction("PSM2"), [simulation.slips]]))
        ends.append((simulation.state().positions - simulation.nodes.rest, np.array(felt)))
    (moved, felt), (plain_moved, plain_felt) = ends
    largest = np.abs(moved).max()
    assert largest > 2e-3 and np.abs(felt[:, 6:9]).max() > 0.1
    np.testing.assert_allclose(plain_moved, moved, atol=2e-3 * largest)
    np.testing.assert_allclose(plain_felt, felt, atol=0.01 * np.abs(felt).max())


def _lying(instrument, deeper):
    pose, links = instrument.at(TIP + [0.0, 0.03, -0.004 + deeper], np.pi / 2)
    return pose, False, links


@pytest.mark.parametrize("material", ["fixed_corotated", "fung"])
def test_the_held_back_resists_a_tool_which_feels_what_the_pins_hold(material):
    simulation = simulate(material=material, damping=50.0)  # 20 mm thick
    rod = Capsule("rod", np.zeros(3), np.array([0.0, 0.0, -0.05]), 0.006)
    simulation.set_instrument("probe", [rod])
    for deep in [*np.linspace(-0.002, 0.022, 31), *[0.022] * 25]:
        pose = pose_at(TIP + [0, 0, deep - rod.radius])
        simulation.set_grasp("probe", pose, False, {"rod": pose})
        simulation.step()
    (force, _), solver = simulation.reaction("probe"), simulation.solver
    u, springs = solver.state.u.numpy(), solver.pin_springs.numpy()
    assert force[2] < -7, "the back stays where it was"  # 5.7 N and none where it touches nothing
    np.testing.assert_allclose(force, -(springs[:, None] * u).sum(0), atol=0.01 * np.abs(force).max())


@pytest.mark.slow
def test_a_shaft_pushes_along_its_length():
    simulation, instrument = simulate(node_count=2000), Instrument()
    simulation.set_instrument("PSM1", instrument.capsules)
    for step in range(12):
        pose, links = instrument.at(TIP + [0.07, 0, -0.008 + 0.0007 * step], np.pi / 2)
        simulation.set_grasp("PSM1", pose, False, links)
        simulation.step()
    state = simulation.state()
    moved = np.linalg.norm(state.positions - state.rest, axis=1)
    along = state.rest[moved > 0.3 * moved.max(), 0]
    force, torque = simulation.reaction("PSM1")
    assert np.ptp(along) > 0.03 and moved.max() > 1e-3 and simulation.faults == 0
    lever = torque[1] / force[2]  # about the tip, 7 cm from the middle of the tissue
    assert force[2] < -0.3 and 0.04 < lever < 0.09
    felt = simulation.link_reactions("PSM1")
    np.testing.assert_allclose(felt["roll"][0], force, atol=1e-9)
    np.testing.assert_allclose(felt["roll"][1], torque, atol=1e-9)
    assert not any(part.any() for link, parts in felt.items() if link != "roll" for part in parts)


def test_symmetric_jaws_close_symmetrically_and_do_not_squeeze_out_what_lies_between():
    # 15 distances are ten cells of the grid, which then lies as the tissue does on both sides; no node lies in the middle.
    nodes = specimen((13, 16, 5), 0.0025, lambda x: x[:, 2] < 1e-6, lambda x: np.ones(len(x), bool))
    simulation = TissueSimulation.from_nodes(nodes, PhysicsConfig(device="cpu"))
    simulation.set_instrument("PSM1", plain_jaws(0.001, 0.015))
    middle, top = nodes.rest.max(0) / 2, nodes.rest[:, 2].max()
    pose = pose_at([middle[0] - 0.012, middle[1], top + 0.001])
    felt = []
    for angle in [*np.linspace(1.2, 0.0, 16), *[0.0] * 4]:
        simulation.set_grasp("PSM1", pose, False, opened(pose, angle))
        simulation.step()
        felt.append(simulation.reaction("PSM1")[0])
        parts = simulation.link_reactions("PSM1")
        np.testing.assert_allclose(sum(force for force, _ in parts.values()), felt[-1], atol=1e-9)
        np.testing.assert_allclose(sum(torque for _, torque in parts.values()), simulation.reaction("PSM1")[1], atol=1e-9)
        assert np.abs(parts["jaw_left"][0] * [1, -1, 1] - parts["jaw_right"][0]).max() < 0.1 * np.abs(felt).max()
    moved = (simulation.state().positions - nodes.rest).reshape(13, 16, 5, 3)
    largest = np.abs(moved).max()
    np.testing.assert_allclose(moved[:, ::-1] * [1, -1, 1], moved, atol=0.02 * largest)
    felt = np.array(felt)
    assert np.abs(felt[:, 1]).max() < 0.02 * np.abs(felt).max() and largest > 1e-3 and simulation.faults == 0


def test_links_in_the_air_leave_tissue_at_rest_and_one_that_appears_in_it_pushes_it_out_gently():
    simulation, instrument = simulate(), Instrument()
    simulation.set_instrument("PSM1", instrument.capsules)
    for step in range(3):
        simulation.set_grasp("PSM1", *_with(False, instrument.at(TIP + [0, 0, -0.05 + 0.002 * step])))
        simulation.step()
        assert simulation.resting and not simulation.reaction("PSM1")[0].any()
    simulation.reset()
    for _ in range(15):
        simulation.set_grasp("PSM1", *_with(False, instrument.at(TIP)))
        simulation.step()
        assert simulation.faults == 0 and np.abs(simulation.solver.state.v.numpy()).max() < 2.0
    assert not simulation.resting and simulation.reaction("PSM1")[0][2] < -0.05
    simulation.set_grasp("PSM1", pose_at(TIP), False)  # nobody knows where the links are: a bare tip
    steps(simulation, 2)
    assert not simulation.reaction("PSM1")[0].any() and not simulation.link_reactions("PSM1")


def _with(closed, at):
    return at[0], closed, at[1]


def test_an_instrument_whose_links_nobody_knows_is_a_bare_tip_bit_for_bit():
    ends = []
    for instrument in (None, Instrument()):
        simulation = simulate(contact_radius=0.006)
        if instrument is not None:
            simulation.set_instrument("PSM1", instrument.capsules)
        for step in range(6):
            simulation.set_grasp("PSM1", pose_at(TIP + [0, 0, -0.006 + 0.0005 * step]), False)
            simulation.set_grasp("PSM2", pose_at(TIP + [0.03, 0, -0.001 * step]), True)
            simulation.step()
        ends.append((simulation.state().positions, *simulation.reaction("PSM1"), *simulation.reaction("PSM2")))
    for one, other in zip(*ends):
        np.testing.assert_array_equal(one, other)


def test_links_that_cannot_be_used_are_one_sentence_and_leave_the_tool_as_it_was():
    simulation, instrument = simulate(node_count=300), Instrument()
    pose, links = instrument.at(TIP - [0, 0, 0.05])
    with pytest.raises(ValueError, match="tool 'PSM1' has no instrument, so it has no links; give it one with set_instrument"):
        simulation.set_grasp("PSM1", pose, False, links)
    simulation.set_instrument("PSM1", instrument.capsules)
    with pytest.raises(ValueError, match="links of tool 'PSM1': jaw_left missing; give poses of all of roll, "):
        simulation.set_grasp("PSM1", pose, False, {name: each for name, each in links.items() if name != "jaw_left"})
    for bad, sentence in (
        (np.full((4, 4), np.nan), "pose of link roll of tool 'PSM1' must be a finite 4×4 matrix"),
        (np.eye(3), "pose of link roll of tool 'PSM1' must be a finite 4×4 matrix"),
        ("here", "pose of link roll of tool 'PSM1' must be a finite 4×4 matrix, got 'here'"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "pose of link roll of tool 'PSM1' must turn and shift"),
    ):
        with pytest.raises(ValueError, match=sentence):
            simulation.set_grasp("PSM1", pose, False, {**links, "roll": bad})
    assert not simulation._tools.present.any() and not simulation._tools.linked.any()
    rod = Capsule("rod", np.zeros(3), np.ones(3), 0.001)
    with pytest.raises(ValueError, match="has 13 capsules; there can be 12"):
        simulation.set_instrument("PSM1", [rod] * 13)
    for capsule in (Capsule("rod", np.zeros(3), np.full(3, np.inf), 0.001), Capsule("rod", np.zeros(3), np.ones(3), 0.0)):
        with pytest.raises(ValueError, match="a capsule of link rod must have finite ends and a radius above zero"):
            simulation.set_instrument("PSM1", [rod, capsule])
    with pytest.raises(ValueError, match="needs capsules of both links jaw_left and jaw_right or of neither"):
        simulation.set_instrument("PSM1", plain_jaws()[:1])
    simulation.set_grasp("PSM1", pose, False, links)


@pytest.mark.slow
def test_a_batch_takes_the_links_of_all_its_copies_at_once():
    config = PhysicsConfig(device="cpu", node_count=600, grip_force=1.0)
    nodes, instrument = build_control_nodes(curved_sheet(), EYE, config), Instrument("PROGRASP_FORCEPS")
    links, offsets = ToolLinks(instrument.capsules), [0.0, 0.001, 0.05]
    batch = TissueBatch(nodes, config, environments=3, tools=1, capsules=len(links))
    singles = [TissueSimulation.from_nodes(nodes, config) for _ in offsets]
    for single in singles:
        single.set_instrument("PSM1", instrument.capsules)
    for step in range(20):
        deep = min(step, 5) - 2.0 * max(step - 6, 0)
        at = [instrument.at(TIP + [0, 0, -0.02 + 0.001 * deep - away], 0.0, 0.0) for away in offsets]
        poses = np.stack([[each[name] for name in links.links] for _, each in at])
        batch.tools.set_links(0, links, torch.from_numpy(poses))
        tips = torch.from_numpy(np.stack([pose for pose, _ in at]))
        batch.tools.tips[:, 0], batch.tools.rotations[:, 0], batch.tools.present[:] = tips[:, :3, 3], tips[:, :3, :3], 1
        batch.tools.closed[:, 0] = int(step >= 6)
        batch.step()
        for single, (pose, each) in zip(singles, at):
            single.set_grasp("PSM1", pose, step >= 6, each)
            single.step()
    for b, single in enumerate(singles):
        np.testing.assert_array_equal(batch.displacements[b].numpy(), single.solver.displacements())
        for i, (force, torque) in enumerate(single.link_reactions("PSM1").values()):
            np.testing.assert_array_equal(batch.tools.link_forces[b, 0, i].numpy(), force)
            np.testing.assert_array_equal(batch.tools.link_torques[b, 0, i].numpy(), torque)
    assert batch.displacements[0].any() and batch.tools.slips[0, 0] and not batch.displacements[2].any()
    assert len({int(each) for each in batch.tools.faults}) == 1
    with pytest.raises(ValueError, match=r"poses of links have shape \[3, 2, 4, 4\], expected \[3, 4, 4, 4\] \(roll, "):
        batch.tools.set_links(0, links, torch.zeros(3, 2, 4, 4))
    with pytest.raises(ValueError, match="the instrument has 7 capsules, but tools have room for 1"):
        TissueBatch(nodes, config, 3).tools.set_links(0, links, torch.from_numpy(poses))
    batch.tools.starts[1, 0, 2] = float("nan")
    batch.step()
    assert batch.tools.faults.tolist() == [0, 1, 0]
