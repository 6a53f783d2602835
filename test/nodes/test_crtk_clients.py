"""The Python clients of CRTK and of the dVRK, as they are published, against the arms of physics_node.

They are found in a sourced workspace, or as checkouts `crtk_python_client` and `dvrk_python` in the folder CRTK_SOURCES (default:
beside this repository). They need PyKDL and crtk_msgs.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from ros_bench import tissue_bench

from endo_sim_ros.instruments import load_arm

pytestmark = [pytest.mark.dds, pytest.mark.slow]

ROOT = Path(os.environ.get("CRTK_SOURCES", Path(__file__).parents[3]))
SOURCES = [str(path) for name in ("crtk_python_client", "dvrk_python") if (path := ROOT / name / "src").is_dir()]

CLIENT = """
import json, time
import crtk, dvrk, numpy, PyKDL

ral = crtk.ral("client")
psm, ecm = dvrk.psm(ral, "PSM1"), dvrk.ecm(ral, "ECM")
ral.spin()
ral.check_connections(10)  # of all topics that both wait for

def after(move):  # topics overtake one another
    done = move.wait(timeout=10)
    time.sleep(0.1)
    return done

told = {"enabled": any(psm.enable(2) for _ in range(5))}  # what is sent before the topics have found one another is lost
told["homed"] = any(psm.home(2) for _ in range(5)) and any(ecm.home(2) for _ in range(5))
start = psm.measured_jp(wait_timeout=5)[0]
told["moved"] = after(psm.move_jp(start))  # to where it is
goal = start + numpy.array([0.1, -0.1, 0.02, 0.2, 0.1, -0.1])
told["moved"] &= after(psm.move_jp(goal))
told["joints"] = [list(goal), list(psm.measured_jp()[0])]
position, velocity, effort, _ = psm.measured_js()
told["lengths"] = [len(position), len(velocity), len(effort)]
told["moved"] &= after(psm.insert_jp(0.1))
frame = PyKDL.Frame(psm.measured_cp()[0])
frame.p += PyKDL.Vector(0.01, 0.0, -0.01)
told["moved"] &= after(psm.move_cp(frame))
told["offset"] = (psm.measured_cp()[0].p - frame.p).Norm()
told["moved"] &= after(psm.jaw.close())
told["closed"] = float(psm.jaw.measured_jp()[0][0])
told["moved"] &= after(psm.jaw.open())
camera = ecm.measured_jp()[0] + numpy.array([0.05, 0.02, 0.01, 0.1])
told["moved"] &= after(ecm.move_jp(camera))
told["camera"] = [list(camera), list(ecm.measured_jp()[0])]
start = psm.measured_jp()[0]
psm.servo_jr(numpy.array([0.02, 0, 0, 0, 0, 0]))
told["moved"] &= after(psm.move_jr(numpy.array([-0.01, 0, 0, 0, 0, 0])))
told["changed"] = float(psm.measured_jp()[0][0] - start[0])
psm.trajectory_j_set_ratio(0.2)
for _ in range(100):
    time.sleep(0.02)
    if psm.trajectory_j_get_ratio() == 0.2:
        break
told["ratio"] = psm.trajectory_j_get_ratio()
start = psm.measured_jp()[0]
for stop in (psm.hold, psm.free):
    before = psm.measured_jp()[0][0]
    moving = psm.move_jr(numpy.array([0.3, 0, 0, 0, 0, 0]))
    moving.wait(is_busy=True, timeout=10)
    for _ in range(500):  # it is busy before its first step
        if abs(psm.measured_jp()[0][0] - before) > 0:
            break
        time.sleep(0.02)
    stop()
    told["moved"] &= after(moving)
told["held"] = float(psm.measured_jp()[0][0] - start[0])
told["jacobians"] = [arm.jacobian(wait_timeout=5)[0].tolist() for arm in (psm.body, psm.spatial)]
told["joints at the end"] = list(psm.measured_jp()[0])
told["local"] = list(psm.local.measured_cp()[0].p)
told["disabled"] = psm.disable(10)
print(json.dumps(told, default=float))
ral.shutdown()
"""


@pytest.fixture
def graph(monkeypatch):
    for path in SOURCES:
        monkeypatch.syspath_prepend(path)
    for package in ("PyKDL", "crtk_msgs.msg", "crtk", "dvrk"):
        pytest.importorskip(package, reason=f"needs {package}: source a workspace of the dVRK, or set CRTK_SOURCES")
    with tissue_bench(arms="[PSM1, ECM]", arm_source="commanded", cartesian_frame="ECM_view") as bench:
        yield bench


def test_unmodified_clients_command_the_arms(graph):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*SOURCES, os.environ.get("PYTHONPATH", "")]), "ROS_VERSION": "2"}
    process = subprocess.Popen([sys.executable, "-c", CLIENT], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        graph.until(lambda: process.poll() is not None, "the client to end", 60)
    finally:
        process.kill()
    out, err = process.communicate()
    assert process.returncode == 0, err + out
    told = json.loads(out.splitlines()[-1])
    assert all(told[what] for what in ("enabled", "homed", "moved", "disabled")), told
    assert told["lengths"] == [6, 6, 6]
    for goal, there in (told["joints"], told["camera"]):
        np.testing.assert_allclose(there, goal, atol=1e-9)
    assert told["offset"] < 1e-9 and told["closed"] == pytest.approx(np.radians(-20))
    assert told["changed"] == pytest.approx(0.01) and told["ratio"] == 0.2
    assert 0 < told["held"] < 0.5, "two moves of 0.3 rad that were ended"
    psm, joints = load_arm("PSM", "LARGE_NEEDLE_DRIVER"), told["joints at the end"]
    np.testing.assert_allclose(told["jacobians"], [psm.body_jacobian(joints), psm.spatial_jacobian(joints)], atol=1e-9)
    np.testing.assert_allclose(told["local"], psm.tip_pose(told["joints at the end"])[:3, 3], atol=1e-6)
