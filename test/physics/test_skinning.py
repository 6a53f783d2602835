"""Skinning: exact on affine fields, fast with any number of threads, other nodes after a cut."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch
from tissue_scene import EYE, TIP, curved_sheet, random_rotations, simulate, steps

from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.kernels import compare_plain
from endo_sim_ros.physics import PhysicsConfig, Skinning, TissueBatch, build_control_nodes, sample_farthest


def affine_field(rest: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    A = np.array([[1.1, 0.2, 0.0], [-0.1, 0.9, 0.1], [0.05, 0.0, 1.2]])
    return A, rest @ A.T + [0.01, 0.02, -0.03], np.tile(A, (len(rest), 1, 1))


@pytest.mark.slow
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


@pytest.mark.parametrize("plain", [False, True], ids=["vectors", "the kernel of CUDA"])
@pytest.mark.parametrize("F", [np.diag([9.0, 1.0, 1.0]), np.diag([1.0, 1.0, -1.0]), np.zeros((3, 3)), np.diag([1.0, 1.0, 1e-6])])
def test_f_is_taken_as_it_is_without_the_clamp(F, plain):
    model = curved_sheet(300)
    rest = model.means[::5].numpy()
    with compare_plain() if plain else nullcontext():
        skinning = Skinning(model, rest, stretch=None, device="cpu")
    _, covars = skinning.deform(rest, np.tile(F, (len(rest), 1, 1)))
    torch.testing.assert_close(covars, torch.from_numpy(F @ skinning.covars.numpy() @ F.T).float(), rtol=1e-4, atol=1e-12)


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
    with pytest.raises(ValueError, match="weighting must be compact or softmax, not 'linear'"):
        Skinning(model, rest, weighting="linear", device="cpu")


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


def model_and_rest(count: int = 9001, offset: tuple = (0.0, 0.0, 0.0)):
    model = curved_sheet(count, offset=offset)
    return model, model.means[::40].numpy()


def wild_state(rest: np.ndarray, where=slice(None)) -> tuple[np.ndarray, np.ndarray]:
    """Nodes moved by millimetres, of which some stretch their Gaussians beyond the range."""
    rng = np.random.default_rng(3)
    positions, F = rest.copy(), np.tile(np.eye(3, dtype=np.float32), (len(rest), 1, 1))
    positions[where] += rng.normal(0, 1e-3, rest.shape)[where]
    F[where] += (rng.normal(0, 0.2, F.shape) * rng.choice([1, 20], (len(rest), 1, 1), p=[0.9, 0.1]))[where]
    return positions, F


def _deform(s: Skinning, positions: np.ndarray, F: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Equations 9 and 10 of the paper with A = F in float64; Gaussians stretched beyond the range have covariance NaN."""
    index, w, F = s.neighbours.numpy(), s.weights.double().numpy(), F.astype(np.float64)
    p, rest, means = positions.astype(np.float64), s.node_rest.double().numpy(), s.means.double().numpy()
    moved = np.einsum("nkij,nkj->nki", F[index], means[:, None] - rest[index]) + p[index]
    blend = np.einsum("nk,nkij->nij", w, F[index])
    sigma = np.linalg.svd(blend, compute_uv=False)
    low, high = s.stretch
    blend[(np.linalg.det(blend) <= 0) | (sigma[:, -1] < low) | (sigma[:, 0] > high)] = np.nan
    covars = blend @ s.covars.double().numpy() @ blend.transpose(0, 2, 1)
    return torch.from_numpy((w[..., None] * moved).sum(1)), torch.from_numpy(covars)


