"""How a mouse pulls at tissue: a jaw that holds it, follows the mouse, and is no stronger than it should be."""

import numpy as np

_SETTLE = 0.08  # s that the tip waits at the tissue before the jaw closes: pose and jaw may travel on different ways
_YIELD = 0.15  # s in which the pull follows what the force allows; several steps, as reactions come late
_SLOWEST = 0.1  # share of the largest speed that is left near the largest force
_FELT = 0.02  # share of the largest force below which a reaction tells nothing of the stiffness


class Grasp:
    """The pose of a jaw from its way to a point of the tissue to its way back.

    The tip comes along its z axis, and the jaw closes. Then it moves towards the target, not faster than ``max_speed``. Where the
    reaction says that the way would take more than ``max_force``, taking the tissue for a linear spring, it stops short. As the jaw
    moves tissue by its position, this is stable for any stiffness; a spring between mouse and tissue would swing as soon as it is
    stiffer than what it pulls at, since the tissue comes to rest within a step.

    Args:
        pose: Pose of the tip [4, 4] at the tissue, m, world.
        max_force: N.
        max_speed: m/s.
        longest_pull: Longest pull, m.
        ahead: How far in front of the tissue the tip comes from, and goes back to, m.
    """

    def __init__(self, pose: np.ndarray, max_force: float, max_speed: float, longest_pull: float, ahead: float = 0.0):
        self.start = np.array(pose, np.float64)
        self._max_force, self._max_speed, self._longest_pull = max_force, max_speed, longest_pull
        self.target = self._pull = np.zeros(3)
        self._ahead = self._way = ahead  # m: where it comes from; what is left of the way
        self._age = 0.0  # s at the tissue

    @property
    def closed(self) -> bool:
        """Whether the jaw is closed by now."""
        return self._age > _SETTLE

    @property
    def pose(self) -> np.ndarray:
        """Pose of the tip [4, 4], m, world."""
        pose = self.start.copy()
        pose[:3, 3] += self._pull - self._way * pose[:3, 2]
        return pose

    def aim(self, pull: np.ndarray) -> None:
        """How far what is held shall be pulled [3], m, world."""
        self.target = _shortened(np.asarray(pull, np.float64), self._longest_pull)

    def resistance(self, force: np.ndarray) -> float:
        """How hard the tissue resists the pull, N, by the force [3] on it, N, world; what jaws press with from the side does not count."""
        length = float(np.linalg.norm(self._pull))
        return max(float(force @ self._pull) / length, 0.0) if length else 0.0

    def withdraw(self, seconds: float) -> bool:
        """Go back for some time; returns whether it is on its way still."""
        before, self._way = self._way, min(self._way + self._max_speed * seconds, self._ahead)
        return self._way > before

    def advance(self, seconds: float, reaction: float) -> np.ndarray:
        """Pose of the tip after some time in which the tissue resisted with a force, N."""
        if self._way > 0:
            self._way = max(self._way - self._max_speed * seconds, 0.0)
            return self.pose
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
