"""The task in which a fold hides a place."""

import numpy as np
import pytest

from endo_sim_ros.core.dye import DyedSpot
from endo_sim_ros.learning.config import SightConfig
from endo_sim_ros.learning.policies import scripted_policy
from endo_sim_ros.learning.scenes import load_scene
from endo_sim_ros.learning.task_batch import TaskBatch
from endo_sim_ros.learning.tasks import Exposure
from endo_sim_ros.learning.tasks.exposure import hidden_by

COUNT = 12


@pytest.mark.thorough
@pytest.mark.slow
def test_what_nodes_say_is_hidden_and_seen_is_so_in_pictures(monkeypatch):
    """By the pixels that a small spot of dye at the place changes, of the tissue alone."""
    monkeypatch.setattr(Exposure, "dyed_spots", lambda task, b: (DyedSpot(task.rest[task.sites[b, 0]].copy(), 0.002),))
    scene = load_scene("phantom:3")
    sights = [SightConfig(image_width=256, instrument=False, dye=dye) for dye in (True, False)]
    dyed, plain = batches = [TaskBatch("exposure", scene, COUNT, sight=sight, device="cpu", images=True) for sight in sights]
    for batch in batches:
        batch.reset(range(COUNT), [np.random.default_rng(b) for b in range(COUNT)])
        batch.observe()

    def pixels():
        changed = np.abs(dyed.images().astype(int) - plain.images()).max(3) > 15
        return changed.sum((1, 2))

    hidden, script = pixels(), scripted_policy("exposure", COUNT)
    assert (dyed.task.sites[:, 0] != dyed.task.sites[:, 1]).all()
    seen, going = np.zeros(COUNT, int), np.ones(COUNT, bool)
    while going.any():
        actions = script.act(dyed.state())
        outcome, _ = (batch.step(actions)[1] for batch in batches)
        ended = (outcome.terminated | outcome.truncated) & going
        if ended.any():
            seen[ended] = np.where(outcome.success, pixels(), 0)[ended]
        going &= ~ended
    assert np.median(hidden) == 0 and (seen > hidden).mean() > 0.8


def test_a_place_is_hidden_until_it_is_higher_than_the_face_before_it():
    here = np.array([[[0, 0, -0.02], [-0.01, -0.01, 0], [0.01, -0.01, 0], [0, 0.0024, 0.0]]])  # the place, and a triangle before it
    corners = np.array([[[1, 2, 3], [0, 0, 0]]])
    eye = np.array([[0, 0, 10.0]])  # far away: lines of sight are parallel
    np.testing.assert_allclose(hidden_by(eye, here, corners), 0.0025, atol=1e-12)
    here[0, 1:, 1] -= 0.0025
    assert hidden_by(eye, here, corners) == 0
    here[0, 1:] = [0, 0.003, 0.0] - here[0, 1:]
    here[0, 1:, 2] = -0.03  # behind the place
    assert hidden_by(eye, here, corners) == 0


def test_a_scene_without_folds_is_refused(monkeypatch):
    monkeypatch.setattr(Exposure, "least", 0.02)
    with pytest.raises(ValueError, match="exposure: no place in the scene is hidden behind a fold; take one with more relief"):
        TaskBatch("exposure", load_scene(), device="cpu")
