"""The command line: `endo-sim COMMAND --help`."""

import logging
import shutil
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.progress import track

from endo_sim_ros import hear_interrupts
from endo_sim_ros.core.config import ConfigError, refuse_renamed_flags
from endo_sim_ros.core.frames import Frame, SequenceError
from endo_sim_ros.core.gaussians import ModelError
from endo_sim_ros.evaluation.config import EvaluationConfig
from endo_sim_ros.learning.config import PPOConfig, Randomisation, TrainingConfig
from endo_sim_ros.messages import MessageError
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.reconstruction.presets import PRESETS, Preset, preset
from endo_sim_ros.sequences.phantom import PhantomConfig
from endo_sim_ros.viewer.config import ViewerConfig

Positional = tyro.conf.Positional


@dataclass(frozen=True)
class Convert:
    """Turn a recording (StereoMIS, SCARED, EndoNeRF, folder of images, video) into a rosbag2."""

    source: Positional[Path]
    """Folder or file of the recording."""
    bag: Positional[Path]
    """Folder of the new bag; it must not exist."""
    kind: Literal["auto", "stereomis", "scared", "endonerf", "folder", "video"] = "auto"
    """Layout; auto recognises it."""
    start: int | None = None
    """First frame number."""
    stop: int | None = None
    """Frame number to stop before."""
    step: int | None = None
    """Take every n-th frame."""
    fps: float | None = None
    """Frame rate, Hz; default: that of the recording."""
    split: Literal["train", "test"] | None = None
    """StereoMIS: only the frame ranges of this split."""
    mask_polarity: Literal["auto", "tool", "tissue"] | None = None
    """StereoMIS, EndoNeRF, folder, video: what white means in the masks."""
    depth_scale: float | None = None
    """EndoNeRF, folder: metres per unit of the depth images (default 0.001)."""
    pose_direction: Literal["auto", "world_to_camera", "camera_to_world"] | None = None
    """SCARED: direction of the poses; auto finds it by comparing images."""
    poses: Path | None = None
    """Video: file of camera poses (frame tx ty tz qx qy qz qw, camera-to-world). Without one poses.txt beside the video
    is taken, and without that, or with "sfm", they are estimated by structure from motion."""
    scale: float | None = None
    """Video: metres per unit of the poses."""
    sfm_step: int | None = None
    """Video: structure from motion uses every n-th frame (default 6)."""
    calibration: Path | None = None
    """Video: YAML file with fx, fy, cx, cy and optional distortion."""
    fx: float | None = None
    """Video: focal length, pixels, instead of a file; fy, cx and cy follow from it where not given."""
    fy: float | None = None
    """Video: vertical focal length, pixels."""
    cx: float | None = None
    """Video: principal point, pixels."""
    cy: float | None = None
    """Video: principal point, pixels."""
    distortion: tuple[float, ...] | None = None
    """Video: coefficients k1 [k2 [p1 p2 [k3]]]."""
    mask: Path | None = None
    """Video: image of one mask for all frames, or a folder of numbered ones."""

    def run(self) -> None:
        from endo_sim_ros.sequences.bag import write_bag
        from endo_sim_ros.sequences.readers import open_sequence

        if self.bag.exists():  # before any work
            raise SequenceError(f"{self.bag} exists already; choose another name or remove it first")
        if self.fps is not None and not self.fps > 0:
            raise SequenceError(f"--fps must be positive, got {self.fps:g}")
        fixed = ("source", "bag", "kind")
        options = {name: value for name, value in vars(self).items() if name not in fixed and value is not None}
        frames = open_sequence(self.source, self.kind, **options)
        try:
            count = write_bag(self.bag, _tracked(frames, f"converting {self.source.name}"))
        except BaseException:  # half a conversion would only be in the way of the next try
            shutil.rmtree(self.bag, ignore_errors=True)
            raise
        print(f"{self.bag}: {count} frames")


@dataclass(frozen=True)
class Phantom:
    """Write a bag of a synthetic patient with exact poses, depth, stereo pair and mask."""

    bag: Positional[Path]
    """Folder of the new bag; it must not exist."""
    config: Annotated[PhantomConfig, tyro.conf.arg(name="")] = field(default_factory=PhantomConfig)

    def run(self) -> None:
        from endo_sim_ros.sequences.bag import write_bag
        from endo_sim_ros.sequences.phantom import phantom_sequence

        frames = _Sized(phantom_sequence(self.config), self.config.frames)
        print(f"{self.bag}: {write_bag(self.bag, _tracked(frames, 'rendering the patient'))} frames")


