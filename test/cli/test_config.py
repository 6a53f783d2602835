"""Configurations: one source for defaults, ranges and words."""

import operator
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

import pytest
import tyro
import yaml

from endo_sim_ros import cli
from endo_sim_ros.core.config import (
    ConfigError,
    Range,
    StageConfig,
    option_values,
    options,
    refuse_renamed_flags,
    renamed_options,
    unused_options,
)
from endo_sim_ros.nodes.configs import NODE_CONFIGS
from endo_sim_ros.nodes.parameter_file import parameter_file
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.tissues import TISSUES, Tissue, tissue
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.presets import PRESETS, Preset, preset
from endo_sim_ros.reconstruction.strategies import STRATEGIES

ALL = [config for configs in NODE_CONFIGS.values() for config in configs]
FILE = Path(__file__).parents[2] / "config" / "endo_sim.yaml"


@dataclass(frozen=True)
class Example(StageConfig):
    """An example."""

    count: Annotated[int, Range(1, 5)] = 2
    """How many."""
    length: Annotated[float, Range(0, 1, "m")] = 0.5
    """How long."""
    kind: Literal["a", "b"] = "a"
    """Which."""
    on: bool = True
    """Whether
    or not."""


def test_options_know_type_default_range_and_words():
    count, length, kind, on = options(Example)
    assert count == ("count", int, 2, "How many.", Range(1, 5), None)
    assert (length.type, length.range.unit, kind.choices, on.description) == (float, "m", ("a", "b"), "Whether or not.")


@pytest.mark.parametrize(
    "values, sentence",
    [
        ({"count": 6}, r"Example.count must lie in \[1, 5\], got 6"),
        ({"length": -1.0}, r"Example.length must lie in \[0, 1\] m, got -1"),
        ({"length": float("nan")}, "Example.length must be finite"),
        ({"kind": "c"}, "Example.kind must be one of a, b, got 'c'"),
        ({"count": True}, "Example.count must be a int"),
        ({"count": "2"}, "Example.count must be a int"),
        ({"size": 1}, "Example has no option size; it has count, length, kind, on"),
    ],
)
def test_bad_values_are_refused_with_what_is_allowed(values, sentence):
    with pytest.raises(ConfigError, match=sentence):
        Example.from_mapping(values)


def test_a_large_limit_is_told_to_the_digit_where_it_refuses():
    with pytest.raises(ConfigError, match=r"seed must lie in \[0, 2147483647\], got 2147483648"):
        ReconstructionConfig(seed=2**31)


def test_whole_numbers_are_accepted_for_lengths():
    assert isinstance(Example(length=1).length, float)


@dataclass(frozen=True)
class Nested(StageConfig):
    """A stage within another."""

    renamed = {"size": "example.length"}
    example: Example = Example(count=3)
    last: int = 0
    """The last one."""


def test_options_of_a_nested_stage_are_dotted():
    assert [option.name for option in options(Nested)] == ["example.count", "example.length", "example.kind", "example.on", "last"]
    assert options(Nested)[0].default == 3, "that of the field, not of the class"
    config = Nested.from_mapping({"example.length": 1, "last": 4})
    assert config == Nested(Example(count=3, length=1.0), 4)
    assert Nested.from_mapping({"example": {"length": 1}, "last": 4}) == config
    assert Nested.from_mapping(option_values(config)) == config
    assert option_values(config)["example.count"] == 3


def test_options_of_a_nested_stage_are_checked_and_old_names_lead_to_the_new_ones():
    with pytest.raises(ConfigError, match=r"Example.count must lie in \[1, 5\], got 9"):
        Nested.from_mapping({"example.count": 9})
    with pytest.raises(ConfigError, match="Example has no option size; it has count, length, kind, on"):
        Nested.from_mapping({"example.size": 9})
    with pytest.raises(ConfigError, match="Nested: the option size is now example.length"):
        Nested.from_mapping({"size": 0.5})


@dataclass(frozen=True)
class Outer(StageConfig):
    """A stage within a stage within a stage."""

    renamed = {"mode": "kind a or b of the example"}
    nested: Nested = Nested()


def test_old_names_are_known_at_every_depth():
    assert renamed_options(Outer) == {"mode": "kind a or b of the example", "nested.size": "nested.example.length"}


@dataclass
class Command:
    """A command with two stages, one of them without a prefix, as tyro has it."""

    out: str
    stage: Annotated[Nested, tyro.conf.arg(name="")]
    other: Nested


@pytest.mark.parametrize(
    "words, sentence",
    [
        ("--size 1", r"^--size is now --example\.length$"),
        ("--size=1", r"^--size is now --example\.length$"),
        ("--last 1 --no-size", r"^--no-size is now --example\.length$"),
        ("--other.size 1", r"^--other.size is now --other\.example\.length$"),
    ],
)
def test_old_flags_are_refused_with_the_new_ones(words, sentence):
    with pytest.raises(ConfigError, match=sentence):
        refuse_renamed_flags(words.split(), Command)


def test_other_words_are_not_taken_for_old_flags():
    refuse_renamed_flags(["size", "--out", "size", "--example.size", "--example.length", "3", "--", "-s"], Command)


@pytest.mark.parametrize(
    "given",
    [
        {"capacity.without_depth": 0.0, "max_gaussians": 9},
        {"multi_view.reflection": 40, "multi_view_refinement": False},
        {"extrapolated.min_coverage": 0.1, "extrapolation": 0.0},
    ],
)
def test_an_option_that_acts_elsewhere_than_the_rest_of_its_stage_is_not_said_to_have_no_effect(given):
    assert unused_options(preset("default", **given)) == []


