"""Camera: keep the tip of a moving instrument in the picture; the task, and a script that solves it."""

import numpy as np

from endo_sim_ros.core.cameras import invert_pose
from endo_sim_ros.instruments import PlacementConfig, load_arm
from endo_sim_ros.instruments.inverse import aim_shaft
from endo_sim_ros.learning.tasks.task import LENGTH, Script, Task, dot, norm
from endo_sim_ros.physics import ControlNodes, PhysicsConfig

_TONES = 3  # sines of the path, along each axis


class Camera(Task):
    """Guide the endoscope, so that the tip of an instrument that moves stays in the middle of the picture.

    The endoscope is on an ECM, which turns it about its remote centre. An action turns it to the right and up as its picture shows
    these, slides it in, and rolls it, in parts of `turn`, `step_length` and `roll`. The instrument moves above the tissue on a smooth
    path of its own. The view is good while the tip is within `middle` of the optical axis and `near` of the wanted distance, and the
    picture within `level` of upright. The episode is solved after `wanted` steps with a good view.
    """

    name = "camera"
    sentence = "Guide the endoscope: keep the tip of the instrument in the middle, at the same distance, and the picture upright."
    observation_names = (
        *("tip_right", "tip_up", "tip_far", "roll", "moves_right", "moves_up", "moves_far", "good"),
        *("ecm_yaw", "ecm_pitch", "ecm_insertion"),
        *(f"force_{axis}" for axis in "xyz"), "force", "time_left",
    )  # fmt: skip
    horizon, force_limit = 150, 1.0
    roams = turns = True
    low, high = (-0.018, -0.018, 0.0), (0.018, 0.018, 0.045)
    open_jaw = 0.2
    turn, roll = 0.01, 0.02  # rad a step: half a radian a second
    middle, near, level, wanted = 0.06, 0.01, 0.1, 100  # slope from the axis, m, rad, steps
    span = (0.5, 0.5, 0.06, 0.8)  # how far the joints go from where the scene has the endoscope, rad and m
    share = 0.85  # wanted distance, in parts of that from which the scene was seen: instruments are in front of the tissue

    @staticmethod
    def physics(device: str = "auto") -> PhysicsConfig:
        """Soft tissue, which nothing touches."""
        return PhysicsConfig(node_count=800, layers=2, thickness=0.015, young_modulus=4e3, device=device)

    @staticmethod
    def script(count: int) -> "CameraScript":
        """The one below."""
        return CameraScript()

    def __init__(self, nodes: ControlNodes, endoscope: np.ndarray, count: int = 1):
        super().__init__(nodes, endoscope, count)
        self._arm = load_arm("ECM")
        self._middle = self._arm.lower + np.array([0, 0, PlacementConfig().insertion, 0]) * (self._arm.upper - self._arm.lower)
        self._middle[[0, 1, 3]] = 0.0  # as `place_arm` has it
        self._base = self.endoscope @ invert_pose(self._arm.tip_pose(self._middle))
        self._lower = np.maximum(self._middle - self.span, self._arm.lower)
        self._upper = np.minimum(self._middle + self.span, self._arm.upper)
        away = np.sqrt(((self.rest[self.places] - self.endoscope[:3, 3]) ** 2).sum(1))
        self.distance = self.share * float(np.median(away))  # m, that is wanted
        self.joints = np.tile(self._middle, (count, 1))  # yaw, pitch, insertion, roll
        self._path = np.zeros((count, self.horizon + 1, 3))  # of the tip, m, task frame
        self._seen, self._before = np.zeros((count, 3)), np.zeros((count, 3))  # tip: right, up and far in the picture, now and before
        self._good = np.zeros(count, int)

    def _reset(self, b: int, rng: np.random.Generator) -> None:
        self._path[b] = self._draw_path(b, rng)
        self.tip[b] = self._path[b, 0]
        # The tip is in the picture, but neither in the middle nor at its distance, and the picture is not upright.
        sides, amounts = rng.choice([-1.0, 1.0], 2), rng.uniform(0, 1, 4)
        tip = (invert_pose(self._base) @ np.append(self.tips()[b], 1.0))[:3]
        off, angle = 0.1 + 0.1 * amounts[0], 2 * np.pi * amounts[1]  # slope
        depth = self.distance + sides[0] * (0.015 + 0.01 * amounts[2])
        outside = np.linalg.norm(tip) - depth  # from the remote centre to the lens
        yaw, pitch = np.concatenate(aim_shaft(tip[None])) + off * depth / (outside + depth) * np.array([np.cos(angle), np.sin(angle)])
        lens = -self._arm.tip_pose(self._middle)[2, 3] - self._middle[2]  # of the endoscope beyond its insertion
        joints = np.array([yaw, pitch, outside - lens, sides[1] * (0.15 + 0.2 * amounts[3])])
        self.joints[b] = np.clip(joints, self._lower, self._upper)
        self._good[b] = 0
        self._see()
        self._before[b] = self._seen[b]

    def _draw_path(self, b: int, rng: np.random.Generator) -> np.ndarray:
        """A smooth way [T, 3] above the skin, m, task frame: slow sines along each axis."""
        around = self.skin_in_frame(b)
        near = np.abs(around[:, :2]).max(1) <= 1.5 * self.high[0]
        above = max(float(around[near, 2].max()), 0.0) + 0.012
        periods, phases = rng.uniform(3.0, 9.0, (_TONES, 3)), rng.uniform(0, 2 * np.pi, (_TONES, 3))  # s
        time = np.arange(self.horizon + 1) * self.physics().step_duration
        waves = np.sin(2 * np.pi * time[:, None, None] / periods + phases).sum(1) / _TONES
        return np.clip(waves * [*self.high[:2], 0.008] + [0, 0, above], self.low, self.high)

    def skin_in_frame(self, b: int) -> np.ndarray:
        """The skin at rest [K, 3], m, in the frame of episode b."""
        return dot(self.axes[b], (self.rest[self.skin] - self.origin[b])[:, None])

    def act(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `Task.act`: where the tips are on their paths at the end of the step; the actions move the endoscopes."""
        actions = self.check_actions(actions, 4)
        self.joints = self.aim(actions)
        self._before = self._seen.copy()
        found = self.go(self._next(), actions[:, 3])
        self._see()
        return found

    def aim(self, actions: np.ndarray) -> np.ndarray:
        """Joints of the endoscopes [B, 4] that actions [B, 4] ask for, rad and m."""
        right, up, slide, roll = np.asarray(actions, np.float64).clip(-1, 1).T
        c, s = np.cos(self.joints[:, 3]), np.sin(self.joints[:, 3])
        moves = [-self.turn * (right * c + up * s), self.turn * (up * c - right * s), self.step_length * slide, self.roll * roll]
        return np.clip(self.joints + np.stack(moves, 1), self._lower, self._upper)

    def endoscope_joints(self, actions: np.ndarray | None = None) -> np.ndarray:
        """Joints of the endoscopes [B, 4], rad and m, now, or where actions [B, 4] take them."""
        return self.joints.copy() if actions is None else self.aim(actions)

    def endoscopes(self, actions: np.ndarray | None = None) -> np.ndarray:
        """Poses of the endoscopes [B, 4, 4], camera to world, m, now, or where actions [B, 4] take them."""
        return self._base @ self._arm.tip_pose(self.endoscope_joints(actions))

    def reach(self, actions: np.ndarray) -> np.ndarray:
        """Where the tips go next on their paths [B, 3], m, world, whatever the actions are."""
        return self.origin + self._to_world(self._next())

    def _next(self) -> np.ndarray:
        return self._path[np.arange(self.count), np.minimum(self.steps + 1, self.horizon)]

    def _see(self) -> None:
        """Where the tips are in the pictures."""
        poses = self.endoscopes()
        x, y, z = dot(poses[:, :3, :3].transpose(0, 2, 1), (self.tips() - poses[:, :3, 3])[:, None]).T
        z = np.maximum(z, 1e-3)
        self._seen = np.stack([x / z, -y / z, z - self.distance], 1)

    def dyed_spots(self, b: int) -> tuple:
        """None: the tip is the target."""
        return ()

    def goal_lines(self) -> tuple[str, ...]:
        """How far the view is from a good one, and how long it has been good."""
        right, up, far = self._seen[0]
        off, rolled = np.hypot(right, up), np.rad2deg(self.joints[0, 3])
        return (
            f"tip {abs(far) * 1e3:.0f} mm too {'far' if far > 0 else 'near'}, good within {self.near * 1e3:.0f} mm",
            f"{off:.2f} beside the middle (slope), good within {self.middle:g}",
            f"rolled by {rolled:+.0f}°, good within {np.rad2deg(self.level):.0f}°",
            f"good for {self._good[0]} of {self.wanted} steps",
        )

    def _columns(self, here: np.ndarray) -> list[np.ndarray]:
        right, up, far = self._seen.T
        moves = (self._seen - self._before).T
        travelled = ((self.joints - self._middle) / self.span).T
        seen = [right / self.middle, up / self.middle, far / LENGTH, self.joints[:, 3] / self.level]
        return [*seen, moves[0] / self.middle, moves[1] / self.middle, moves[2] / LENGTH, self._good / self.wanted, *travelled[:3]]

    def _errors(self) -> np.ndarray:
        """How far each view is from a good one [B, 3], 1 where it is just good: from the axis, in distance, and in roll."""
        right, up, far = self._seen.T
        off = np.sqrt(right * right + up * up)
        return np.stack([off / self.middle, np.abs(far) / self.near, np.abs(self.joints[:, 3]) / self.level], 1)

    def _value(self) -> np.ndarray:
        # 2 for the good steps, and −1 for views that are three times as far off as a good one may be: coming nearer pays at once.
        return 2 * np.minimum(self._good / self.wanted, 1.0) - norm(self._errors()) / 3

    def _judge_goal(self) -> np.ndarray:
        self._good = self._good + (self._errors() <= 1).all(1)
        return self._good >= self.wanted


class CameraScript(Script):
    """Turns towards where the tip will be, keeps the distance, and rolls upright."""

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions [B, 4] for state observations [B, n]."""
        o = dict(zip(Camera.observation_names, self.states(observations).T))
        # The remote centre is about as far behind the lens as the tip is before it, so that a turn moves the tip by twice its angle.
        turns = [0.5 * Camera.middle * o[f"tip_{axis}"] / Camera.turn for axis in ("right", "up")]
        slide, roll = LENGTH * o["tip_far"] / Camera.step_length, -Camera.level * o["roll"] / Camera.roll
        return np.clip(np.stack([*turns, slide, roll], 1), -1, 1)
