"""Fixtures of the tests of learning."""

import numpy as np
import pytest
from made_recordings import realtime

from endo_sim_ros.core.cameras import save_cameras
from endo_sim_ros.core.gaussians import save_ply
from endo_sim_ros.learning.scenes import load_scene


@pytest.fixture(scope="session")
def bag(tmp_path_factory):
    return realtime(tmp_path_factory.mktemp("recordings") / "realtime")


@pytest.fixture(scope="session")
def two_arms(tmp_path_factory):
    return realtime(tmp_path_factory.mktemp("recordings") / "two", arms=("PSM1", "PSM2"))


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    """File of a scene that is too small for retraction."""
    whole, path = load_scene("phantom:0"), tmp_path_factory.mktemp("small") / "model.ply"
    save_ply(whole.model.select(np.flatnonzero(np.linalg.norm(whole.model.means[:, :2], axis=1) < 0.012)), path)
    save_cameras(whole.cameras, path.with_name("cameras.json"))
    return str(path)
