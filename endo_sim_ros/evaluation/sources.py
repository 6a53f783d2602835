"""Sequences as they are named on the command line: a path or `phantom:SEED`, then options of the reader as `,name=value`."""

import contextlib
import dataclasses
import itertools
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from endo_sim_ros.core.config import ConfigError, StageConfig, options
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.sequences.bag import read_bag
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence
from endo_sim_ros.sequences.readers import check_option, find_reader, is_bag
from endo_sim_ros.sequences.recording import Recording

PHANTOM = "phantom:"
"""Prefix of the synthetic patients; a seed follows."""


def split_source(source: str) -> tuple[str, list[str]]:
    """The path or name of a sequence, and its options."""
    place, *options = re.split(r",(?=\w+=)", source)
    return place, options


def parse_values(items: Iterable[str], where: str, of: type[StageConfig]) -> dict[str, Any]:
    """Texts name=value as values of options by (dotted) name; the configuration checks both."""
    texts, values = {option.name for option in options(of) if option.type is str}, {}
    for item in items:
        name, equals, text = item.partition("=")
        if not equals:
            raise ConfigError(f"{where} {item}: give name=value")
        values[name] = text if name in texts else _value(text)
    return values


def _value(text: str) -> Any:
    """A text in the type that YAML sees in it; YAML takes 1e-3 for a word, but nobody else does."""
    value = yaml.safe_load(text)
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            return float(value)
    return value


def open_named(source: str) -> Iterable[Frame]:
    """The frames of a sequence as it is named on the command line.

    Raises:
        SequenceError, ConfigError: If there is no such sequence or option, or the reader finds a fault.
    """
    return find_named(source)()


def find_patient(source: str) -> PhantomConfig | None:
    """The synthetic patient that a source names, as `phantom:0,frames=50`; None if it names something else.

    Raises:
        SequenceError, ConfigError: If it has no number, or no such option.
    """
    place, texts = split_source(source)
    if not place.startswith(PHANTOM):
        return None
    seed = place.removeprefix(PHANTOM)
    if not seed.isdecimal():
        raise SequenceError(f"{place}: the synthetic patients have numbers, as {PHANTOM}0")
    # Half a round: after a whole one the last view would be the first again, and two views one.
    return PhantomConfig.from_mapping({"seed": int(seed), "rounds": 0.5} | parse_values(texts, place, PhantomConfig))


def source_names(source: str) -> tuple[str, list[str]]:
    """A source told in full, so that another text of the same sequence gives the same, and names that it may have, short ones first.

    Options of a synthetic patient are in its name where they are no defaults, those of readers where they are given.
    """
    place, texts = split_source(source)
    if patient := find_patient(source):
        place = f"{PHANTOM}{patient.seed}"
        plain = find_patient(place)
        changed = {key: value for key, value in dataclasses.asdict(patient).items() if value != getattr(plain, key)}
        name = ",".join([place, *(f"{key}={value}".lower() for key, value in changed.items())])
        return name, [name]
    path, texts = Path(os.path.abspath(place)), sorted(texts, key=lambda text: text.partition("=")[0])  # of one given twice the last counts
    if "," in str(path) and "," not in place:  # which would begin an option
        path = Path(place)
    ending, short = ("".join(f",{text}" for text in each) for each in (texts, [re.sub("=.*/", "=", text) for text in texts]))
    names = ["/".join(path.parts[-count:]) + short for count in range(1, len(path.parts))]
    return f"{path}{ending}", [*names, f"{path}{ending}"]


def find_named(source: str) -> Callable[[], Iterable[Frame]]:
    """What opens a sequence; nothing of it is read yet.

    Raises:
        SequenceError, ConfigError: If there is no such sequence or option.
    """
    place, texts = split_source(source)
    if config := find_patient(source):
        return lambda: Recording(lambda: phantom_sequence(config), config.frames)
    given = {name: _value(value) for name, _, value in (text.partition("=") for text in texts)}
    if "distortion" in given:
        given["distortion"] = tuple(np.atleast_1d(given["distortion"]).tolist())
    path = Path(place)
    if is_bag(path):
        unknown = set(given) - {"start", "stop", "step"}
        if unknown:
            raise SequenceError(f"{place}: a bag has no option {', '.join(sorted(unknown))}; it has start, stop and step")
        part = [given.get(name) for name in ("start", "stop", "step")]
        for name, value in given.items():
            check_option(place, name, value, int)
        if any(value is not None and not value >= least for value, least in zip(part, (0, 0, 1))):
            raise SequenceError(f"{place}: start and stop are 0 or more, step is 1 or more")
        return lambda: Recording(lambda: itertools.islice(read_bag(path), *part), 0, source=path)
    opened = find_reader(path, "auto", given)  # refuses what is no number
    if given.get("step", 1) < 1:
        raise SequenceError(f"{place}: step must be 1 or more, got {given['step']}")
    return opened
