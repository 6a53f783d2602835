"""How points that are followed in images err is told by residuals."""

from dataclasses import replace

import numpy as np
import pytest
from slab import pressed

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.identification import Tracks
from endo_sim_ros.identification.followed_errors import learn_followed
from endo_sim_ros.identification.observations import Observations
from endo_sim_ros.identification.solving import Data, Point, Prior

POINTS, STEPS = 40, np.arange(0, 24, 2)
CAMERA = Camera(np.array([[500.0, 0, 160], [0, 500, 120], [0, 0, 1]]), 320, 240, np.eye(4))
MOVES = 4 * np.sin(np.pi * STEPS / 24)  # pixels, of every point in each image, along x


def followed(share, white, lasting=0.0, seed=0):
    """What was seen, a point of a model that is the truth, and derivatives by how far all move."""
    rng = np.random.default_rng(seed)
    true = np.broadcast_to(MOVES[:, None, None] * [1.0, 0.0], (len(STEPS), POINTS, 2))
    rms = MOVES / np.sqrt(2)
    seen = true + share * rms[:, None, None] * rng.normal(size=(POINTS, 2)) + white * rng.normal(size=true.shape)
    rest = np.column_stack([rng.uniform(-0.02, 0.02, (POINTS, 2)), np.full(POINTS, 0.1)])
    tracks = Tracks(rest, STEPS, seen, [CAMERA] * len(STEPS), 0.5, lasting)
    part = Data(Observations(replace(pressed(), tracks=[tracks]), 0.0), np.zeros((0, 1)), np.zeros((0, 1)))
    none = np.zeros((seen.size, 0))
    R = part.seen.covariance(np.zeros((seen.size, 3)), none)
    J = true.reshape(-1, 1)
    return part, Point(np.zeros(1), Prior(np.zeros(1), np.eye(1)), [(seen - true).ravel()], [J], [R], [(np.zeros((seen.size, 3)), none)], 0)


@pytest.mark.parametrize(("share", "white"), [(0.5, 0.5), (0.0, 0.5), (0.2, 1.5)])
def test_what_lasts_along_tracks_is_told_from_noise(share, white):
    part, point = followed(share, white)
    assert learn_followed(point, [part])
    rms = np.sqrt((part.seen.followed**2).sum(1).reshape(len(STEPS), -1)[len(STEPS) // 2].mean())
    assert rms == pytest.approx(share * MOVES.max() / np.sqrt(2), rel=0.35, abs=0.3)
    assert np.median(part.seen.noise) == pytest.approx(white, rel=0.25)


def test_points_tell_no_more_than_one_of_a_change_that_is_like_what_images_hide():
    part, point = followed(0.0, 0.5, lasting=2.0)
    learn_followed(point, [part])
    R = part.seen.covariance(np.zeros((len(part.seen.values), 3)), part.seen.followed)
    known = float((point.jacobians[0] * R.solve(point.jacobians[0])).sum()) ** -0.5
    assert known > 0.9 * 2.0 / MOVES.max()


def test_nothing_is_learnt_without_images():
    part = Data(Observations(replace(pressed(), forces=np.zeros((24, 3))), 0.0), np.zeros((0, 1)), np.zeros((0, 1)))
    assert not learn_followed(replace(followed(0.0, 0.5)[1], residuals=[np.zeros(72)]), [part])
