"""Choice of the few views to train on."""

import numpy as np

from endo_sim_ros.core.frames import Frame


def select_keyframes(frames: list[Frame], count: int, scene_depth: float = 0.1) -> list[int]:
    """Indices, in order, of at most ``count`` views that spread over the camera path.

    Greedy farthest-point choice, beginning with the first and the last view; the distance between two poses is the
    translation plus the shift that a rotation gives a point at ``scene_depth`` (metres), by default a usual distance of a laparoscope.
    """
    if count >= len(frames):
        return list(range(len(frames)))
    poses = np.array([frame.camera.pose for frame in frames])
    # Optical centre and a point ahead of it: their movement measures translation and viewing direction alike.
    ahead = poses[:, :3, 3] + scene_depth * poses[:, :3, 2]
    features = np.concatenate([poses[:, :3, 3], ahead], 1)
    chosen = [0, len(frames) - 1][: max(count, 1)]
    distance = np.min([np.linalg.norm(features - features[i], axis=1) for i in chosen], 0)
    while len(chosen) < count:
        distance[chosen] = -1.0  # identical poses must not be picked twice
        farthest = int(distance.argmax())
        chosen.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(features - features[farthest], axis=1))
    return sorted(chosen)