@pytest.mark.parametrize("weighting", ["compact", "softmax"])
def test_number_of_threads_changes_no_bit(monkeypatch, weighting):
    model, rest = model_and_rest()
    positions, F = wild_state(rest)
    results = []
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("ENDO_SIM_THREADS", threads)
        s = Skinning(model, rest, weighting=weighting, device="cpu")
        results.append((*s.deform(positions, F), s.rotations(F)))
    for others in results[1:]:
        assert all(torch.equal(one, other) for one, other in zip(results[0], others, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("neighbours", [1, 4, 7])
def test_vectors_agree_with_the_equations_and_with_the_kernel_of_cuda(neighbours):
    model, rest = model_and_rest(5000)
    positions, F = wild_state(rest)
    s = Skinning(model, rest, neighbours=neighbours, device="cpu")
    means, covars = s.deform(positions, F)
    expected_means, expected_covars = _deform(s, positions, F)
    healthy = expected_covars.isfinite().all((1, 2))
    if neighbours > 1:
        assert 100 < healthy.sum() < 4900
    torch.testing.assert_close(means.double(), expected_means, atol=2e-7, rtol=0)
    torch.testing.assert_close(covars.double()[healthy], expected_covars[healthy], atol=2e-11, rtol=1e-4)
    assert covars.isfinite().all()

    with compare_plain():
        scalar = Skinning(model, rest, neighbours=neighbours, device="cpu")
    scalar_means, scalar_covars = scalar.deform(positions, F)
    torch.testing.assert_close(means, scalar_means, atol=1e-7, rtol=0)
    torch.testing.assert_close(covars, scalar_covars, atol=2e-11, rtol=1e-4)


def test_tissue_at_rest_is_copied_and_the_copies_belong_to_the_caller():
    model, rest = model_and_rest()
    s = Skinning(model, rest, device="cpu")
    identity = np.tile(np.eye(3), (len(rest), 1, 1))
    means, covars = s.deform(rest, identity)
    assert torch.equal(means, model.means) and torch.equal(covars, s.covars)
    means.zero_(), covars.zero_()
    again, _ = s.deform(rest, identity)
    assert torch.equal(again, model.means)

    # A node without Gaussians moves: nothing is copied at once, and the general way gives the same bits.
    s.rebind(np.where(s.neighbours == 0, 1, s.neighbours), s.weights.numpy())
    moved = rest.copy()
    moved[0] += 0.01
    means, covars = s.deform(moved, identity)
    assert torch.equal(means, model.means) and torch.equal(covars, s.covars)


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (8.0, -4.0, 16.0)])
def test_tissue_moves_only_where_its_nodes_have_moved(offset):
    model, rest = model_and_rest(offset=offset)
    moving = rest[:, 0] < offset[0] - 0.01
    s = Skinning(model, rest, device="cpu")
    means, covars = s.deform(*wild_state(rest, moving))
    still = ~moving[s.neighbours.numpy()].any(1)
    assert 0.2 < still.mean() < 0.8
    assert torch.equal(means[still], model.means[still]) and torch.equal(covars[still], s.covars[still])
    assert (means[~still] != model.means[~still]).any(1).float().mean() > 0.99


def test_affine_fields_are_as_exact_far_from_the_origin_as_floats_are_there():
    offset = np.array([8.0, -4.0, 16.0])
    model, rest = model_and_rest(offset=tuple(offset))
    _, around, F = affine_field(rest.astype(np.float64) - offset)
    means, _ = Skinning(model, rest, device="cpu").deform(around + offset, F)
    expected = affine_field(model.means.double().numpy() - offset)[1] + offset
    np.testing.assert_allclose(means, expected, rtol=0, atol=2e-6)  # 16 m has floats 1.9e-6 m apart


def test_a_state_that_is_not_finite_shows():
    model, rest = model_and_rest(5000)
    positions, F = wild_state(rest, slice(0))
    positions[3], F[5] = np.nan, np.nan
    s = Skinning(model, rest, device="cpu")
    means, _ = s.deform(positions, F)
    touched = torch.isin(s.neighbours, torch.tensor([3, 5])).any(1)
    assert torch.equal(means.isnan().any(1), touched)


