"""A policy that works on a task over topics. In lockstep observations and actions are those of the environment in one process."""

import re
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from std_srvs.srv import Trigger

from endo_sim_ros import messages
from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.core.folders import written_whole
from endo_sim_ros.core.plugins import told_where
from endo_sim_ros.instruments import part_links
from endo_sim_ros.learning.actions import arm_state, tip_poses
from endo_sim_ros.learning.config import SightConfig
from endo_sim_ros.learning.held_tools import HeldTools, hold_tools
from endo_sim_ros.learning.pictures import IMAGE, IMAGE_RIGHT
from endo_sim_ros.learning.policies import make_policy
from endo_sim_ros.learning.scenes import load_scene
from endo_sim_ros.learning.task_batch import ARM_STATE
from endo_sim_ros.learning.tasks import find_task, set_up
from endo_sim_ros.messages import OK, STATE, WARN, PolicyState
from endo_sim_ros.nodes.base import STREAM_DEPTH, EndoNode, run, sentence
from endo_sim_ros.nodes.configs import PolicyConfig, arm_names
from endo_sim_ros.nodes.listeners import Listeners, delivered

_DYED_WITHIN = 1.0  # seconds that the spot of an episode, and its camera, have to arrive before its first picture is rendered
_TOLD_WITHIN = 1.0  # seconds that the last outcome has to arrive before the node exits
_STRAY = 1.0  # seconds in which pictures of a rest before the first reset may still come
_SETTLED = 2  # real time: states after the tools were put where an episode begins, until they are seen there
_PATIENCE = 30.0  # seconds; a request to a physics_node that was killed just now is never answered
_SILENT = 5.0  # seconds without an answer after which the node says so
_GIVEN_UP = 60.0  # seconds without an answer; one may be lost unseen where another physics_node begins at once


