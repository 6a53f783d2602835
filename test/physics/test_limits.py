"""Stability and faults: substeps, absurd forces and sizes."""

import dataclasses
import re

import numpy as np
import pytest
import torch
import warp as wp
from tissue_scene import TIP, depth_of_dent, pose_at, simulate, specimen, steps

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.physics import ControlNodes, MpmSolver, PhysicsConfig, StabilityError, TissueProperties, plan_substeps


@pytest.mark.parametrize("kinematics", ["rest", "current"])
def test_absurd_force_is_caught_and_the_last_good_state_restored(kinematics):
    simulation = simulate(kinematics=kinematics)
    simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.1])
    steps(simulation, 3)
    good = simulation.state()
    simulation.set_wrench("probe", TIP, [0.0, 0.0, -1e7])
    simulation.step()
    bad = simulation.state()
    assert simulation.faults == 1 and "undone" in simulation.last_fault and "(probe 1e+07 N); use less force" in simulation.last_fault
    np.testing.assert_array_equal(bad.positions, good.positions)
    np.testing.assert_array_equal(bad.F, good.F)
    assert not np.any(simulation.solver.momentum()[0])
    simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.1])
    steps(simulation, 2)
    assert simulation.faults == 1 and np.isfinite(simulation.state().positions).all()


def test_the_reaction_of_tissue_that_can_follow_no_farther_stays():
    simulation, felt = simulate(), []
    for k in range(1, 81):
        simulation.set_wrench("probe", TIP, [0.0, 0.0, -0.2 * k])
        simulation.step()
        felt.append(simulation.reaction("probe")[0][2])
    assert simulation.faults > 0
    np.testing.assert_allclose(felt[:50], 0.2 * np.arange(1, 51))
    assert min(felt[50:]) >= 10.0 and felt[-1] < 16.0
    simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.0])
    assert not simulation.reaction("probe")[0].any()
    simulation.step()
    assert not simulation.reaction("probe")[0].any()


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("young_modulus", [2e3, 1e4, 5e4])
def test_the_reaction_to_ever_larger_forces_saturates_whether_they_come_at_once_or_grow(young_modulus):
    simulation, towards = simulate(young_modulus=young_modulus), np.array([0.0, 0.0, 1.0])
    bearable = 8e-4 * young_modulus  # N, a little more than this tissue bears

    def push(forces: np.ndarray) -> np.ndarray:
        simulation.reset()
        felt = []
        for force in forces:
            simulation.set_wrench("probe", TIP, force * towards)
            simulation.step()
            felt.append(simulation.reaction("probe")[0])
        np.testing.assert_array_equal(np.array(felt)[:, :2], 0.0)
        return -np.array(felt) @ towards

    most = push(np.minimum(np.linspace(0.0, 2.0, 80), 1.5) * bearable)[-20:].mean()
    assert most > 0.6 * bearable and depth_of_dent(simulation) > 0.9 * simulation.config.travel
    for times in (1.2, 1.6, 3.0, 10.0, 1e6):
        felt = push(np.full(60, times * bearable))
        assert (felt >= 0).all() and (felt[15:] > 0.9 * most).all() and felt.max() < 1.1 * most
        assert depth_of_dent(simulation) > 0.9 * simulation.config.travel
        within = 0.5 * most  # less than it bears: at once all of it arrives
        simulation.set_wrench("probe", TIP, within * towards)
        simulation.step()
        assert simulation.reaction("probe")[0][2] == pytest.approx(-within, rel=1e-12)


def test_a_wrench_of_force_and_torque_is_borne_in_proportion():
    simulation = simulate()
    for _ in range(30):
        simulation.set_wrench("probe", TIP, [0.0, 0.0, 30.0], [0.0, 0.0, 0.06])
        simulation.step()
    force, torque = simulation.reaction("probe")
    assert -10.0 < force[2] < -4.0
    np.testing.assert_allclose(torque, 0.002 * force, atol=1e-12)