def test_a_configuration_takes_the_place_of_a_nested_stage():
    config = Nested().replaced({"example": Example(count=5), "last": 4})
    assert config == Nested(Example(count=5), 4)
    assert Nested().replaced({"example": Example(count=5), "example.count": 1}).example.count == 1


@pytest.mark.parametrize(
    "name, given, why",
    [
        ("3dgs", {"mcmc.growth": 0.1}, "densification is gradient; set densification to mcmc"),
        ("default", {"proximity.far": 3.0}, "densification is mcmc; set densification to proximity"),
        ("paper", {"motion.width": 100}, "dynamic_mask is false; set dynamic_mask to true"),
        ("paper", {"extrapolated.size": 1.0}, "extrapolation is 0.0; set extrapolation to more than 0"),
        ("default", {"coverage.new_share": 0.1, "keyframes": 8}, "keyframes is 8; set keyframes to 0"),
        ("laptop", {"training.min_iterations": 1}, "iterations is 600; set iterations to 0"),
        ("default", {"training.max_gaussians": 9, "max_gaussians": 8, "iterations": 0}, "max_gaussians is 8; set max_gaussians to 0"),
        ("default", {"network.max_error": 0.2, "depth": "points"}, "depth is points; set depth to auto or network or network_first"),
        ("default", {"poses.exact": 0.01, "poses.correct": False}, "poses.correct is false; set poses.correct to true"),
        ("default", {"tilted.weight": 2.0, "tilted.every": 0}, "tilted.every is 0; set tilted.every to more than 0"),
        ("laptop", {"capacity.fewer": 0.2}, "max_gaussians is 15000; set max_gaussians to 0"),
    ],
)
def test_an_option_without_effect_is_told_with_what_gives_it_one(name, given, why):
    assert unused_options(preset(name, **given)) == [f"{next(iter(given))} has no effect while {why}"]
    users = ReconstructionConfig(), ReconstructionConfig(densification="proximity", depth="network")
    assert not unused_options(preset(name, **given), *users), "one of several uses it"


@pytest.mark.parametrize("config", [*map(preset, PRESETS), *map(tissue, TISSUES)], ids=[*PRESETS, *TISSUES])
def test_presets_and_tissues_have_no_option_without_effect(config):
    assert not unused_options(config)


def test_what_options_need_can_be_had():
    for config in (ReconstructionConfig, PhysicsConfig):
        known = {option.name: option for option in options(config)}
        for name, (switch, *wanted) in ((name, need) for name, need in config.needs.items() if need):
            assert operator.attrgetter(name)(config()) is not None and switch in known
            assert known[switch].choices is None or set(wanted) <= set(known[switch].choices)
    assert all(ReconstructionConfig.needs[name] == ("densification", name) for name in STRATEGIES)


@pytest.mark.parametrize("node", NODE_CONFIGS)
def test_no_old_name_is_an_option_of_the_same_node(node):
    known = {option.name for config in NODE_CONFIGS[node] for option in options(config)}
    for config in NODE_CONFIGS[node]:
        assert not known & renamed_options(config).keys()


@pytest.mark.parametrize("config", ALL, ids=lambda config: config.__name__)
def test_every_option_is_described_and_its_default_is_valid(config):
    config()
    for option in options(config):
        assert option.description.endswith((".", "one.")), option.name
        if option.type in (int, float):
            assert option.range is not None, option.name


def test_parameter_file_in_the_repository_is_the_generated_one():
    assert FILE.read_text() == parameter_file(), "run: endo-sim config > config/endo_sim.yaml"


UNCOMMENTED = re.sub(r"^    #(?=\w)", "    ", FILE.read_text(), flags=re.M)


@pytest.mark.parametrize("text", [FILE.read_text(), UNCOMMENTED], ids=["as it is", "with what is commented out"])
def test_parameter_file_gives_every_node_its_defaults(text):
    sections = yaml.safe_load(text)
    for node, configs in NODE_CONFIGS.items():
        values = sections[f"/**/{node}"]["ros__parameters"]
        for config in configs:
            mine = {option.name: values.pop(option.name) for option in options(config) if option.name in values}
            assert config.from_mapping(mine) == config()
            assert len(mine) == len(options(config)) or (config in (ReconstructionConfig, PhysicsConfig) and text != UNCOMMENTED)
        assert not values


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_beside_the_parameter_file_has_its_values(name):
    values = yaml.safe_load(FILE.read_text())["/**/reconstruction_node"]["ros__parameters"]
    given = {key: value for key, value in values.items() if key in option_values(ReconstructionConfig())}
    assert preset(name, **given) == preset(name)


@pytest.mark.parametrize("name", TISSUES)
def test_a_tissue_beside_the_parameter_file_has_its_values(name):
    values = yaml.safe_load(FILE.read_text())["/**/physics_node"]["ros__parameters"]
    given = {key: value for key, value in values.items() if key in option_values(PhysicsConfig())}
    assert tissue(name, **given) == tissue(name)


def test_presets_and_tissues_have_the_names_that_options_allow():
    assert get_args(Preset) == tuple(PRESETS) and get_args(Tissue) == tuple(TISSUES)


def test_parameters_are_found_by_the_name_of_the_executable_too(capsys):
    cli.parse("config", ["policy_node", "viewer_node"]).run()
    assert capsys.readouterr().out == parameter_file(("policy", "viewer_node"))
