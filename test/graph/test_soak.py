"""The graph under random traffic."""

import pytest
from forked_nodes import ForkedNodes

from endo_sim_ros.graph import soak

pytestmark = pytest.mark.dds


class SmallNodes(ForkedNodes):
    """The model at the end is made without the stages that take longest."""

    def start(self, name, *ros_arguments, **parameters):
        stages = {"plane_sweep": False, "extrapolation": 0.0} if name == "reconstruction_node" else {}
        return super().start(name, *ros_arguments, **parameters, **stages)


@pytest.mark.thorough
@pytest.mark.slow
def test_the_graph_lives_and_works_after_three_seconds_of_random_traffic(tmp_path, monkeypatch):
    monkeypatch.setattr(soak, "NodeGroup", SmallNodes)
    rows = {row.name: row.value for row in soak.soak(tmp_path / "soak.json", minutes=3 / 60, seed=7)}
    assert rows["nodes that died"] == 0 and rows["messages sent"] > 100 and rows["of them spoilt"] > 25, rows
    assert (tmp_path / "soak.json").exists()
