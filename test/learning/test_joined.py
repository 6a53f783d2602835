"""Environments of several scenes as one: each is what it is alone, here and in workers."""

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="environments need gymnasium")

from endo_sim_ros.learning.environments import TaskEnvironment, VectorTaskEnvironment  # noqa: E402
from endo_sim_ros.learning.joined import JoinedEnvironments  # noqa: E402

SCENES = ["phantom:0", "phantom:1"]


def play(environment, count, steps=8):
    """Everything that a few steps return, from seed 5 on."""
    rng = np.random.default_rng(0)
    returned = [*environment.reset(seed=5)]
    for _ in range(steps):
        returned += environment.step(rng.uniform(-1, 1, (5, 4))[:count])
    return returned


def same(a, b, of=slice(None)):
    """Whether results are equal bit for bit, one being a part of the other."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[name], b[name], of) for name in a)
    return np.array_equal(a, b[of])


@pytest.mark.slow
def test_environments_of_several_scenes_are_what_they_are_alone():
    joined = JoinedEnvironments("retraction", 5, SCENES, observations="both", image_width=32, device="cpu")
    assert joined.num_envs == 5 and joined.observation_space["image"].shape == (5, 26, 32, 3)
    together = play(joined, 5)
    first = play(VectorTaskEnvironment("retraction", 3, scene=SCENES[0], observations="both", image_width=32, device="cpu"), 3)
    assert all(same(a, b, slice(0, 3)) for a, b in zip(first, together))
    alone = TaskEnvironment("retraction", SCENES[1], observations="both", image_width=32, device="cpu")
    observed, _ = alone.reset(seed=5 + 4)
    assert same(observed, together[0], 4)


def test_episodes_are_renewed_where_they_are():
    joined = JoinedEnvironments("retraction", 4, SCENES, device="cpu")
    before, _ = joined.reset(seed=1)
    moved, *_ = joined.step(np.ones((4, 4)))
    renewed = joined.renew(np.array([0, 3]))
    assert (
        np.array_equal(renewed[1:3], moved[1:3]) and not np.array_equal(renewed[0], moved[0]) and not np.array_equal(renewed[3], moved[3])
    )
    again, _ = joined.reset(seed=1, options={"reset_mask": [True, False, True, False]})
    assert np.array_equal(again[[0, 2]], before[[0, 2]]) and np.array_equal(again[3], renewed[3])
    with pytest.raises(ValueError, match="4 environments need as many seeds, got 3"):
        joined.reset(seed=[1, 2, 3])
    with pytest.raises(ValueError, match="the action of environment 3 is not finite"):
        joined.step(np.where(np.arange(4)[:, None] == 3, np.nan, np.zeros((4, 4))))
    assert np.array_equal(joined.renew(np.array([], int)), again)  # nothing has moved
    with pytest.raises(ValueError, match=r"4 environments need as many actions, of 4 numbers, got the shape \(2, 4\)"):
        joined.step(np.ones((2, 4)))


def test_what_cannot_be_divided_is_refused():
    with pytest.raises(ValueError, match="1 environments cannot be divided among 1 workers with 2 scenes each"):
        JoinedEnvironments("retraction", 1, SCENES)
    with pytest.raises(ValueError, match="workers is -1; give a number of processes, or 0 for this one"):
        JoinedEnvironments("retraction", 2, workers=-1)


def test_workers_without_ray_say_what_to_install():
    try:
        import ray  # noqa: F401
    except ImportError:
        with pytest.raises(RuntimeError, match=r"workers need Ray, which is not installed; pip install 'endo_sim_ros\[ray\]'"):
            JoinedEnvironments("retraction", 2, workers=2, device="cpu")
    else:
        pytest.skip("Ray is installed")


@pytest.mark.slow
def test_workers_of_ray_give_the_same_bits():
    ray = pytest.importorskip("ray", reason="workers need Ray")
    ray.init(num_cpus=2, num_gpus=0, include_dashboard=False, log_to_driver=False)
    try:
        with pytest.raises(ValueError, match="3 workers need a CPU each, but Ray knows of 2; give fewer workers"):
            JoinedEnvironments("retraction", 6, workers=3, device="cpu")
        workers = JoinedEnvironments("retraction", 5, workers=2, device="cpu")
        assert all(same(a, b) for a, b in zip(play(workers, 5), play(VectorTaskEnvironment("retraction", 5, device="cpu"), 5)))
        with pytest.raises(ValueError, match="the action of environment 1 is not finite"):
            workers.step(np.where(np.arange(5)[:, None] == 1, np.nan, np.zeros((5, 4))))
        ray.kill(workers._parts[0]._hosted)
        with pytest.raises(RuntimeError, match="a worker with environments ended .*; make them again"):
            workers.step(np.zeros((5, 4)))
    finally:
        ray.shutdown()
