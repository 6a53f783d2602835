"""Draws docs/two_instruments.gif: two instruments spread the tissue of a model, such as that of the demo. OpenCV 4.11 or newer writes it.

python docs/two_instruments.py out/model.ply docs/two_instruments.gif
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from endo_sim_ros.core.cameras import load_cameras
from endo_sim_ros.core.gaussians import load_ply
from endo_sim_ros.instruments import build_instrument, link_poses, load_arm, place_arm, solve_inverse
from endo_sim_ros.instruments.drawing import InstrumentDrawing
from endo_sim_ros.physics import PhysicsConfig, TissueSimulation
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig, render_depth

TOOLS = {"PSM1": "PROGRASP_FORCEPS", "PSM2": "LARGE_NEEDLE_DRIVER"}
PLACES = {"PSM1": (0.55, 0.48), "PSM2": (0.43, 0.50)}  # where they take hold, shares of the picture
ASIDE = {"PSM1": np.array([0.010, 0.002, -0.014]), "PSM2": np.array([-0.010, -0.003, -0.012])}  # m, camera: how far they pull
NEAR = 0.006  # m from the hinge of the jaws to the tissue between them
SECONDS, EVERY = 4.8, 2  # of tissue, and steps from one picture to the next
JAW = 0.7  # rad, open


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
    arms, places, parts, capsules, held = {}, {}, [], [], {}
    for name, tool in TOOLS.items():
        arms[name] = load_arm("PSM", tool)
        column, row = (int(share * size) for share, size in zip(PLACES[name], (camera.width, camera.height)))
        places[name] = place_arm(name, arms[name], camera, float(depth[row, column]))
        held[name] = camera.backproject(depth)[row, column]
        shape, capsule = build_instrument(arms[name])
        parts.append(shape)
        capsules.append(capsule)
    drawing = InstrumentDrawing(parts, device=renderer.device, capsules=capsules)
    pictures, toward = [], -camera.pose[:3, 2]
    steps = round(SECONDS / tissue.step_duration)
    for step in range(steps):
        time, posed = step / steps, []
        for name, arm in arms.items():
            place = places[name]
            # Down to the tissue, close, spread and lift, back, open, up.
            above = 0.02 * (1 - smooth(time / 0.2) + smooth((time - 0.85) / 0.15))
            pulled = camera.pose[:3, :3] @ ASIDE[name] * (smooth((time - 0.3) / 0.25) - smooth((time - 0.65) / 0.15))
            tip = place.base @ arm.tip_pose(place.joints)
            tip[:3, 3] = held[name] + pulled + (NEAR + above) * toward
            closed = 0.25 < time < 0.82
            tissue.set_grasp(name, tip, closed)
            joints = solve_inverse(arm, np.linalg.inv(place.base) @ tip, place.joints).joints
            jaw = JAW * (1 - smooth((time - 0.2) / 0.05) + smooth((time - 0.82) / 0.04))
            posed.append({link: place.base @ pose for link, pose in link_poses(arm, joints, jaw).items()})
        tissue.step()
        if step % EVERY == 0:
            state = tissue.state()
            (view,) = renderer.views([camera], state.positions, state.F, depth=False, instruments=drawing.at(posed))
            pictures.append(cv2.cvtColor(view.image, cv2.COLOR_RGB2BGR))
    animation = cv2.Animation()
    animation.frames = [cv2.resize(picture, (360, 288), interpolation=cv2.INTER_AREA) for picture in pictures]
    animation.durations = [round(1000 * EVERY * tissue.step_duration)] * len(pictures)
    if not cv2.imwriteanimation(target, animation):
        raise SystemExit(f"{target} could not be written; name a .gif in a folder that is there")


if __name__ == "__main__":
    main()
