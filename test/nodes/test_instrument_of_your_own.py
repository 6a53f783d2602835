"""A URDF named beside the tool of an arm is what is drawn and what touches."""

import numpy as np
import pytest

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments import build_instrument, load_arm
from endo_sim_ros.instruments.urdf import robot_description
from endo_sim_ros.instruments.urdf_reader import load_shape
from endo_sim_ros.nodes.arm_setup import make_arms
from endo_sim_ros.nodes.configs import PhysicsNodeConfig


@pytest.mark.parametrize(("model", "tool"), [("PSM", "LARGE_NEEDLE_DRIVER:400006"), ("PSM_Si", "PROGRASP_FORCEPS:420093")])
def test_the_file_goes_from_the_options_to_who_draws(tmp_path, model, tool):
    arm, file = load_arm(model, tool), tmp_path / "mine.urdf"
    file.write_text(robot_description({"PSM1": (arm, np.eye(4), build_instrument(arm)[1])}))
    made = make_arms(PhysicsNodeConfig(instruments=(f"{tool}@{file}",), arm_models=(model,), link_contact=True))["PSM1"]
    assert made.tool_type == f"{tool}@{file}"
    parts, capsules = load_shape(made.tool_type)
    assert {part.link for part in parts} == {capsule.link for capsule in made.capsules} == {capsule.link for capsule in capsules}
    assert len(made.capsules) != len(build_instrument(arm)[1])  # one for each link, fitted to its mesh


def test_a_file_that_cannot_be_used_is_one_sentence(tmp_path):
    with pytest.raises(ConfigError, match=r"gone\.urdf: this is no readable URDF: .*No such file"):
        make_arms(PhysicsNodeConfig(instruments=(f"LARGE_NEEDLE_DRIVER@{tmp_path / 'gone.urdf'}",)))
