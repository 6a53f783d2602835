"""Physics: nodes, materials, the solver against theory, tools, faults and skinning."""

import dataclasses
import re
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.config import ConfigError, options
from endo_sim_ros.core.gaussians import GaussianModel, save_ply
from endo_sim_ros.physics import (
    ControlNodes,
    MpmSolver,
    PhysicsConfig,
    Skinning,
    StabilityError,
    TissueBatch,
    TissueProperties,
    TissueSimulation,
    build_control_nodes,
    lame_parameters,
    plan_substeps,
    sample_farthest,
    solver,
    sound_speed,
)
from endo_sim_ros.physics.backends import cluster_kernels as cluster
from endo_sim_ros.physics.materials import MATERIALS, energy_density, kirchhoff_stress, rotation_of
from endo_sim_ros.rendering import render_depth

EYE = np.zeros(3)  # the camera of the test scene, looking along +z
TIP = np.array([0.0, 0.0, 0.12])  # on the sheet, in front of the camera


def curved_sheet(count: int = 3000, seed: int = 0, offset: tuple = (0.0, 0.0, 0.0)) -> GaussianModel:
    """A 10 × 8 cm curved sheet 12 cm in front of the origin. Coordinates are multiples of 2⁻²⁰ m, so that moving the
    scene by whole metres rounds nothing."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform([-0.05, -0.04], [0.05, 0.04], (count, 2))
    points = np.c_[xy, 0.12 + 0.5 * (xy**2).sum(1) + 0.003 * np.sin(60 * xy[:, 0])]
    points = np.round(points * 2**20) / 2**20 + offset
    colors = torch.from_numpy(rng.uniform(size=(count, 3))).float()
    return GaussianModel.from_points(torch.from_numpy(points).float(), colors, torch.full((count,), 0.001))


def simulate(model=None, viewpoint=EYE, **overrides) -> TissueSimulation:
    model = curved_sheet() if model is None else model
    return TissueSimulation(model, viewpoint, PhysicsConfig(device="cpu", **{"node_count": 1000, **overrides}))


def steps(simulation: TissueSimulation, count: int) -> None:
    for _ in range(count):
        simulation.step()


def depth_of_dent(simulation: TissueSimulation) -> float:
    state = simulation.state()
    return float(np.linalg.norm(state.positions - state.rest, axis=1).max())


def specimen(shape: tuple, spacing: float, pinned, is_skin) -> ControlNodes:
    """A block of nodes whose volumes add up to the block's; `pinned` and `is_skin` map positions [M, 3] to bool [M]."""
    axes = [np.arange(n) * spacing for n in shape]
    rest = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    on_face = (rest < spacing / 2) | (rest > rest.max(0) - spacing / 2)
    volumes = np.where(on_face, spacing / 2, spacing).prod(1)
    return ControlNodes(rest.astype(np.float32), pinned(rest), volumes.astype(np.float32), is_skin(rest), spacing)


# Configuration


def test_every_option_has_a_description_and_every_material_is_a_choice():
    assert all(option.description for option in options(PhysicsConfig))
    material = next(option for option in options(PhysicsConfig) if option.name == "material")
    assert set(material.choices) == set(MATERIALS)
    assert PhysicsConfig().step_duration == pytest.approx(0.04)
    with pytest.raises(ConfigError, match="poisson_ratio"):
        PhysicsConfig(poisson_ratio=0.5)


# Control nodes


def test_farthest_points_agree_with_brute_force():
    points = np.random.default_rng(1).normal(size=(1500, 3))
    chosen = [7]
    nearest = np.full(len(points), np.inf)
    for _ in range(59):
        nearest = np.minimum(nearest, ((points - points[chosen[-1]]) ** 2).sum(1))
        chosen.append(int(nearest.argmax()))
    assert sample_farthest(points, 60, start=7).tolist() == chosen


def test_farthest_points_of_duplicates_take_the_lowest_index():
    points = np.repeat(np.eye(3), 4, axis=0)
    assert sample_farthest(points, 3).tolist() == [0, 4, 8]


def test_more_samples_than_points_is_refused():
    with pytest.raises(ValueError, match="cannot pick 5 of 4 points"):
        sample_farthest(np.zeros((4, 3)), 5)


def test_tissue_has_the_volume_and_depth_asked_for():
    nodes = build_control_nodes(curved_sheet(), EYE, PhysicsConfig(node_count=2000, layers=4, thickness=0.02))
    assert len(nodes) == 2000 and nodes.is_skin.sum() == 400
    skin, back = nodes.rest[:400], nodes.rest[-400:]
    depth = np.linalg.norm(back, axis=1) - np.linalg.norm(skin, axis=1)
    np.testing.assert_allclose(depth, 0.02, atol=1e-6)
    np.testing.assert_allclose(np.cross(skin, back), 0, atol=1e-8)  # along the viewing rays
    assert nodes.pinned[-400:].all()
    # 10 × 8 cm seen from 12 cm, 2 cm deep: a little more than 160 cm³, as the frustum widens.
    assert 1.0 * 160e-6 < nodes.volumes.sum() < 1.4 * 160e-6


def test_rim_is_the_border_and_only_the_border():
    nodes = build_control_nodes(curved_sheet(), EYE, PhysicsConfig(node_count=2000, pin_back=False))
    x, y = np.abs(nodes.rest[nodes.is_skin][:, :2]).T
    rim = nodes.pinned[nodes.is_skin]
    assert rim[(x > 0.0495) | (y > 0.0395)].all()
    assert not rim[(x < 0.044) & (y < 0.034)].any()


def test_faint_and_floating_gaussians_do_not_become_nodes():
    model = curved_sheet()
    logits = model.logit_opacities.clone()
    logits[:500] = -4.0
    means = model.means.clone()
    means[500] = torch.tensor([0.0, 0.0, 0.05])
    nodes = build_control_nodes(dataclasses.replace(model, means=means, logit_opacities=logits), EYE, PhysicsConfig())
    skin = {tuple(point) for point in nodes.rest[nodes.is_skin].tolist()}
    assert not skin & {tuple(point) for point in means[:501].tolist()}


def test_coinciding_gaussians_become_one_node():
    model = curved_sheet(300)
    twice = model.select(torch.arange(300).repeat(10))
    nodes = build_control_nodes(twice, EYE, PhysicsConfig(node_count=5000))
    assert nodes.is_skin.sum() == 300
    assert nodes.volumes.sum() < 1.4 * 160e-6


