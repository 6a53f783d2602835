"""How a mouse pulls at tissue: a jaw that holds it, follows the mouse, and is no stronger than it should be."""

import numpy as np

_SETTLE = 0.08  # s that the tip waits at the tissue before the jaw closes: pose and jaw may travel on different ways
_YIELD = 0.15  # s in which the pull follows what the force allows; several steps, as reactions come late
_SLOWEST = 0.1  # share of the largest speed that is left near the largest force
_FELT = 0.02  # share of the largest force below which a reaction tells nothing of the stiffness


class Grasp:
    """The pose of a jaw between its closing on a point of the tissue and its opening.

    The tip moves from the point towards the target, not faster than ``max_speed``. Where the reaction says that the way
    would take more than ``max_force``, taking the tissue for a linear spring, it stops short. As the jaw moves tissue by
    its position, this is stable for any stiffness; a spring between mouse and tissue would swing as soon as it is
    stiffer than what it pulls at, since the tissue comes to rest within a step.

    Args:
        pose: Pose of the tip [4, 4] on the tissue, m, world.
        max_force: N.
        max_speed: m/s.
        longest_pull: Longest pull, m.
    """

    def __init__(self, pose: np.ndarray, max_force: float, max_speed: float, longest_pull: float):
        self.start = np.array(pose, np.float64)
        self._max_force, self._max_speed, self._longest_pull = max_force, max_speed, longest_pull
        self.target = self._pull = np.zeros(3)
        self._age = 0.0

    @property
    def closed(self) -> bool:
        """Whether the jaw is closed by now."""
        return self._age > _SETTLE

    @property
    def pose(self) -> np.ndarray:
        """Pose of the tip [4, 4], m, world."""
        pose = self.start.copy()
        pose[:3, 3] += self._pull
        return pose

    def aim(self, target: np.ndarray) -> None:
        """Where the tip [3] shall go, m, world."""
        self.target = _shortened(np.asarray(target, np.float64) - self.start[:3, 3], self._longest_pull)

    def advance(self, seconds: float, reaction: float) -> np.ndarray:
        """Pose of the tip after some time in which the tissue resisted with a force, N."""
        was_closed, self._age = self.closed, self._age + seconds
        if not was_closed:
            return self.pose
        length, step, most = float(np.linalg.norm(self._pull)), self.target - self._pull, self._max_speed * seconds
        if length and reaction > _FELT * self._max_force:
            allowed = _shortened(self.target, length * self._max_force / reaction)
            if allowed is not self.target:
                step = (allowed - self._pull) * (1 - np.exp(-seconds / _YIELD))
        if step @ self._pull > 0:  # gently towards the limit, as the reaction is that of a while ago
            most *= max(1 - reaction / self._max_force, _SLOWEST)
        self._pull = self._pull + _shortened(step, most)
        return self.pose


def _shortened(vector: np.ndarray, longest: float) -> np.ndarray:
    """The vector, or one in its direction of the greatest allowed length."""
    length = float(np.linalg.norm(vector))
    return vector if length <= longest else vector * (longest / length)
