"""Recordings of tools that press flat tissue, made by hand: what is in them is known exactly."""

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.core.cameras import rigid_pose
from endo_sim_ros.messages import ControlNodeCloud, bag_types
from endo_sim_ros.physics import ControlNodes, PhysicsConfig, TissueSimulation
from endo_sim_ros.rendering import render_depth
from endo_sim_ros.sequences.bag import BagWriter

S = 1_000_000_000
BEGIN = 1000 * S
STEP = 0.04
RADIUS = 0.004  # of the tool, m
DEPTH = 0.003  # of its presses, m
STIFFNESS = 200.0  # N/m
SURFACE = 0.1  # m, before the camera at the origin
PHYSICS = PhysicsConfig(contact_radius=RADIUS, step_duration=STEP, layers=1)


def flat_tissue(apart=0.002, size=21):
    """A skin across z, seen from the origin, over one pinned layer."""
    grid = (np.arange(size) - size // 2) * apart
    skin = np.stack(np.meshgrid(grid, grid, [SURFACE], indexing="ij"), -1).reshape(-1, 3)
    rest = np.concatenate([skin, skin + [0, 0, 0.02]]).astype(np.float32)
    is_skin = np.arange(len(rest)) < len(skin)
    return ControlNodes(rest, ~is_skin, np.full(len(rest), 1e-7, np.float32), is_skin, apart, np.zeros(3))


def pressed(seconds, presses=(1.0,), duration=1.0, depth=DEPTH):
    """How deep the tool is [T] at times [T], s: it stands 1 cm above the skin, and goes in and out within a duration from the time of each
    press."""
    phase = np.stack([(seconds - start) / duration for start in presses])
    inside = np.where((phase > 0) & (phase < 1), np.sin(np.pi * np.clip(phase, 0, 1)), 0.0).max(0)
    return inside * (depth + 0.01) - 0.01


def tip(depth, x=0.0, y=0.0):
    """Pose of a tool whose ball is so deep in the skin, m."""
    return rigid_pose(np.eye(3), [x, y, SURFACE - RADIUS + depth])


class Touches:
    """Writes messages of a console or a simulation; times in seconds since the beginning."""

    def __init__(self, path):
        self.bag, self.types, self._clock = BagWriter(path), bag_types(), 0

    def __enter__(self):
        self.bag.__enter__()
        return self

    def __exit__(self, *error):
        self.bag.__exit__(*error)

    def say(self, topic, message):
        self._clock += 1_000_000
        self.bag.write(topic, message, BEGIN + self._clock)

    def pose(self, seconds, pose, arm="PSM1", frame="world"):
        self.say(messages.tool_pose(arm), messages.encode_pose(pose, BEGIN + round(seconds * S), frame, self.types))

    def force(self, seconds, force, arm="PSM1", frame="PSM1"):
        stamp = BEGIN + round(seconds * S)
        self.say(messages.tool_reaction(arm), messages.encode_wrench(np.asarray(force), np.zeros(3), stamp, frame, self.types))

    def jaw(self, seconds, angle, arm="PSM1"):
        self.say(messages.tool_jaw(arm), messages.encode_jaw(angle, BEGIN + round(seconds * S), self.types))

    def nodes(self, seconds, nodes, moved):
        eye = np.tile(np.eye(3, dtype=np.float32), (len(nodes), 1, 1))
        cloud = ControlNodeCloud(nodes.rest, nodes.rest + moved.astype(np.float32), eye, S)
        self.say(messages.CONTROL_NODES, messages.encode_control_nodes(cloud, BEGIN + round(seconds * S), "world", self.types))


def press(path, seconds=4.0, presses=(1.0,), rate=100.0, forces=25.0, force=lambda depth: STIFFNESS * max(depth, 0.0), **options):
    """A recording of presses: poses at a rate, Hz, and forces at another, 0 = none.

    Args:
        path: Of the bag.
        seconds: How long it is.
        presses: When each begins, s.
        rate, forces: Of messages, Hz.
        force: Newtons towards the camera by the depth, m.
        options: depth; duration: of a press, s; late: seconds by which forces are late (function of the time); noise: of a force, N;
            offset: of all forces [3], N; leave_out: (from, to) without poses, s; frame, base: name and pose of the frame of poses;
            x: how far beside, m; broken: when a pose is no number, s.
    """
    depth, base = options.get("depth", DEPTH), options.get("base", np.eye(4))
    late, rng = options.get("late", lambda t: 0.0), np.random.default_rng(0)
    first, last = options.get("leave_out", (np.inf, np.inf))
    with Touches(path) as bag:
        for t in np.arange(int(seconds * rate)) / rate:
            if not first < t < last:
                pose = tip(pressed(np.array([t]), presses, options.get("duration", 1.0), depth)[0], options.get("x", 0.0))
                pose[0, 3] += np.nan if abs(t - options.get("broken", np.inf)) < 0.5 / rate else 0.0
                bag.pose(t, np.linalg.inv(base) @ pose, frame=options.get("frame", "world"))
        for t in np.arange(int(seconds * forces)) / forces if forces else ():
            at = pressed(np.array([t]), presses, options.get("duration", 1.0), depth)[0]
            vector = np.array([0, 0, -force(at)]) + options.get("offset", np.zeros(3)) + options.get("noise", 0.0) * rng.normal(size=3)
            bag.force(t + late(t), vector)
    return path


def simulate(path, scene, physics, depth=0.005, beside=(0.0,), noise=0.0, forces=True):
    """A recording of presses into a scene's tissue, each so far beside the middle of the picture (m), and what it answers."""
    camera, rng = scene.camera, np.random.default_rng(0)
    simulation = TissueSimulation(
        scene.model, np.stack([each.position for each in scene.cameras]), physics, list(scene.cameras), render_depth
    )
    down = np.interp(np.arange(76), [0, 12, 22, 34, 42, 54, 64, 75], [-0.02, -0.02, -0.003, depth, depth, -0.003, -0.02, -0.02])
    tips = []
    skin = simulation.nodes.rest[simulation.nodes.is_skin].astype(float)
    for x in beside:
        pixel = camera.K[:2, 2] + [x * camera.K[0, 0] / scene.depth, 0.0]
        (z,) = scene_depth(skin, camera, pixel)
        place = camera.unproject(pixel[None], np.array([z]))[0]
        tips += [place + (each - simulation.contact_radius) * camera.pose[:3, 2] for each in down]
    with Touches(path) as bag:
        for step, place in enumerate(tips):
            pose = rigid_pose(np.eye(3), place)
            simulation.set_grasp("PSM1", pose, False)
            simulation.step()
            pose[:3, 3] += 0.01 * noise * rng.normal(size=3)
            bag.pose(step * physics.step_duration, pose)
            if forces:
                bag.force(step * physics.step_duration, simulation.reaction("PSM1")[0] + noise * rng.normal(size=3))
    return simulation


def scene_depth(skin, camera, pixel):
    """Depth [1] of the control node of the skin that is nearest to a pixel, m."""
    uv, z = camera.project(skin)
    return z[[np.linalg.norm(uv - pixel, axis=1).argmin()]]
