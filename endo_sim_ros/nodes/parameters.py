"""ROS parameters from configurations: declared, checked, and set later."""

import difflib
import functools
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.context import Context
from rclpy.exceptions import InvalidParameterTypeException, ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter

from endo_sim_ros.core.config import ConfigError, Option, StageConfig, option_values, options, renamed_options, unused_options
from endo_sim_ros.nodes.configs import CHOSEN_BY, NODE_CONFIGS
from endo_sim_ros.nodes.errors import sentence
from endo_sim_ros.nodes.rclpy_private import given_parameters, set_empty

Config = TypeVar("Config", bound=StageConfig)


class ConfiguredNode(Node):
    """A ROS node whose parameters are the options of configurations.

    A parameter that somebody gave a value, at start or later, keeps it, even if that is the default.
    """

    read_at_start: frozenset[str] = frozenset()
    """Parameters that act at start only; all others act when they are set."""

    def __init__(self, name: str, context: Context | None = None) -> None:
        super().__init__(name, context=context)
        self._configs: dict[type[StageConfig], StageConfig] = {}
        self._given = set(given_parameters(self))  # parameters that somebody gave a value
        self._requested: set[str] = set()  # those that somebody is setting now
        self._choosing = False  # whether the node itself sets some
        self._set_since: dict[str, Any] = {}  # those that were set since the start, with their values

    def declare(self, config_class: type[Config]) -> Config:
        """Declare every option of a configuration as a parameter and return the configuration that they give.

        Options that nobody gives have the values that a preset or tissue, which is declared before, chooses.

        Args:
            config_class: The configuration; options of its nested stages are dotted.

        Raises:
            ConfigError: If a value given at start cannot be used, or is given for an old name of an option.
        """
        for old, new in renamed_options(config_class).items():
            if old in self._given and not self.has_parameter(old):
                raise ConfigError(f"the parameter {old} is now {new}")
        values, chosen = {}, _chosen(config_class, self._values)
        for option in options(config_class):
            default = chosen.get(option.name, option.default)
            try:
                # ROS takes an empty list for one of bytes.
                default = (list(default) or Parameter.Type.STRING_ARRAY) if option.type is tuple else default
                value = self.declare_parameter(option.name, default, _descriptor(option)).value
                if value is None:
                    set_empty(self, option.name)
                values[option.name] = () if value is None else value
            except InvalidParameterTypeException as error:
                kind = {float: "float, with a decimal point", tuple: "list such as [PSM1, PSM2]"}
                kind = kind.get(option.type, option.type.__name__)
                raise ConfigError(f"parameter {option.name} must be a {kind}: {error}") from error
            except Exception as error:  # rclpy has one exception type for each way a value can be wrong
                raise ConfigError(f"parameter {option.name}: {error} ({option.description})") from error
        config = config_class.from_mapping(values)
        _require_device(config)
        for text in unused_options(config):
            self.get_logger().warning(text)
        self._configs[config_class] = config
        if len(self._configs) == 1:
            self.add_pre_set_parameters_callback(self._before_set)
            self.add_on_set_parameters_callback(self._on_set)
        return config

    def config_changed(self, config: Any) -> None:
        """Called with a whole, valid configuration after one of its parameters was set; override to use it.

        Raises:
            ValueError: If the values cannot be used after all; the parameters then keep their old ones.
        """

    def choose(self, values: Mapping[str, Any]) -> None:
        """Set those of these parameters to which nobody gave a value. They count as not given after that, too.

        Raises:
            ValueError: If one cannot be; all keep their old values then.
        """
        free = {name: value for name, value in values.items() if name not in self._given and value != self._values[name]}
        if not free:
            return
        self._choosing = True
        try:
            result = self.set_parameters_atomically([Parameter(name, value=value) for name, value in free.items()])
        finally:
            self._choosing = False
        if not result.successful:
            raise ValueError(result.reason)

    @property
    def given(self) -> frozenset[str]:
        """Parameters to which somebody gave a value."""
        return frozenset(self._given)

    @property
    def _values(self) -> dict[str, Any]:
        """The values of all options that are declared."""
        return {name: value for config in self._configs.values() for name, value in option_values(config).items()}

    @functools.cached_property
    def _unknown(self) -> str:
        """What was given at start but is no parameter of this node, in words; ROS itself says nothing about it."""
        unknown = {name for name in given_parameters(self) if not self.has_parameter(name)}
        if unknown:
            unknown -= _meant_for_others()
        # rclpy declares those of its own qos_overrides that act.
        names = [self._suggestion(name) for name in sorted(unknown) if not name.startswith("qos_overrides.")]
        text = f"unknown parameter{'s' * (len(names) > 1)} {', '.join(names)}" if names else ""
        if text:
            self.get_logger().warning(text)
        return text

    def _suggestion(self, name: str) -> str:
        """A name, and the parameter that is spelled like it."""
        near = difflib.get_close_matches(name, self.get_parameters_by_prefix(""), 1)
        return f"{name} (did you mean {near[0]}?)" if near else name

    def _before_set(self, parameters: list[Parameter]) -> list[Parameter]:
        """Refuse names that are not declared; add what a preset or tissue chooses and nobody gave."""
        renamed = {old: new for config_class in self._configs for old, new in renamed_options(config_class).items()}
        for name in (parameter.name for parameter in parameters if not self.has_parameter(parameter.name)):
            raise _NotDeclared(f"{name} is now {renamed[name]}" if name in renamed else f"unknown parameter {self._suggestion(name)}")
        requested: dict[str, Any] = {parameter.name: parameter.value for parameter in parameters}
        self._requested = set() if self._choosing else {*requested}
        chosen = {name: value for config_class in self._configs for name, value in _chosen(config_class, requested).items()}
        free, current = sorted(chosen.keys() - self._given - requested.keys()), self._values
        return [*parameters, *(Parameter(name, value=chosen[name]) for name in free if chosen[name] != current[name])]

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        new = {parameter.name: parameter.value for parameter in parameters}
        requested, self._requested = self._requested, set()
        try:
            changed, unused = [], []
            for config in self._configs.values():
                old = option_values(config)
                candidate = config.replaced({name: new[name] for name in old.keys() & new.keys()})
                names = {name for name, value in option_values(candidate).items() if value != old[name]}
                if names & self.read_at_start:
                    fixed = ", ".join(sorted(names & self.read_at_start))
                    raise ConfigError(f"{fixed}: read at start only; restart the node with the new value")
                if names:
                    _require_device(candidate)
                    changed.append(candidate)
                    unused += sorted({*unused_options(candidate)} - {*unused_options(config)})
            for index, config in enumerate(changed):
                try:
                    self.config_changed(config)
                except Exception:
                    for acting in changed[:index]:  # all are set, or none
                        self.config_changed(self._configs[type(acting)])
                    raise
            self._configs |= {type(config): config for config in changed}
        except Exception as error:
            return SetParametersResult(successful=False, reason=sentence("parameters", error))
        self._given |= requested
        self._set_since |= {name: new[name] for name in requested}
        for text in unused:
            self.get_logger().warning(text)
        return SetParametersResult(successful=True)


