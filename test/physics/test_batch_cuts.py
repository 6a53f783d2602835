"""Copies of a tissue that are cut, each on its own."""

import contextlib

import numpy as np
import pytest
import torch
from tissue_scene import EYE, TIP, curved_sheet, pose_at

from endo_sim_ros.core.kernels import compare_plain
from endo_sim_ros.physics import PhysicsConfig, TissueBatch, TissueSimulation, build_control_nodes

OPTIONS = {"node_count": 800, "layers": 2, "thickness": 0.015, "blade_length": 0.012, "force_radius": 0.008}
GRIP = TIP - [0.012, 0.0, 0.0]
BACKENDS = {"vectorised": contextlib.nullcontext, "plain": compare_plain}


@pytest.fixture(scope="module")
def nodes():
    return build_control_nodes(curved_sheet(), EYE, PhysicsConfig(**OPTIONS))


def play(nodes, cutters, steps=12, plain=False):
    """Pull beside x = 0 in copies, each of which has a blade along y there, or None; displacements of each [steps, B, M, 3]."""
    with compare_plain() if plain else contextlib.nullcontext():
        batch = TissueBatch(nodes, PhysicsConfig(device="cpu", **OPTIONS), len(cutters), 2, own_cuts=True)
    return batch, go_on(batch, cutters, steps)


def go_on(batch, cutters, steps=12):
    batch.tools.rotations[:] = torch.eye(3)
    seen = []
    for step in range(steps):
        poses, cutting = np.tile(np.eye(4), (len(cutters), 2, 1, 1)), np.zeros((len(cutters), 2), bool)
        for b, at in enumerate(cutters):
            poses[b, 0, :3, 3] = GRIP - [0.0006 * step, 0, 0]
            if at is not None:
                poses[b, 1, :3, 3], cutting[b, 1] = [0.0, at + 0.0025 * step, 0.132], True
        batch.move_edges(poses, cutting)
        batch.tools.tips[:] = torch.from_numpy(poses[:, :, :3, 3])
        batch.tools.present[:, 0] = batch.tools.closed[:, 0] = 1
        batch.step()
        seen.append(batch.displacements.clone())
    return torch.stack(seen)


@pytest.mark.parametrize("plain", [False, True], ids=["vectorised", "plain"])
def test_a_copy_that_is_cut_is_one_tissue_that_is_cut_and_the_others_are_whole(nodes, plain):
    batch, seen = play(nodes, [None, -0.015, None, 0.0], plain=plain)
    _, whole = play(nodes, [None], plain=plain)
    assert [len(batch.cuts(b)) > 0 for b in range(4)] == [False, True, False, True]
    assert torch.equal(seen[:, 0], whole[:, 0]) and torch.equal(seen[:, 2], whole[:, 0])
    for b, at in ((1, -0.015), (3, 0.0)):
        alone, own = play(nodes, [at], plain=plain)
        assert torch.equal(seen[:, b], own[:, 0])
        np.testing.assert_array_equal(batch.cuts(b), alone.cuts())
        skin = nodes.rest[nodes.is_skin]
        near = (np.abs(skin[:, 0]) < 0.006) & (np.abs(skin[:, 1] - at - 0.013) < 0.008)
        opened = lambda u: u[near & (skin[:, 0] > 0)].mean() - u[near & (skin[:, 0] < 0)].mean()
        gaps = [opened(each[nodes.is_skin, 0].numpy()) for each in (seen[-1, b], whole[-1, 0])]
        assert gaps[0] > gaps[1] + 1e-4, "the edges part"


def test_the_only_copy_has_the_bits_of_a_simulation_with_the_same_tools(nodes):
    _, seen = play(nodes, [-0.015])
    simulation = TissueSimulation.from_nodes(nodes, PhysicsConfig(device="cpu", **OPTIONS))
    for step in range(12):
        assert simulation.set_grasp("grip", pose_at(GRIP - [0.0006 * step, 0, 0]), True)
        simulation.set_cut("knife", pose_at([0.0, -0.015 + 0.0025 * step, 0.132]), True)
        simulation.step()
        np.testing.assert_array_equal(simulation.solver.displacements(), seen[step, 0].numpy())


@pytest.mark.parametrize("plain", [False, True], ids=["vectorised", "plain"])
def test_cuts_heal_in_the_copies_that_begin_anew_and_in_no_other(nodes, plain):
    cutters = [-0.015, -0.01]
    batch, seen = play(nodes, cutters, plain=plain)
    kept = batch.cuts(1).copy()
    batch.reset(torch.tensor([0]))
    assert not len(batch.cuts(0)) and not batch.displacements[0].any()
    np.testing.assert_array_equal(batch.cuts(1), kept)
    again = go_on(batch, [cutters[0], None])
    assert torch.equal(again[:, 0], seen[:, 0]), "and is cut as at first"
    np.testing.assert_array_equal(batch.cuts(1), kept)
    batch.reset()
    whole = go_on(batch, [None, None])
    assert torch.equal(whole, play(nodes, [None, None], plain=plain)[1])


def test_copies_that_share_what_is_whole_are_not_cut(nodes):
    batch = TissueBatch(nodes, PhysicsConfig(device="cpu", **OPTIONS), 2)
    triangle = TIP + np.array([[0, -0.01, -0.01], [0, 0.01, -0.01], [0, 0, 0.01]])
    with pytest.raises(ValueError, match="2 environments share what is whole; make them with own_cuts to cut one of them"):
        batch.cut({1: triangle[None]})
