"""What the scripted tool does by what it feels, in tissue that is a spring, felt a while later; and where its shaft may go."""

import numpy as np
import pytest

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import Camera, intrinsic_matrix
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments import load_arm, place_arm
from endo_sim_ros.instruments.urdf import robot_description
from endo_sim_ros.messages import ScriptedToolState
from endo_sim_ros.nodes.aimed_tool import AimedTool
from endo_sim_ros.nodes.configs import ScriptedToolConfig
from endo_sim_ros.nodes.scripted_motion import ScriptedMotion

SLOPE = np.array([0.6, 0.0, 0.8])  # way of a tool into tissue that faces the camera, down the z axis
SINCE, LATE = 0.02, 6  # s from command to command; commands after which a force is felt: three steps of physics


def play(config, stiffness, early=0.0, pauses=(), interval=SINCE, distance=0.1):
    """What the spring exerts [N, 3], N, and places of the tip [N, 3], m, at each command, and what the tool did then.

    The tip meets the spring some metres early, where it can press only; closed jaws hold it where they closed. Pauses are commands that
    come 2 s late. The lens is at a distance, m.
    """
    pose = np.eye(4)
    pose[:3, :3] = np.stack([[0.8, 0.0, -0.6], [0.0, 1.0, 0.0], SLOPE], 1)
    motion = ScriptedMotion(pose, np.array([0.0, 0.0, -distance]), np.array([1.0, 0.0, 0.0]))
    forces, places, states, held = [np.zeros(3)] * LATE, [], [], False
    while not states or states[-1] is not ScriptedToolState.DONE:
        since = 2.0 if len(states) in pauses else interval if states else 0.0
        pose, angle, state = motion.command(config, since, forces[-LATE])
        places.append(pose[:3, 3])
        held = angle == 0.0
        pressed = -stiffness * (places[-1] + early * SLOPE)  # of a spring that is at rest so much before the place where it takes hold
        forces.append(pressed if held else min(pressed @ SLOPE, 0.0) * SLOPE)
        states.append(state)
    return np.array(forces[LATE:]), np.array(places), states


@pytest.mark.parametrize("stiffness, early", [(150, 0.0), (150, 0.01), (300, 0.01), (1000, 0.0)])  # tissue of 10 kPa has 100 to 500 N/m
@pytest.mark.parametrize("force", [0.5, 2.0])
def test_the_tool_keeps_to_the_force_in_soft_and_in_stiff_tissue(stiffness, force, early):
    forces, _, states = play(ScriptedToolConfig(force=force), stiffness, early)
    sizes = np.linalg.norm(forces, axis=1)
    assert sizes.max() < 1.2 * force
    swinging = np.array([state is ScriptedToolState.SWINGING for state in states])
    assert sizes[swinging].min() > 0.8 * force


def test_a_tool_that_nothing_resists_pulls_two_centimetres_in_the_time_given():
    config = ScriptedToolConfig(pull=3.0)
    _, places, states = play(config, 0.0)
    lengths = np.linalg.norm(places, axis=1)
    assert lengths[states.index(ScriptedToolState.SWINGING)] == pytest.approx(0.02, rel=0.05)
    assert lengths[0] == pytest.approx(0.02) and lengths[int(2.3 / SINCE)] < 1e-9  # from before the tissue to it
    assert places[-1] @ SLOPE < -0.02  # and back


def test_tissue_near_the_lens_is_pulled_by_a_quarter_of_the_way_to_it():
    _, places, states = play(ScriptedToolConfig(), 0.0, distance=0.015)
    pulled = np.linalg.norm(places, axis=1)[[state is ScriptedToolState.SWINGING for state in states]]
    assert pulled.max() == pytest.approx(0.015 / 4) and pulled.min() > 0.9 * 0.015 / 4


def test_the_slowest_rate_takes_no_more_time():
    config = ScriptedToolConfig(rate=10.0)
    lasted = [interval * len(play(config, 0.0, interval=interval)[2]) for interval in (SINCE, 1 / config.rate)]
    assert lasted[1] == pytest.approx(lasted[0], abs=0.3)
    with pytest.raises(ConfigError, match="rate"):  # each command would count as a late one
        ScriptedToolConfig(rate=5.0)


@pytest.mark.parametrize("late", [20, 150, 300])
def test_a_late_command_makes_no_leap(late):
    _, places, _ = play(ScriptedToolConfig(), 300.0, pauses=[late])
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 0.004


CAMERA = Camera(intrinsic_matrix(200, 200, 160, 128), 320, 256)
RIDGE = 0.05  # m from the camera, in the lower right, from where PSM1 comes; the tissue behind is twice as far


def picture():
    depth = np.full((CAMERA.height, CAMERA.width), 0.1)
    depth[150:, 190:] = RIDGE
    return depth


def test_a_shaft_goes_through_no_tissue_that_is_seen():
    arm, tool = load_arm("PSM", "LARGE_NEEDLE_DRIVER"), AimedTool("PSM1")
    depth, pixels = picture(), np.array([[128, 160], [128, 40], [200, 250], [100, 300]])  # row, column; the first two behind the ridge
    targets = CAMERA.backproject(depth)[pixels[:, 0], pixels[:, 1]]
    assert tool.has_way(targets, CAMERA, depth).all()  # a bare tip has no shaft
    base = place_arm("PSM1", arm, CAMERA, 0.1).base
    tool.receive_type(messages.encode_text("LARGE_NEEDLE_DRIVER:400006"))
    tool.receive_description(messages.encode_text(robot_description({"PSM1": (arm, base, ())})))
    assert tool.has_way(targets, CAMERA, depth).tolist() == [False, False, True, True]
    assert tool.has_way(targets[[0, 1, 3]], CAMERA, np.full_like(depth, 0.1)).all()  # without the ridge
    assert tool.has_way(targets, CAMERA, np.zeros_like(depth)).all()  # of what is not seen nobody knows
