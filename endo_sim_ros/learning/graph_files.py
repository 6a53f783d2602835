"""A task in a scene as the files that start the graph of ROS nodes on it."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from endo_sim_ros.core.cameras import save_cameras
from endo_sim_ros.core.config import option_values
from endo_sim_ros.core.folders import make_writable, naming
from endo_sim_ros.core.gaussians import save_ply
from endo_sim_ros.instruments import save_tool
from endo_sim_ros.learning.actions import Contact, require_contact
from endo_sim_ros.learning.config import Randomisation, SightConfig
from endo_sim_ros.learning.held_tools import hold_tools
from endo_sim_ros.learning.scenes import Scene
from endo_sim_ros.learning.tasks import find_task, moving, set_up
from endo_sim_ros.learning.variation import Variation
from endo_sim_ros.physics import MotionConfig, PhysicsConfig


def save_scene(
    scene: Scene,
    folder: Path,
    task: str,
    seed: int = 0,
    sight: SightConfig = SightConfig(),
    motion: MotionConfig = MotionConfig(),
    mode: Literal["realtime", "lockstep"] = "lockstep",
    contact: Contact = "point",
) -> None:
    """Write model.ply, cameras.json, files of the tools and parameters.yaml, which start the graph on a task in this scene.

    Args:
        scene: What to write.
        folder: Where; it is made if need be.
        task: Name of the task.
        seed: Of the first episode.
        sight: What the endoscope shows. Which of the pictures are rendered is up to who subscribes to them.
        motion: Breath and heart; at rest, those of the task. Each episode on the graph begins in the phases of the first.
        mode: lockstep: time goes on with each action, as in the environments. realtime: it goes on by itself.
        contact: What touches the tissue, see :class:`TaskBatch`.

    Raises:
        ValueError: If there is no such task or tool, the scene is too small for it, an arm does not reach it, links shall touch that
            are not there or cut, or the folder takes no files.
    """
    kind = find_task(task)
    require_contact(task, contact)
    if contact == "links" and not sight.instrument:
        raise ValueError("contact is links, which are those of an instrument; leave instrument at true")
    if motion.file:
        motion = replace(motion, file=str(Path(motion.file).resolve()))
    physics = moving(kind.physics(), motion)
    first = set_up(kind, scene.nodes(physics), scene.camera.pose)
    rng = np.random.default_rng(seed)
    first.reset(0, rng)
    if physics.motion.breathing or physics.motion.heartbeat:
        breath, heart = Variation.draw(Randomisation(), rng).phases.tolist()
        physics = replace(physics, motion=replace(physics.motion, breathing_phase=breath, heartbeat_phase=heart))
    usual = option_values(PhysicsConfig())
    changed = {name: value for name, value in option_values(physics).items() if value != usual[name] and name != "device"}
    changed |= {"regions": list(first.regions())} if first.regions() else {}
    around = physics.motion.breathing + physics.motion.heartbeat
    make_writable(folder)
    save_ply(scene.whole if kind.roams else scene.seen_within(sight.baseline, around), folder / "model.ply")
    save_cameras(list(scene.cameras), folder / "cameras.json")
    several = len(kind.arms) > 1
    arms = lambda: {"arms": list(kind.arms)} if several else {}  # lists of their own, as rcl reads no aliases
    tools: dict[str, Any] = {"instruments": ["none"]}  # tips that reach every pose and are not seen
    if sight.instrument:
        tools = {"instruments": [], "frames": []}
        for held in hold_tools(kind, scene, sight.tool):
            # The name names the shape, and the end of the tool depends on the arm.
            tool = folder.resolve() / (held.holder if several else "") / f"{held.arm.tool}.json"
            tool.parent.mkdir(exist_ok=True)
            save_tool(tool, held.arm)
            tools["instruments"].append(str(tool))
            tools["frames"].append(held.frame)
    named = str(Path(sight.tool).resolve()) if sight.tool.endswith(".json") else sight.tool
    parameters = {
        "reconstruction_node": {"mode": mode, "model_file": str(folder.resolve() / "model.ply")},
        "physics_node": {
            "mode": mode,
            "arm_source": "commanded",
            "lockstep_inputs": ["pose", "jaw", *(["cut"] if kind.cutting else [])],
            "link_contact": contact == "links",
            **({"tell_empty_jaws": False} if kind.thing() else {}),
            **arms(),
            **tools,
            **changed,
        },
        # Pictures of many episodes at once show the background where skin is lifted off what it hid.
        "rendering_node": {"mode": mode, **arms(), "image_width": sight.image_width, "baseline": sight.baseline, "behind.shown": False}
        | ({"lockstep_camera": True} if kind.roams else {})
        | ({"thing": task} if kind.thing() and sight.instrument else {}),
        "viewer_node": {"arm_source": "commanded"} | arms(),
        "policy": {"mode": mode, "task": task, "scene": str(folder.resolve()), "seed": seed, "tool": named, "dye": sight.dye},
    }
    sections = {f"/**/{node}": {"ros__parameters": values} for node, values in parameters.items()}
    with naming(folder / "parameters.yaml"):
        (folder / "parameters.yaml").write_text(yaml.safe_dump(sections, sort_keys=False))
