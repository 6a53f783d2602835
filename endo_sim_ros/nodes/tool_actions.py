"""What commanded tools do to the simulated tissue, and sentences for what they fail to do."""

from collections.abc import Callable, Mapping
from itertools import combinations

import numpy as np

from endo_sim_ros.instruments.overlap import overlap
from endo_sim_ros.nodes.arm import DISABLED, Arm
from endo_sim_ros.nodes.configs import PhysicsNodeConfig
from endo_sim_ros.nodes.errors import sentence
from endo_sim_ros.nodes.jointed_arm import JointedArm
from endo_sim_ros.physics import PhysicsConfig, TissueSimulation


def collisions(arms: Mapping[str, Arm]) -> list[str]:
    """Which instruments run into each other, in a sentence each; nothing stops them."""
    known = {name: (arm.capsules, arm.links()) for name, arm in arms.items() if isinstance(arm, JointedArm) and arm.capsules}
    pairs = combinations(((name, posed) for name, posed in known.items() if posed[1]), 2)
    depths = {f"{first} and {second}": float(overlap(one, other)) for (first, one), (second, other) in pairs}
    told = "run into each other, and nothing stops them"
    return [f"the instruments of {both} {told}; they overlap by {1e3 * depth:.1f} mm" for both, depth in depths.items() if depth]


def apply_tools(
    simulation: TissueSimulation,
    tools: Mapping[str, Arm],
    options: PhysicsNodeConfig,
    now: float | None,
    report: Callable[[str], None],
    warn: Callable[[str], None],
) -> None:
    """Let tools grasp, cut and pull in the next step, as their arms command.

    Args:
        simulation: What they work in.
        tools: Arms with a tool, by their names. What has no effect is given up, but two jaws that closed on nothing stay closed.
        options: Of the node.
        now: Seconds, to tell wrenches that are too old; None in lockstep, where none is.
        report: Called with a sentence for each command that has no effect.
        warn: Called with one for each jaw that begins to close on nothing, which may be wanted.
    """
    for name, arm in tools.items():
        astray = isinstance(arm, JointedArm) and bool(arm.capsules) and arm.astray
        if arm.pose is None or not arm.acts or arm.state == DISABLED or astray:
            simulation.withdraw(name)
            continue
        where = f"at {np.round(arm.pose[:3, 3], 4).tolist()}"
        out_of_reach = f"no movable tissue lies within force_radius = {simulation.config.force_radius:g} m of where the tool works"
        links = arm.links() if isinstance(arm, JointedArm) and simulation.has_instrument(name) else {}
        grasps = simulation.set_grasp(name, arm.pose, arm.closed, links or None)
        if not grasps:
            reach = "the jaws touch no movable tissue" if links else out_of_reach
            if options.tell_empty_jaws and not arm.empty:
                warn(f"{name}: the jaw closed on nothing {where}; {reach}")
            arm.closed = simulation.is_closed(name)
        arm.empty = not grasps
        try:
            simulation.set_cut(name, arm.pose, arm.cutting)
        except ValueError as error:
            arm.cutting = False
            report(sentence(f"{name}: cut", error))
        force, torque = arm.force, arm.torque
        stale = now is not None and 0 < options.command_timeout < now - arm.heard
        if force is None or torque is None or stale:
            force, torque = np.zeros(3), np.zeros(3)
        wanted = bool(force.any() or torque.any())
        if wanted or arm.acting:
            reached = simulation.set_wrench(name, arm.works_at, force, torque)
            if wanted and not reached:
                report(f"{name}: the wrench {where} has no effect; {out_of_reach}")
        arm.acting = wanted


def slip_sentence(name: str, config: PhysicsConfig, link_contact: bool) -> str:
    """What to say when tissue slipped out of the jaw of an arm."""
    pulled, raised = f"almost {config.travel:g} m", "travel"
    if link_contact and config.grip_force:
        pulled += f", or with {2 * config.friction * config.grip_force:.3g} N between two jaws"
        raised += " or grip_force"
    return f"{name}: tissue slipped out of the jaw, which pulled it {pulled}; open it, come nearer, or raise {raised}"
