"""A browser that is none, and the scene that it looks at."""

import os

import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.physics import PhysicsConfig
from endo_sim_ros.viewer.browser import SPLATS, Pointer

PORT = 20000 + os.getpid() % 20000
CAMERA = Camera(np.array([[200.0, 0, 100], [0, 200.0, 80], [0, 0, 1]]), 200, 160)
MOST = 3.0  # N
SOFT = PhysicsConfig(node_count=400, force_radius=0.02, device="cpu")


class FakeBrowser:
    """Stands for a browser that looks from the origin and keeps what it is shown."""

    view, wants_splats, wants_nodes, wants_stress, wants_stiffness = SPLATS, True, True, True, False

    def __init__(self):
        self.splats, self.colors, self.models = [], [], 0

    def ray(self, x, y):
        local = np.linalg.solve(CAMERA.K, [x * CAMERA.width, y * CAMERA.height, 1.0])
        return np.zeros(3), local, CAMERA

    def show_model(self, means, camera):
        self.models += 1

    def show_splats(self, *splats):
        self.splats.append(splats)

    def show_nodes(self, positions, colors, size):
        self.colors.append(colors)

    def show_picture(self, render, endoscope, draw_tools, changed):
        pass

    def close(self):
        pass


def point(viewer, phase, at, client=1, lifts=False):
    viewer.point(Pointer(client, phase, (0.5, 0.5), at, lifts))


def moved(page):
    state = page.simulation.state()
    return float(np.linalg.norm(state.positions - state.rest, axis=1).max())
