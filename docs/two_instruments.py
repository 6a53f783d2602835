"""Draws docs/two_instruments.gif: two instruments spread the tissue of a model, such as that of the demo. OpenCV 4.11 or newer writes it.

python docs/two_instruments.py out/model.ply docs/two_instruments.gif
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros.core.cameras import load_cameras
from endo_sim_ros.core.gaussians import load_ply
from endo_sim_ros.instruments import build_instrument, load_arm, place_arm
from endo_sim_ros.instruments.aiming import AHEAD
from endo_sim_ros.instruments.drawing import InstrumentDrawing
from endo_sim_ros.physics import PhysicsConfig, TissueSimulation
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig, render_depth
from endo_sim_ros.viewer.posed_tool import PosedTool

TOOLS = {"PSM1": "PROGRASP_FORCEPS", "PSM2": "LARGE_NEEDLE_DRIVER"}
PLACES = {"PSM1": (0.55, 0.48), "PSM2": (0.43, 0.50)}  # where they take hold, shares of the picture
ASIDE = {"PSM1": np.array([0.007, 0.001, -0.009]), "PSM2": np.array([-0.007, -0.002, -0.008])}  # m, camera: how far they pull
SECONDS, EVERY = 4.8, 3  # of tissue, and steps from one picture to the next
WIDTH, HEIGHT = 300, 240  # pixels


def smooth(share: float) -> float:
    """0 to 1 without a jerk."""
    share = min(max(share, 0.0), 1.0)
    return share * share * (3 - 2 * share)


def main() -> None:
    """Simulate, draw and write."""
    path, target = Path(sys.argv[1]), sys.argv[2]
    model, cameras = load_ply(path), load_cameras(path.parent / "cameras.json")
    camera = cameras[len(cameras) // 2]
    tissue = TissueSimulation(model, np.array([c.position for c in cameras]), PhysicsConfig(), cameras, render_depth)
    renderer = DeformableRenderer(model, tissue.nodes.rest, RenderingConfig())
    depth = render_depth(model, camera)
    tools, tips, shapes = {}, {}, []
    for name, tool in TOOLS.items():
        arm = load_arm("PSM", tool)
        column, row = (int(share * size) for share, size in zip(PLACES[name], (camera.width, camera.height)))
        tools[name] = PosedTool(arm, place_arm(name, arm, camera, float(depth[row, column])), renderer.device)
        tips[name] = tools[name].aim(camera.backproject(depth)[row, column])
        tissue.set_instrument(name, tools[name].capsules)
        shapes.append(build_instrument(arm))
    drawing = InstrumentDrawing([parts for parts, _ in shapes], device=renderer.device, capsules=[own for _, own in shapes])
    pictures, steps = [], round(SECONDS / tissue.step_duration)
    for step in range(steps):
        time = step / steps
        for name, tool in tools.items():
            # Down to the tissue, close, spread and lift, back, open, up.
            back = AHEAD * (1 - smooth(time / 0.2) + smooth((time - 0.85) / 0.15))
            pulled = camera.pose[:3, :3] @ ASIDE[name] * (smooth((time - 0.3) / 0.25) - smooth((time - 0.65) / 0.15))
            tip, closed = tips[name].copy(), 0.25 < time < 0.82
            tip[:3, 3] += pulled - back * tip[:3, 2]
            links = tool.move(tip, closed)
            tissue.set_grasp(name, tool.pose, closed, links)
        tissue.step()
        if step % EVERY == 0:
            state, posed = tissue.state(), drawing.at([tool.links() for tool in tools.values()])
            (view,) = renderer.views([camera], state.positions, state.F, depth=False, instruments=posed)
            pictures.append(cv2.cvtColor(view.image, cv2.COLOR_RGB2BGR))
    animation = cv2.Animation()
    animation.frames = [cv2.resize(picture, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) for picture in pictures]
    animation.durations = [round(1000 * EVERY * tissue.step_duration)] * len(pictures)
    if not cv2.imwriteanimation(target, animation):
        raise SystemExit(f"{target} could not be written; name a .gif in a folder that is there")


if __name__ == "__main__":
    main()