def test_a_capsule_that_pushes_feels_the_tissue_in_steps_that_are_undone():
    simulation, felt = simulate(contact_radius=0.02), []
    for k in range(44):
        simulation.set_grasp("ball", pose_at(TIP + [0, 0, 0.0015 * k - 0.03]), False)
        before = simulation.faults
        simulation.step()
        felt.append(simulation.reaction("ball")[0][2])
        if simulation.faults > before:
            assert felt[-1] == felt[-2] < -10.0
    assert simulation.faults > 0


def test_an_absurd_torque_is_said_to_be_one():
    simulation = simulate()
    simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.1], [0.0, 1e6, 0.0])
    simulation.step()
    assert "(probe 0.1 N and 1e+06 N·m); use less torque or more travel" in simulation.last_fault
    simulation.reset()
    simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.0], [0.0, 1e6, 0.0])
    simulation.step()
    assert "(probe 1e+06 N·m); use less torque or" in simulation.last_fault
    simulation.reset()
    simulation.set_wrench("probe", TIP, [0.0, 0.0, 1.0], [0.0, 0.9, 0.0])  # whose levers are centimetres: as much as 90 N
    simulation.step()
    assert "(probe 1 N and 0.9 N·m); use less torque or" in simulation.last_fault


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize(("material", "relaxation"), [("neo_hookean", 0.0), ("fixed_corotated", 5.0)])
def test_tissue_crushed_until_no_step_goes_on_comes_back_when_the_tool_has_gone(material, relaxation):
    simulation = simulate(material=material, relaxation=relaxation, contact_radius=0.05)
    simulation.set_grasp("ball", pose_at(TIP), False)
    steps(simulation, 20)
    crushed = depth_of_dent(simulation)
    simulation.set_grasp("ball", pose_at(TIP - [0, 0, 0.2]), False)
    steps(simulation, 60)
    faults = simulation.faults
    steps(simulation, 240)
    assert faults > 0 and simulation.faults == faults and "ball pushing" in simulation.last_fault
    assert crushed > 0.03 and depth_of_dent(simulation) < 0.03 * crushed


@pytest.mark.parametrize("strain", [1e30, np.inf, np.nan])
def test_infinite_strain_is_told_and_put_to_rest(strain):
    """No step leaves it behind, but whoever writes into the state can."""
    simulation = simulate(node_count=300, material="fung")
    wp.to_torch(simulation.solver.state.F)[40] = torch.diag(torch.tensor([strain, 1.0, 1.0]))
    simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.05])
    simulation.step()
    assert "nodes ended non-finite, torn or" in simulation.last_fault
    steps(simulation, 10)
    assert simulation.faults == 2 and np.isfinite(simulation.state().F).all() and 0 < depth_of_dent(simulation) < 0.01


@pytest.mark.parametrize("offset", [1e5, 1e30])
def test_tissue_too_far_away_for_its_nodes_to_be_told_apart_is_refused(offset):
    nodes = specimen((3, 3, 3), 0.01, lambda X: np.zeros(len(X), bool), lambda X: np.ones(len(X), bool))
    far = dataclasses.replace(nodes, rest=nodes.rest + np.float32([offset, 0, 0]))
    with pytest.raises(ValueError, match="from the world's origin, too far to tell its nodes 0.01 m apart"):
        MpmSolver(far, PhysicsConfig(device="cpu"))


@pytest.mark.parametrize("spacing", [1e-42, 1e-9, 1e6])
def test_tissue_of_an_absurd_size_is_refused(spacing):
    nodes = specimen((3, 3, 3), spacing, lambda X: np.zeros(len(X), bool), lambda X: np.ones(len(X), bool))
    with pytest.raises(ValueError, match="grid cells would be .* m wide.*metres"):
        MpmSolver(nodes, PhysicsConfig(device="cpu"))


