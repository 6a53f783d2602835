"""How one episode differs from the scene, by its chance."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from endo_sim_ros.core.cameras import rigid_pose
from endo_sim_ros.learning.config import Randomisation

_FIRST, _MORE = 10, 12  # numbers that are drawn
_BELOW = 1e-9  # share taken off random stiffness: rounded, it must not exceed what the substeps were planned for


def departed(poses: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Poses of endoscopes [4, 4] or [B, 4, 4], camera to world, that each depart from as `Variation.camera` [B, 4, 4] has it."""
    left = moved.copy()
    left[:, :3, :3] = poses[..., :3, :3] @ moved[:, :3, :3]
    left[:, :3, 3] += poses[..., :3, 3]
    return left


@dataclass(frozen=True)
class Variation:
    """What an episode has of each kind of randomisation.

    Args:
        by: How much of each there may be.
        chance: Numbers [10] in -1 … 1.
        more: Further ones [12].
    """

    by: Randomisation
    chance: np.ndarray
    more: np.ndarray

    @classmethod
    def draw(cls, by: Randomisation, rng: np.random.Generator) -> "Variation":
        """By a generator, from which always as many numbers are taken, so that what is randomised does not change the task."""
        chance = rng.uniform(-1, 1, _FIRST)
        # From a generator of their own, so that later episodes of a seed stay as they were before there were these kinds.
        return cls(by, chance, np.random.default_rng(chance.view(np.uint32)).uniform(-1, 1, _MORE))

    @property
    def stiffness(self) -> float:
        """Factor on the moduli."""
        return float(np.exp(self.by.stiffness * self.chance[0]) * (1 - _BELOW * (self.by.stiffness > 0)))

    @property
    def camera(self) -> np.ndarray:
        """Pose [4, 4] of the endoscope in the frame of the scene's, but its position is along the axes of the world, m."""
        turn = Rotation.from_rotvec(np.radians(self.by.camera_angle) * self.chance[4:7])
        return rigid_pose(turn.as_matrix(), self.by.camera_position * self.chance[1:4])

    @property
    def light(self) -> np.ndarray:
        """Factor on the brightness, and by how much less the corners of a square picture have [2]."""
        return np.array([1 + self.by.light * self.chance[7], self.by.light * 0.5 * (1 + self.chance[8])])

    @property
    def texture(self) -> float:
        """Factor on the contrast of the tissue's colours."""
        return 1 + self.by.texture * float(self.chance[9])

    def tool(self, count: int) -> int | None:
        """Number of the tool, of so many; None = that of the task."""
        share = 0.5 * (self.more[0] + 1)
        return min(int(share / self.by.tool * count), count - 1) if share < self.by.tool else None

    def trocar(self, base: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Where a base [4, 4] stands in this episode, m, world, turned about a place [3]."""
        turned = base.copy()
        if self.by.trocar_angle or self.by.trocar_position:
            R = Rotation.from_rotvec(np.radians(self.by.trocar_angle) * self.more[1:4]).as_matrix()
            turned[:3, :3] = R @ base[:3, :3]
            turned[:3, 3] = centre + R @ (base[:3, 3] - centre) + self.by.trocar_position * self.more[4:7]
        return turned

    @property
    def metal(self) -> np.ndarray:
        """Factors on what surfaces of the tool give back and on their roughness [2]."""
        return 1 + self.by.metal * self.more[7:9]

    @property
    def lamp(self) -> np.ndarray:
        """By how much the lamp is moved [3], m, camera."""
        return self.by.lamp * self.more[9:12]

    @property
    def phases(self) -> np.ndarray:
        """In which breath and heart begin [2], in periods."""
        return np.random.default_rng(self.more.view(np.uint32)).uniform(0, 1, 2)  # as above

    def values(self) -> dict[str, np.ndarray | float]:
        """What was drawn of each kind that there is, but the tool, by the names of the options; angles in degrees."""
        by = self.by
        kinds: dict[str, Callable[[], np.ndarray | float]] = {
            "stiffness": lambda: self.stiffness,
            "light": lambda: self.light,
            "texture": lambda: self.texture,
            "camera_position": lambda: by.camera_position * self.chance[1:4],
            "camera_angle": lambda: by.camera_angle * self.chance[4:7],
            "trocar_angle": lambda: by.trocar_angle * self.more[1:4],
            "trocar_position": lambda: by.trocar_position * self.more[4:7],
            "metal": lambda: self.metal,
            "lamp": lambda: self.lamp,
        }
        return {name: value() for name, value in kinds.items() if getattr(by, name)}
