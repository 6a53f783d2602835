"""Tissue that is pulled farther than it bears tears."""

from typing import Any

import numpy as np
import pytest
import torch
from tissue_scene import pose_at, simulate

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.physics import PhysicsConfig, TissueBatch, TissueSimulation
from endo_sim_ros.physics.cutting.tearing import Tearing
from endo_sim_ros.physics.cutting.tension import released_forces


def pull(simulation: TissueSimulation, far: float) -> float:
    """Grasp the skin at two places and pull them apart, m each; returns the greatest force of one, N."""
    skin, force = simulation.nodes.rest[simulation.nodes.is_skin & ~simulation.nodes.pinned], 0.0
    held = {side: skin[np.linalg.norm(skin - [0.015 * side, 0, 0.12], axis=1).argmin()] for side in (-1, 1)}
    for step in range(26):
        for side, tip in held.items():
            simulation.set_grasp(f"jaw {side}", pose_at(tip + [side * far * step / 25, 0, 0]), True)
        simulation.step()
        force = max(force, float(np.linalg.norm(simulation.reaction("jaw 1")[0])))
    return force


@pytest.mark.slow
def test_tissue_tears_between_what_pulls_it_apart_the_same_in_each_run_and_heals_on_reset():
    whole, torn = simulate(), simulate(tear_strain=0.38)
    assert pull(torn, 0.001) == pull(whole, 0.001) and torn.tears == 0 == len(torn.cuts)
    np.testing.assert_array_equal(torn.state().positions, whole.state().positions)
    forces, cuts = [], []
    for _ in range(2):
        torn.reset()
        assert torn.tears == 0 == len(torn.cuts) == len(torn.torn) and torn.last_tear == ""
        forces.append(pull(torn, 0.012))
        cuts.append(torn.cuts)
    assert torn.tears > 1 and len(torn.cuts) == 2 * torn.tears and torn.faults == 0
    assert forces[0] == forces[1] and np.array_equal(*cuts)
    assert "its true strain was 0." in torn.last_tear and "tear_strain is 0.38" in torn.last_tear
    first = cuts[0][:2].reshape(-1, 3)
    assert np.abs(first.mean(0)[:2]).max() < 0.012  # between the jaws
    for at in (0.03, 0.04):  # a tool cuts beside it
        torn.set_cut("edge", pose_at([at, 0.0, 0.135]), True)
    assert torn.torn[: len(cuts[0])].all() and len(torn.torn) == len(torn.cuts) > torn.torn.sum() == len(cuts[0])
    whole.reset()
    assert pull(whole, 0.012) > 1.5 * forces[0]
    before, told = torn, torn.last_tear
    others: list[TissueSimulation] = []
    changes: list[dict[str, Any]] = [{"tear_strain": 0.38, "young_modulus": 12e3}, {}, {"tear_strain": 0.38}]  # the second bears everything
    for options in changes:
        other = simulate(**options)
        assert other.continue_from(before) and other.tears == torn.tears and np.array_equal(other.cuts, torn.cuts)
        assert other.last_tear == told and np.array_equal(other.torn, torn.torn)
        before = other
        others.append(other)
    assert np.array_equal(before._batch.tearing[0]._tougher, torn._batch.tearing[0]._tougher)
    others[1].reset()
    assert others[1].tears == len(others[1].cuts) == 0 and others[1].last_tear == ""


@pytest.mark.slow
def test_each_copy_tears_as_it_does_alone_and_heals_on_its_reset():
    nodes, config = simulate().nodes, simulate(tear_strain=0.38).config
    skin = nodes.rest[nodes.is_skin & ~nodes.pinned]
    held = np.stack([skin[np.linalg.norm(skin - [0.015 * side, 0, 0.12], axis=1).argmin()] for side in (-1, 1)])

    def pulled(batch, far):
        batch.tools.rotations[:] = torch.eye(3)
        batch.tools.present[:] = batch.tools.closed[:] = 1
        torn = []
        for step in range(26):
            apart = np.multiply.outer(far, [[-step / 25, 0, 0], [step / 25, 0, 0]])
            batch.tools.tips[:] = torch.from_numpy(held + apart)
            torn += batch.step()
        return torn, batch.displacements.clone()

    far = [0.012, 0.001, 0.009]
    batch = TissueBatch(nodes, config, 3, 2, own_cuts=True)
    torn, moved = pulled(batch, far)
    counts = [tearing.count for tearing in batch.tearing]
    assert counts == [torn.count(b) for b in range(3)] and counts[0] > counts[2] > 0 == counts[1]
    for b, own in enumerate(far):
        alone = TissueBatch(nodes, config, 1, 2, own_cuts=True)
        assert torch.equal(pulled(alone, [own])[1][0], moved[b])
        np.testing.assert_array_equal(alone.cuts(), batch.cuts(b))
    batch.reset(torch.tensor([0]))
    assert [tearing.count for tearing in batch.tearing] == [0, 0, counts[2]] and not len(batch.cuts(0))
    assert pulled(TissueBatch(nodes, config, 2, 2), far[:2])[0] == []  # they share what is whole


