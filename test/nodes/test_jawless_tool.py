"""A tool without a jaw, and what its arm publishes."""

import pytest
from ros_bench import tissue_bench

from endo_sim_ros import messages

pytestmark = pytest.mark.dds


def test_a_tool_without_a_jaw_tells_no_angle_of_one():
    shown = messages.tool_jaw_state, messages.tool_jaw_setpoint
    with tissue_bench(messages.tool_reaction("PSM1"), arm_source="commanded", instruments="[PERMANENT_CAUTERY_HOOK, none]") as bench:
        bench.until(lambda: bench.heard["PSM1/body/measured_cf"], "a reaction")
        found = {arm: [bench.nodes[1].count_publishers(topic(arm).name) for topic in shown] for arm in ("PSM1", "PSM2")}
    assert found == {"PSM1": [0, 0], "PSM2": [1, 1]}
