"""Stage configurations: one frozen dataclass each is the single source of a stage's options.

The command line, the ROS 2 parameters and `config/*.yaml` are all derived from (or tested against) these classes.
A field is declared as ``name: Annotated[float, Range(lo, hi, unit)] = default`` with a one-line docstring under it.
A field whose type is another stage configuration nests its options; their names are then dotted: ``stage.option``.
"""

import ast
import dataclasses
import difflib
import inspect
import math
import operator
import sys
import textwrap
import typing
from collections.abc import Sequence
from functools import cache
from typing import Any, ClassVar, NamedTuple

from typing_extensions import Doc, Self

_NO_LIMIT = 1e6  # an upper bound from here on only guards against slips; help does not tell it


class Range(NamedTuple):
    """Inclusive bounds of a numeric option and its unit, used inside ``Annotated``."""

    minimum: float
    maximum: float
    unit: str = ""


class Option(NamedTuple):
    """Everything known about one option of a configuration."""

    name: str  # dotted for an option of a nested stage
    type: type  # bool, int, float, str, or tuple of strings
    default: Any
    description: str
    range: Range | None
    choices: tuple[str, ...] | None  # of a ``Literal`` field

    @property
    def help(self) -> str:
        """The description with range and unit."""
        if self.range is None:
            return self.description
        low, high, unit = self.range
        unit = " " * bool(unit) + unit
        return f"{self.description} [{f'{low:g}{unit} or more' if high >= _NO_LIMIT else f'{low:g} to {high:g}{unit}'}]"


class ConfigError(ValueError):
    """A configuration value that cannot be used; the message names the field, the value and what is allowed."""


@cache
def options(config_class: type) -> tuple[Option, ...]:
    """All options of a configuration dataclass, in order; those of a nested stage follow under ``stage.option``."""
    hints = typing.get_type_hints(config_class, include_extras=True)
    docstrings = {}
    for each in reversed(config_class.__mro__):
        if "__dataclass_fields__" in vars(each):
            docstrings |= _field_docstrings(each)
    found = []
    for field in dataclasses.fields(config_class):
        hint, bounds, choices = hints[field.name], None, None
        if _is_stage(hint):
            factory = field.default_factory
            stage: Any = field.default if factory is dataclasses.MISSING else factory()
            defaults = option_values(stage)  # which may differ from those of the class
            found += [option._replace(name=f"{field.name}.{option.name}", default=defaults[option.name]) for option in options(hint)]
            continue
        if typing.get_origin(hint) is typing.Annotated:
            hint, *extras = typing.get_args(hint)
            bounds = next((extra for extra in extras if isinstance(extra, Range)), None)
        if typing.get_origin(hint) is typing.Literal:
            choices = typing.get_args(hint)
            hint = type(choices[0])
        hint = typing.get_origin(hint) or hint
        found.append(Option(field.name, hint, field.default, docstrings.get(field.name, ""), bounds, choices))
    return tuple(found)


def _field_docstrings(config_class: type) -> dict[str, str]:
    """The strings under the fields of a class, which Python itself forgets."""
    definition = _class_definitions(config_class.__module__).get(config_class.__qualname__)
    if definition is None:  # it is local to a function
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(config_class))).body
    body = definition.body if isinstance(definition, ast.ClassDef) else []
    found = {}
    for field, doc in zip(body, body[1:]):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(doc, ast.Expr):
            if isinstance(doc.value, ast.Constant) and isinstance(doc.value.value, str):
                found[field.target.id] = " ".join(doc.value.value.split())
    return found


@cache
def _class_definitions(module: str) -> dict[str, ast.ClassDef]:
    """The classes of a module by name; `inspect` would parse its file again for each of them, at every start of a program."""
    body = ast.parse(inspect.getsource(sys.modules[module])).body
    return {node.name: node for node in body if isinstance(node, ast.ClassDef)}


def _is_stage(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, StageConfig)


