"""Fixtures of the tests of learning."""

import pytest
from made_recordings import realtime


@pytest.fixture(scope="session")
def bag(tmp_path_factory):
    return realtime(tmp_path_factory.mktemp("recordings") / "realtime")


@pytest.fixture(scope="session")
def two_arms(tmp_path_factory):
    return realtime(tmp_path_factory.mktemp("recordings") / "two", arms=("PSM1", "PSM2"))
