"""`endo-sim bench`: finds and runs the benchmarks, which are no part of the installed package."""

import importlib
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

import endo_sim_ros


def find_benchmarks() -> None:
    """Make the repository's folder `benchmarks` importable.

    Raises:
        RuntimeError: If the package runs neither from a checkout nor in one.
    """
    for root in (Path(endo_sim_ros.__file__).parents[1], Path.cwd()):
        if (root / "benchmarks" / "raster.py").is_file():
            if str(root) not in sys.path:
                sys.path.insert(0, str(root))
            return
    raise RuntimeError("the benchmarks are not installed with the package; run this command in a checkout of the repository")


@dataclass(frozen=True)
class Measured:
    """What benchmarks have in common. Each is a function ``bench_NAME`` of the module NAME, which takes the options."""

    json: Path | None = None
    """File for the results as a list of rows."""
    device: str = "auto"
    """Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N."""

    def run(self) -> None:
        """Measure."""
        find_benchmarks()
        name = type(self).__name__.removeprefix("Bench").lower()
        options = {"json_file" if option == "json" else option: value for option, value in vars(self).items()}
        getattr(importlib.import_module(f"benchmarks.{name}"), f"bench_{name}")(**options)


@dataclass(frozen=True)
class BenchRaster(Measured):
    """The rasteriser: forward, forward and backward, memory, and how time grows."""


@dataclass(frozen=True)
class BenchPhysics(Measured):
    """The simulation: the paper's comparison of every Gaussian with sparse nodes, the cost of a step, and many copies of a tissue."""

    models: tuple[Path, ...] = ()
    """PLY model of each tissue, in metres, seen by the first camera of the cameras.json beside it, else from the world's
    origin; default: a piece of the synthetic patient. The paper's comparison is the median over all, the rest is of the first."""
    environments: tuple[int, ...] = ()
    """Numbers of copies stepped together; default: 1 4 16 64, on a GPU also 256 1024."""
    driven: Literal["path", "force"] = "path"
    """What the tool of the paper's comparison prescribes: where it goes, by a centimetre, or how hard it pulls, by 0.02 N, as the paper's
    does."""


@dataclass(frozen=True)
class BenchGraph(Measured):
    """The node graph over DDS, each node its own process: latency from wrench to image, rates and losses."""

    gaussians: int = 30_000
    """Size of the model."""
    width: int = 640
    """Width of the images, pixels."""
    height: int = 512
    """Height of the images, pixels."""
    rate: float = 25.0
    """Commands and images per second, Hz."""
    changes: int = 200
    """Changes of the wrench in real time whose way to the image is timed."""
    commands: int = 200
    """Commands in lockstep."""
    kills: int = 3
    """Deaths of each node whose recovery is timed; 0 = none."""


@dataclass(frozen=True)
class BenchEnvironments(Measured):
    """The environments to learn in: steps per second, with states, with images, and with the tool in them."""

    task: str = "retraction"
    """Name of the task, such as retraction or palpation; an unknown one is answered with the list."""
    environments: tuple[int, ...] = (1, 64)
    """Numbers of environments stepped together."""
    gpus: int = 0
    """Workers of Ray, each on a GPU of its own, or a core where there is none, that step the greatest of these numbers each; 0 = none."""


@dataclass(frozen=True)
class BenchIdentification(Measured):
    """Identification of tissue: how well moduli and inclusions are found that are known, whether intervals hold the truth, and how long
    it takes."""

    cases: int = 4
    """Cases of one modulus with each of six truths; 0 = none."""
    truth: str = ""
    """Cases are of those truths alone whose names have this in them, such as corrected; default: of all."""
    inclusions: int = 1
    """Inclusions to be found in maps; 0 = none."""
    radius: float = 0.008
    """Radius of these, m."""
    searches: int = 1
    """Searches for an inclusion, press by press, where the next is expected to tell most, and in a raster; 0 = none."""
    palpations: int = 1
    """Episodes of the task palpation, with presses where the next is expected to tell most, and by the script of the task; 0 = none."""
    noises: int = 1
    """Cases of one modulus with each of seven noises of forces and tips; 0 = none."""
    fields: int = 1
    """Maps of tissue with an inclusion, with two, and with a gradient, whose intervals are compared with the truth; 0 = none."""
    nodes: int = 1000
    """Control nodes of the tissue with inclusions and of these maps."""
    layers: int = 3
    """Layers of it below the skin."""
    folder: Path | None = None
    """Folder of presses of real tissue, as `presses` takes it; default: none."""


@dataclass(frozen=True)
class BenchPresses:
    """The laws of materials on presses of real tissue by a testing machine: how well each fits, and predicts other trials."""

    folder: tyro.conf.Positional[Path]
    """Folder of CSV files with the columns trial, time_s, force_N and position_mm; the trials of a file are of one organ."""
    json: Path | None = None
    """File for the results as a list of rows."""

    def run(self) -> None:
        """Fit and predict."""
        find_benchmarks()
        importlib.import_module("benchmarks.presses").bench_presses(self.folder, self.json)


@dataclass(frozen=True)
class BenchSoak:
    """The node graph under random traffic, half of it spoilt: who dies, whose memory grows, does it still work."""

    json: Path | None = None
    """File for the results as a list of rows."""
    minutes: float = 10.0
    """Duration of the traffic."""
    rate: float = 500.0
    """Messages per second on all topics together."""
    seed: int = 0
    """Other seeds give other traffic."""

    def run(self) -> None:
        """Put the node graph under random traffic."""
        from endo_sim_ros.graph.soak import soak

        soak(self.json, self.minutes, self.rate, self.seed)


@dataclass(frozen=True)
class Command:
    """Measure speed on this machine, beside peers where they are installed, or laws of materials on real tissue; medians and ratios."""

    what: tyro.conf.OmitArgPrefixes[
        Annotated[BenchRaster, tyro.conf.subcommand("raster", prefix_name=False)]
        | Annotated[BenchPhysics, tyro.conf.subcommand("physics", prefix_name=False)]
        | Annotated[BenchGraph, tyro.conf.subcommand("graph", prefix_name=False)]
        | Annotated[BenchEnvironments, tyro.conf.subcommand("environments", prefix_name=False)]
        | Annotated[BenchIdentification, tyro.conf.subcommand("identification", prefix_name=False)]
        | Annotated[BenchPresses, tyro.conf.subcommand("presses", prefix_name=False)]
        | Annotated[BenchSoak, tyro.conf.subcommand("soak", prefix_name=False)]
    ]

    def run(self) -> None:
        """Run the chosen benchmark."""
        self.what.run()
