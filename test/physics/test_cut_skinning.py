"""Cuts in the skinning: no Gaussian follows a node on the other side."""

import numpy as np
from cut_block import MIDDLE, block, wall

from endo_sim_ros.physics.cutting.gaussians import ENDS, CutNeighbours, crop_to_sides
from endo_sim_ros.physics.skinning import bind_weights


def skin(count=3000, seed=0) -> np.ndarray:
    """Means [N, 3] on the face z = 0 of the block, a little rough."""
    return np.random.default_rng(seed).uniform([0, 0, -0.0005], [0.06, 0.04, 0.0005], (count, 3))


def cut_neighbours(means, rest, index, weights, triangles) -> tuple[np.ndarray, np.ndarray]:
    neighbours = CutNeighbours(means, rest, index, weights)
    neighbours.cut(triangles)
    return neighbours.index, neighbours.weights


def test_after_a_cut_no_gaussian_follows_a_node_on_the_other_side():
    means, rest = skin(), block(jitter=0.3)
    index, weights = bind_weights(means, rest, 4, "compact")
    new_index, new_weights = cut_neighbours(means, rest, index, weights, wall())
    other = (means[:, :1] < MIDDLE) != (rest[new_index, 0] < MIDDLE)
    assert ((means[:, :1] < MIDDLE) != (rest[index, 0] < MIDDLE)).any(1).sum() > 100
    assert not (other & (new_weights > 0)).any()
    np.testing.assert_allclose(new_weights.sum(1), 1, atol=1e-6)
    assert (new_weights >= 0).all()
    assert new_index.dtype == index.dtype and new_weights.dtype == weights.dtype


def test_gaussians_away_from_the_cut_are_untouched():
    means, rest = skin(), block(jitter=0.3)
    index, weights = bind_weights(means, rest, 4, "compact")
    new_index, new_weights = cut_neighbours(means, rest, index, weights, wall())
    whole = ((means[:, :1] < MIDDLE) == (rest[index, 0] < MIDDLE)).all(1)
    np.testing.assert_array_equal(new_index[whole], index[whole])
    np.testing.assert_array_equal(new_weights[whole], weights[whole])
    assert not (new_index[~whole] == index[~whole]).all(1).any()
    for triangles in (np.zeros((0, 3, 3)), wall() + [1.0, 0, 0]):
        same = cut_neighbours(means, rest, index, weights, triangles)
        assert np.array_equal(same[0], index) and np.array_equal(same[1], weights)


def test_neighbours_renewed_piece_by_piece_are_those_of_the_whole_cut_bit_for_bit():
    means, rest = skin(), block(jitter=0.3)
    triangles = np.concatenate([wall(), wall(x=0.0211)[..., [1, 0, 2]] * [2, 1, 1]])
    bound = bind_weights(means, rest, 4, "compact")
    neighbours = CutNeighbours(means, rest, *bound)
    for end in range(6, len(triangles) + 1, 6):
        neighbours.cut(triangles[:end])
    whole = cut_neighbours(means, rest, *bound, triangles)
    assert (whole[0] != bound[0]).any(1).sum() > 100
    same = (means[:, None, 0] < MIDDLE) == (rest[whole[0], 0] < MIDDLE)
    same &= (means[:, None, 1] < 0.0211) == (rest[whole[0], 1] < 0.0211)
    assert same[whole[1] > 0].all()
    np.testing.assert_array_equal(neighbours.index, whole[0])
    np.testing.assert_array_equal(neighbours.weights, whole[1])
    assert not neighbours.extends(np.zeros((0, 3, 3)))
    neighbours.heal()
    np.testing.assert_array_equal(neighbours.index, bound[0])


def test_cut_neighbours_takes_what_bind_weights_would_of_one_side():
    means, rest = skin(), block(jitter=0.3)
    left = np.flatnonzero(rest[:, 0] < MIDDLE)
    index, weights = bind_weights(means, rest, 4, "compact")
    parted = (means[:, 0] < MIDDLE) & ~np.isin(index, left).all(1)
    means, index, weights = means[parted], index[parted], weights[parted]
    index, weights = cut_neighbours(means, rest, index, weights, wall())
    expected, expected_weights = bind_weights(means, rest[left], 4, "compact")
    np.testing.assert_array_equal(index, left[expected])
    np.testing.assert_allclose(weights, expected_weights, atol=1e-6)


def test_a_gaussian_with_few_or_no_nodes_left_keeps_finite_weights():
    rest, means = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 0, 1]]), np.array([[0.1, 0, 0], [0.6, 0.1, 0.1]])
    index, weights = bind_weights(means, rest, 3, "compact")

    def plane(x):
        return np.array([[[x, -9.0, -9.0], [x, 9, -9], [x, 0, 9]]])

    one_left = cut_neighbours(means, rest, index, weights, plane(0.3))
    np.testing.assert_allclose(one_left[1].sum(1), 1, atol=1e-6)
    assert (one_left[0][0] == 0).all() and one_left[1][0].tolist() == [1, 0, 0]
    assert not (one_left[1][1] > 0)[one_left[0][1] == 0].any()
    none_left = cut_neighbours(means, rest, index, weights, np.concatenate([plane(0.05), plane(0.3)]))
    np.testing.assert_array_equal(none_left[0][0], index[0])
    np.testing.assert_array_equal(none_left[1][0], weights[0])


def test_gaussians_do_not_reach_across_a_cut_and_those_away_from_it_are_untouched():
    means = skin()
    spread = np.random.default_rng(1).normal(size=(len(means), 3, 3)) * 0.002
    covars = spread @ spread.transpose(0, 2, 1)
    triangles = wall()
    reach = 2 * np.sqrt(np.trace(covars, axis1=1, axis2=2))
    at, cropped = means.copy(), covars.copy()
    changed = crop_to_sides(at, cropped, reach, triangles)
    np.testing.assert_array_equal(changed, np.flatnonzero((cropped != covars).any((1, 2))))
    before, after = (ENDS * np.sqrt(each[:, 0, 0]) for each in (covars, cropped))  # the wall is x = MIDDLE
    distance, side = np.abs(means[:, 0] - MIDDLE), np.sign(means[:, 0] - MIDDLE)
    inside = (means[:, 1] > 0.003) & (means[:, 1] < 0.037)  # others are at the ends, or are moved along it there
    over, now = distance < before, side * (at[:, 0] - MIDDLE)
    assert (over & inside).sum() > 300
    np.testing.assert_allclose((now - after)[over], 0, atol=2e-6)  # they end at the cut, on the side where they were
    np.testing.assert_allclose((now + after)[over], (distance + before)[over], atol=5e-6)  # and reach as far on it
    np.testing.assert_array_equal(cropped[~over], covars[~over])
    np.testing.assert_array_equal(at[~over], means[~over])
    # Along the cut they are where they were, given where they are across it.
    given = lambda each: each[:, 1:, 1:] - each[:, 1:, :1] * each[:, :1, 1:] / each[:, :1, :1]
    np.testing.assert_allclose(given(cropped), given(covars), atol=1e-11)
    assert (np.linalg.eigvalsh(cropped) > -1e-12).all()
    placed, piecewise = means.copy(), covars.copy()
    for part in (triangles[:7], triangles[7:]):
        crop_to_sides(placed, piecewise, reach, part)
    np.testing.assert_array_equal(placed, at)
    np.testing.assert_array_equal(piecewise, cropped)
