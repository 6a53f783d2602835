"""`endo-sim train`."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.learning.config import PPOConfig, Randomisation, TrainingConfig, without_pictures
from endo_sim_ros.physics.config import MotionConfig


@dataclass(frozen=True)
class Command:
    """Train a small policy on a task, and draw its learning curve."""

    out: Positional[Path]
    """Folder for policy.npz, curve.json and curve.png."""
    task: str = "retraction"
    """Name of the task, such as retraction or palpation; an unknown one is answered with the list."""
    algorithm: Literal["cem", "ppo"] = "cem"
    """cem: the cross-entropy method, by the options below; ppo: proximal policy optimisation, by those that begin with ppo; it
    needs stable-baselines3."""
    actions: Literal["cartesian", "joints", "joint_positions"] = "cartesian"
    """What the policy moves: the tip of the tool, or the joints of its arm, by how far or to where; docs/learning.md says more."""
    contact: Literal["point", "links"] = "point"
    """What touches the tissue: the tip that the task describes, or the links of the instrument."""
    model: Path | None = None
    """PLY model with its cameras.json, or phantom:SEED, a piece of a synthetic patient; default: phantom:0."""
    device: str = "auto"
    """Compute device: auto (the GPU when there is one), cpu, cuda or cuda:N."""
    config: Annotated[TrainingConfig, tyro.conf.arg(name="")] = field(default_factory=TrainingConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    vary: Randomisation = field(default_factory=Randomisation)
    motion: MotionConfig = field(default_factory=MotionConfig)

    def run(self) -> None:
        """Train and save, after an interrupt the best so far; raises ConfigError if options have no effect."""
        from endo_sim_ros.core.folders import claimed, leaving_none_empty, told_if_not_kept
        from endo_sim_ros.learning.policy_folder import check_free
        from endo_sim_ros.learning.scenes import load_scene
        from endo_sim_ros.learning.train import Best, save_training, train

        for text in without_pictures(self.vary, self.actions != "cartesian" or self.contact == "links"):
            raise ConfigError(text)
        config, unused, learn = self.config, self.ppo, partial(train, config=self.config)
        if self.algorithm == "ppo":
            from endo_sim_ros.learning.ppo import train_ppo

            config, unused, learn = self.ppo, self.config, partial(train_ppo, config=self.ppo)
        if unused != type(unused)():
            raise ConfigError(f"options that begin with --ppo. are for ppo, the others for cem; --algorithm is {self.algorithm}")
        untrained = 0 if self.algorithm == "ppo" and self.ppo.demonstrations else 1  # first points of the curve
        none_learned = "no policy was tested since it began to learn"
        with leaving_none_empty(self.out), told_if_not_kept(self.out / "policy.npz", none_learned), claimed(self.out):
            check_free(self.out)
            options = {
                "randomisation": self.vary,
                "device": self.device,
                "actions": self.actions,
                "contact": self.contact,
                "motion": self.motion,
            }
            best = Best()
            try:
                learn(self.task, load_scene(self.model), **options, best=best)
            finally:  # an interrupt, too, keeps what has been learned
                if len(best.curve) > untrained:
                    save_training(self.out, best.policy, best.curve, config)
                    point = max(best.curve, key=lambda point: (point["test_success"], point["test_return"]))
                    print(f"{self.out}: {point['test_success']:.0%} of test episodes solved after {point['episodes']} episodes")