class _NotDeclared(ParameterNotDeclaredException):
    """A parameter that does not exist; rclpy tells the text to whoever wanted to set it."""

    def __init__(self, text: str) -> None:
        Exception.__init__(self, text)


def _chosen(config_class: type[StageConfig], values: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a configuration by the preset or tissue among some parameters, which are not checked yet; none where there is none."""
    chooser, sets = CHOSEN_BY.get(config_class, ("", {}))
    name = values.get(chooser)
    return option_values(config_class.from_mapping(sets[name])) if isinstance(name, str) and name in sets else {}


def _descriptor(option: Option) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(description=option.description)
    if option.choices:
        descriptor.additional_constraints = "one of " + ", ".join(option.choices)
    if option.range and option.type is float:
        bounds = FloatingPointRange(from_value=float(option.range.minimum), to_value=float(option.range.maximum))
        descriptor.floating_point_range = [bounds]
    elif option.range:
        bounds = IntegerRange(from_value=int(option.range.minimum), to_value=int(option.range.maximum), step=1)
        descriptor.integer_range = [bounds]
    return descriptor


def _require_device(config: StageConfig) -> None:
    """Raise ConfigError if the device of a configuration does not exist."""
    device = getattr(config, "device", None)
    if device is not None:
        from endo_sim_ros.core.device import pick_device  # needs torch

        try:
            pick_device(device)
        except ValueError as error:
            raise ConfigError(str(error)) from error


def beside_parameters(name: str, value: str) -> str:
    """The path of a file that a parameter names: where the value is relative, beside the file of parameters that gives it, if it is there.

    Else it is as it was given: `endo_sim_ros.graph` hands on in a file of its own what was set while a node ran.
    """
    given = "" if Path(value).is_absolute() else value
    for path, nodes in reversed(_parameter_files()):  # the last file counts
        beside = Path(path).resolve().parent / given
        if given and beside.exists() and any(_parameters_of(node).get(name) == given for node in nodes.values()):
            return str(beside)
    return value


def _parameter_files() -> list[tuple[str, dict[str, Any]]]:
    """The files of parameters that this process was started with: their paths and what they hold."""
    paths = [path for flag, path in zip(sys.argv, sys.argv[1:]) if flag == "--params-file"]
    return [(path, yaml.safe_load(Path(path).read_text()) or {}) for path in paths]  # which ROS has read without complaint


def _meant_for_others() -> set[str]:
    """Parameters of our other nodes that a file gives to all nodes, under /**."""
    configs = {config_class for each in NODE_CONFIGS.values() for config_class in each}
    ours = {name for each in configs for name in (*(option.name for option in options(each)), *renamed_options(each))}
    general: set[str] = set()
    for _, nodes in _parameter_files():
        general |= _parameters_of(nodes.get("/**")).keys()
    return ours & general


def _parameters_of(node: Any) -> dict[str, Any]:
    """The parameters of one node, as a file of parameters has it, by their names."""
    return _dotted(node.get("ros__parameters") or {}) if isinstance(node, dict) else {}


def _dotted(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The parameters in a mapping by their names, in which those with dots may be mappings of their own."""
    found = {}
    for name, value in values.items():
        found |= _dotted(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return found
