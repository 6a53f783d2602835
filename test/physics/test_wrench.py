"""Wrenches at a tool's tip: nodal forces, reaction, reach."""

import numpy as np
import pytest
from tissue_scene import EYE, TIP, depth_of_dent, simulate, steps

from endo_sim_ros.physics import ControlNodes, PhysicsConfig, TissueSimulation


def nodal_forces(positions: np.ndarray, force, torque, tip=(0.0, 0.0, 0.0)) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Forces [K, 3] on free nodes [K, 3] within a reach of 3 cm, and the reaction to them."""
    count = len(positions)
    nodes = ControlNodes(np.float32(positions), np.zeros(count, bool), np.full(count, 1e-6, np.float32), np.ones(count, bool), 0.01)
    simulation = TissueSimulation.from_nodes(nodes, PhysicsConfig(device="cpu", force_radius=0.03, damping=1000.0))
    assert simulation.set_wrench("probe", tip, force, torque)
    simulation.step()
    return simulation.solver.loads.force.numpy().astype(np.float64), simulation.reaction("probe")


def test_nodal_forces_add_up_to_the_wrench_and_are_the_smallest():
    rng = np.random.default_rng(4)
    for count in (3, 5, 40):
        r = np.float32(rng.normal(size=(count, 3)) * 0.005)
        F, tau = 1e-3 * rng.normal(size=3), 1e-5 * rng.normal(size=3)
        f, reaction = nodal_forces(r, F, tau)
        np.testing.assert_allclose(f.sum(0), F, atol=1e-9)
        np.testing.assert_allclose(np.cross(r, f).sum(0), tau, atol=1e-11)
        np.testing.assert_allclose(np.concatenate(reaction), -np.concatenate([F, tau]), atol=1e-12)
        # The pseudo-inverse solves the same problem in scaled unknowns f/√w.
        w = (1 - (np.linalg.norm(r, axis=1) / 0.03) ** 2) ** 2
        A = np.concatenate([np.concatenate([np.eye(3), _cross_matrix(ri)]) * np.sqrt(wi) for ri, wi in zip(r, w)], 1)
        g = np.linalg.pinv(A) @ np.concatenate([F, tau])
        np.testing.assert_allclose(f, g.reshape(-1, 3) * np.sqrt(w)[:, None], atol=2e-5 * np.abs(f).max())


def _cross_matrix(r: np.ndarray) -> np.ndarray:
    return np.array([[0, -r[2], r[1]], [r[2], 0, -r[0]], [-r[1], r[0], 0]])


def test_too_few_nodes_for_a_torque_still_take_the_force():
    for r in ([[0.001, 0.002, 0.0]], [[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]]):
        f, (force, torque) = nodal_forces(np.array(r), [0.0, 0.0, 1e-3], [1e-5, 0.0, 0.0])
        np.testing.assert_allclose(f.sum(0), [0, 0, 1e-3], atol=1e-9)
        np.testing.assert_allclose(force, [0, 0, -1e-3], atol=1e-12)
        by_force = np.cross(r[0], [0, 0, 1e-3])[0]  # about the tip; what was asked for beside it nothing resists
        assert torque[0] == pytest.approx(-by_force, abs=1e-11)


def test_reaction_is_minus_the_wrench_while_it_arrives():
    simulation = simulate()
    force, torque = np.array([0.02, 0.01, 0.1]), np.array([1e-4, 0.0, 5e-5])
    simulation.set_wrench("probe", TIP, force, torque)
    for _ in range(3):
        simulation.step()
        reaction = simulation.reaction("probe")
        np.testing.assert_allclose(reaction[0], -force, atol=1e-12)
        np.testing.assert_allclose(reaction[1], -torque, atol=1e-12)
    assert not np.any(simulation.reaction("nobody"))
    simulation.set_wrench("probe", TIP, np.zeros(3))
    assert not np.any(simulation.reaction("probe"))


def test_tool_out_of_reach_applies_nothing_until_it_reaches():
    simulation = simulate()
    assert not simulation.set_wrench("probe", EYE, [0.0, 0.0, 1.0])
    simulation.step()
    state = simulation.state()
    np.testing.assert_array_equal(state.positions, state.rest)
    assert not simulation.in_reach("probe") and not np.any(simulation.reaction("probe"))
    assert simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.1])
    simulation.step()
    assert depth_of_dent(simulation) > 1e-4


def test_grabbed_tissue_stays_grabbed_while_it_follows():
    simulation = simulate(force_radius=0.006)
    simulation.set_wrench("jaw", TIP, [0.0, 0.0, -0.8])
    steps(simulation, 12)
    assert depth_of_dent(simulation) > simulation.config.force_radius / 2
    tip = TIP - [0, 0, 0.004]
    simulation.set_wrench("jaw", tip, [0.0, 0.0, -0.8])
    simulation.step()
    np.testing.assert_allclose(simulation.reaction("jaw")[0], [0, 0, 0.8], atol=1e-12)


@pytest.mark.slow
def test_a_tip_that_stays_behind_does_not_wring_the_tissue():
    simulation = simulate(force_radius=0.008)
    simulation.set_wrench("jaw", TIP, [2.0, 0.0, -1.0])
    simulation.step()
    at_first = np.linalg.norm(simulation.solver.loads.force.numpy(), axis=1).max()
    steps(simulation, 100)
    assert depth_of_dent(simulation) > simulation.config.force_radius
    in_the_end = np.linalg.norm(simulation.solver.loads.force.numpy(), axis=1).max()
    np.testing.assert_allclose(in_the_end, at_first, rtol=0.2)  # about the tip itself they would have doubled
    np.testing.assert_allclose(simulation.reaction("jaw")[0], [-2.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(simulation.reaction("jaw")[1], 0.0, atol=1e-12)


def test_two_tools_act_at_once():
    simulation = simulate()
    left, right = TIP - [0.025, 0, 0], TIP + [0.025, 0, 0]
    simulation.set_wrench("left", left, [0.0, 0.0, 0.1])
    simulation.set_wrench("right", right, [0.0, 0.0, -0.1])
    steps(simulation, 5)
    state = simulation.state()
    moved = (state.positions - state.rest)[simulation.nodes.is_skin, 2]
    x = state.rest[simulation.nodes.is_skin, 0]
    assert moved[x < 0].max() > 3e-4 and moved[x > 0].min() < -3e-4


@pytest.mark.parametrize("name, position", [("tip", 1), ("force", 2), ("torque", 3)])
@pytest.mark.parametrize("value", [[0.0, np.nan, 0.0], [np.inf, 0.0, 0.0], [0.0, 0.0]])
def test_bad_wrench_is_refused_by_name_and_changes_nothing(name, position, value):
    simulation = simulate(node_count=200)
    arguments = ["probe", TIP, np.zeros(3), np.zeros(3)]
    arguments[position] = value
    with pytest.raises(ValueError, match=f"{name} of tool 'probe' must be three finite numbers"):
        simulation.set_wrench(*arguments)
    simulation.step()
    np.testing.assert_array_equal(simulation.state().positions, simulation.nodes.rest)
