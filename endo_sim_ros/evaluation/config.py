"""Options of an evaluation."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from endo_sim_ros.core.config import ConfigError


@dataclass(frozen=True)
class EvaluationConfig:
    """What to compare, and where the results go."""

    out: Path = Path("evaluation")
    """Folder for the results; what is finished in it is not done again."""
    splits: tuple[str, ...] = ("1:49", "1:99", "two-views")
    """Which views train: 1:49 (and other ratios train:held out), two-views (first and last), every-12th (every twelfth trains),
    all-but-12th (every twelfth is held out), stereo (left images train, right ones are held out)."""
    presets: tuple[str, ...] = ("3dgs", "fsgs", "paper", "default")
    """Presets of the trainer."""
    ablation: bool = False
    """Also each preset without one of its parts at a time."""
    held_out: int = 1000
    """Held-out views that are measured at most, evenly spread: of ten thousand frames the others would tell nothing new."""
    seeds: int = 1
    """Repetitions with other seeds; figures are then mean ± standard deviation."""
    set: tuple[str, ...] = ()
    """Options of the reconstruction for all presets: name=value, as iterations=500 mcmc.growth=0.1."""
    train_depth: bool = False
    """Give the recorded depth images to the training, too; without it they are for measuring only."""
    mono: bool = False
    """Take the right images away from the training."""
    curve: int = 0
    """Number of moments of the training at which PSNR is measured for curves of quality over time; 0 = none."""
    lpips: tuple[Literal["alex", "vgg"], ...] = ("alex", "vgg")
    """Networks of LPIPS."""
    weights: Path | None = None
    """Folder with the weights of LPIPS (alexnet*.pth, vgg16*.pth); default: torch's cache."""
    device: str = "auto"
    """Where to compute: auto (all GPUs, else the CPU), cpu, cuda or cuda:N."""
    workers: int = 1
    """Trainings at a time on each GPU, or on the CPU."""
    pool: Literal["auto", "processes", "ray"] = "auto"
    """What trainings are spread over: processes of this machine, or the hosts of a Ray cluster; auto takes Ray if installed."""
    json: Path | None = None
    """File for the means as a list of rows; ratio is to 3dgs."""

    def __post_init__(self):
        for name, least in (("held_out", 1), ("seeds", 1), ("workers", 1), ("curve", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"--{name.replace('_', '-')} must be {least} or more, got {getattr(self, name)}")
        for name in ("splits", "presets"):
            if not getattr(self, name):
                raise ConfigError(f"--{name}: name one or more")
