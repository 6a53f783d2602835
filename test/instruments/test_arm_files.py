"""Parameter files: ours say what the dVRK's say, and bad ones are refused in a sentence."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments import arm_names, load_arm, save_tool, tool_names

JOINT = {"name": "roll", "type": "revolute", "alpha": 0, "A": 0, "D": 0.4, "qmin": -1, "qmax": 1}


def test_arms_and_tools_have_the_names_of_the_dvrk():
    assert arm_names() == ["ECM", "ECM_Si", "PSM", "PSM_Si"]
    kinds = "LARGE_NEEDLE_DRIVER", "PROGRASP_FORCEPS", "MARYLAND_BIPOLAR_FORCEPS", "CURVED_SCISSORS", "PERMANENT_CAUTERY_HOOK"
    assert {name.rpartition("_")[0] for name in tool_names()} == {*kinds, "LARGE_CLIP_APPLIER", "ENDOSCOPE"}


@pytest.mark.parametrize(
    "arm, tool, loaded",
    [
        ("PSM", "", "LARGE_NEEDLE_DRIVER_400006"),
        ("PSM_Si", "", "LARGE_NEEDLE_DRIVER_420006"),
        ("PSM_Si", "PROGRASP_FORCEPS", "PROGRASP_FORCEPS_420093"),
        ("PSM", "PROGRASP_FORCEPS:420093", "PROGRASP_FORCEPS_420093"),
        ("ECM", "", "ENDOSCOPE_STRAIGHT"),
        ("ECM_Si", "ENDOSCOPE_UP", "ENDOSCOPE_UP"),
    ],
)
def test_a_tool_without_its_number_is_that_for_the_arm(arm, tool, loaded):
    assert load_arm(arm, tool).tool == loaded


def test_shipped_numbers_are_those_of_the_dvrk(given):
    compared = 0
    for path in sorted((given / "kinematics").glob("*.json")):
        if path.stem in arm_names():
            ours, theirs = load_arm(path.stem), load_arm(str(path))
        elif path.stem in tool_names():
            ours, theirs = load_arm("PSM_Si", path.stem), load_arm("PSM_Si", str(path))
        else:
            continue
        assert replace(ours, tooltip_offset=0, coupling=0) == replace(theirs, tooltip_offset=0, coupling=0)
        np.testing.assert_array_equal(ours.tooltip_offset, theirs.tooltip_offset)
        np.testing.assert_array_equal(ours.coupling, theirs.coupling)
        compared += 1
    assert compared == 9


def test_tools_of_the_dvrk_that_are_not_shipped_are_read(given):
    arm = load_arm("PSM_Si", str(given / "kinematics" / "FENESTRATED_BIPOLAR_FORCEPS_420205.json"))
    assert (arm.tool, arm.jaw, arm.joints[5].a) == ("FENESTRATED_BIPOLAR_FORCEPS_420205", (-0.698132, 1.39626), 0.0107)


def test_files_may_have_comments_older_names_and_last_commas(tmp_path):
    text = """/* a tool
    // of ours */ {"DH": {"links": [ // joints
      {"name": "roll // or not", "convention": "modified", "type": "revolute", "alpha": 0, "A": 0, "D": 0.4, "qmin": -1, "qmax": 1},
      {"name": "wrist_pitch", "convention": "modified", "type": "revolute", "alpha": -1.5708, "A": 0, "D": 0, "offset": -1.5708, "qmin": -1, "qmax": 1},
      {"name": "wrist_yaw", "convention": "modified", "type": "revolute", "alpha": -1.5708, "A": 0.01, "D": 0, "offset": -1.5708, "qmin": -1, "qmax": 1},
    ]}, "tooltip-offset": [[1, 0, 0, 0], [0, 1, 0, 0.01], [0, 0, 1, 0], [0, 0, 0, 1]],}"""  # noqa: E501
    (tmp_path / "mine.json").write_text(text)
    arm = load_arm("PSM", str(tmp_path / "mine.json"))
    assert (arm.tool, arm.joints[3].name, arm.jaw, arm.coupling) == ("mine", "roll // or not", None, None)
    assert arm.joints[4].alpha == -np.pi / 2, "1.5708 means a right angle"
    assert arm.tip_pose(np.zeros(6))[2, 3] == pytest.approx(0.4318 - 0.4 - 0.01 - 0.01)


def test_a_rounded_tooltip_offset_is_made_a_rotation(tmp_path):
    rows = [[0, -0.866, 0.5, 0], [1, 0, 0, 0], [0, 0.5, 0.866, 0.18], [0, 0, 0, 1]]
    (tmp_path / "scope.json").write_text(json.dumps({"tooltip_offset": rows}))
    offset = load_arm("ECM", str(tmp_path / "scope.json")).tooltip_offset
    np.testing.assert_allclose(offset[:3, :3] @ offset[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(offset, rows, atol=1e-4)


@pytest.mark.parametrize("tool", ["PROGRASP_FORCEPS", "PERMANENT_CAUTERY_HOOK"])
def test_a_tool_with_another_tip_is_saved_and_loaded(tool, tmp_path):
    arm = load_arm("PSM", tool)
    moved = np.eye(4)
    moved[:3, 3] = 0.001, 0.002, 0.01
    arm = replace(arm, tooltip_offset=arm.tooltip_offset @ moved)
    save_tool(tmp_path / f"{arm.tool}.json", arm)
    loaded = load_arm("PSM", str(tmp_path / f"{arm.tool}.json"))
    assert replace(loaded, tooltip_offset=0, coupling=0) == replace(arm, tooltip_offset=0, coupling=0)
    np.testing.assert_allclose(loaded.tooltip_offset, arm.tooltip_offset, atol=1e-15)
    np.testing.assert_array_equal(loaded.coupling, arm.coupling)


def test_discs_turn_joints_and_back(arms):
    discs = np.random.default_rng(0).normal(size=(7, 4))
    for arm in arms:
        if arm.coupling is None:
            with pytest.raises(ValueError, match=f"{arm.tool}: its parameter file gives no coupling"):
                arm.joints_of_discs(discs)
            continue
        joints = arm.joints_of_discs(discs)
        np.testing.assert_allclose(joints[2], arm.coupling @ discs[2])
        np.testing.assert_allclose(arm.discs_of_joints(joints), discs, atol=1e-12)


def test_only_the_hook_has_no_jaw(arms):
    assert {arm.tool[:-7] for arm in arms if arm.jaw is None and len(arm.joints) == 6} == {"PERMANENT_CAUTERY_HOOK"}


@pytest.mark.parametrize(
    "arm, tool, sentence",
    [
        ("MTM", "", "arm must be the path of a .json file or one of ECM, ECM_Si, PSM, PSM_Si, got 'MTM'"),
        ("PSM", "psm.urdf", "psm.urdf: a URDF has the shape of a tool alone; .* as LARGE_NEEDLE_DRIVER@psm.urdf"),
        ("PSM", "SPOON", "tool must be the path of a .json file or one of CURVED_SCISSORS_400178, .*, got 'SPOON'"),
        ("PSM", "no/where.json", "no/where.json: there is no such file; tool is the path"),
        ("PSM", "ENDOSCOPE_UP", "PSM and ENDOSCOPE_UP: together they have 3 joints, but an arm with its tool has 6"),
        ("ECM", "LARGE_NEEDLE_DRIVER", "together they have 7 joints"),
    ],
)
def test_what_is_not_there_is_told_with_what_is(arm, tool, sentence):
    with pytest.raises(ConfigError, match=sentence):
        load_arm(arm, tool)


@pytest.mark.parametrize(
    "change, sentence",
    [
        ("{", "bad.json: not a readable kinematic file, which is JSON with comments"),
        ("[1]", "expected an object, got a list"),
        ("[" * 100_000, "not a readable kinematic file"),
        ({"DH": {}}, "neither DH.joints nor a tooltip_offset"),
        ({"DH": {"convention": "modified", "joints": [3]}}, "DH must be an object with a list of joints"),
        ({"DH": {"convention": "standard", "joints": [JOINT]}}, r"joint 1 \(roll\): convention must be 'modified', got 'standard'"),
        ({"type": "helical"}, r"joint 1 \(roll\): type must be 'revolute' or 'prismatic', got 'helical'"),
        ({"mode": "passive"}, "mode must be 'active', got 'passive'"),
        ({"alpha": None}, r"joint 1 \(roll\): alpha must be a finite number \(m, rad\), got None"),
        ({"D": float("nan")}, "D must be a finite number"),
        ({"qmin": True}, "qmin must be a finite number"),
        ({"qmax": -1}, "qmin -1 must be below qmax -1"),
        ({"D": 467.0}, r"joint 1 \(roll\): D is 467, but no arm has more than 2 metres; give it in metres"),
        ({"qmin": -260.0, "qmax": 260.0}, "qmin is -260, but no arm has more than 12.6 radians; give it in radians"),
        ({"jaw": {"qmin": -20, "qmax": 80}}, "jaw: qmin is -20, but no arm has more than 12.6 radians"),
        (
            {"tooltip_offset": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 10.2], [0, 0, 0, 1]]},
            "tooltip_offset moves the tip by .*; give it in metres",
        ),
        (
            {"A": 0.1},
            "PSM and bad: joint roll is revolute with a 0.1, where a PSM or ECM has a revolute joint with 0;",
        ),
        ({"type": "prismatic"}, "joint roll is prismatic"),
        ({"tooltip_offset": [[1, 2], [3]]}, "tooltip_offset must be four rows of four finite numbers"),
        ({"tooltip_offset": (2 * np.eye(4)).tolist()}, "tooltip_offset must be a rotation and a position"),
        ({"coupling": {}}, "coupling: ActuatorToJointPosition must be four rows of four finite numbers, got None"),
        ({"coupling": {"ActuatorToJointPosition": np.ones((4, 4)).tolist()}}, "ActuatorToJointPosition has no inverse"),
        ({"jaw": 3}, "jaw must be an object with qmin and qmax, got 3"),
        ({"jaw": {"qmin": 0}}, "jaw: qmax must be a finite number"),
    ],
)
def test_a_malformed_file_is_one_sentence(tmp_path, change, sentence):
    text = change
    if isinstance(change, dict):
        wrists = [JOINT | {"name": name, "alpha": -1.5708, "offset": -1.5708, "D": 0} for name in ("wrist_pitch", "wrist_yaw")]
        on_joint = not change.keys() & {"DH", "tooltip_offset", "coupling", "jaw"}
        fields = {"DH": {"convention": "modified", "joints": [JOINT | change if on_joint else JOINT, *wrists]}}
        text = json.dumps(fields if on_joint else fields | change)
    (tmp_path / "bad.json").write_text(text)
    with pytest.raises(ConfigError, match=sentence) as caught:
        load_arm("PSM", str(tmp_path / "bad.json"))
    assert "\n" not in str(caught.value) and re.search("bad", str(caught.value))