def test_nodes_without_volume_and_properties_of_other_nodes_are_refused():
    nodes = specimen((3, 3, 3), 0.01, lambda X: np.zeros(len(X), bool), lambda X: np.ones(len(X), bool))
    config = PhysicsConfig(device="cpu")
    with pytest.raises(ValueError, match="properties of 5 nodes, but the tissue has 27"):
        MpmSolver(nodes, config, TissueProperties.uniform(5, 1e4, 0.3, 1e3))
    for volume in (0.0, np.nan):
        with pytest.raises(ValueError, match="volume of node 4 is"):
            MpmSolver(dataclasses.replace(nodes, volumes=np.where(np.arange(27) == 4, volume, nodes.volumes)), config)
    with pytest.raises(ValueError, match=r"stiffness has shape \(1, 5\), expected \[K, 27\]"):
        MpmSolver(nodes, config).set_stiffness(slice(None), np.ones((1, 5)))


@pytest.mark.parametrize("size", [100, 1e15, 2.0**61, 1e30])  # in integers the larger ones would wrap around
def test_a_grid_beyond_memory_is_refused(size):
    ends = np.array([[0, 0, 0], [size, size, size]], np.float32)
    nodes = ControlNodes(ends, np.zeros(2, bool), np.full(2, 1e-9, np.float32), np.ones(2, bool), 1e-3)
    with pytest.raises(ValueError, match="simulation grid would have|from the world.s origin"):
        MpmSolver(nodes, PhysicsConfig(device="cpu"))


@pytest.mark.slow
def test_few_substeps_settle_where_many_do():
    dents = []
    for count in (0, 80):
        simulation = simulate(substeps=count)
        simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.5])
        steps(simulation, 30)
        dents.append(depth_of_dent(simulation))
    assert dents[0] == pytest.approx(dents[1], rel=0.06)  # transfer dissipation slows the last bit down


def test_too_few_substeps_for_stiff_material_are_refused_with_a_number_that_works():
    numbers = r"young_modulus 1e\+06 Pa.*0\.3.*1000 kg.*0\.00875 m.*set substeps to \d+ or to 0"
    with pytest.raises(StabilityError, match=numbers):
        plan_substeps(PhysicsConfig(young_modulus=1e6, substeps=80), 0.00875)
    # Where no number of substeps is allowed that would do, the stiffness that would.
    with pytest.raises(StabilityError, match=r"use young_modulus \S+ Pa or less") as refusal:
        plan_substeps(PhysicsConfig(young_modulus=1e9, density=1.0), 0.00875)
    largest = float(re.search(r"use young_modulus (\S+)", str(refusal.value))[1])
    assert plan_substeps(PhysicsConfig(young_modulus=largest, density=1.0), 0.00875).count > 90_000


@pytest.mark.parametrize("old, new", [("substep_dt", "step_duration"), ("adapt_substeps", "substeps")])
def test_an_option_of_another_name_is_refused_with_the_new_one(old, new):
    with pytest.raises(ConfigError, match=f"{old} is now {new}"):
        PhysicsConfig.from_mapping({old: 1})


def test_substeps_follow_from_the_material_and_add_up_to_the_step():
    stiff = plan_substeps(PhysicsConfig(young_modulus=1e6, poisson_ratio=0.45), 0.00875)
    soft = plan_substeps(PhysicsConfig(young_modulus=1e3), 0.00875)
    assert stiff.count > 80 > soft.count >= 1
    for plan in (stiff, soft):
        assert plan.cfl <= 0.5 and plan.count * plan.dt == pytest.approx(PhysicsConfig().step_duration)
    for duration in (0.04, 0.02):  # a number is taken as it is, whatever the duration of the step; the paper has 80
        printed = plan_substeps(PhysicsConfig(substeps=80, step_duration=duration), 0.00875)
        assert (printed.count, printed.dt) == (80, pytest.approx(duration / 80))


def test_a_wrench_beyond_any_unit_is_refused_and_the_one_before_stays():
    simulation = simulate()
    assert simulation.set_wrench("probe", TIP, [0.0, 0.0, -0.1])
    for force in (1e40, 1e300):
        with pytest.raises(ValueError, match=r"the wrench of tool 'probe' is more than 1e\+09 N or N·m; is it in newtons\?"):
            simulation.set_wrench("probe", TIP, [0.0, 0.0, -force])
    simulation.step()
    assert simulation.reaction("probe")[0][2] == pytest.approx(0.1, rel=1e-6)
