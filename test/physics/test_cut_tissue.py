"""Cutting in the simulation: what is separated, what still holds, and the skin beside it."""

import contextlib

import numpy as np
import pytest
import torch
from tissue_scene import TIP, curved_sheet, free_block, pose_at, simulate, steps

from endo_sim_ros.core.kernels import compare_plain
from endo_sim_ros.physics import Skinning, TissueSimulation


def cut_along(simulation: TissueSimulation, ys: np.ndarray, tool: str = "knife") -> None:
    """Draw a blade, upright in the tissue, along y at x = 0."""
    for y in ys:
        simulation.set_cut(tool, pose_at([0.0, y, 0.145]), True)
    simulation.set_cut(tool, pose_at([0.0, ys[-1], 0.145]), False)


def pull_apart(simulation: TissueSimulation, force: float = 0.4) -> tuple[np.ndarray, np.ndarray]:
    """Pull both sides of x = 0 away from it; displacement along x [S] and rest position [S, 3] of the skin nodes."""
    for side in (-1, 1):
        for y in (-0.02, 0.0, 0.02):
            tip = simulation.nodes.rest[simulation.nodes.is_skin]
            tip = tip[np.linalg.norm(tip[:, :2] - [0.012 * side, y], axis=1).argmin()]
            simulation.set_wrench(f"pull{side}{y}", tip, [force * side, 0, 0])
    steps(simulation, 20)
    state, skin = simulation.state(), simulation.nodes.is_skin
    return (state.positions - state.rest)[skin, 0], state.rest[skin]


@pytest.mark.slow
@pytest.mark.parametrize("backend", [contextlib.nullcontext, compare_plain], ids=["vectorised", "plain"])
def test_a_cut_separates_what_is_pulled_apart_and_heals_on_reset(backend):
    gaps = []
    with backend():
        simulation = simulate(node_count=2400, layers=3, blade_length=0.03)
    for cut in (False, True, False):
        simulation.reset()
        assert len(simulation.cuts) == 0
        if cut:
            cut_along(simulation, np.linspace(-0.045, 0.045, 31))
            state = simulation.state()
            np.testing.assert_array_equal(state.positions, state.rest)  # a cut alone moves nothing
        moved, rest = pull_apart(simulation)
        near = (np.abs(rest[:, 0]) < 0.006) & (np.abs(rest[:, 1]) < 0.02)
        gaps.append(moved[near & (rest[:, 0] > 0)].mean() - moved[near & (rest[:, 0] < 0)].mean())
        assert simulation.faults == 0
    assert gaps[1] > 4 * gaps[0] > 0 and gaps[1] > 0.004
    assert gaps[2] == gaps[0]


@pytest.mark.slow
def test_a_cut_opens_where_the_blade_was_and_not_beyond_its_end():
    simulation = simulate(node_count=2400, layers=3, blade_length=0.03)
    cut_along(simulation, np.linspace(-0.045, 0.0, 16))
    moved, rest = pull_apart(simulation)
    near = np.abs(rest[:, 0]) < 0.007

    def gap(low, high):
        where = near & (rest[:, 1] > low) & (rest[:, 1] < high)
        return moved[where & (rest[:, 0] > 0)].mean() - moved[where & (rest[:, 0] < 0)].mean()

    assert gap(-0.03, -0.012) > 3 * gap(0.012, 0.03) > 0


@pytest.mark.slow
def test_a_cut_through_stretched_skin_opens_and_its_edges_curl_up():
    gaps = []
    for strain in (0.0, 0.05, 0.1):
        simulation = simulate(node_count=2400, layers=3, blade_length=0.03, skin_strain=strain)
        cut_along(simulation, np.linspace(-0.03, 0.03, 21))
        steps(simulation, 25)
        state = simulation.state()
        moved, rest, skin = state.positions - state.rest, state.rest, simulation.nodes.is_skin
        near = (np.abs(rest[:, 0]) < 0.006) & (np.abs(rest[:, 1]) < 0.02)
        apart = lambda where: moved[where & (rest[:, 0] > 0), 0].mean() - moved[where & (rest[:, 0] < 0), 0].mean()
        gaps.append(apart(near & skin))
        assert simulation.faults == 0
    assert gaps[0] == 0.0 and 0.001 < gaps[1] < gaps[2] < 0.006 and gaps[2] == pytest.approx(2 * gaps[1], rel=0.2)
    below = near & ~skin & ~simulation.nodes.pinned
    assert gaps[2] > 2 * apart(below)  # what lies deeper holds the edges back
    assert moved[near & skin, 2].mean() < -1e-4  # towards the camera
    other = simulate(node_count=2400, layers=3, blade_length=0.03, skin_strain=0.1, young_modulus=12e3)
    assert other.continue_from(simulation)
    steps(other, 10)
    np.testing.assert_allclose(other.state().positions, state.positions, atol=4e-4)  # stiffer skin is as much stiffer stretched
    simulation.reset()
    steps(simulation, 2)
    np.testing.assert_array_equal(simulation.state().positions, state.rest)