def option_values(config: "StageConfig") -> dict[str, Any]:
    """The value of every option by its (dotted) name, in the order of `options`."""
    return {option.name: operator.attrgetter(option.name)(config) for option in options(type(config))}


def unused_options(*configs: "StageConfig") -> list[str]:
    """A sentence for each option that is not at its default, yet has no effect in any of these configurations of one class."""
    values, found = [option_values(config) for config in configs], []
    for option in options(type(configs[0])):
        needs = configs[0].needs
        switch, *wanted = needs.get(option.name, needs.get(option.name.partition(".")[0])) or ("",)
        if switch and any(each[option.name] != option.default for each in values):
            now = [each[switch] for each in values]
            # A number or a switch has to be on, unless 0 is what is wanted.
            if not any(str(value) in wanted or not isinstance(value, str) and value and "0" not in wanted for value in now):
                texts = " or ".join(dict.fromkeys(str(value).lower() for value in now))
                found.append(f"{option.name} has no effect while {switch} is {texts}; set {switch} to {' or '.join(wanted)}")
    return found


def renamed_options(config_class: type["StageConfig"]) -> dict[str, str]:
    """What to write instead of each old name of an option; those of nested stages are dotted."""
    renamed = dict(config_class.renamed)
    for stage, hint in typing.get_type_hints(config_class).items():
        if _is_stage(hint):
            renamed |= {f"{stage}.{old}": f"{stage}.{new}" for old, new in renamed_options(hint).items()}
    return renamed


def refuse_renamed_flags(words: Sequence[str], command: type) -> None:
    """Raise a sentence with the new name if a command line gives an option by a name that it had before.

    Args:
        words: The command line after the name of the command.
        command: Dataclass of the command, as tyro has it: a field with a stage configuration adds the options of that, under
            ``--field.option``, or ``--option`` where the field is annotated with the name "".

    Raises:
        ConfigError: If there is one.
    """
    renamed = {}
    for field, stage, extras in _stages(command):
        prefix = "" if any(getattr(extra, "name", None) == "" for extra in extras) else f"{field}."
        for old, new in renamed_options(stage).items():
            names = new.split(" and ")  # of options, unless there are other words
            renamed[prefix + old] = new if any(" " in name for name in names) else " and ".join(f"--{prefix}{name}" for name in names)
    for flag in (word.partition("=")[0] for word in words if word.startswith("--")):
        stage, dot, option = flag.removeprefix("--").replace("-", "_").rpartition(".")
        new = renamed.get(stage + dot + option) or renamed.get(stage + dot + option.removeprefix("no_"))
        if new:
            raise ConfigError(f"{flag} is now {new.replace('_', '-') if new.startswith('--') else new}")


def refuse_repeated_flags(words: Sequence[str]) -> None:
    """Raise a sentence if a command line gives an option twice: of the two, one would be lost.

    Args:
        words: The command line after the name of the command.

    Raises:
        ConfigError: If there is one.
    """
    seen = set[str]()
    for flag in (word.partition("=")[0].replace("_", "-") for word in words if word.startswith("--")):
        if flag in seen:
            raise ConfigError(f"{flag} is given twice; give it once, with all its values")
        seen.add(flag)


@cache
def document_ranges(command: type) -> None:
    """Let tyro's help of a command tell range and unit of each option of the stage configurations that it holds."""
    for _, stage, _ in _stages(command):
        hints = typing.get_type_hints(stage, include_extras=True)
        for option in options(stage):
            if option.range and "." not in option.name:
                stage.__annotations__[option.name] = typing.Annotated[hints[option.name], Doc(option.help)]
        document_ranges(stage)


def _stages(holder: type) -> list[tuple[str, type["StageConfig"], list[Any]]]:
    """The fields of a dataclass that are stage configurations: name, class, and what else their annotation holds."""
    found = []
    for field, hint in typing.get_type_hints(holder, include_extras=True).items():
        stage, *extras = typing.get_args(hint) if typing.get_origin(hint) is typing.Annotated else (hint,)
        if _is_stage(stage):
            found.append((field, stage, extras))
    return found