class PolicyNode(EndoNode):
    """One command, one observation, and so on; begins when the tissue of its scene is there, and exits after the last episode."""

    read_at_start = frozenset(PolicyConfig.__dataclass_fields__)

    def __init__(self) -> None:
        super().__init__("policy")
        self._config = config = self.declare(PolicyConfig)
        try:
            with told_where():
                scene = load_scene(config.scene or None)
                task = find_task(config.task)
                physics = task.physics()
                self._task = set_up(task, scene.nodes(physics), scene.camera.pose)
                self._task.reset(0, np.random.default_rng(config.seed))  # what is wrong with a user's own is told now
                self._policy = policy = make_policy(config.policy, config.task, device=config.device)
                self._tools = None if policy.actions == "cartesian" else HeldTools(hold_tools(task, scene, config.tool), task, 1)
        except (ValueError, RuntimeError) as error:
            raise ConfigError(str(error)) from error
        if task.turns and self._tools is not None:
            raise ConfigError(
                f"policy: {config.task} acts by the joints of the endoscope, not by those of the tool, as {config.policy} does"
            )
        if not self._task.same_tissue and config.episodes > 1:
            raise ConfigError(f"episodes: {config.task} has one episode over topics, as its tissue is part of physics_node's parameters")
        arms = arm_names([config.arm] if len(task.arms) == 1 else task.arms)
        self._step_ns = round(physics.step_duration * 1e9)
        commands = messages.tool_joint_command if self._tools else messages.tool_pose_command
        self._pose_pubs = [self.publisher(commands(arm)) for arm in arms]
        self._jaw_pubs = [self.publisher(messages.tool_jaw(arm)) for arm in arms]
        self._cut_pubs = [self.publisher(messages.tool_cut(arm)) for arm in arms] if task.cutting else []
        self._dye_pub = self.publisher(messages.DYE)
        self._outcome_pub = self.publisher(messages.TASK_OUTCOME)
        self._camera_pub = self.publisher(messages.CAMERA_POSE) if task.roams else None
        self._thing = () if (thing := task.thing()) is None else part_links(thing[0])
        self._thing_pub = self.publisher(messages.THING_POSES) if self._thing else None
        self._commanded = *self._pose_pubs, *self._jaw_pubs, *self._cut_pubs
        self._listeners = Listeners(self._commanded)
        self._resetting = self.create_client(Trigger, f"{config.physics_node}/reset")
        self._state, self._missing = PolicyState.WAITING, ""  # and what for
        self._begun, self._solved, self._done = False, 0, 0
        self._model_stamp = 0  # ns, which the state at rest has
        self._realtime = config.mode == "realtime"
        self._stamp = 0  # of the command whose answer is awaited; 0 = the state at rest. In real time: what answers is newer
        self._heard: dict[str, Any] = {}  # parts of that answer
        self._awaited_from = 0.0  # when the command was sent, or the last part of its answer came
        self._lost = False  # whether the tissue was at rest again meanwhile
        self._stamps: dict[str, int] = {}  # and theirs, ns
        self._observation: np.ndarray | None = None  # what the answer tells without its pictures
        self._placed, self._rested = False, 0  # whether the tool was put where the episode begins, and states since
        self._rows: list[tuple[np.ndarray, np.ndarray, float, bool, int]] = []
        depth = 1 if self._realtime else STREAM_DEPTH  # only the newest counts, or none may be lost
        self.subscribe(messages.CONTROL_NODES, self._on_nodes, depth)
        self._surfaces = {0: np.zeros((0, 3, 3), np.float32)}  # all that is cut, by its number: whole tissue, and the newest
        if task.cutting:
            self.subscribe(messages.CUT_SURFACE, self._on_cut_surface)
        self._forces = [f"force of {arm}" for arm in arms]
        for number, arm in enumerate(arms):
            self.subscribe(messages.tool_reaction(arm), partial(self._on_reaction, number), depth)
        self._pictures = {} if policy.sight is None else {IMAGE: messages.RENDERED_IMAGE}
        if policy.sight is not None and policy.sight.eyes == 2:
            self._pictures[IMAGE_RIGHT] = messages.RENDERED_RIGHT_IMAGE
        for name, topic in self._pictures.items():
            self.subscribe(topic, partial(self._on_picture, name), depth)
        self._tool_types = dict.fromkeys(arms if self._pictures else (), "none")  # as the graph tells them
        for arm in self._tool_types:
            self.subscribe(messages.tool_type(arm), partial(self._on_tool_type, arm), 1)
        if IMAGE_RIGHT in self._pictures:
            self.subscribe(messages.RENDERED_RIGHT_INFO, self._on_right_info, 1)
        self._baseline = 0.0  # m; 0 until it is heard
        self._compared = not self._pictures  # whether pictures are found to show what the policy learned from, or that was told
        self._asked: Any = None  # the reset that was asked for last, and when
        self._asked_at = self._pictured_at = 0.0
        self._begin()
        self.every(0.5, self._ask)

    # ------------------------------------------------------------- episodes

    def _begin(self) -> None:
        """Set up the next episode and ask for the tissue at rest."""
        self._task.reset(0, np.random.default_rng(self._config.seed + self._done))
        self._policy.reset([0])
        if self._tools is not None:
            self._tools.begin(np.arange(len(self._task.arms)), tip_poses(self._task, self._task.tips()))
        self._stamp, self._placed, self._state = 0, False, PolicyState.WAITING
        self._forget()
        spots = self._task.dyed_spots(0) if self._config.dye else ()
        self._dye_pub.publish(messages.encode_dye(spots, self.now_ns(), self._config.world_frame))
        delivered(self._dye_pub, _DYED_WITHIN)  # the state at rest is asked for next
        self._ask()

    def _ask(self) -> None:
        """Reset the tissue; again and again until its state at rest is heard, as there may be no model or no connection yet.

        An episode whose physics_node began anew itself, or is out of reach, so that its answer is lost, begins anew.
        """
        silence, reached = self._silence(), self._resetting.service_is_ready()
        if silence > _GIVEN_UP or silence > _SILENT and (self._lost or not reached):
            self.report_error(f"physics_node was reset, ended or out of reach; episode {self._done + 1} begins anew")
            self._rows = [row for row in self._rows if row[-1] < self._done]
            self._begin()
            return
        if self._stamp == 0:
            self._go_on()
        if self._stamp != 0 or self._asked is not None and time.monotonic() - self._asked_at < _PATIENCE and not self._unanswered():
            return
        listening = all(publisher.get_subscription_count() for publisher in self._commanded)
        if not (listening and self._resetting.service_is_ready()):
            named = f" and the arms {' and '.join(self._task.arms)}" if len(self._task.arms) > 1 else ""
            self._missing = f"physics_node with arm_source commanded{named}" + (", and an instrument with joints" if self._tools else "")
            return
        if not (self._begun or self._listeners.settled()):  # a recorder, which hears the first command if it is there already
            self._missing = "whoever else listens"
            return
        if unseen := [topic.name for topic in self._pictures.values() if not self.count_publishers(topic.name)]:
            self._missing = f"rendering_node, which publishes {' and '.join(unseen)}"
            return
        self._begun, self._missing = True, "the tissue of the scene" + (" and its pictures" if self._pictures else "")
        self._forget()
        self._placed = False
        if self._asked is not None:  # an answer that comes after all is none to this request
            self._resetting.remove_pending_request(self._asked)
        self._asked, self._asked_at = self._resetting.call_async(Trigger.Request()), time.monotonic()
        self._asked.add_done_callback(self._on_reset)

    def _unanswered(self) -> bool:
        """Whether the reset that was asked for last was refused, or the tissue has another state since; pictures take their time. So it is
        where the tissue came to rest and nobody says that this was a reset: another physics_node has begun meanwhile."""
        if not self._asked.done():
            return "nodes" in self._heard and time.monotonic() - self._awaited_from > _SILENT
        return not {"reset", "nodes"} <= self._heard.keys()

    def _on_reset(self, future: Any) -> None:
        with self.guard("reset"):
            if future.result().success:
                self._answer("reset", True, self._model_stamp)

    # -------------------------------------------------------------- answers

    def _on_nodes(self, message: Any) -> None:
        cloud, stamp = messages.decode_control_nodes(message), messages.stamp_to_ns(message.header.stamp)
        if self._stamp == 0 and (self._realtime or stamp == cloud.model_stamp_ns):
            if not np.array_equal(cloud.rest, self._task.nodes.rest):
                text = f"the tissue on control_nodes, {len(cloud.rest)} nodes, is not that of the scene and the task"
                raise ValueError(f"{text}, {len(self._task.nodes)} nodes; start the graph with what `endo-sim scene` wrote")
            self._model_stamp, self._rested = stamp, self._rested + self._placed
        elif not self._answers(stamp):
            self._lost |= stamp == cloud.model_stamp_ns
            return
        self._heard["cut"] = cloud.cut
        self._answer("nodes", cloud.positions, stamp)

    def _on_cut_surface(self, message: Any) -> None:
        triangles = messages.decode_cut_surface(message)
        self._surfaces = {0: self._surfaces[0], messages.cut_number(triangles): triangles}
        self._go_on()

    def _on_reaction(self, arm: int, message: Any) -> None:
        stamp = messages.stamp_to_ns(message.header.stamp)
        if self._stamp and self._answers(stamp):
            force = messages.decode_wrench(message, "measured_cf")[0]
            self._answer(self._forces[arm], self._task.rotations.reshape(-1, 3, 3)[arm] @ force, stamp)

    def _on_picture(self, name: str, message: Any) -> None:
        stamp = messages.stamp_to_ns(message.header.stamp)
        if self._answers(stamp):
            self._pictured_at = time.monotonic()
            self._answer(name, messages.decode_image(message, self._pictures[name].name), stamp)

    def _on_tool_type(self, arm: str, message: Any) -> None:
        self._tool_types[arm] = _tool_name(messages.decode_text(message))

    def _on_right_info(self, message: Any) -> None:
        P = messages.decode_camera_info(message, messages.RENDERED_RIGHT_INFO.name).P
        self._baseline = -P[0, 3] / P[0, 0]

    def _compare_pictures(self, sight: SightConfig) -> None:
        """Tell what pictures show that the policy did not learn from."""
        self._compared = True
        self._compare("dye", *("yes" if dyed else "no" for dyed in (sight.dye, self._config.dye)))
        if self._baseline:
            self._compare("distance between the eyes, mm", *(f"{1000 * value:.3g}" for value in (sight.baseline, self._baseline)))
        for (arm, shown), holder in zip(self._tool_types.items(), self._task.arms):
            learned = _tool_name(sight.tool or self._task.tool_of(holder)) if sight.instrument else "none"
            self._compare(f"tool of {arm}", learned, shown)

    def _compare(self, what: str, learned: str, shown: str) -> None:
        if learned != shown:
            told = f"policy {self._config.policy} learned from pictures with {what}: {learned}; here it is {shown}"
            self.report_error(f"{told}; give `endo-sim scene` what it learned from, or expect it to solve less")

    def _answers(self, stamp: int) -> bool:
        """Whether what has a stamp answers the last command."""
        if self._realtime:
            return 0 < self._stamp < stamp
        return stamp == (self._stamp or self._model_stamp)

    def _answer(self, part: str, value: Any, stamp: int) -> None:
        """Take in a part of what answers the last command."""
        self._heard[part], self._stamps[part], self._awaited_from = value, stamp, time.monotonic()
        self._go_on()

    def _forget(self) -> None:
        """Await another answer."""
        self._heard, self._stamps, self._observation, self._lost = {}, {}, None, False
        self._awaited_from = time.monotonic()

    def _silence(self) -> float:
        """Seconds for which nothing has come of an answer that is awaited; 0 where none is."""
        return time.monotonic() - self._awaited_from if self._stamp > 0 else 0.0

    def _go_on(self) -> None:
        """When the answer to the last command is complete, act."""
        if not {"nodes", *(self._forces if self._stamp else ["reset"])} <= self._heard.keys():
            return
        if self._task.cutting and self._heard["cut"] not in self._surfaces:
            return
        if self._realtime and not self._stamp:
            if not self._placed:
                self._place()
            elif self._rested >= _SETTLED:
                self._stamp = self._model_stamp
                self._forget()
            return
        pictured = self._pictures.keys() <= self._heard.keys() and len({self._stamps[name] for name in self._pictures}) <= 1
        if self._observation is None and (pictured or not self._realtime):  # in lockstep pictures show what follows from it
            self._observation = self._observe()
        if self._observation is None or not pictured:
            return
        if not self._stamp and not self._placed:  # the tool begins where the task has it, and is seen there
            if self._pictures and not self._done and time.monotonic() - self._pictured_at < _STRAY:
                return
            self._place()
            if self._pictures:  # those after this show it there
                self._heard = {name: value for name, value in self._heard.items() if name not in self._pictures}
                return
        observation, stamp = self._observation, self._stamps["nodes"]
        ended = False
        if self._task.steps[0]:
            outcome = self._task.judge()
            ended = bool(outcome.terminated[0] or outcome.truncated[0])
            told = float(outcome.reward[0]), ended, bool(outcome.success[0]), self._config.seed + self._done
            self._outcome_pub.publish(messages.encode_outcome(*told, self._task.origin[0], stamp))
            self._rows.append((self._seen, self._action, float(outcome.reward[0]), bool(outcome.success[0]), self._done))
        if ended:
            self._end(outcome.success[0])
        else:
            self._seen = observation[0]
            self._act(self._sensed() if self._pictures else observation)

    def _place(self) -> None:
        """Put the tools where the episode begins."""
        self._placed, self._rested = True, 0
        self._send_thing(self._model_stamp)
        self._command(self._task.tips(), np.zeros(self._task.fourth.shape, bool), self._model_stamp)

    def _observe(self) -> np.ndarray:
        """The state that a policy takes [1, n]."""
        forces = np.array([self._heard.get(name, np.zeros(3)) for name in self._forces]).reshape(self._task.force.shape)
        if self._task.cutting:
            self._task.hear_cuts(0, self._surfaces[self._heard["cut"]])
        observation = self._task.observe(self._heard["nodes"][self._task.sites], forces)
        if self._stamp:
            self._send_thing(self._stamps["nodes"])
        return observation if self._tools is None else self._tools.observe(observation)

    def _sensed(self) -> dict[str, np.ndarray]:
        """What a policy takes that sees: the pictures, and what the arm measures of itself."""
        return {ARM_STATE: arm_state(self._task), **{name: self._heard[name][None] for name in self._pictures}}

    def _act(self, observation: np.ndarray | dict[str, np.ndarray]) -> None:
        if not self._compared and self._policy.sight is not None:
            self._compare_pictures(self._policy.sight)
        try:
            with told_where():
                actions = self._policy.act(observation)
                if self._tools is None:
                    tips, closed = self._task.act(actions)
                else:
                    poses, closed = self._tools.act(self._task, actions, self._policy.actions == "joints")
                    tips = poses[:, :3, 3]
        except Exception as error:  # of whatever the policy is; it would do the same again
            self.failed = True
            self.report_error(sentence(f"policy {self._config.policy}", error))
            self._finish()
            return
        self._action = actions[0]
        self._stamp = self._stamps["nodes"] if self._realtime else self._stamp + self._step_ns
        self._forget()
        self._state = PolicyState.WORKING
        self._command(tips, closed, self._stamp)

    def _send_camera(self, stamp: int) -> None:
        """Publish where the endoscope is, if the task moves it; where an episode begins, wait until it has arrived."""
        poses = self._task.endoscopes()
        if self._camera_pub is not None and poses is not None:
            self._camera_pub.publish(messages.encode_pose(poses[0], stamp, self._config.world_frame))
            if stamp == self._model_stamp:
                delivered(self._camera_pub, _DYED_WITHIN)

    def _send_thing(self, stamp: int) -> None:
        """Publish where the thing of the task is, if there is one; where an episode begins, wait until that has arrived."""
        if self._thing_pub is not None:
            poses = self._task.thing_poses()
            placed = np.stack([poses[link][0] for link in self._thing])
            self._thing_pub.publish(messages.encode_thing_poses(placed, stamp, self._config.world_frame))
            if stamp == self._model_stamp:
                delivered(self._thing_pub, _DYED_WITHIN)

    def _command(self, tips: np.ndarray, closed: np.ndarray, stamp: int) -> None:
        """Publish where the tips [A] shall be, m, world, or the joints that put them there, whether the jaws are closed [A], and whether
        edges cut."""
        self._send_camera(stamp)
        none, poses = np.zeros(0), tip_poses(self._task, tips)
        for arm, (publisher, jaw) in enumerate(zip(self._pose_pubs, self._jaw_pubs)):
            if self._tools is None:
                publisher.publish(messages.encode_pose(poses[arm], stamp, self._config.world_frame))
            else:
                publisher.publish(messages.encode_joints([], self._tools.joints[arm], none, none, stamp))
            jaw.publish(messages.encode_jaw(self._task.closed_jaw if closed.flat[arm] else self._task.open_jaw, stamp))
        for publisher, cuts in zip(self._cut_pubs, self._task.cuts(self._task.fourth).flat):
            publisher.publish(messages.encode_cut(bool(cuts), stamp))

    def _end(self, success: bool) -> None:
        self._done += 1
        self._solved += int(success)
        self._stamp = -1  # nothing is awaited, and nothing that comes late completes an answer
        self._forget()
        self.get_logger().info(f"episode {self._done}: {'solved' if success else 'not solved'} in {self._task.steps[0]} steps")
        if self._config.record:
            self._record(Path(self._config.record))
        if self._done < self._config.episodes:
            self._begin()
            return
        self._finish()

    def _record(self, path: Path) -> None:
        """Write the episodes that are over; after each, so that whatever ends the process leaves them."""
        names = ("observations", "actions", "rewards", "success", "episode")
        columns: dict[str, Any] = {name: np.array(column) for name, column in zip(names, zip(*self._rows))}
        with written_whole(path) as partial, partial.open("wb") as file:
            np.savez(file, **columns)

    def _finish(self) -> None:
        """End the process."""
        self._state, self._stamp = PolicyState.DONE, -1
        self._forget()
        delivered(self._outcome_pub, _TOLD_WITHIN)
        self.finish(f"{self._solved} of {self._done} episodes solved")

    def status(self) -> tuple[int, str, dict[str, Any]]:
        """Level, message and values: how many episodes ended and were solved, and the steps of all."""
        values = {STATE: self._state, "episodes": self._done, "solved": self._solved, "steps": len(self._rows)}
        text = {
            PolicyState.WAITING: f"waiting for {self._missing}",
            PolicyState.WORKING: f"working on {self._config.task}, step {self._task.steps[0]} of episode {self._done + 1}",
            PolicyState.DONE: "finished",
        }[self._state]
        solved = f", {self._solved} of {self._done} solved" if self._done else ""
        silent = self._silence() > _SILENT
        silence = f"; nothing has come from physics_node{' or rendering_node' if self._pictures else ''} for {self._silence():.0f} s"
        return (WARN if silent or self._state is PolicyState.WAITING else OK), text + silence * silent + solved, values


def _tool_name(tool: str) -> str:
    """Name of a tool, as `endo_sim_ros.instruments.load_arm` or a topic tells it, without its number, which is that of the robot, too."""
    return re.sub(r"[:_]\d+$", "", Path(tool.partition("@")[0]).name.removesuffix(".json"))


if __name__ == "__main__":
    raise SystemExit(run(PolicyNode))