def test_rebound_gaussians_follow_their_new_nodes():
    model, rest = model_and_rest(5000)
    s = Skinning(model, rest, device="cpu")
    right = rest[:, 0] > 0
    own = np.argmax(right), np.argmin(right)  # a node of each side
    index = np.where(model.means[:, :1].numpy() > 0, own[0], own[1])
    s.rebind(index, np.ones((5000, 1)))
    positions = rest + np.where(right[:, None], [0.01, 0, 0], 0).astype(np.float32)
    means, covars = s.deform(positions, np.tile(np.eye(3), (len(rest), 1, 1)))
    shift = np.where(model.means[:, :1].numpy() > 0, np.float32([0.01, 0, 0]), 0)
    np.testing.assert_allclose(means, model.means.numpy() + shift, atol=1e-8)
    assert torch.equal(covars, s.covars)


def test_bindings_that_make_no_sense_are_refused_and_change_nothing():
    model, rest = model_and_rest(50)
    s = Skinning(model, rest, device="cpu")
    before = s.neighbours.clone(), s.weights.clone()
    index, weights = np.zeros((50, 2), np.int32), np.full((50, 2), 0.5, np.float32)
    with pytest.raises(ValueError, match=r"index has shape \(50, 2\) and weights \(50, 3\), expected both \[50, K\]"):
        s.rebind(index, np.ones((50, 3)))
    with pytest.raises(ValueError, match="whole numbers from 0 to 1,"):
        s.rebind(index + 2, weights)
    with pytest.raises(ValueError, match="whole numbers"):
        s.rebind(index * 1.0, weights)
    for wrong in (weights * 1.1, weights * np.nan, weights * [3, -1]):
        with pytest.raises(ValueError, match="must add up to one"):
            s.rebind(index, wrong)
    assert torch.equal(s.neighbours, before[0]) and torch.equal(s.weights, before[1])


@pytest.mark.parametrize("environments, backend", [(1, nullcontext), (3, nullcontext), (3, compare_plain)])
def test_skinning_within_the_step_gives_the_same_bits_as_after_it(environments, backend):
    model, _ = model_and_rest(5000)
    config = PhysicsConfig(node_count=400, device="cpu")
    nodes = build_control_nodes(model, np.zeros(3), config)
    batch = TissueBatch(nodes, config, environments)
    with backend():
        s = Skinning(model, nodes.rest, device="cpu")
    means, covars = batch.append_skinning(s)
    assert torch.equal(means[0], s.means) and torch.equal(covars[-1], s.covars)
    force = torch.tensor([0.2, 0.0, -0.4], dtype=torch.float64)
    batch.tools.grasp_points[:] = torch.tensor([0.0, 0.0, 0.12])
    batch.tools.forces[:, 0] = force * torch.arange(1, environments + 1)[:, None]
    for _ in range(3):
        batch.step()
    positions, pinned = batch.positions(), torch.from_numpy(nodes.pinned)
    for b in range(environments):
        expected = s.deform(positions[b], torch.where(pinned[:, None, None], torch.eye(3), batch.F[b]))
        assert torch.equal(means[b], expected[0]) and torch.equal(covars[b], expected[1])
        assert 1e-3 < (means[b] - s.means).norm(dim=1).max() < 0.02
    assert environments == 1 or not torch.equal(means[0], means[1])


def test_skinning_of_other_nodes_or_with_the_printed_weights_cannot_be_part_of_the_step():
    model, rest = model_and_rest(5000)
    config = PhysicsConfig(node_count=400, device="cpu")
    nodes = build_control_nodes(model, np.zeros(3), config)
    batch = TissueBatch(nodes, config, 2)
    with pytest.raises(ValueError, match="125 nodes on cpu cannot follow 2 × 400 nodes on cpu"):
        batch.append_skinning(Skinning(model, rest, device="cpu"))
    with pytest.raises(ValueError, match="softmax cannot be part of the step"):
        batch.append_skinning(Skinning(model, nodes.rest, weighting="softmax", device="cpu"))
