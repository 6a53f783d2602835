"""Every arm with every tool that is shipped, and where the files of the dVRK are."""

from pathlib import Path

import pytest

from endo_sim_ros.instruments import load_arm, tool_names

TOOLS = [name for name in tool_names() if not name.startswith("ENDOSCOPE")]
SCOPES = [name for name in tool_names() if name.startswith("ENDOSCOPE")]
ARMS = [*((arm, tool) for arm in ("PSM", "PSM_Si") for tool in TOOLS), *((arm, scope) for arm in ("ECM", "ECM_Si") for scope in SCOPES)]
_GIVEN = "shared/data/instruments"


@pytest.fixture(scope="session")
def arms():
    return [load_arm(*pair) for pair in ARMS]


@pytest.fixture(scope="session")
def given() -> Path:
    """The folder with ``kinematics/`` and ``psm/`` of others."""
    for folder in Path(__file__).resolve().parents:
        if (folder / _GIVEN).is_dir():
            return folder / _GIVEN
    pytest.skip(f"the files of the dVRK are not at ../{_GIVEN}")
