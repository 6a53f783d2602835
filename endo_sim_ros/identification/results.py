"""What was identified as files: parameters of physics_node, a map, and a picture of it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from endo_sim_ros.core.config import option_values
from endo_sim_ros.core.drawing import write_png
from endo_sim_ros.core.folders import written_whole
from endo_sim_ros.identification.estimate import Identification
from endo_sim_ros.identification.maps import paint_as_regions
from endo_sim_ros.identification.picture import draw_map
from endo_sim_ros.learning.scenes import Scene
from endo_sim_ros.physics import PhysicsConfig
from endo_sim_ros.physics.regions import MAX_POISSON_RATIO

_DIGITS = 6


def told(found: Identification, physics: PhysicsConfig) -> dict[str, Any]:
    """Parameters of physics_node that were identified: the modulus of most tissue, regions, and what else was unknown.

    Where no modulus is known, as without forces, ratios alone count: most tissue has the modulus that physics has. Where there are doubts
    physics stays as it was.

    Args:
        found: The estimate.
        physics: The tissue as far as it was known; its regions stay for what else they say.
    """
    options, middle = option_values(physics), float(np.median(found.young_modulus))
    if found.doubts:
        return {"young_modulus": physics.young_modulus, "regions": [*physics.regions] or [""]}
    scale = 1.0 if found.any_known else physics.young_modulus / middle
    values: dict[str, Any] = {"young_modulus": _rounded(scale * middle)}
    varied = paint_as_regions(found.nodes, scale * found.young_modulus) if len(np.unique(found.young_modulus)) > 1 else ()
    values["regions"] = [text for text in (*physics.regions, *varied) if text] or [""]
    others = {each.name: each.estimate for each in found.unknowns if each.name in options and each.name not in values}
    if "poisson_ratio" in others:
        others["poisson_ratio"] = min(others["poisson_ratio"], MAX_POISSON_RATIO)  # as it was simulated
    return values | {name: _rounded(value) for name, value in others.items()}


def parameters(found: Identification, physics: PhysicsConfig) -> dict[str, Any]:
    """Parameters of physics_node with which its tissue is what was identified: all that are not its defaults.

    Args:
        found: The estimate.
        physics: The tissue as far as it was known.
    """
    usual, given = option_values(PhysicsConfig()), option_values(physics)
    changed = {name: value for name, value in given.items() if value != usual[name] and name != "device"}
    values = changed | told(found, physics)
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def save_results(found: Identification, scene: Scene, physics: PhysicsConfig, out: Path, notes: Sequence[str] = ()) -> None:
    """Write stiffness.yaml, stiffness.npz and stiffness.png into a folder that exists; each is there whole or not at all.

    Args:
        found: The estimate.
        scene: What it is of.
        physics: The tissue as far as it was known.
        out: The folder.
        notes: Sentences for people at the top of stiffness.yaml.
    """
    text = "".join(f"# {line}\n" for note in (*notes, *found.summary().splitlines()) for line in note.splitlines())
    values = {"/**/physics_node": {"ros__parameters": parameters(found, physics)}}
    with written_whole(out / "stiffness.yaml") as path:
        path.write_text(text + yaml.safe_dump(values, sort_keys=False, width=1000))
    with written_whole(out / "stiffness.npz") as path, path.open("wb") as file:
        np.savez_compressed(
            file,
            positions=found.nodes.rest,
            young_modulus=found.young_modulus,
            low=found.low,
            high=found.high,
            known=found.known,
            names=np.array([each.name for each in found.unknowns]),
            estimates=np.array([[each.estimate, each.low, each.high] for each in found.unknowns]),
            told=np.array([each.told for each in found.unknowns]),
            level=np.array(found.level),
        )
    picture = draw_map(scene.model, scene.camera, found.nodes, found.young_modulus, found.known, title(found), physics.device)
    write_png(out / "stiffness.png", picture)


def title(found: Identification) -> str:
    """One line about the map."""
    known, moduli = found.known, found.young_modulus
    if not known.any():
        return "stiffness: striped, as it is not known anywhere"
    low, high = moduli[known].min() / 1e3, moduli[known].max() / 1e3
    values = f"{low:.3g} kPa" if high / low < 1.005 else f"{low:.3g} to {high:.3g} kPa"
    where = "known everywhere" if known.all() else f"known of {known.mean():.0%} of the tissue, striped where not"
    return f"stiffness: {values}, {where}"


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