def test_several_viewpoints_mean_their_centre():
    config = PhysicsConfig(node_count=500)
    one = build_control_nodes(curved_sheet(), EYE, config)
    two = build_control_nodes(curved_sheet(), np.array([[0.01, 0, 0], [-0.01, 0, 0]]), config)
    np.testing.assert_array_equal(one.rest, two.rest)


@pytest.mark.parametrize("viewpoint", [[0.0, np.nan, 0.0], [[np.inf, 0.0, 0.0]]])
def test_a_viewpoint_that_is_not_finite_is_refused(viewpoint):
    with pytest.raises(ValueError, match="viewpoint must be a finite"):
        build_control_nodes(curved_sheet(), np.array(viewpoint), PhysicsConfig())


def test_tissue_is_carved_where_a_camera_sees_through_it_and_only_there():
    """A small plate in front of a wide one: what hangs behind its edge is seen from the side."""
    rng = np.random.default_rng(7)
    plates = [np.c_[rng.uniform(-half, half, (count, 2)), np.full(count, z)] for half, z, count in ((0.02, 0.1, 4000), (0.1, 0.16, 16000))]
    points = torch.from_numpy(np.concatenate(plates)).float()
    model = GaussianModel.from_points(points, torch.rand(len(points), 3), torch.full((len(points),), 0.0014))
    model = dataclasses.replace(model, logit_opacities=torch.full((len(points),), 4.0))
    K = np.array([[300.0, 0, 160], [0, 300, 128], [0, 0, 1]])
    cameras = [Camera(K, 320, 256, pose_at([x, 0.0, 0.0])) for x in (-0.06, 0.0, 0.06)]
    config = PhysicsConfig(node_count=6000)
    whole = build_control_nodes(model, EYE, dataclasses.replace(config, carve=False), cameras)
    carved = build_control_nodes(model, EYE, config, cameras, render_depth)
    with pytest.raises(ValueError, match="pass render_depth"):
        build_control_nodes(model, EYE, config, cameras)
    left = {tuple(position) for position in carved.rest.tolist()}
    gone = np.array([position for position in whole.rest.tolist() if tuple(position) not in left])
    assert len(gone) > 20 and len(whole) - len(carved) == len(gone)
    depth = gone[:, 2]
    assert depth.min() > 0.1 and depth.max() < 0.125  # behind the plate, in front of the other
    # The camera at 6 cm sees, past the edge at 2 cm, what lies right of the line through both.
    behind = whole.rest[(whole.rest[:, 2] > 0.101) & (whole.rest[:, 2] < 0.125) & ~whole.is_skin]
    past_edge = np.abs(behind[:, 0]) - (0.02 - (behind[:, 2] - 0.1) * 0.04 / 0.1)
    kept = np.array([tuple(position) in left for position in behind.tolist()])
    assert kept[past_edge < 0].all() and kept[past_edge > 0.003].mean() < 0.15
    assert carved.is_skin.sum() == whole.is_skin.sum()


def test_what_no_camera_has_seen_gives_no_nodes():
    """A reconstruction continues tissue beyond the pictures."""
    cameras = [Camera(np.array([[600.0, 0, 160], [0, 600, 128], [0, 0, 1]]), 320, 256, pose_at([x, 0.0, 0.0])) for x in (-0.01, 0.01)]
    model = curved_sheet()
    in_pictures = lambda points: np.any([((c.project(points)[0] >= 0) & (c.project(points)[0] <= [320, 256])).all(1) for c in cameras], 0)
    skin = lambda nodes: nodes.rest[nodes.is_skin].astype(np.float64)
    config = PhysicsConfig(node_count=600, carve=False)
    assert in_pictures(skin(build_control_nodes(model, EYE, config))).mean() < 0.95
    assert in_pictures(skin(build_control_nodes(model, EYE, config, cameras))).all()
    away = [camera.at(camera.pose @ np.diag([-1.0, 1, -1, 1])) for camera in cameras]  # not those that saw it
    np.testing.assert_array_equal(build_control_nodes(model, EYE, config, away).rest, build_control_nodes(model, EYE, config).rest)


def test_a_model_without_opaque_gaussians_is_refused():
    model = dataclasses.replace(curved_sheet(), logit_opacities=torch.full((3000,), -9.0))
    with pytest.raises(ValueError, match="only 0 of 3000 Gaussians are as opaque"):
        build_control_nodes(model, EYE, PhysicsConfig())


# Materials


@wp.kernel(enable_backward=False)
def _rotations(F: wp.array[wp.mat33], R: wp.array[wp.mat33]):
    i = wp.tid()
    R[i] = rotation_of(F[i])


def _stress_kernel(material):
    stress = MATERIALS[material][0]

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate(F: wp.array[wp.mat33], mu: float, lam: float, P: wp.array[wp.mat33], tau: wp.array[wp.mat33]):
        i = wp.tid()
        P[i] = stress(F[i], mu, lam)
        tau[i] = kirchhoff_stress(P[i], F[i])

    return evaluate


def stresses(material: str, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """P and τ [N, 3, 3] of F [N, 3, 3] for μ = 2 and λ = 3."""
    F = wp.array(F.astype(np.float32), dtype=wp.mat33, device="cpu")
    P, tau = wp.empty_like(F), wp.empty_like(F)
    wp.launch(_stress_kernel(material), len(F), [F, 2.0, 3.0, P, tau], device="cpu")
    return P.numpy(), tau.numpy()


def random_rotations(count: int, seed: int = 0) -> np.ndarray:
    Q, R = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, 3, 3)))
    Q *= np.sign(np.diagonal(R, axis1=1, axis2=2))[:, None, :]
    Q[np.linalg.det(Q) < 0, :, 0] *= -1
    return Q


@pytest.mark.parametrize("material", MATERIALS)
def test_stress_is_the_gradient_of_the_energy(material):
    rng = np.random.default_rng(2)
    F = random_rotations(64) @ (np.eye(3) + 0.25 * rng.uniform(-1, 1, (64, 3, 3)))
    F = F[np.linalg.det(F) > 0.2]
    leaf = torch.from_numpy(F).requires_grad_()
    energy_density(material, leaf, 2.0, 3.0).sum().backward()
    P, tau = stresses(material, F)
    np.testing.assert_allclose(P, leaf.grad.numpy(), atol=3e-5)
    np.testing.assert_allclose(tau, leaf.grad.numpy() @ F.transpose(0, 2, 1), atol=3e-5)
    assert np.abs(P).max() > 0.5


@pytest.mark.parametrize("material", MATERIALS)
def test_rigid_rotation_gives_no_stress_and_rest_gives_exactly_none(material):
    P, _ = stresses(material, random_rotations(64))
    np.testing.assert_allclose(P, 0, atol=5e-6)
    assert not np.any(stresses(material, np.eye(3)[None])[0])


