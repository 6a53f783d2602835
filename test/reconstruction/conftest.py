"""Fixtures of the tests of reconstruction."""

import pytest
from short_training import film

from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence


@pytest.fixture(scope="session")
def small():
    """Nine frames of the phantom, 160×128, with exact depth and stereo."""
    return film(160, 128, 9)


@pytest.fixture(scope="session")
def large():
    """Four frames of the phantom, 640×512, for matching."""
    return film(640, 512, 4)


@pytest.fixture(scope="session")
def views():
    """Nine frames 160×128 of half a round about the phantom, the exposure of the camera automatic."""
    return list(phantom_sequence(PhantomConfig(width=160, height=128, frames=9, rounds=0.5, auto_exposure=True, border=0.04)))