def _named_preset() -> ReconstructionConfig:
    """The options of the preset that the command line names: the defaults of options that it does not give."""
    name = "default"
    for word, following in zip(sys.argv, [*sys.argv[1:], ""]):
        if word == "--preset" or word.startswith("--preset="):
            name = following if word == "--preset" else word.removeprefix("--preset=")
    return preset(name if name in PRESETS else "default")  # the parser refuses other names


@dataclass(frozen=True)
class Reconstruct:
    """Reconstruct a Gaussian model from a bag without ROS, and measure it on the views that were held out."""

    bag: Positional[Path]
    """Bag with images, camera_info and poses."""
    out: Positional[Path]
    """Folder for model.ply, cameras.json, checkpoint.pt and held_out.png."""
    resume: bool = False
    """Go on from the checkpoint.pt that an interrupted reconstruction of the same bag with the same options left in that folder."""
    preset: Preset = "default"
    """Method: ours, ours sized for a CPU, that of the paper as printed, FSGS, or 3DGS. Options that are not given have the
    values of the preset."""
    config: Annotated[ReconstructionConfig, tyro.conf.arg(name="")] = field(default_factory=_named_preset)

    def run(self) -> None:
        from endo_sim_ros.evaluation.held_out import reconstruct_and_measure

        reconstruct_and_measure(self.bag, self.out, self.config, self.resume)


@dataclass(frozen=True)
class Evaluate:
    """Train methods on few views of sequences, measure each on the views held out, and compare, beside the paper's figures."""

    sequences: Annotated[Positional[tuple[str, ...]], tyro.conf.arg(metavar="SEQ [SEQ ...]")]
    """Bags, recordings as for convert, or phantom:0 (synthetic patients); options of the reader follow as ,name=value:
    phantom:1,frames=100 my_bag,step=2 video.mp4,fx=907."""
    config: Annotated[EvaluationConfig, tyro.conf.arg(name="")] = field(default_factory=EvaluationConfig)

    def run(self) -> None:
        from endo_sim_ros.evaluation.evaluate import evaluate

        cells = evaluate(self.sequences, self.config)["cells"]
        print(f"{self.config.out}: table.md, table.csv, results.json, views.csv, strips/, plots/")
        failed = sum(cell["error"] is not None for cell in cells)
        if failed:
            raise RuntimeError(f"{failed} of {len(cells)} cells failed, as the table says; the same command tries them again")


@dataclass(frozen=True)
class Report:
    """Show an evaluation as one HTML page: sortable tables beside the paper's, plots, pictures with a slider."""

    run_folder: Positional[Path]
    """Folder that `endo-sim evaluate` wrote; report.html goes there, too."""

    def run(self) -> None:
        from endo_sim_ros.evaluation.page import write_page

        print(write_page(self.run_folder))


@dataclass(frozen=True)
class Touch:
    """Poke, pull, grasp and cut a reconstructed model without ROS, and draw what it looks like."""

    model: Positional[Path]
    """PLY model, with the cameras.json that is saved beside it."""
    out: Path = Path("touch.png")
    """Picture to write."""
    config: Annotated[PhysicsConfig, tyro.conf.arg(name="")] = field(default_factory=PhysicsConfig)

    def run(self) -> None:
        from endo_sim_ros.evaluation.interaction_sheet import draw_touches

        draw_touches(self.model, self.out, self.config)


@dataclass(frozen=True)
class Demo:
    """Run the whole graph: replay, reconstruct, touch and render, each node its own process."""

    bag: Path | None = None
    """Bag to use; default: a synthetic patient."""
    out: Path = Path("out")
    """Folder for the results."""
    seed: int = 0
    """Synthetic patient: other seeds give other organs."""
    frames: int = 60
    """Synthetic patient: number of frames."""
    width: int = 480
    """Width of training and rendered images, pixels."""
    iterations: int = 1500
    """Training iterations."""
    force: float = 2.0
    """Largest force of the scripted tool, N."""
    timeout: float = 900.0
    """Give up after this long, seconds."""

    def run(self) -> None:
        from endo_sim_ros.graph.demo import run_demo

        run_demo(self.bag, self.out, self.seed, self.frames, self.width, self.iterations, self.force, self.timeout)