@pytest.mark.parametrize("material", MATERIALS)
def test_inverted_and_collapsed_matter_has_finite_stress(material):
    F = np.stack([np.diag([1.0, 1.0, -0.5]), np.zeros((3, 3)), np.diag([1.0, 1.0, 0.0]), -np.eye(3)])
    assert np.isfinite(stresses(material, F)[0]).all()


def test_polar_rotation_is_proper_and_nearest():
    rng = np.random.default_rng(3)
    F = rng.normal(size=(200, 3, 3))
    U, _, Vt = np.linalg.svd(F)
    U[np.linalg.det(U @ Vt) < 0, :, 2] *= -1
    R = wp.empty(200, dtype=wp.mat33, device="cpu")
    wp.launch(_rotations, 200, [wp.array(F.astype(np.float32), dtype=wp.mat33, device="cpu"), R], device="cpu")
    near_tie = np.abs(np.linalg.svd(F)[1][:, 2]) < 0.05  # the rotation is ill-conditioned there
    np.testing.assert_allclose(R.numpy()[~near_tie], (U @ Vt)[~near_tie], atol=2e-3)
    np.testing.assert_allclose(np.linalg.det(R.numpy()), 1, atol=1e-4)


def test_small_strains_obey_hooke():
    strain = np.diag([1e-3, -2e-4, -2e-4])
    for material in MATERIALS:
        P, _ = stresses(material, (np.eye(3) + strain)[None])
        np.testing.assert_allclose(P[0], 4.0 * strain + 3.0 * np.trace(strain) * np.eye(3), atol=2e-5)


def test_sound_speed_of_the_default_tissue():
    mu, lam = lame_parameters(10e3, 0.3)
    assert (mu, lam) == pytest.approx((3846.15, 5769.23), rel=1e-5)
    assert sound_speed(10e3, 0.3, 1000) == pytest.approx(3.669, rel=1e-3)


# The solver


@pytest.mark.parametrize("kinematics", ["rest", "current"])
@pytest.mark.parametrize("material", MATERIALS)
def test_rest_state_stays_bit_identical_without_force(kinematics, material):
    simulation = simulate(kinematics=kinematics, material=material)
    steps(simulation, 3)
    state = simulation.state()
    np.testing.assert_array_equal(state.positions, state.rest)
    np.testing.assert_array_equal(state.F, np.tile(np.eye(3, dtype=np.float32), (len(state.F), 1, 1)))
    assert state.time == pytest.approx(0.12) and state.positions.dtype == np.float32


@pytest.mark.parametrize("count", [20, 700, 2000, 4000])
def test_blocks_of_a_cluster_add_up_what_all_nodes_give_to_a_grid_node(count):
    solver = simulate(node_count=count).solver
    corners = solver._corners()
    division = cluster.divide(solver.rest_cells, corners)
    given = np.random.default_rng(0).normal(size=corners.shape)
    expected = np.zeros(corners.max() + 1)
    np.add.at(expected, corners, given)
    assert sorted(division.nodes[division.nodes >= 0]) == list(range(len(corners)))
    patch = division.shares.shape[2]
    inboxes = np.zeros((cluster.CLUSTER, division.inbox))
    for nodes, places, sums, inbox in zip(division.nodes, division.places, division.sums.reshape(cluster.CLUSTER, -1, 4), inboxes):
        memory = np.zeros(division.slots)
        memory[places[nodes >= 0]] = given[nodes[nodes >= 0]]
        assert not memory[-1] and len(np.unique(places[nodes >= 0])) == 27 * (nodes >= 0).sum()
        for thread, (_, _, sharing, g) in enumerate(sums):
            if g >= 0:
                threads = sums[thread : thread + cluster.BANKS * sharing : cluster.BANKS]
                inbox[g] = sum(memory[begin : end : cluster.WARP].sum() for begin, end, _, _ in threads)
    totals = inboxes[:, :patch].copy()
    for block, sends in enumerate(division.sends.reshape(cluster.CLUSTER, -1, 3)):
        for g, other, place in sends[sends[:, 0] >= 0]:
            assert other != block and not inboxes[other, place]
            inboxes[other, place] = totals[block, g]
    np.testing.assert_array_equal((inboxes[:, patch:] != 0).sum(1), division.received)
    for nodes, corners_of, shares, inbox in zip(division.nodes, division.corners, division.shares, inboxes):
        totals = inbox[shares].sum(0)
        np.testing.assert_allclose(totals[corners_of[nodes >= 0]], expected[corners[nodes[nodes >= 0]]], atol=1e-12)


def test_more_nodes_than_a_cluster_holds_are_not_divided():
    solver = simulate(curved_sheet(20_000), node_count=8000).solver
    assert cluster.divide(solver.rest_cells, solver._corners()) is None


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


@pytest.mark.parametrize("kinematics", ["rest", "current"])
def test_undriven_energy_decays(kinematics):
    simulation = simulate(kinematics=kinematics, damping=0.0)
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


def free_block(**overrides) -> TissueSimulation:
    """A block of 4 × 3 × 2 cm that nothing holds."""
    nodes = specimen((9, 7, 5), 0.005, lambda x: np.zeros(len(x), bool), lambda x: np.ones(len(x), bool))
    config = PhysicsConfig(device="cpu", **{"damping": 0.0, "travel": 0.3, "force_radius": 0.01, **overrides})
    return TissueSimulation.from_nodes(nodes, config)


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


@pytest.mark.parametrize("kinematics", ["rest", "current"])
def test_same_inputs_give_the_same_bits_twice(kinematics):
    def run():
        simulation = simulate(kinematics=kinematics)
        simulation.set_wrench("probe", TIP, [0.1, 0.0, 0.2], [0.0, 0.0, 1e-4])
        steps(simulation, 4)
        return simulation

    first, second = run(), run()
    np.testing.assert_array_equal(first.state().positions, second.state().positions)
    np.testing.assert_array_equal(first.state().F, second.state().F)
    first.reset()
    first.set_wrench("probe", TIP, [0.1, 0.0, 0.2], [0.0, 0.0, 1e-4])
    steps(first, 4)
    np.testing.assert_array_equal(first.state().positions, second.state().positions)


