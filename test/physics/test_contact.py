"""Rigid tools: what they push, drag and feel."""

import numpy as np
import pytest
from tissue_scene import EYE, TIP, curved_sheet, depth_of_dent, free_block, pose_at, simulate, specimen, steps

from endo_sim_ros.physics import PhysicsConfig, TissueSimulation


def press(simulation: TissueSimulation, depth: float, over: int = 10, hold: int = 10) -> None:
    """Press the capsule of a tool into the tissue from the camera's side."""
    above = TIP - [0, 0, simulation.contact_radius]
    for step in range(over + hold):
        simulation.set_grasp("probe", pose_at(above + [0, 0, depth * min(step + 1, over) / over]), False)
        simulation.step()


@pytest.mark.slow
@pytest.mark.parametrize("kinematics", ["rest", "current"])
def test_what_a_pushing_tool_feels_is_the_momentum_that_the_tissue_gets(kinematics):
    simulation = free_block(kinematics=kinematics, contact_radius=0.006, contact_length=0.05, friction=0.3)
    centre, given, turned = simulation.nodes.rest.mean(0), np.zeros(3), np.zeros(3)
    for step in range(16):
        tip = np.array([centre[0] - 0.002, centre[1], -0.008 + 0.001 * step])
        simulation.set_grasp("probe", pose_at(tip), False)
        simulation.step()
        force, torque = simulation.reaction("probe")
        given -= simulation.step_duration * force
        turned -= simulation.step_duration * (torque + np.cross(tip, force))
    linear, angular = simulation.solver.momentum()
    np.testing.assert_allclose(given, linear, atol=1e-4 * np.linalg.norm(linear))
    np.testing.assert_allclose(turned, angular, atol=2e-3 * np.linalg.norm(angular))
    assert linear[2] > 5e-4 and simulation.faults == 0


@pytest.mark.slow
@pytest.mark.parametrize("young", [5e3, 10e3])
def test_a_pressed_layer_resists_as_the_theory_of_indentation_says(young):
    """A frictionless sphere in a layer bonded to its ground: Hertz with the correction of Dimitriadis et al. (2002)."""
    radius, spacing, layer, nu, forces, theory = 0.008, 0.0025, 0.015, 0.3, [], []
    nodes = specimen((17, 17, 7), spacing, lambda x: x[:, 2] > layer - 1e-6, lambda x: x[:, 2] < 1e-6)
    for depth in (0.001, 0.002):
        config = PhysicsConfig(device="cpu", young_modulus=young, contact_radius=radius, friction=0.0)
        simulation = TissueSimulation.from_nodes(nodes, config)
        for step in range(20):
            tip = np.array([0.02, 0.02, -radius + depth * min(1, (step + 1) / 10)])
            simulation.set_grasp("probe", pose_at(tip), False)
            simulation.step()
        forces.append(-simulation.reaction("probe")[0][2])
        chi = np.sqrt(radius * depth) / layer
        alpha = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1 - nu)
        beta = (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1 - nu)
        correction = 1 - 2 * alpha / np.pi * chi + 4 * alpha**2 / np.pi**2 * chi**2
        correction -= 8 / np.pi**3 * (alpha**3 + 4 * np.pi**2 / 15 * beta) * chi**3
        correction += 16 * alpha / np.pi**4 * (alpha**3 + 3 * np.pi**2 / 5 * beta) * chi**4
        theory.append(4 / 3 * young / (1 - nu**2) * np.sqrt(radius) * depth**1.5 * correction)
        gap = np.linalg.norm(simulation.state().positions - tip, axis=1).min() - radius
        assert abs(gap) < 0.1 * depth
    np.testing.assert_allclose(forces, theory, rtol=0.15)


@pytest.mark.slow
def test_friction_drags_and_without_it_tools_slide():
    drags = []
    for friction in (0.0, 0.3):
        simulation = simulate(node_count=2000, contact_radius=0.006, friction=friction)
        press(simulation, 0.003)
        level = np.array([0.0, 0.0, TIP[2] - simulation.contact_radius + 0.003])
        pulls = []
        for step in range(12):
            simulation.set_grasp("probe", pose_at(level + [0.0005 * (step + 1), 0, 0]), False)
            simulation.step()
            force = simulation.reaction("probe")[0]
            pulls.append(force[0] / -force[2])
        drags.append(-np.mean(pulls[4:]))
    assert 0.15 < drags[1] - drags[0] < 0.4  # about the coefficient, beside the shape of the tissue


@pytest.mark.slow
def test_a_capsule_touches_along_its_length_and_a_thin_one_does_not_pass_between_nodes():
    simulation = simulate(node_count=2000, contact_radius=0.004, contact_length=0.03)
    pose = pose_at(TIP - [0.015, 0, 0.003])
    pose[:3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]  # its z axis along -x: the capsule lies along +x
    for step in range(10):
        pose[2, 3] += 0.0003
        simulation.set_grasp("probe", pose, False)
        simulation.step()
    state = simulation.state()
    moved = np.linalg.norm(state.positions - state.rest, axis=1)
    along = state.rest[moved > 0.5 * moved.max(), 0]
    assert np.ptp(along) > 0.02 and moved.max() > 1e-3
    for count in (1000, 4000, 12000):
        thin = simulate(curved_sheet(12000), node_count=count, contact_radius=1e-4, contact_length=0.05)
        top = thin.nodes.rest[np.linalg.norm(thin.nodes.rest - TIP, axis=1).argmin()]
        for step in range(20):
            thin.set_grasp("probe", pose_at(top + [0, 0, 0.0005 * (step + 1) - thin.contact_radius]), False)
            thin.step()
        assert depth_of_dent(thin) > 0.008 and thin.reaction("probe")[0][2] < -0.5  # of 10 mm


def test_a_tool_that_appears_within_tissue_pushes_it_out_gently():
    simulation, centre = simulate(contact_radius=0.01), TIP - [0, 0, 0.004]
    simulation.set_grasp("probe", pose_at(centre), False)
    for _ in range(20):
        simulation.step()
        assert simulation.faults == 0 and np.abs(simulation.solver.state.v.numpy()).max() < 2.0
    gap = np.linalg.norm(simulation.state().positions - centre, axis=1).min() - 0.01
    assert -0.0005 < gap < 0.0005


def test_a_tool_that_goes_away_feels_nothing_and_too_many_tools_are_refused():
    simulation = simulate(contact_radius=0.006)
    press(simulation, 0.003)
    assert simulation.reaction("probe")[0][2] < -0.05
    simulation.set_grasp("probe", pose_at(TIP - [0, 0, 0.05]), False)
    steps(simulation, 2)
    assert not simulation.reaction("probe")[0].any()
    with pytest.raises(ValueError, match="tool 'p7' is one too many; there can be 8: probe, p0"):
        for k in range(8):
            simulation.set_grasp(f"p{k}", pose_at(EYE), False)