@dataclass(frozen=True)
class View:
    """Show a model in the browser and pull it with the mouse; needs no ROS."""

    model: Positional[Path]
    """PLY model, in metres; seen by the cameras in the cameras.json beside it, else from the world's origin."""
    config: Annotated[ViewerConfig, tyro.conf.arg(name="")] = field(default_factory=ViewerConfig)
    node_count: int | None = None
    """Number of control nodes; default: that of the physics."""
    device: str = "auto"
    """Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N."""

    def run(self) -> None:
        from endo_sim_ros.viewer.standalone import view

        count = {} if self.node_count is None else {"node_count": self.node_count}
        view(self.model, PhysicsConfig(device=self.device, **count), self.config)


@dataclass(frozen=True)
class Compress:
    """Write a model in SuperSplat's compressed layout, a quarter of the size; every command reads either."""

    model: Positional[Path]
    """PLY model, compressed or not."""
    out: Positional[Path]
    """File to write; a name that ends in .compressed.ply makes it compressed, any other .ply whole again."""

    def run(self) -> None:
        from endo_sim_ros.core.gaussians import load_ply, save_ply

        if self.out.suffix != ".ply":
            raise ModelError(f"{self.out}: models are written as .compressed.ply or .ply; give such a name")
        model, before = load_ply(self.model), self.model.stat().st_size  # the two files may be one
        save_ply(model, self.out)
        print(f"{self.out}: {len(model)} Gaussians, {self.out.stat().st_size / 1e6:.1f} MB, was {before / 1e6:.1f} MB")


@dataclass(frozen=True)
class Record:
    """Record a running graph into a rosbag2, for replay or `export`, until interrupted."""

    out: Positional[Path]
    """Folder of the new bag; it must not exist."""
    arms: tuple[str, ...] = ("PSM1",)
    """Names of the tool arms."""
    topics: tuple[str, ...] = ("all",)
    """Names of the topics to record, such as rendered/image_raw; all records every topic of msg_conventions.md."""
    namespace: str = ""
    """Namespace of the graph; the bag has the names without it."""

    def run(self) -> None:
        from endo_sim_ros.nodes.recorder_node import record

        record(self.out, self.arms, self.topics, self.namespace)


@dataclass(frozen=True)
class Export:
    """Turn recordings of the graph into a dataset to learn from; each is one episode."""

    paths: Annotated[Positional[tuple[Path, ...]], tyro.conf.arg(metavar="BAG [BAG ...] OUT")]
    """Recordings with rendered images, control nodes, and poses and reactions of tools; then the folder of the new dataset."""
    format: Literal["lerobot"] = "lerobot"
    """lerobot: a LeRobotDataset v3.0."""
    fps: int | None = None
    """Frames per second; default: those of the steps of a recording in lockstep, else 25."""
    arm: tuple[str, ...] = ()
    """Names of the tool arms; default: all in the recording."""
    task: str = "manipulate the tissue"
    """What was done, in words."""
    sampling: Literal["auto", "rate", "lockstep"] = "auto"
    """rate: the last message of each topic, at a fixed rate; lockstep: messages with equal stamps; auto: lockstep where there
    are such messages and no other fps is asked for."""
    images: Literal["video", "png"] = "video"
    """video: small (H.264); png: exact."""
    world_frame: str = "world"
    """Frame of the poses in the recording."""
    frames: tuple[str, ...] = ()
    """Other frames of poses and wrenches in the recording, as the nodes' parameter: 'PSM1_base x y z qx qy qz qw' each."""

    def run(self) -> None:
        from endo_sim_ros.learning.lerobot import export_lerobot

        if len(self.paths) < 2:
            raise SequenceError("give one recording or more, then the folder of the dataset")
        *bags, out = self.paths
        episodes, frames = export_lerobot(
            bags, out, self.task, self.fps, self.arm, self.sampling, self.images, self.world_frame, self.frames
        )
        print(f"{out}: {episodes} episode{'s' * (episodes != 1)}, {frames} frames")


@dataclass(frozen=True)
class SaveScene:
    """Write what starts the graph on a task to learn: model.ply, cameras.json and parameters.yaml for its nodes."""

    out: Positional[Path]
    """Folder to write; it may exist."""
    task: str = "retraction"
    """retraction or palpation."""
    model: Path | None = None
    """PLY model with its cameras.json; default: a piece of the synthetic patient."""
    seed: int = 0
    """Of the first episode."""

    def run(self) -> None:
        from endo_sim_ros.learning.scenes import load_scene, save_scene

        save_scene(load_scene(self.model), self.out, self.task, self.seed)
        print(f"{self.out}: model.ply, cameras.json, parameters.yaml")