@pytest.mark.parametrize("kinematics", ["rest", "current"])
@pytest.mark.parametrize("material", MATERIALS)
def test_the_vectorised_step_agrees_with_the_kernels_of_the_gpu(kinematics, material, monkeypatch):
    """The same kernels that a GPU runs, here on the CPU: a second implementation of everything that acts at once."""
    states = []
    for vectorised in (True, False):
        if not vectorised:
            monkeypatch.setattr(solver, "STRESSES", {})
        simulation = simulate(
            kinematics=kinematics, material=material, contact_radius=0.006, relaxation=0.5, gravity_z=0.5,
            regions=("sphere 0 0 0.12 0.02 young_modulus=20000",),
        )  # fmt: skip
        assert simulation.solver._vectorised == vectorised
        assert simulation.set_wrench("pull", TIP - [0.03, 0, 0], [0.1, 0.0, -0.3])
        assert simulation.set_grasp("grip", pose_at(TIP + [0.03, 0, 0]), True)
        for step in range(6):
            simulation.set_grasp("grip", pose_at(TIP + [0.03, 0, -0.001 * step]), True)
            simulation.set_grasp("probe", pose_at(TIP + [0, 0, -0.006 + 0.0005 * step]), False)
            simulation.step()
        state = simulation.state()
        reactions = [np.concatenate(simulation.reaction(tool)) for tool in ("pull", "grip", "probe")]
        states.append((state.positions - state.rest, state.F, np.array(reactions)))
    assert np.abs(states[0][0]).max() > 3e-3 and states[0][2][2, 2] < -0.01
    np.testing.assert_allclose(states[1][0], states[0][0], atol=1e-6)
    np.testing.assert_allclose(states[1][1], states[0][1], atol=2e-4)
    np.testing.assert_allclose(states[1][2], states[0][2], atol=1e-3)


def test_inverted_tissue_recovers_in_both_implementations(monkeypatch):
    """Near-singular and inverted F take the decomposition instead of the iteration."""
    ends, chosen = [], np.random.default_rng(6).permutation(300)[:20]
    for vectorised in (True, False):
        if not vectorised:
            monkeypatch.setattr(solver, "STRESSES", {})
        simulation = simulate(node_count=300, damping=200.0)
        F = simulation.solver.deformation_gradients()
        F[chosen] = np.float32(np.diag([1.0, 1.0, -0.3]))
        F[chosen[:4]] = 0.0
        simulation.solver.state.F.assign(F)
        simulation._disturbed = True
        steps(simulation, 3)
        assert simulation.faults == 0
        ends.append(simulation.state().positions)
    np.testing.assert_allclose(ends[1], ends[0], atol=2e-5)


def test_moving_the_scene_by_metres_changes_nothing():
    dents = []
    for offset in ((0.0, 0.0, 0.0), (2.0, -4.0, 3.0)):
        simulation = simulate(curved_sheet(offset=offset), np.array(offset))
        simulation.set_wrench("probe", TIP + offset, [0.0, 0.0, 0.2])
        steps(simulation, 5)
        state = simulation.state()
        dents.append(state.positions.astype(np.float64) - state.rest)
    np.testing.assert_allclose(dents[1], dents[0], atol=2e-6)
    assert np.abs(dents[0]).max() > 5e-4


def test_printed_skin_only_method_and_dense_baseline_run():
    printed = simulate(layers=0, kinematics="current")
    dense = TissueSimulation(curved_sheet(), EYE, PhysicsConfig.baseline(device="cpu"))
    assert len(printed.nodes) == 1000 and len(dense.nodes) == 3000
    for simulation in (printed, dense):
        assert simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.002])
        steps(simulation, 3)
        assert 1e-5 < depth_of_dent(simulation) < 0.02
        assert simulation.faults == 0


# Stiffness, relaxation and many environments


def test_tissue_that_relaxes_holds_back_less_and_less_as_a_standard_linear_solid():
    ratio, time, forces = 1.5, 0.4, []
    simulation = simulate(relaxation=ratio, relaxation_time=time)
    simulation.set_grasp("PSM1", pose_at(TIP), True)
    simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.002]), True)
    for _ in range(60):
        simulation.step()
        forces.append(simulation.reaction("PSM1")[0][2])
    lasting = simulate()
    lasting.set_grasp("PSM1", pose_at(TIP), True)
    lasting.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.002]), True)
    steps(lasting, 60)
    final = lasting.reaction("PSM1")[0][2]
    elapsed = simulation.step_duration * np.arange(1, 61) - simulation.step_duration
    expected = final * (1 + ratio * np.exp(-elapsed / time))
    np.testing.assert_allclose(forces[5:], expected[5:], rtol=0.08)
    assert forces[5] > 1.7 * forces[-1] > 0


def test_slowly_relaxing_tissue_is_not_left_as_it_is_before_it_has_relaxed():
    held, lasting = [], []
    for relaxation, results in ((1.0, held), (0.0, lasting)):
        simulation = simulate(node_count=300, relaxation=relaxation, relaxation_time=4.0)
        simulation.set_grasp("PSM1", pose_at(TIP), True)
        simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.002]), True)
        for _ in range(7):
            results.append(simulation.reaction("PSM1")[0][2])
            steps(simulation, 100)  # 4 s
    assert held[1] > 1.25 * lasting[-1] and held[-1] == pytest.approx(lasting[-1], rel=0.02)
    steps(simulation, 1)
    assert simulation._resting


def test_relaxing_tissue_needs_the_substeps_of_its_fast_stiffness():
    plain, relaxing = PhysicsConfig(adapt_substeps=False, substeps=30), PhysicsConfig(relaxation=3.0)
    assert plan_substeps(relaxing, 0.01).count == pytest.approx(2 * plan_substeps(PhysicsConfig(), 0.01).count, abs=1)
    with pytest.raises(StabilityError, match=r"young_modulus 2e\+06 Pa.*relaxation 3 and density"):
        plan_substeps(dataclasses.replace(plain, relaxation=3.0, young_modulus=2e6), 0.01)


def test_a_stiff_region_gives_way_less_and_the_tissue_beside_it_as_before():
    region = "sphere 0.025 0 0.12 0.012 young_modulus=100000"
    left, right = TIP - [0.025, 0, 0], TIP + [0.025, 0, 0]
    dents = []
    for regions in ((), (region,)):
        simulation = simulate(node_count=2000, regions=regions)
        for name, tip in (("left", left), ("right", right)):
            simulation.set_wrench(name, tip, [0.0, 0.0, 0.2])
        steps(simulation, 10)
        state = simulation.state()
        moved, x = state.positions[:, 2] - state.rest[:, 2], state.rest[:, 0]
        dents.append((moved[x < 0].max(), moved[x > 0].max()))
    assert dents[1][0] == pytest.approx(dents[0][0], rel=0.05)
    assert dents[1][1] < 0.5 * dents[0][1]
    with pytest.raises(ConfigError, match="sphere 5 5 5"):
        simulate(regions=("sphere 5 5 5 0.01 young_modulus=1e5",))


