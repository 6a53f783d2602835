"""An image policy, as a user writes one: goes where the picture is blue, down until it feels something, and up again."""

import numpy as np

from endo_sim_ros.learning.config import SightConfig


class BlueSeeker:
    """See above."""

    actions = "cartesian"
    sight = SightConfig(image_width=48, eyes=2)

    def __init__(self, count):
        self.count = count

    def reset(self, episodes):
        pass

    def act(self, observations):
        arm = observations["arm"].astype(np.float64)
        moves = [self._way(observations["image"]), self._way(observations["image_right"])]
        across = np.clip(np.mean(moves, 0) * [4, -4], -1, 1)
        felt = np.linalg.norm(arm[:, 8:], axis=1) > 0.05
        return np.column_stack([across, np.where(felt, 0.3, -0.5), np.where(felt, 1.0, -1.0)])

    @staticmethod
    def _way(images):
        """From the middle of pictures to where they are blue [B, 2], in parts of their size."""
        blue = np.maximum(images[..., 2].astype(np.float64) - images[..., 0], 0) + 1e-6
        rows, columns = (np.linspace(-0.5, 0.5, size) for size in blue.shape[1:])
        total = blue.sum((1, 2))
        return np.stack([(blue * columns).sum((1, 2)) / total, (blue * rows[:, None]).sum((1, 2)) / total], 1)


class Lost(BlueSeeker):
    """Knows no more what to do in the second episode."""

    episodes = 0

    def reset(self, episodes):
        self.episodes += 1

    def act(self, observations):
        return super().act(observations) * (np.nan if self.episodes > 1 else 1)