def _converted(option: Option, value: Any) -> Any:
    """A value in the type of an option, where nothing is lost: a whole number for a float, a list for a tuple."""
    if option.type is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return tuple(value) if option.type is tuple and isinstance(value, list) else value


@dataclasses.dataclass(frozen=True)
class StageConfig:
    """Base of the stage configurations: validates on construction and converts from plain mappings.

    Raises:
        ConfigError: If a field has not its declared type or lies outside its declared bounds.
    """

    renamed: ClassVar[dict[str, str]] = {}
    """Options that had another name: the old name, and the new one, or what to write instead in words."""

    needs: ClassVar[dict[str, tuple[str, ...]]] = {}
    """Options, also dotted ones, and nested stages that have an effect only beside some value of another: the name of that, then its
    values in words. Of an option that is no word any value counts but zero and false. Empty: an option that acts without what its stage
    needs."""

    def __post_init__(self):
        for option in options(type(self)):
            if "." in option.name:
                continue  # the nested stage has validated itself
            value = _converted(option, getattr(self, option.name))
            object.__setattr__(self, option.name, value)
            where = f"{type(self).__name__}.{option.name}"
            if not isinstance(value, option.type) or (option.type is int and isinstance(value, bool)):
                raise ConfigError(f"{where} must be a {option.type.__name__}, got {value!r}")
            if option.type is tuple and not all(isinstance(item, str) for item in value):
                raise ConfigError(f"{where} must be a list of names, got {value!r}")
            if option.type is float and not math.isfinite(value):
                raise ConfigError(f"{where} must be finite, got {value}")
            if option.choices and value not in option.choices:
                raise ConfigError(f"{where} must be one of {', '.join(map(str, option.choices))}, got {value!r}")
            if option.range and not option.range.minimum <= value <= option.range.maximum:
                low, high, unit = option.range
                raise ConfigError(f"{where} must lie in [{low:g}, {high:.10g}] {unit}, got {value:.10g}".replace(" ,", ","))

    @classmethod
    def from_mapping(cls, values: dict[str, Any]) -> Self:
        """Build from a mapping such as a YAML section; options that are not in it keep their defaults.

        Args:
            values: By option name; options of a nested stage are dotted (``stage.option``) or a mapping of their own.

        Raises:
            ConfigError: If a value cannot be used, or a name is unknown; the sentence then lists the known ones.
        """
        return cls().replaced(values)

    def replaced(self, values: dict[str, Any]) -> Self:
        """A copy in which the named options have other values; names as in `from_mapping`.

        Raises:
            ConfigError: As `from_mapping` does.
        """
        stages = {field.name for field in dataclasses.fields(self) if isinstance(getattr(self, field.name), StageConfig)}
        own, nested, unknown = {}, {}, []
        for name, value in values.items():
            stage, _, rest = name.partition(".")
            if stage in stages and rest:
                nested.setdefault(stage, {})[rest] = value
            elif stage in stages:
                nested.setdefault(stage, {}).update(value if isinstance(value, dict) else option_values(value))
            elif name in {field.name for field in dataclasses.fields(self)}:
                own[name] = value
            else:
                unknown.append(name)
        for name in unknown:
            if name in self.renamed:
                raise ConfigError(f"{type(self).__name__}: the option {name} is now {self.renamed[name]}")
        if unknown:
            known = [option.name for option in options(type(self))]
            near = {name: difflib.get_close_matches(name, known, 1) for name in unknown}
            told = ", ".join(f"{name} (did you mean {like[0]}?)" if like else name for name, like in near.items())
            raise ConfigError(f"{type(self).__name__} has no option {told}; it has {', '.join(known)}")
        changed = {stage: getattr(self, stage).replaced(inner) for stage, inner in nested.items()}
        return dataclasses.replace(self, **own, **changed)