@dataclass(frozen=True)
class Train:
    """Train a small policy on a task, and draw its learning curve."""

    out: Positional[Path]
    """Folder for policy.npz, curve.json and curve.png."""
    task: str = "retraction"
    """retraction or palpation."""
    algorithm: Literal["cem", "ppo"] = "cem"
    """cem: the cross-entropy method, by the options below; ppo: proximal policy optimisation, by those that begin with ppo; it
    needs stable-baselines3."""
    model: Path | None = None
    """PLY model with its cameras.json; default: a piece of the synthetic patient."""
    device: str = "auto"
    """Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N."""
    config: Annotated[TrainingConfig, tyro.conf.arg(name="")] = field(default_factory=TrainingConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    vary: Randomisation = field(default_factory=Randomisation)

    def run(self) -> None:
        from endo_sim_ros.learning.scenes import load_scene
        from endo_sim_ros.learning.train import save_training, train

        config, unused = self.config, self.ppo
        if self.algorithm == "ppo":
            from endo_sim_ros.learning.ppo import train_ppo as train

            config, unused = unused, config
        if unused != type(unused)():
            raise ConfigError(f"options that begin with --ppo. are for ppo, the others for cem; --algorithm is {self.algorithm}")
        self.out.mkdir(parents=True, exist_ok=True)  # before the long work
        policy, curve = train(self.task, load_scene(self.model), config, self.vary, self.device)
        save_training(self.out, policy, curve, config)
        last = curve[-1]
        print(f"{self.out}: {last['test_success']:.0%} of test episodes solved after {last['episodes']} episodes")


@dataclass(frozen=True)
class Up:
    """Start the graph, each node its own process, and show what each says, until Ctrl-C; `ros2 launch` without ROS installed."""

    bag: Path | None = None
    """Recording to replay; default: none, for a live endoscope."""
    params_file: Path | None = None
    """ROS parameter file for the nodes; `endo-sim config` prints one with all defaults."""
    namespace: str = ""
    """Namespace of all nodes and topics."""
    arms: tuple[str, ...] = ()
    """Names of the tool arms; default: as in the parameter file, else PSM1."""
    model: str = ""
    """PLY model to start with; latest = the newest one that was saved."""
    logs: Path = Path("~/.ros/endo_sim_ros/logs")
    """Folder for what each node prints."""
    respawn: bool = True
    """Start a node that crashes again, after a pause that grows, until it has crashed four times in a row soon after its start."""
    view: bool = False
    """Serve the page as well, on which tissue is seen and pulled with the mouse: http://localhost:8080."""

    def run(self) -> None:
        from endo_sim_ros.graph.up import run_up

        run_up(self.bag, self.params_file, self.namespace, self.arms, self.model, self.logs, self.respawn, self.view)


@dataclass(frozen=True)
class Config:
    """Print the parameters of all nodes, or of some, with their defaults as a ROS parameter file."""

    nodes: Positional[tuple[str, ...]] = ()
    """Names of nodes; default: all."""

    def run(self) -> None:
        from endo_sim_ros.nodes.configs import NODE_CONFIGS
        from endo_sim_ros.nodes.parameter_file import parameter_file

        nodes = [name if name in NODE_CONFIGS else name.removesuffix("_node") for name in self.nodes]  # executables end in _node
        unknown = [name for name in nodes if name not in NODE_CONFIGS]
        if unknown:
            raise ConfigError(f"no node is called {', '.join(unknown)}; there are {', '.join(NODE_CONFIGS)}")
        print(parameter_file(nodes or tuple(NODE_CONFIGS)), end="")


@dataclass(frozen=True)
class BenchRaster:
    """The rasteriser: forward, forward and backward, memory, and how time grows."""

    json: Path | None = None
    """File for the results as a list of rows."""
    device: str = "auto"
    """Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N."""

    def run(self) -> None:
        from benchmarks.raster import bench_raster

        bench_raster(self.device, self.json)


@dataclass(frozen=True)
class BenchPhysics:
    """The simulation: the paper's comparison of every Gaussian with sparse nodes, the cost of a step, and many copies of a tissue."""

    json: Path | None = None
    """File for the results as a list of rows."""
    device: str = "auto"
    """Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N."""
    model: Path | None = None
    """PLY model of the tissue, in metres, seen by the first camera of the cameras.json beside it, else from the world's
    origin; default: a piece of the synthetic patient."""
    environments: tuple[int, ...] = ()
    """Numbers of copies stepped together; default: 1 4 16 64, on a GPU also 256 1024."""

    def run(self) -> None:
        from benchmarks.physics import bench_physics

        bench_physics(self.device, self.json, self.model, self.environments)


@dataclass(frozen=True)
class BenchGraph:
    """The node graph over DDS, each node its own process: latency from wrench to image, rates and losses."""

    json: Path | None = None
    """File for the results as a list of rows."""
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
    device: str = "auto"
    """Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N."""
    kills: int = 3
    """Deaths of each node whose recovery is timed; 0 = none."""

    def run(self) -> None:
        from benchmarks.graph import bench_graph

        options = {name: value for name, value in vars(self).items() if name != "json"}
        bench_graph(self.json, **options)


@dataclass(frozen=True)
class BenchEnvironments:
    """The environments to learn in: steps per second, with states and with images."""

    json: Path | None = None
    """File for the results as a list of rows."""
    task: str = "retraction"
    """retraction or palpation."""
    environments: tuple[int, ...] = (1, 64)
    """Numbers of environments stepped together."""
    device: str = "auto"
    """Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N."""

    def run(self) -> None:
        from benchmarks.environments import bench_environments

        bench_environments(self.json, self.task, self.environments, self.device)


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
        from endo_sim_ros.graph.soak import soak

        soak(self.json, self.minutes, self.rate, self.seed)


@dataclass(frozen=True)
class Bench:
    """Measure speed on this machine, beside peers where they are installed; medians and ratios."""

    what: tyro.conf.OmitArgPrefixes[
        Annotated[BenchRaster, tyro.conf.subcommand("raster", prefix_name=False)]
        | Annotated[BenchPhysics, tyro.conf.subcommand("physics", prefix_name=False)]
        | Annotated[BenchGraph, tyro.conf.subcommand("graph", prefix_name=False)]
        | Annotated[BenchEnvironments, tyro.conf.subcommand("environments", prefix_name=False)]
        | Annotated[BenchSoak, tyro.conf.subcommand("soak", prefix_name=False)]
    ]

    def run(self) -> None:
        self.what.run()


@dataclass(frozen=True)
class Plot:
    """Draw results of `bench … --json` as bars; several files, such as those of two machines, side by side."""

    files: Positional[tuple[Path, ...]]
    """Files of rows; each gives its name to its bars."""
    out: Path = Path("bench.png")
    """Picture to write: .png, .svg or .pdf."""
    only: str = ""
    """Regular expression; rows whose names it is not found in are left out."""
    title: str = ""
    """Over the picture, such as the name of the machine."""

    def run(self) -> None:
        from benchmarks.plot import plot_rows

        if not self.files:
            raise ValueError("no files to plot; give those that `endo-sim bench … --json FILE` wrote")
        print(f"{self.out}: {plot_rows(self.files, self.out, self.only, self.title)} rows")


COMMANDS = {
    "demo": Demo,
    "view": View,
    "up": Up,
    "convert": Convert,
    "phantom": Phantom,
    "reconstruct": Reconstruct,
    "compress": Compress,
    "touch": Touch,
    "record": Record,
    "export": Export,
    "scene": SaveScene,
    "train": Train,
    "config": Config,
    "evaluate": Evaluate,
    "report": Report,
    "bench": Bench,
    "plot": Plot,
}


class _Sized:
    """An iterator whose length is known, for progress bars."""

    def __init__(self, items: Iterable[Frame], count: int):
        self._items, self._count = items, count

    def __iter__(self) -> Iterator[Frame]:
        return iter(self._items)

    def __len__(self) -> int:
        return self._count


def _tracked(frames: Iterable[Frame], text: str) -> Iterable[Frame]:
    return track(frames, description=text, total=len(frames) if hasattr(frames, "__len__") else None)


def main() -> int:
    hear_interrupts()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    start = time.monotonic()
    try:
        if sys.argv[1:2] and sys.argv[1] in COMMANDS:
            refuse_renamed_flags(sys.argv[2:], COMMANDS[sys.argv[1]])
        command = tyro.extras.subcommand_cli_from_dict(
            COMMANDS, prog="endo-sim", description="Endoscope recordings become tissue that a robot can touch."
        )
        command.run()
    except KeyboardInterrupt:
        return 130
    except (SequenceError, MessageError, ModelError, ConfigError, ImportError, RuntimeError, ValueError, OSError) as error:
        print(f"endo-sim: {str(error) or type(error).__name__}", file=sys.stderr)
        return 1
    logging.getLogger(__name__).info("done in %.0f s", time.monotonic() - start)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