@pytest.mark.slow
def test_both_edges_of_an_upright_cut_through_flat_skin_draw_back_and_curl_alike():
    flat = curved_sheet()
    flat.means[:, 2] = 0.12
    simulation = simulate(flat, node_count=1600, layers=3, blade_length=0.03, skin_strain=0.1)
    cut_along(simulation, np.linspace(-0.03, 0.03, 21))
    steps(simulation, 15)
    state = simulation.state()
    x, y, _ = state.rest.T
    moved = state.positions - state.rest
    near = simulation.nodes.is_skin & (np.abs(x) < 0.008) & (np.abs(y) < 0.02)
    right, left = (moved[near & (side * x > 0)].mean(0) * [side, 1, 1] for side in (1, -1))
    assert right[0] > 0.001 and right[2] < -2e-4  # outwards, and towards the camera
    np.testing.assert_allclose(left[[0, 2]], right[[0, 2]], rtol=0.15)


@pytest.mark.slow
def test_stretched_skin_pulls_both_sides_of_a_cut_alike():
    simulation = free_block(layers=0, blade_length=0.05, skin_strain=0.01)
    for y in np.linspace(-0.01, 0.04, 21):
        simulation.set_cut("knife", pose_at([0.0225, y, 0.04]), True)
    steps(simulation, 5)
    x, moved = simulation.nodes.rest[:, 0], simulation.solver.displacements()[:, 0]
    assert moved[x < 0.0225].mean() < -1e-5 and moved[x > 0.0225].mean() > 1e-5
    assert np.abs(simulation.solver.momentum()[0]).max() < 2e-6


@pytest.mark.slow
def test_momentum_is_kept_on_each_side_of_a_cut_through_free_tissue():
    simulation = free_block(layers=0, blade_length=0.05, kinematics="rest")
    x = simulation.nodes.rest[:, 0]
    for y in np.linspace(-0.01, 0.04, 21):
        simulation.set_cut("knife", pose_at([0.0225, y, 0.04]), True)
    simulation.set_wrench("pull", [0.04, 0.015, 0.01], [0.01, 0, 0])
    steps(simulation, 5)
    moved = simulation.solver.displacements()[:, 0]
    assert not moved[x < 0.0225].any() and moved[x > 0.0225].min() > 1e-3  # the other half feels nothing at all
    momentum = simulation.solver.momentum()[0]
    np.testing.assert_allclose(momentum, [0.01 * 0.2, 0, 0], atol=2e-6)


@pytest.mark.slow
def test_skin_follows_its_own_side_of_a_cut():
    model = curved_sheet(4000)
    simulation = simulate(model, node_count=2400, layers=3, blade_length=0.03)
    skinning = Skinning(model, simulation.nodes.rest, device="cpu")
    whole = Skinning(model, simulation.nodes.rest, device="cpu")
    for y in np.linspace(-0.045, 0.045, 31):
        simulation.set_cut("knife", pose_at([0.0, y, 0.145]), True)
        skinning.cut(simulation.cuts)
    pull_apart(simulation)
    state = simulation.state()
    x, y = model.means[:, 0].numpy(), model.means[:, 1].numpy()
    inner = (np.abs(x) < 0.008) & (np.abs(y) < 0.015)
    moved, bridged = ((each.deform(state.positions, state.F)[0] - model.means)[:, 0].numpy() for each in (skinning, whole))
    assert (np.sign(moved[inner]) == np.sign(x[inner])).mean() > 0.99
    assert np.abs(moved[inner]).min() > 2 * np.abs(bridged[inner]).min()  # without the cut some skin hangs in the gap
    at_once = Skinning(model, simulation.nodes.rest, device="cpu")
    at_once.cut(simulation.cuts)
    assert torch.equal(at_once.neighbours, skinning.neighbours) and torch.equal(at_once.weights, skinning.weights)
    skinning.cut(np.zeros((0, 3, 3)))  # healed
    assert torch.equal(skinning.neighbours, whole.neighbours) and torch.equal(skinning.weights, whole.weights)


def test_cutting_air_changes_nothing_and_what_cannot_be_cut_says_so():
    simulation = simulate(blade_length=0.01)
    for z in (0.02, 0.03, 0.04):
        simulation.set_cut("knife", pose_at([0.0, 0.0, z]), True)
    assert len(simulation.cuts) == 0
    with pytest.raises(ValueError, match="pose of tool 'knife' must be a finite"):
        simulation.set_cut("knife", np.full((4, 4), np.nan), True)
    with pytest.raises(ValueError, match="kinematics current cannot be cut; set kinematics to rest"):
        simulate(kinematics="current").set_cut("knife", pose_at(TIP), True)
