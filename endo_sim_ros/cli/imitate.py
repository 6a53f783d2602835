"""`endo-sim imitate`."""

import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from endo_sim_ros.core.config import ConfigError, unused_options
from endo_sim_ros.core.folders import claimed, leaving_none_empty, told_if_not_kept
from endo_sim_ros.learning.config import ImitationConfig


@dataclass(frozen=True)
class Command:
    """Train an image policy on demonstrations: a small one of this package, or by lerobot; without that say what to install."""

    dataset: Positional[Path]
    """Folder that `endo-sim demonstrate` wrote."""
    out: Positional[Path]
    """Folder for what is trained, which `endo-sim benchmark` and policy_node take as a policy."""
    config: Annotated[ImitationConfig, tyro.conf.arg(name="")] = field(default_factory=ImitationConfig)
    device: str = "auto"
    """Where keypoints are trained, not those of lerobot: auto (the GPU when there is one), cpu, cuda or cuda:N."""

    def run(self) -> None:
        """Write and train; raises SequenceError if the dataset cannot be used, ConfigError if options cannot, RuntimeError if the training
        fails."""
        for text in unused_options(self.config):
            raise ConfigError(text)
        if (self.out / "meta/info.json").exists():
            raise ConfigError(f"{self.out} is a dataset; give the policy a folder of its own")
        with leaving_none_empty(self.out), claimed(self.out):
            self._train()

    def _train(self) -> None:
        from endo_sim_ros.learning.lerobot_policy import PACKAGES, available, write_training

        if self.config.policy == "keypoints":
            from endo_sim_ros.learning.keypoint_policy import FILE, KEPT_FROM, train_keypoints

            few = f"fewer than {KEPT_FROM:.0%} of the steps were done"
            with told_if_not_kept(self.out / FILE, few):
                train_keypoints(self.dataset, self.out, self.config, self.device)
            print(f"{self.out}: trained; endo-sim benchmark OUT {self.out}")
            return
        if self.device != "auto":
            way = "lerobot takes the GPU where there is one; CUDA_VISIBLE_DEVICES=3 before the command is that of this number"
            raise ConfigError(f"device has no effect while policy is {self.config.policy}: {way}")
        path = write_training(self.dataset, self.out, self.config)
        if not available():
            print(f"{path} is written, but lerobot, which trains by it, is not installed here. In an environment with Python 3.12:")
            print(f"  pip install '{PACKAGES}'\n  lerobot-train --config_path={path}")
            return
        words = [sys.executable, "-m", "lerobot.scripts.lerobot_train", f"--config_path={path}"]
        if status := subprocess.run(words, check=False).returncode:
            raise RuntimeError(f"lerobot ended with status {status}; what it wrote is above")
        print(f"{self.out}: trained; endo-sim benchmark OUT {self.out}")