def test_each_node_obeys_its_own_material():
    """A column of two halves in series, each shortening as its own modulus says."""
    height, spacing = 0.02, 0.0025
    nodes = specimen((9, 9, 9), spacing, lambda x: x[:, 2] > height - 1e-6, lambda x: x[:, 2] < 1e-6)
    stiff = nodes.rest[:, 2] < height / 2 - 1e-6
    properties = TissueProperties.uniform(len(nodes), 5e3, 0.0, 1000.0).painted(stiff, young_modulus=20e3)
    config = PhysicsConfig(device="cpu", poisson_ratio=0.0, force_radius=0.05)
    simulation = TissueSimulation.from_nodes(nodes, config, properties)
    force, area = 0.05, (8 * spacing) ** 2
    simulation.set_wrench("load", [0.01, 0.01, 0.0], [0.0, 0.0, force])
    steps(simulation, 40)
    moved = (simulation.state().positions - nodes.rest)[:, 2]
    middle = nodes.is_skin & (np.linalg.norm(nodes.rest[:, :2] - 0.01, axis=1) < 0.008)
    half = np.abs(nodes.rest[:, 2] - height / 2) < 1e-6
    expected_half = force / area / 5e3 * height / 2
    assert moved[half].mean() == pytest.approx(expected_half, rel=0.12)
    assert moved[middle].mean() == pytest.approx(expected_half * 1.25, rel=0.12)


def test_environments_are_independent_copies_on_any_number_of_threads(monkeypatch):
    nodes = build_control_nodes(curved_sheet(), EYE, PhysicsConfig(node_count=400))
    config = PhysicsConfig(device="cpu", node_count=400)

    def run(threads: int):
        monkeypatch.setenv("ENDO_SIM_THREADS", str(threads))
        batch = TissueBatch(nodes, config, environments=5, tools=2, stiffness=[1.0, 1.0, 2.0, 1.0, 1.0])
        batch.tools.reaches[:, 0] = torch.from_numpy(TIP)
        batch.tools.forces[:, 0, 2] = torch.tensor([0.1, 0.2, 0.2, 0.0, 1e7])
        for _ in range(5):
            batch.step()
        return batch

    batch, other = run(1), run(3)
    assert torch.equal(batch.displacements, other.displacements) and torch.equal(batch.F, other.F)
    depths = batch.displacements.norm(dim=2).max(1).values
    assert depths[1] > 1.8 * depths[0] and depths[2] < 0.6 * depths[1]
    assert not batch.displacements[3].any() and torch.equal(batch.positions()[3], torch.from_numpy(nodes.rest))
    assert batch.tools.faults.tolist() == [0, 0, 0, 0, 5] and batch.displacements.isfinite().all()
    np.testing.assert_allclose(batch.tools.reaction_forces[:4, 0, 2], [-0.1, -0.2, -0.2, 0.0], atol=1e-12)
    single = TissueSimulation.from_nodes(nodes, config)  # with fewer substeps, as nothing in it is stiffer
    single.set_wrench("probe", TIP, [0.0, 0.0, 0.1])
    steps(single, 5)
    np.testing.assert_allclose(batch.positions()[0], single.state().positions, atol=0.03 * depths[0])
    assert not batch.tools.reaction_forces[4].any()  # its steps were undone, and what the wrench did
    batch.reset(torch.tensor([1, 4]))
    assert not batch.displacements[1].any() and batch.displacements[0].any() and batch.tools.faults[4] == 0


def test_copies_feel_their_own_stiffness_whatever_that_of_the_others():
    nodes = build_control_nodes(curved_sheet(), EYE, PhysicsConfig(node_count=400))
    felt = []
    for other in (1.0, 4.0):
        config = PhysicsConfig(device="cpu", node_count=400, adapt_substeps=False)
        batch = TissueBatch(nodes, config, environments=2, stiffness=[1.0, other])
        batch.tools.present[:], batch.tools.closed[:] = 1, 1
        batch.tools.rotations[:] = torch.eye(3)
        for lift in (0.0, 0.001, 0.002, 0.002):
            batch.tools.tips[:, 0] = torch.from_numpy(TIP - [0, 0, lift])
            batch.step()
        felt.append(batch.tools.reaction_forces[:, 0, 2].clone())
    assert felt[0][0] == felt[1][0] == felt[0][1] > 0.01
    assert felt[1][1] > 3 * felt[1][0]


@pytest.mark.parametrize("name", ["forces", "torques", "tips", "rotations"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_commands_that_are_not_finite_are_faults_of_their_copy(name, value):
    nodes = build_control_nodes(curved_sheet(), EYE, PhysicsConfig(node_count=300))
    batch = TissueBatch(nodes, PhysicsConfig(device="cpu", node_count=300, contact_radius=0.005), environments=2)
    batch.tools.reaches[:, 0] = torch.from_numpy(TIP)
    batch.tools.forces[:, 0, 2] = 0.1
    batch.tools.present[:] = 1
    batch.tools.rotations[:] = torch.eye(3)
    batch.step()
    before = batch.displacements[1].clone()
    getattr(batch.tools, name)[1] = value
    batch.step()
    assert batch.tools.faults.tolist() == [0, 1]
    assert torch.equal(batch.displacements[1], before) and not batch.tools.reaction_forces[1].any()
    assert batch.displacements[0].norm(dim=1).max() > before.norm(dim=1).max()


def test_the_documented_batch_runs(tmp_path):
    text = (Path(__file__).parents[1] / "docs" / "physics.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    save_ply(curved_sheet(), tmp_path / "model.ply")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "0.2000" in done.stdout  # the reaction to the wrench


def test_tissue_whose_material_changes_goes_on_from_where_it_is():
    soft, stiff = simulate(blade_length=0.03), simulate(blade_length=0.03, young_modulus=20e3)
    for y in np.linspace(-0.045, 0.0, 10):
        soft.set_cut("knife", pose_at([0.02, y, 0.145]), True)
    soft.set_wrench("probe", TIP, [0.0, 0.0, 0.2])
    soft.set_grasp("grip", pose_at(TIP + [0.03, 0, 0]), True)
    steps(soft, 20)
    assert stiff.continue_from(soft)
    np.testing.assert_array_equal(stiff.state().positions, soft.state().positions)
    assert len(stiff.cuts) == len(soft.cuts) > 0 and stiff.in_reach("grip") and stiff.time == soft.time
    before = depth_of_dent(stiff)
    steps(stiff, 20)
    assert depth_of_dent(stiff) == pytest.approx(before / 2, rel=0.2)  # the same force, twice the stiffness
    np.testing.assert_allclose(stiff.reaction("probe")[0], [0, 0, -0.2], atol=1e-9)
    assert not simulate(node_count=400).continue_from(soft)


# Grasping


def pose_at(position) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = position
    return pose


def test_closed_jaw_holds_tissue_that_follows_and_pulls_back():
    simulation = simulate()
    assert simulation.set_grasp("PSM1", pose_at(TIP), True)
    held = simulation.held_nodes("PSM1")
    for i in range(1, 11):
        simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.001 * i]), True)
        simulation.step()
    moved = (simulation.state().positions - simulation.nodes.rest)[held]
    np.testing.assert_allclose(moved, np.tile([0, 0, -0.01], (len(held), 1)), atol=1e-3)
    force, _ = simulation.reaction("PSM1")
    assert force[2] > 0.05 and np.linalg.norm(force[:2]) < 0.3 * force[2]  # the tissue pulls the jaw back, away from the camera
    assert simulation.in_reach("PSM1") and simulation.faults == 0


