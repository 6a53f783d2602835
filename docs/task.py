"""Draws the moving pictures of docs/learning.md: scripted policies play episodes of a task, side by side. OpenCV 4.11 or newer writes it.

python docs/task.py camera docs/camera.webp
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros.learning.config import SightConfig
from endo_sim_ros.learning.policies import scripted_policy
from endo_sim_ros.learning.scenes import load_scene
from endo_sim_ros.learning.task_batch import TaskBatch

WIDTH, EPISODES, EVERY, MOST = 224, 3, 3, 120  # pixels, side by side, steps of a picture, steps
PATIENT, QUALITY = "phantom:2", 60


def main(task: str, target: Path) -> None:
    """Play a task and write a moving picture of it."""
    batch = TaskBatch(task, load_scene(PATIENT), EPISODES, "both", sight=SightConfig(image_width=WIDTH), device="cpu")
    policy = scripted_policy(task, EPISODES)
    batch.reset(range(EPISODES), [np.random.default_rng(seed) for seed in range(EPISODES)])
    policy.reset(range(EPISODES))
    seen, frames, running = batch.observe(), [], np.ones(EPISODES, bool)
    last = seen["image"]
    for step in range(MOST):
        last = np.where(running[:, None, None, None], seen["image"], last)
        if step % EVERY == 0:
            frames.append(np.hstack([*last])[..., ::-1].copy())
        if not running.any():
            break
        seen, outcome = batch.step(policy.act(seen["state"]))
        running &= ~(outcome.terminated | outcome.truncated)
    animation = cv2.Animation()
    animation.frames, animation.durations = frames, [40 * EVERY] * (len(frames) - 1) + [1500]
    if not cv2.imwriteanimation(str(target), animation, [cv2.IMWRITE_WEBP_QUALITY, QUALITY]):
        raise SystemExit(f"{target} could not be written; name a .webp in a folder that is there")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
