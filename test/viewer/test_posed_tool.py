"""The instrument that the mouse moves where there is no graph."""

import logging

import numpy as np
import pytest
from dense_sheet import sheet

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments import build_instrument, load_arm
from endo_sim_ros.instruments.urdf import robot_description
from endo_sim_ros.physics import PhysicsConfig
from endo_sim_ros.viewer.config import ViewerConfig

CAMERA = Camera(np.array([[330.0, 0, 330], [0, 330, 200], [0, 0, 1]]), 660, 400)
SOFT = PhysicsConfig(device="cpu", node_count=800, young_modulus=4000.0)
TARGET = np.array([0.005, 0.0, 0.12])


@pytest.fixture
def open_page():
    pytest.importorskip("viser")
    from endo_sim_ros.viewer.standalone import Standalone

    pages = []

    def make(instrument, camera=CAMERA):
        pages.append(Standalone(sheet(), [camera], SOFT, ViewerConfig(port=8350), instrument))
        return pages[-1]

    yield make
    for page in pages:
        page.viewer.stop()


def test_jaws_close_on_tissue_pull_it_and_let_it_go(open_page):
    page = open_page("LARGE_NEEDLE_DRIVER")
    page.viewer.paused = True
    rest = page.simulation.nodes.rest
    assert page.viewer.instruments is not None, "it is seen before it is moved"
    pose, ahead = page.aim(TARGET, np.eye(3))
    assert ahead > 0.01
    for share in np.linspace(1, 0, 6):
        way = pose.copy()
        way[:3, 3] -= share * ahead * pose[:3, 2]
        page.hold(way, False)
        page.step()
    assert np.linalg.norm(page._tool.works_at - TARGET) < 1e-6, "the place between the jaws is where the mouse is"
    page.hold(pose, True)
    page.step()
    for _ in range(10):
        pose[2, 3] -= 0.001
        page.hold(pose, True)
        page.step()
    moved = page.simulation.state().positions - rest
    assert moved[:, 2].min() < -0.004 and page.viewer.tools["mouse"].force[2] < -0.05, "towards the camera"
    page.let_go()
    pose[2, 3] -= 0.03
    for _ in range(60):
        page.hold(pose, False)
        page.step()
    assert not page.viewer.tools and np.abs(page.simulation.state().positions - rest).max() < 1e-3
    start = page._tool.pose
    page.reset()
    assert not np.allclose(page._tool.pose, start) and page.simulation.reaction("mouse")[0].max() == 0


def test_jaws_that_close_on_nothing_say_so(open_page):
    page = open_page("LARGE_NEEDLE_DRIVER")
    pose, _ = page.aim(TARGET - [0, 0, 0.04], np.eye(3))
    page.hold(pose, True)
    assert page.viewer.notice == "nothing here can be held: nothing is between the jaws, or it slips"


def test_where_no_arm_reaches_the_mouse_moves_a_bare_tip(open_page, caplog):
    wide = Camera(np.array([[60.0, 0, 330], [0, 60, 200], [0, 0, 1]]), 660, 400)
    with caplog.at_level(logging.WARNING):
        page = open_page("LARGE_NEEDLE_DRIVER", wide)
    assert "the mouse moves a bare tip: PSM1" in caplog.text
    assert page.viewer.instruments is None and page.aim(TARGET, np.eye(3))[1] == 0


def test_a_urdf_gives_the_shape_of_the_tool(open_page, tmp_path):
    pytest.importorskip("trimesh")
    arm, file = load_arm("PSM", "LARGE_NEEDLE_DRIVER"), tmp_path / "mine.urdf"
    file.write_text(robot_description({"PSM1": (arm, np.eye(4), build_instrument(arm)[1])}))
    page = open_page(f"LARGE_NEEDLE_DRIVER@{file}")
    assert page.viewer.instruments is not None
    assert len(page._tool.capsules) != len(build_instrument(arm)[1])  # one for each link, fitted to its mesh


def test_an_unknown_tool_is_refused(open_page):
    with pytest.raises(ConfigError, match="NO_SUCH_TOOL"):
        open_page("NO_SUCH_TOOL")
