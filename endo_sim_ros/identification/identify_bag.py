"""From a recording to what is known of the tissue, with a progress bar: the work of `endo-sim identify`."""

from pathlib import Path

from rich.console import Console
from rich.progress import Progress as ProgressBar
from rich.table import Table

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.device import pick_device
from endo_sim_ros.core.folders import make_writable
from endo_sim_ros.core.progress_bar import stages_in
from endo_sim_ros.identification.config import IdentificationConfig
from endo_sim_ros.identification.estimate import Identification, excess_force, identify
from endo_sim_ros.identification.experiment import Experiment
from endo_sim_ros.identification.forward import finer_physics
from endo_sim_ros.identification.from_bag import read_experiments
from endo_sim_ros.identification.maps import seen_from
from endo_sim_ros.identification.recording_config import RecordingConfig
from endo_sim_ros.identification.results import save_results
from endo_sim_ros.learning.scenes import Scene, load_scene
from endo_sim_ros.physics import PhysicsConfig

_COARSE = (
    "few control nodes push back more than real tissue of the same modulus: moduli are too low, by about {:.0%} by the forces of {} nodes,"
    " which intervals do not count, unless a simulation of the same nodes made the recording; finer {:.2g} corrects that"
)
_FINE = 2800  # control nodes whose forces correct those of 1000 so that moduli are 7 % off
_TOLD = {"known": "green", "ratio only": "yellow", "not told by these data": "red"}


def identify_bag(
    bag: Path, model: str | Path, out: Path, config: IdentificationConfig, recording: RecordingConfig, physics: PhysicsConfig
) -> Identification:
    """Estimate what tissue is made of from a recording, print it, and write it into a folder.

    Args:
        bag: Recording with poses of tools.
        model: PLY model with its cameras.json, or a folder with both.
        out: Folder for the files; it is made if need be.
        config: What is unknown.
        recording: What is taken from the recording.
        physics: The tissue as far as it is known.

    Raises:
        SequenceError: If the recording cannot be used.
        IdentificationError: If nothing can be estimated from it.
        ValueError: If the model or options cannot be used.
    """
    pick_device(physics.device)  # what cannot be used is refused before the long work
    if physics.kinematics != "rest" or physics.dense:
        raise ConfigError("identification needs sparse control nodes and kinematics rest; leave dense and kinematics as they are")
    scene = load_scene(model)
    make_writable(out)  # before the long work
    with ProgressBar(transient=True) as bar:
        task = bar.add_task("building control nodes", total=None)
        nodes = scene.nodes(physics)
        recorded = read_experiments(bag, scene.model, nodes, physics, recording, lambda text: bar.update(task, description=text))
        on_progress = stages_in(bar, task)
        finer = scene.nodes(finer_physics(physics, recording.finer)) if recording.finer > 1 else None
        found = identify(recorded.experiments, nodes, physics, config, physics.device, on_progress, finer=finer)
        recorded.findings.extend(seen_from(found, scene.camera))
        if recorded.forces and not recorded.simulated and finer is None:
            recorded.findings.extend(_coarse(found, recorded.experiments, scene, physics))
        on_progress("drawing the map", 0, 0)
        save_results(found, scene, physics, out, [f"Written by endo-sim identify, from {bag}.", *recorded.findings])
    _tell(found, recorded.findings)
    return found


def _coarse(found: Identification, experiments: list[Experiment], scene: Scene, physics: PhysicsConfig) -> list[str]:
    """A sentence where finer control nodes push back less than all forces of the model are thought to be wrong."""
    times = min(max(1.5, (_FINE / len(found.nodes)) ** (1 / 3)), 4.0)
    finer = scene.nodes(finer_physics(physics, times))
    share = excess_force(found, experiments, finer)
    # Forces are proportional to the modulus: of tissue that pushes back twice as much it is half.
    return [_COARSE.format(share / (1 + share), len(finer), times)] if share > found.parameters.config.model_error else []


def _tell(found: Identification, findings: list[str]) -> None:
    """Print what is known, and what was noticed."""
    console = Console(highlight=False)
    table = Table("", "estimate", f"{found.level:.0%} interval", "", title="what the tissue is made of", title_justify="left")
    for each in found.unknowns:
        unit = f" {each.unit}" if each.unit else ""
        told = f"[{_TOLD.get(each.told, 'white')}]{each.told}[/]"
        table.add_row(each.name, f"{each.estimate:.4g}{unit}", f"{each.low:.4g} to {each.high:.4g}{unit}", told)
    console.print(table)
    for text in dict.fromkeys([*findings, *found.findings]):
        console.print(f"- {text}", markup=False, soft_wrap=True)