def test_reaction_of_a_grasp_grows_with_stiffness():
    pulls = []
    for modulus in (5e3, 10e3):
        simulation = simulate(young_modulus=modulus)
        simulation.set_grasp("PSM1", pose_at(TIP), True)
        simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.002]), True)
        steps(simulation, 10)
        pulls.append(simulation.reaction("PSM1")[0][2])
    assert pulls[1] / pulls[0] == pytest.approx(2, rel=0.1)


def test_what_a_jaw_feels_hardly_depends_on_how_many_nodes_there_are():
    pulls = []
    for count, layers in ((1000, 3), (4000, 3), (12000, 5)):
        simulation = simulate(curved_sheet(12000), node_count=count, layers=layers)
        simulation.set_grasp("PSM1", pose_at(TIP), True)
        simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.003]), True)
        held = simulation.held_nodes("PSM1")
        steps(simulation, 15)
        lag = np.linalg.norm(simulation.state().positions[held] - simulation.nodes.rest[held] + [0, 0, 0.003], axis=1)
        assert lag.mean() < 0.1 * 0.003
        pulls.append(simulation.reaction("PSM1")[0][2])
    assert max(pulls) < 1.35 * min(pulls)


def test_turning_free_tissue_steadily_takes_no_torque():
    simulation = free_block(force_radius=0.006)
    centre = simulation.nodes.rest.mean(0).astype(float)
    pose, torques = pose_at(centre), []
    simulation.set_grasp("PSM1", pose, True)
    for step in range(40):
        c, s = np.cos(0.02 * step), np.sin(0.02 * step)
        pose[:2, :2] = [[c, -s], [s, c]]
        simulation.set_grasp("PSM1", pose, True)
        simulation.step()
        torques.append(simulation.reaction("PSM1")[1][2])
    assert np.abs(torques[30:]).max() < 0.02 * np.abs(torques).max()  # which was to set it going


def test_turning_the_jaw_turns_the_tissue_and_is_resisted():
    simulation = simulate()
    simulation.set_grasp("PSM1", pose_at(TIP), True)
    held = simulation.held_nodes("PSM1")
    pose = pose_at(TIP)
    angle = 0.2
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    simulation.set_grasp("PSM1", pose, True)
    steps(simulation, 5)
    state, rest = simulation.state(), simulation.nodes.rest
    expected = (rest[held] - TIP) @ pose[:3, :3].T + TIP
    np.testing.assert_allclose(state.positions[held], expected, atol=4e-4)
    assert simulation.reaction("PSM1")[1][2] < -1e-4


def test_tissue_is_handed_from_jaw_to_jaw_without_a_jerk():
    simulation, aside = simulate(), TIP + [0.0048, 0, 0]
    for closed in (False, True):
        for tool in ("PSM1", "PSM2"):
            assert simulation.set_grasp(tool, pose_at(TIP), closed)
    held = simulation.held_nodes("PSM1")

    def follow(tool):
        for _ in range(3):
            simulation.step()
            moved = (simulation.state().positions - simulation.nodes.rest)[held].mean(0)
            yield *moved, simulation.reaction(tool)[0][0]

    for part in np.linspace(0, 1, 6):  # both hold it, and only one goes away
        simulation.set_grasp("PSM1", pose_at(TIP + part * (aside - TIP)), True)
        simulation.step()
    assert np.abs(list(follow("PSM1"))[-1]).max() < 1e-4  # it has nothing yet
    simulation.set_grasp("PSM2", pose_at(TIP), False)
    given = np.array(list(follow("PSM1")))
    np.testing.assert_allclose(given[:, :3], np.tile(aside - TIP, (3, 1)), atol=1e-4)
    assert given[-1, 3] < -0.5 and abs(given[0, 3]) < 1.1 * abs(given[-1, 3])
    simulation.set_grasp("PSM2", pose_at(aside), True)
    simulation.set_grasp("PSM1", pose_at(aside), False)
    back = np.array(list(follow("PSM2")))
    np.testing.assert_allclose(back[:, :3], given[:, :3], atol=1e-4)
    assert back[:, 3] == pytest.approx(given[-1, 3], rel=0.15) and not simulation.reaction("PSM1")[0].any()


def test_opening_the_jaw_releases_the_tissue():
    simulation = simulate()
    simulation.set_grasp("PSM1", pose_at(TIP), True)
    simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.008]), True)
    steps(simulation, 5)
    pulled = depth_of_dent(simulation)
    assert simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.008]), False)
    steps(simulation, 100)
    assert pulled > 0.007 and depth_of_dent(simulation) < 0.1 * pulled
    assert not simulation.reaction("PSM1")[0].any() and not simulation.in_reach("PSM1")


def test_jaw_closed_in_the_air_holds_nothing_and_tissue_pulled_too_far_slips():
    simulation = simulate()
    assert not simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.05]), True)
    assert simulation.set_grasp("PSM1", pose_at(TIP), True)
    simulation.set_grasp("PSM1", pose_at(TIP - [0, 0, 0.06]), True)
    simulation.step()
    assert simulation.slips == 1 and not simulation.in_reach("PSM1") and simulation.faults == 0
    with pytest.raises(ValueError, match="must turn and shift, not scale or mirror"):
        simulation.set_grasp("PSM1", np.diag([2.0, 2.0, 2.0, 1.0]), True)
    with pytest.raises(ValueError, match="pose of tool 'PSM1' must be a finite"):
        simulation.set_grasp("PSM1", np.full((4, 4), np.nan), True)