def test_a_tear_goes_across_the_stretch_once_and_only_above_the_limit():
    rest = np.stack(np.meshgrid(*[np.arange(5) * 0.01] * 3, indexing="ij"), -1).reshape(-1, 3)
    tearing, F = Tearing(rest, 0.4, 0.015), np.tile(np.eye(3), (125, 1, 1))
    F[62] = np.diag([1, np.exp(0.39), 1])
    assert not len(tearing.tear(F)) and tearing.newest is None
    F[62] = np.diag([1, np.exp(0.41), 1]) @ F[0]
    F[63] = np.diag([1, np.exp(0.5), 1])  # a neighbour, which is strained more
    triangles = tearing.tear(F)
    assert triangles.shape == (2, 3, 3) and tearing.count == 1
    np.testing.assert_allclose(triangles[..., 1], rest[63, 1] + 0.005, atol=1e-12)  # across y, halfway to the node behind it
    np.testing.assert_allclose(np.ptp(triangles, axis=(0, 1))[[0, 2]].max(), 2.5 * 0.015, rtol=0.45)
    assert tearing.newest is not None and tearing.newest[1] == pytest.approx(0.5)
    assert not len(tearing.tear(F))  # the tear relieves both, which bear more from then on
    F[63] = np.diag([1, np.exp(0.65), 1])
    assert len(tearing.tear(F)) == 2 and tearing.newest[1:] == pytest.approx((0.65, 0.4))
    assert not len(tearing.tear(F))
    F[0] = np.diag([np.nan, 1, 1])
    assert not len(tearing.tear(F))
    tearing.reset()
    assert len(tearing.tear(F)) == 2


@pytest.mark.slow
def test_what_a_jaw_lifts_farther_than_it_bears_comes_off():
    """Through a node of the skin itself a tear would part nothing: the force would rise for as long as the jaw does."""
    forces, lifted = {}, {}
    for limit in (0.0, 0.38):
        simulation = simulate(tear_strain=limit, force_radius=0.006)
        skin = simulation.nodes.rest[simulation.nodes.is_skin & ~simulation.nodes.pinned]
        tip = skin[np.linalg.norm(skin - [0, 0, 0.12], axis=1).argmin()]
        for step in range(41):
            simulation.set_grasp("jaw", pose_at(tip - [0, 0, 0.0005 * step]), True)
            simulation.step()
        forces[limit], lifted[limit] = float(np.linalg.norm(simulation.reaction("jaw")[0])), simulation
    assert lifted[0.38].tears and forces[0.38] < 0.2 * forces[0.0]
    assert len(lifted[0.38].held_nodes("jaw"))  # it still holds what it tore out


def test_tissue_with_current_kinematics_never_tears():
    simulation = simulate(tear_strain=0.1, kinematics="current")
    simulation.step()
    assert simulation.tears == 0 and simulation.last_tear == ""


@pytest.mark.slow
def test_tissue_goes_on_by_the_strain_that_it_bears_now():
    for before, now in ((0.0, 0.38), (0.6, 0.2)):
        first, other, fresh = (simulate(tear_strain=limit) for limit in (before, now, now))
        first.step()
        assert other.continue_from(first)
        for each in (other, fresh):
            pull(each, 0.012)
        assert other.tears == fresh.tears > 0 and other.last_tear == fresh.last_tear


@pytest.mark.slow
def test_what_has_come_off_is_not_driven_away_by_the_tension_of_the_skin():
    rest = np.arange(6)[:, None] * [0.01, 0, 0]
    links, pulls, pinned = np.array([[1, 2], [3, 4]]), np.ones(6), np.arange(6) == 0
    forces = released_forces(rest, links, pulls, np.array([0, 0, 1, 1, 0, 0]), pinned)
    assert (forces[[1, 4], 0] != 0).all() and not forces[[2, 3]].any(), "its neighbours draw back"
    forces = released_forces(rest, links, pulls, np.zeros(6, int), pinned)
    np.testing.assert_allclose(forces.sum(0), 0)
    assert (forces[1:5, 0] != 0).all()

    torn = simulate(tear_strain=0.2, skin_strain=0.2)
    pull(torn, 0.012)
    assert torn.tears > 5
    for side in (-1, 1):
        torn.set_grasp(f"jaw {side}", pose_at([side, 0, 0]), False)
    faults = torn.faults
    for _ in range(100):
        torn.step()
    assert torn.faults == faults


def test_skin_that_its_own_tension_would_tear_is_refused():
    with pytest.raises(
        ConfigError, match="skin_strain 0.5 stretches the skin at rest by a true strain of 0.41, and tear_strain is 0.2: it"
    ):
        PhysicsConfig(skin_strain=0.5, tear_strain=0.2)
    PhysicsConfig(skin_strain=0.2, tear_strain=0.2)
    PhysicsConfig(skin_strain=0.5)
