"""Draws docs/tension.gif and docs/handover.gif: a task solved by its scripted policy, the end held. OpenCV 4.11 or newer writes them.

python docs/task_animation.py tension docs/tension.gif
"""

import sys

import cv2
import numpy as np

from endo_sim_ros.learning.config import SightConfig
from endo_sim_ros.learning.policies import scripted_policy
from endo_sim_ros.learning.scenes import load_scene
from endo_sim_ros.learning.task_batch import TaskBatch

SCENE, SEED = "phantom:3", 36
WIDTH, EVERY, HELD = 240, 3, 1.0  # pixels; steps from one picture to the next; seconds that the last one stays


def main() -> None:
    """Play, draw and write."""
    task, target = sys.argv[1:]
    batch = TaskBatch(task, load_scene(SCENE), 1, "both", sight=SightConfig(image_width=2 * WIDTH), device="cpu")
    batch.reset([0], [np.random.default_rng(SEED)])
    policy, seen, pictures, ended = scripted_policy(task), batch.observe(), [], False
    while not ended:
        assert isinstance(seen, dict)  # of state and image
        pictures.append(seen["image"][0])
        seen, outcome = batch.step(policy.act(seen["state"]))
        ended = bool(outcome.terminated[0] or outcome.truncated[0])
    duration = round(1000 * batch.task.physics().step_duration)
    size = WIDTH, WIDTH * pictures[0].shape[0] // pictures[0].shape[1]
    shown = [*pictures[:-1:EVERY], pictures[-1]]
    animation = cv2.Animation()
    animation.frames = [cv2.resize(cv2.cvtColor(each, cv2.COLOR_RGB2BGR), size, interpolation=cv2.INTER_AREA) for each in shown]
    animation.durations = [EVERY * duration] * (len(shown) - 1) + [round(1000 * HELD)]
    if not cv2.imwriteanimation(target, animation):
        raise SystemExit(f"{target} could not be written; name a .gif in a folder that is there")


if __name__ == "__main__":
    main()