def test_tissue_that_came_to_rest_is_not_stepped_until_a_tool_acts():
    simulation = simulate()
    calls, step = [], simulation.solver.step
    simulation.solver.step = lambda: calls.append(1) or step()
    steps(simulation, 3)
    assert not calls and simulation.time == pytest.approx(3 * simulation.step_duration)
    simulation.set_wrench("PSM1", TIP, [0, 0, 0.1])
    simulation.step()
    simulation.set_wrench("PSM1", TIP, [0, 0, 0])
    steps(simulation, 200)
    assert 4 < len(calls) < 100
    assert depth_of_dent(simulation) < 2e-5


# Cutting


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


@pytest.mark.parametrize("vectorised", [True, False])
def test_a_cut_separates_what_is_pulled_apart_and_heals_on_reset(vectorised, monkeypatch):
    if not vectorised:
        monkeypatch.setattr(solver, "STRESSES", {})
    gaps = []
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


def test_a_cut_opens_where_the_blade_was_and_not_beyond_its_end():
    simulation = simulate(node_count=2400, layers=3, blade_length=0.03)
    cut_along(simulation, np.linspace(-0.045, 0.0, 16))
    moved, rest = pull_apart(simulation)
    near = np.abs(rest[:, 0]) < 0.007

    def gap(low, high):
        where = near & (rest[:, 1] > low) & (rest[:, 1] < high)
        return moved[where & (rest[:, 0] > 0)].mean() - moved[where & (rest[:, 0] < 0)].mean()

    assert gap(-0.03, -0.012) > 3 * gap(0.012, 0.03) > 0


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


# Stability and faults


def test_substeps_adapt_to_the_material_and_add_up_to_the_step():
    stiff = plan_substeps(PhysicsConfig(young_modulus=1e6, poisson_ratio=0.45), 0.00875)
    soft = plan_substeps(PhysicsConfig(young_modulus=1e3), 0.00875)
    assert stiff.count > 80 > soft.count >= 1
    for plan in (stiff, soft):
        assert plan.cfl <= 0.5 and plan.count * plan.dt == pytest.approx(PhysicsConfig().step_duration)
    printed = plan_substeps(PhysicsConfig(adapt_substeps=False), 0.00875)  # as the paper has it
    assert (printed.count, printed.dt) == (80, pytest.approx(0.0005))


def test_few_adapted_substeps_settle_where_many_do():
    dents = []
    for adapt in (True, False):
        simulation = simulate(adapt_substeps=adapt)
        simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.5])
        steps(simulation, 30)
        dents.append(depth_of_dent(simulation))
    assert dents[0] == pytest.approx(dents[1], rel=0.06)  # transfer dissipation slows the last bit down


def test_stiff_material_is_refused_with_the_numbers_when_substeps_may_not_adapt():
    numbers = r"young_modulus 1e\+06 Pa.*0\.3.*1000 kg.*0\.00875 m.*use \d+ substeps of"
    with pytest.raises(StabilityError, match=numbers):
        plan_substeps(PhysicsConfig(young_modulus=1e6, adapt_substeps=False), 0.00875)
    # Where no number of substeps is allowed that would do, the stiffness that would.
    with pytest.raises(StabilityError, match=r"use young_modulus \S+ Pa or less") as refusal:
        plan_substeps(PhysicsConfig(young_modulus=1e9, density=1.0), 0.00875)
    largest = float(re.search(r"use young_modulus (\S+)", str(refusal.value))[1])
    assert plan_substeps(PhysicsConfig(young_modulus=largest, density=1.0), 0.00875).count > 90_000


@pytest.mark.parametrize("kinematics", ["rest", "current"])
def test_absurd_force_is_caught_and_the_last_good_state_restored(kinematics):
    simulation = simulate(kinematics=kinematics)
    simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.1])
    steps(simulation, 3)
    good = simulation.state()
    simulation.set_wrench("probe", TIP, [0.0, 0.0, -1e7])
    simulation.step()
    bad = simulation.state()
    assert simulation.faults == 1 and "undone" in simulation.last_fault and "1e+07 N" in simulation.last_fault
    np.testing.assert_array_equal(bad.positions, good.positions)
    np.testing.assert_array_equal(bad.F, good.F)
    assert not np.any(simulation.solver.momentum()[0])
    simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.1])
    steps(simulation, 2)
    assert simulation.faults == 1 and np.isfinite(simulation.state().positions).all()


@pytest.mark.parametrize(("material", "relaxation"), [("neo_hookean", 0.0), ("fixed_corotated", 5.0)])
def test_tissue_crushed_until_no_step_goes_on_comes_back_when_the_tool_has_gone(material, relaxation):
    simulation = simulate(material=material, relaxation=relaxation, contact_radius=0.05)
    simulation.set_grasp("ball", pose_at(TIP), False)
    steps(simulation, 20)
    crushed = depth_of_dent(simulation)
    simulation.set_grasp("ball", pose_at(TIP - [0, 0, 0.2]), False)
    steps(simulation, 60)
    faults = simulation.faults
    steps(simulation, 190)
    assert faults > 0 and simulation.faults == faults and "ball pushing" in simulation.last_fault
    assert crushed > 0.03 and depth_of_dent(simulation) < 0.03 * crushed


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


# Tools


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


def press(simulation: TissueSimulation, depth: float, over: int = 10, hold: int = 10) -> None:
    """Press the capsule of a tool into the tissue from the camera's side."""
    above = TIP - [0, 0, simulation.contact_radius]
    for step in range(over + hold):
        simulation.set_grasp("probe", pose_at(above + [0, 0, depth * min(step + 1, over) / over]), False)
        simulation.step()


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


def test_tissue_can_be_built_in_one_thread_while_other_tissue_begins_to_move_in_another():
    points = np.random.default_rng(0).normal(size=(2000, 3))
    expected, wrong, done = sample_farthest(points, 40), [], threading.Event()

    def sample():
        while not done.is_set():
            try:
                np.testing.assert_array_equal(sample_farthest(points, 40), expected)
            except BaseException as error:
                wrong.append(error)
                return

    thread = threading.Thread(target=sample)
    thread.start()
    try:
        for _ in range(20):
            simulation = simulate(node_count=60, layers=1)
            simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.01])
            simulation.step()  # the first one prepares the launches
    finally:
        done.set()
        thread.join()
    assert not wrong


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


# Skinning


