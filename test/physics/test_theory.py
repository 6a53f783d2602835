"""The solver against theory: momentum, energy, columns, beams and dents."""

import numpy as np
import pytest
from tissue_scene import TIP, depth_of_dent, free_block, simulate, specimen, steps

from endo_sim_ros.physics import PhysicsConfig, TissueSimulation, lame_parameters


@pytest.mark.parametrize("kinematics", ["rest", "current"])
def test_free_tissue_takes_up_the_impulse(kinematics):
    simulation = simulate(kinematics=kinematics, layers=2, pin_back=False, pin_rim=False, damping=0.0)
    force = np.array([0.02, -0.03, 0.05])
    simulation.set_wrench("probe", TIP, force)
    steps(simulation, 4)
    np.testing.assert_allclose(simulation.solver.momentum()[0], force * simulation.time, rtol=2e-3, atol=1e-6)


def test_damping_decays_momentum_exponentially():
    simulation = simulate(layers=2, pin_back=False, pin_rim=False, damping=20.0)
    simulation.set_wrench("probe", TIP, [0, 0, 0.05])
    steps(simulation, 2)
    before = simulation.solver.momentum()[0]
    simulation.set_wrench("probe", TIP, [0, 0, 0])
    steps(simulation, 2)
    np.testing.assert_allclose(simulation.solver.momentum()[0], before * np.exp(-20 * 0.08), rtol=5e-3, atol=1e-7)


@pytest.mark.parametrize("material", ["fixed_corotated", "fung"])
@pytest.mark.parametrize("kinematics", ["rest", "current"])
def test_undriven_energy_decays(kinematics, material):
    simulation = simulate(kinematics=kinematics, material=material, damping=0.0)
    simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.1])
    steps(simulation, 4)
    simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.0])
    energies = []
    for _ in range(10):
        energies.append(sum(simulation.solver.energy()))
        simulation.step()
    assert energies[0] > 1e-6
    assert all(later <= 1.001 * earlier for earlier, later in zip(energies, energies[1:]))


def test_released_tissue_returns_to_rest():
    simulation = simulate()
    simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.3])
    steps(simulation, 8)
    deep = depth_of_dent(simulation)
    simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.0])
    steps(simulation, 40)
    assert depth_of_dent(simulation) < 0.05 * deep


@pytest.mark.slow
@pytest.mark.parametrize("kinematics", ["rest", "current"])
@pytest.mark.parametrize("relaxation", [0.0, 1.0])
def test_free_tissue_keeps_its_linear_and_angular_momentum(kinematics, relaxation):
    simulation = free_block(kinematics=kinematics, relaxation=relaxation, relaxation_time=0.05)
    corner = simulation.nodes.rest.max(0)
    simulation.set_wrench("probe", corner, [0.0, 0.02, 0.01], [0, 0, 2e-4])
    steps(simulation, 2)
    simulation.set_wrench("probe", corner, np.zeros(3))
    linear, angular = simulation.solver.momentum()
    steps(simulation, 10)
    later = simulation.solver.momentum()
    np.testing.assert_allclose(later[0], linear, atol=5e-5 * np.linalg.norm(linear))
    np.testing.assert_allclose(later[1], angular, atol=1e-3 * np.linalg.norm(angular))
    assert simulation.faults == 0 and depth_of_dent(simulation) > 0.02  # it flies, turns and wobbles


@pytest.mark.slow
@pytest.mark.parametrize("spacing", [0.005, 0.0025])
def test_a_wide_slab_under_its_own_weight_is_a_confined_column(spacing):
    height, width = 0.02, 0.08
    counts = [round(edge / spacing) + 1 for edge in (width, width, height)]
    nodes = specimen(counts, spacing, lambda x: x[:, 2] > height - 1e-6, lambda x: x[:, 2] < 1e-6)
    config = PhysicsConfig(device="cpu", gravity_z=9.81, poisson_ratio=0.3, grid_ratio=2.0)
    simulation = TissueSimulation.from_nodes(nodes, config)
    steps(simulation, 25)
    state = simulation.state()
    middle = nodes.is_skin & (np.linalg.norm(nodes.rest[:, :2] - width / 2, axis=1) < 0.01)
    sag = (state.positions - state.rest)[middle, 2].mean()
    mu, lam = lame_parameters(10e3, 0.3)
    assert sag == pytest.approx(1000 * 9.81 * height**2 / (2 * (lam + 2 * mu)), rel=0.1)


@pytest.mark.parametrize("kinematics, ratio", [("rest", 1.75), ("rest", 2.0), ("current", 2.0)])
def test_column_under_its_own_weight_shortens_as_theory_says(kinematics, ratio):
    height, spacing = 0.02, 0.005
    nodes = specimen((13, 13, 5), spacing, lambda x: x[:, 2] > height - 1e-6, lambda x: x[:, 2] < 1e-6)
    config = PhysicsConfig(device="cpu", gravity_z=9.81, poisson_ratio=0.0, kinematics=kinematics, grid_ratio=ratio)
    simulation = TissueSimulation.from_nodes(nodes, config)
    steps(simulation, 25)
    state = simulation.state()
    sag = (state.positions - state.rest)[nodes.is_skin, 2].mean()
    assert sag == pytest.approx(1000 * 9.81 * height**2 / (2 * 10e3), rel=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("spacing, tolerance", [(0.005, 0.15), (0.0025, 0.06)])
def test_cantilever_bends_as_timoshenko_says_and_better_when_finer(spacing, tolerance):
    length, side, young, force = 0.08, 0.02, 20e3, 0.008
    counts = [round(edge / spacing) + 1 for edge in (length, side, side)]
    nodes = specimen(counts, spacing, lambda x: x[:, 0] < 1e-6, lambda x: x[:, 0] > length - 1e-6)
    config = PhysicsConfig(device="cpu", young_modulus=young, poisson_ratio=0.0, damping=25.0, force_radius=0.05)
    simulation = TissueSimulation.from_nodes(nodes, config)
    simulation.set_wrench("load", [length, side / 2, side / 2], [0.0, 0.0, force])
    steps(simulation, 30)
    state = simulation.state()
    bent = (state.positions - state.rest)[nodes.is_skin, 2].mean()
    theory = force * length**3 / (3 * young * side**4 / 12) + force * length / (5 / 6 * young / 2 * side**2)
    assert bent == pytest.approx(theory, rel=tolerance)


@pytest.mark.slow
def test_dent_grows_with_force_and_shrinks_with_stiffness():
    dents = []
    for force, young in ((0.05, 10e3), (0.2, 10e3), (0.2, 20e3)):
        simulation = simulate(young_modulus=young)
        assert simulation.set_wrench("probe", TIP, [0.0, 0.0, force])
        steps(simulation, 10)
        dents.append(depth_of_dent(simulation))
    assert dents[1] > 3 * dents[0]
    assert dents[2] == pytest.approx(dents[1] / 2, rel=0.15)


def test_pinned_nodes_do_not_move_and_tissue_beside_them_hardly_does():
    simulation = simulate(node_count=2000)
    simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.3])
    steps(simulation, 8)
    state, pinned = simulation.state(), simulation.nodes.pinned
    np.testing.assert_array_equal(state.positions[pinned], state.rest[pinned])
    assert np.abs(simulation.solver.displacements()[pinned]).max() < 0.02 * depth_of_dent(simulation)
