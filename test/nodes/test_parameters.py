"""Options as ROS parameters: what is given counts, whatever its value, at start, in a file and later."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
import rclpy
from rclpy.context import Context
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.parameter import Parameter

from endo_sim_ros.core.config import ConfigError, Range, StageConfig, option_values
from endo_sim_ros.nodes.parameters import ConfiguredNode, _meant_for_others, beside_parameters
from endo_sim_ros.nodes.physics_node import PhysicsNode
from endo_sim_ros.nodes.reconstruction_node import ReconstructionNode
from endo_sim_ros.physics import PhysicsConfig, tissue
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.presets import preset

FILE = Path(__file__).parents[2] / "config" / "endo_sim.yaml"


@dataclass(frozen=True)
class Flow(StageConfig):
    """A stage within another."""

    renamed = {"wrongness": "flow_error"}
    flow_error: Annotated[float, Range(0, 10, "pixels")] = 1.0
    """How far flow may err."""
    levels: Annotated[int, Range(1, 9)] = 3
    """How many."""


@dataclass(frozen=True)
class Example(StageConfig):
    """Two options, and those of another stage."""

    renamed = {"agreement": "multi_view_refinement"}
    multi_view_refinement: bool = True
    """Whether."""
    names: tuple[str, ...] = ("a",)
    """Which."""
    multi_view: Flow = Flow(levels=5)


class ExampleNode(ConfiguredNode):
    """Takes `Example` and remembers what it was told."""

    read_at_start = frozenset({"multi_view.levels"})

    def __init__(self, context):
        super().__init__("example", context)
        self.config = self.declare(Example)

    def config_changed(self, config):
        self.config = config


@pytest.fixture
def start():
    """Makes a node as if its process had been given these ROS arguments; of those of the package there can be one a test."""
    made = []

    def start(node_class, *arguments):
        context = Context() if node_class is ExampleNode else None
        rclpy.init(args=["--ros-args", *arguments], context=context)
        made.append((context, None))
        node = node_class() if context is None else node_class(context)
        made.append((context, node))
        return node

    yield start
    for context, node in reversed(made):
        if node is not None:
            node.destroy_node()
        else:
            rclpy.try_shutdown(context=context)


def set_parameter(node, name, value):
    """Like `ros2 param set`."""
    return node.set_parameters_atomically([Parameter(name, value=value)])


def options_of(node):
    """The options of the reconstruction that the parameters of a node give."""
    values = {name: node.get_parameter(name).value for name in option_values(ReconstructionConfig())}
    config = ReconstructionConfig.from_mapping(values)
    assert node.config == config, "what the node uses is what its parameters say"
    return config


# ----------------------------------------------------------------------------------------------------- nested stages


def test_options_of_a_nested_stage_are_dotted_parameters(start, tmp_path):
    params = tmp_path / "params.yaml"
    params.write_text("/**: {ros__parameters: {multi_view: {levels: 2}, multi_view.flow_error: 0.5}}")
    node = start(ExampleNode, "--params-file", str(params), "-p", "multi_view.levels:=4")
    assert node.config == Example(multi_view=Flow(flow_error=0.5, levels=4))
    descriptor = node.describe_parameter("multi_view.flow_error")
    assert descriptor.description == "How far flow may err." and descriptor.floating_point_range[0].to_value == 10.0
    assert set_parameter(node, "multi_view.flow_error", 2.0).successful
    assert node.config == Example(multi_view=Flow(flow_error=2.0, levels=4))
    refused = set_parameter(node, "multi_view.levels", 6)
    assert not refused.successful and "multi_view.levels: read at start only" in refused.reason
    assert not set_parameter(node, "multi_view.flow_error", 11.0).successful
    assert node.config == Example(multi_view=Flow(flow_error=2.0, levels=4))


def test_unknown_parameters_are_refused_with_the_nearest_name(start):
    node = start(ExampleNode)
    with pytest.raises(ParameterNotDeclaredException, match=r"^unknown parameter flow_error \(did you mean multi_view.flow_error\?\)$"):
        set_parameter(node, "flow_error", 1.0)
    with pytest.raises(ParameterNotDeclaredException, match="^unknown parameter xyzzy$"):
        set_parameter(node, "xyzzy", 1.0)


def test_parameters_by_an_old_name_end_the_node_at_start(start, tmp_path):
    with pytest.raises(ConfigError, match="^the parameter agreement is now multi_view_refinement$"):
        start(ExampleNode, "-p", "agreement:=false")
    params = tmp_path / "params.yaml"
    params.write_text("/**/example: {ros__parameters: {multi_view: {wrongness: 0.5}}}")
    with pytest.raises(ConfigError, match="^the parameter multi_view.wrongness is now multi_view.flow_error$"):
        start(ExampleNode, "--params-file", str(params))


def test_parameters_by_an_old_name_are_refused_later(start):
    node = start(ExampleNode)
    with pytest.raises(ParameterNotDeclaredException, match="^agreement is now multi_view_refinement$"):
        set_parameter(node, "agreement", False)
    assert node.config == Example()


# ----------------------------------------------------------------------------------------------------------- presets


def test_a_parameter_that_equals_the_default_counts_beside_a_preset(start):
    node = start(ReconstructionNode, "-p", "preset:=paper", "-p", "lambda_dist:=0.0", "-p", "sh_degree:=2")
    assert preset("paper").lambda_dist != 0.0
    assert options_of(node) == preset("paper", lambda_dist=0.0, sh_degree=2)


def test_a_preset_counts_beside_the_parameter_file_that_is_installed(start):
    node = start(ReconstructionNode, "--params-file", str(FILE), "-p", "preset:=fsgs")
    assert options_of(node) == preset("fsgs")


def test_a_parameter_file_counts_beside_its_preset(start, tmp_path):
    params = tmp_path / "params.yaml"
    params.write_text("/**: {ros__parameters: {preset: paper, lambda_dist: 0.0, light: true}}")
    node = start(ReconstructionNode, "--params-file", str(params))
    assert options_of(node) == preset("paper", lambda_dist=0.0, light=True)


def test_a_preset_that_is_set_later_changes_what_nobody_gave(start):
    node = start(ReconstructionNode, "-p", "lambda_tv:=0.0")
    assert set_parameter(node, "lambda_dist", 0.0).successful  # as it is already
    assert set_parameter(node, "preset", "paper").successful
    assert options_of(node) == preset("paper", lambda_tv=0.0, lambda_dist=0.0)
    assert set_parameter(node, "light", True).successful
    assert set_parameter(node, "preset", "3dgs").successful
    assert options_of(node) == preset("3dgs", lambda_tv=0.0, lambda_dist=0.0, light=True)
    assert set_parameter(node, "preset", "default").successful
    assert options_of(node) == ReconstructionConfig()


def test_a_parameter_without_effect_is_told_at_start_and_later(start, capfd):
    sentence = "mcmc.growth has no effect while densification is gradient; set densification to mcmc"
    node = start(ReconstructionNode, "-p", "preset:=3dgs-sh0", "-p", "mcmc.growth:=0.1")
    assert sentence in capfd.readouterr().err
    assert set_parameter(node, "densification", "mcmc").successful and set_parameter(node, "seed", 1).successful
    assert not capfd.readouterr().err
    assert set_parameter(node, "densification", "gradient").successful
    assert sentence in capfd.readouterr().err


def test_a_preset_that_does_not_exist_changes_nothing(start):
    node = start(ReconstructionNode, "-p", "preset:=paper")
    refused = set_parameter(node, "preset", "nerf")
    assert not refused.successful and "must be one of default, laptop, paper" in refused.reason
    assert not set_parameter(node, "preset", 3).successful
    assert options_of(node) == preset("paper")


def test_a_tissue_has_its_options_unless_somebody_gave_them(start):
    node = start(PhysicsNode, "--params-file", str(FILE), "-p", "tissue:=liver", "-p", "young_modulus:=4000.0")
    assert node.config == tissue("liver", young_modulus=4000.0)
    assert set_parameter(node, "tissue", "lung").successful and set_parameter(node, "density", 300.0).successful
    assert node.config == tissue("lung", young_modulus=4000.0, density=300.0)
    refused = set_parameter(node, "tissue", "jelly")
    assert not refused.successful and "must be one of default, liver, gall_bladder, lung, fat" in refused.reason
    assert set_parameter(node, "tissue", "default").successful
    assert node.config == PhysicsConfig(young_modulus=4000.0, density=300.0)


def test_a_tissue_can_be_set_where_nobody_gave_a_list(start, tmp_path):
    params = tmp_path / "params.yaml"
    params.write_text("# only a comment")
    node = start(PhysicsNode, "--params-file", str(params))
    assert set_parameter(node, "tissue", "fat").successful and node.config == tissue("fat")
    values = {parameter.name: parameter.value for parameter in node.get_parameters(node.get_parameters_by_prefix(""))}  # as a client does
    assert values["regions"] == [] and values["tissue"] == "fat"


@pytest.mark.parametrize("text", ["# only a comment", "/**:", "/**: {ros__parameters: }"])
def test_a_file_without_parameters_gives_none(tmp_path, monkeypatch, text):
    params = tmp_path / "params.yaml"
    params.write_text(text)
    monkeypatch.setattr("sys.argv", ["physics_node", "--ros-args", "--params-file", str(params)])
    assert beside_parameters("motion.file", "motion.npz") == "motion.npz" and _meant_for_others() == set()


def test_what_was_refused_does_not_count_as_given(start):
    node = start(ReconstructionNode)
    assert not set_parameter(node, "learning_rate", -1.0).successful
    assert not set_parameter(node, "device", "tpu").successful
    assert set_parameter(node, "preset", "laptop").successful
    assert options_of(node) == preset("laptop")


@pytest.mark.parametrize(
    "arms, sentence",
    [("[]", "the list is empty"), ("[PSM1, PSM2, ' PSM1']", "PSM1 is there 2 times"), ("['']", "'' cannot name topics")],
    ids=["none", "twice", "nameless"],
)
def test_arms_without_a_name_of_their_own_end_the_node_at_start(arms, sentence):
    rclpy.init(args=["--ros-args", "-p", f"arms:={arms}"])
    try:
        with pytest.raises(ConfigError, match=f"^arms: {sentence}"):
            PhysicsNode()
    finally:
        rclpy.shutdown()