def affine_field(rest: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    A = np.array([[1.1, 0.2, 0.0], [-0.1, 0.9, 0.1], [0.05, 0.0, 1.2]])
    return A, rest @ A.T + [0.01, 0.02, -0.03], np.tile(A, (len(rest), 1, 1))


@pytest.mark.parametrize("weighting", ["compact", "softmax"])
def test_undeformed_nodes_leave_gaussians_untouched(weighting):
    model = curved_sheet()
    nodes = build_control_nodes(model, EYE, PhysicsConfig(node_count=1000))
    skinning = Skinning(model, nodes.rest, weighting=weighting, device="cpu")
    means, covars = skinning.deform(nodes.rest, np.tile(np.eye(3), (len(nodes), 1, 1)))
    assert torch.equal(means, model.means)
    torch.testing.assert_close(covars, skinning.covars, rtol=1e-6, atol=0.0)


def test_affine_fields_are_exact():
    model = curved_sheet()
    nodes = build_control_nodes(model, EYE, PhysicsConfig(node_count=1000))
    A, positions, F = affine_field(nodes.rest)
    skinning = Skinning(model, nodes.rest, device="cpu")
    means, covars = skinning.deform(positions, F)
    np.testing.assert_allclose(means, affine_field(model.means.numpy())[1], atol=1e-7)
    np.testing.assert_allclose(covars, A @ skinning.covars.numpy() @ A.T, rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("weighting", ["compact", "softmax"])
def test_rigid_motion_is_exact_and_gives_its_rotation(weighting):
    model = curved_sheet(500)
    rest = model.means[::5].numpy()
    R = random_rotations(1)[0]
    skinning = Skinning(model, rest, weighting=weighting, device="cpu")
    F = np.tile(R, (len(rest), 1, 1))
    means, _ = skinning.deform(rest @ R.T + 0.01, F)
    np.testing.assert_allclose(means, model.means.numpy() @ R.T + 0.01, atol=2e-7)
    np.testing.assert_allclose(skinning.rotations(F), np.tile(R, (500, 1, 1)), atol=1e-5)


def test_a_dent_is_smoother_with_compact_weights_than_with_the_printed_softmax():
    rng = np.random.default_rng(5)
    xy = rng.uniform(-0.02, 0.02, (4000, 2))
    points = np.c_[xy, np.zeros(4000)]
    rest = points[sample_farthest(points, 220)]  # 2.7 mm apart

    def dent(p):  # 5 mm deep, Gaussian, and its gradient
        depth = 0.005 * np.exp(-(p[:, :2] ** 2).sum(1) / (2 * 0.006**2))
        F = np.tile(np.eye(3), (len(p), 1, 1))
        F[:, 2, :2] = -depth[:, None] * p[:, :2] / 0.006**2
        return p + np.c_[np.zeros((len(p), 2)), depth], F

    model = GaussianModel.from_points(torch.from_numpy(points).float(), torch.rand(4000, 3), torch.full((4000,), 0.001))
    inside = np.abs(xy).max(1) < 0.015
    line = np.c_[np.linspace(-0.015, 0.015, 6001), np.zeros((6001, 2))]  # 5 µm apart: jumps show, slopes do not
    along = GaussianModel.from_points(torch.from_numpy(line).float(), torch.rand(6001, 3), torch.full((6001,), 0.001))
    rms, jump = {}, {}
    for weighting in ("compact", "softmax"):
        means, _ = Skinning(model, rest, weighting=weighting, device="cpu").deform(*dent(rest))
        error = np.linalg.norm(means.numpy() - dent(points)[0], axis=1)[inside]
        rms[weighting] = np.sqrt((error**2).mean())
        means, _ = Skinning(along, rest, weighting=weighting, device="cpu").deform(*dent(rest))
        jump[weighting] = np.abs(np.diff(means[:, 2].numpy() - dent(line)[0][:, 2])).max()
    assert rms["compact"] < 0.05e-3 and rms["compact"] < 0.6 * rms["softmax"]
    assert jump["compact"] < 0.01e-3 and jump["compact"] < 0.1 * jump["softmax"]


def test_wild_nodes_give_bounded_gaussians():
    model = curved_sheet(300)
    rest = model.means[::5].numpy()
    for F in (np.diag([9.0, 1.0, 1.0]), np.diag([1.0, 1.0, -1.0]), np.zeros((3, 3)), np.diag([1.0, 1.0, 1e-6])):
        skinning = Skinning(model, rest, device="cpu")
        _, covars = skinning.deform(rest, np.tile(F, (len(rest), 1, 1)))
        stretch = torch.linalg.eigvalsh(covars).sqrt() / 0.001
        assert 0.199 < stretch.min() and stretch.max() < 4.01


def test_few_nodes_and_no_gaussians_are_fine():
    model = curved_sheet(50)
    for count in (1, 2, 3):
        rest = model.means[:count].numpy()
        means, _ = Skinning(model, rest, device="cpu").deform(rest + 1, np.tile(np.eye(3), (count, 1, 1)))
        np.testing.assert_allclose(means, model.means + 1, atol=1e-6)
    empty = model.select(torch.zeros(50, dtype=torch.bool))
    assert Skinning(empty, rest, device="cpu").deform(rest, np.zeros((3, 3, 3)))[0].shape == (0, 3)


def test_wrong_node_shapes_are_refused():
    model = curved_sheet(50)
    rest = model.means[:10].numpy()
    skinning = Skinning(model, rest, device="cpu")
    with pytest.raises(ValueError, match=r"F has shape \(9, 3, 3\), expected \(10, 3, 3\)"):
        skinning.deform(rest, np.zeros((9, 3, 3)))
    with pytest.raises(ValueError, match=r"node_rest has shape \(0, 3\)"):
        Skinning(model, np.zeros((0, 3)), device="cpu")


def test_simulated_dent_reaches_the_gaussians():
    model = curved_sheet()
    simulation = simulate(model)
    simulation.set_wrench("probe", TIP, [0.0, 0.0, 0.2])
    steps(simulation, 8)
    state = simulation.state()
    means, covars = Skinning(model, state.rest, device="cpu").deform(state.positions, state.F)
    moved = (means - model.means)[:, 2].numpy()
    distance = np.linalg.norm(model.means[:, :2].numpy(), axis=1)
    assert moved[distance < 0.004].mean() > 3 * moved[(distance > 0.012) & (distance < 0.016)].mean() > 0
    assert np.abs(moved[distance > 0.035]).max() < 0.05 * moved.max()
    assert torch.linalg.eigvalsh(covars).min() > 0
