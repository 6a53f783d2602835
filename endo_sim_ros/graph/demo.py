"""The main job end to end: a bag is replayed, reconstructed, made soft, pulled by a tool and rendered, over DDS."""

import contextlib
import itertools
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.utilities import try_shutdown
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Column
from std_srvs.srv import Trigger

from endo_sim_ros import messages
from endo_sim_ros.core import drawing
from endo_sim_ros.core.folders import claimed
from endo_sim_ros.evaluation.interaction_report import TouchReport
from endo_sim_ros.graph.processes import NodeGroup
from endo_sim_ros.messages import ERROR, OK, NodeStatus, ReconstructionState, ScriptedToolState
from endo_sim_ros.nodes.base import shutdown_interrupts
from endo_sim_ros.nodes.configs import ScriptedToolConfig
from endo_sim_ros.nodes.watcher import Watcher
from endo_sim_ros.reconstruction.config import ReconstructionConfig
from endo_sim_ros.sequences.bag import BagReader, write_bag
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

_ARM = "PSM1"
_FPS = 25.0
_MODEL = ("model.ply", "cameras.json")


class DemoError(RuntimeError):
    """The demo cannot go on; the message says which stage and where its log is."""


@shutdown_interrupts()
def _request(watcher: Watcher, service: str, executor: SingleThreadedExecutor) -> None:
    """Call a Trigger service.

    Raises:
        DemoError: If it does not answer, or refuses.
    """
    client = watcher.create_client(Trigger, service)
    if not client.wait_for_service(timeout_sec=20.0):
        raise DemoError(f"the service {service} is not there; see the log of its node")
    future = client.call_async(Trigger.Request())
    executor.spin_until_future_complete(future, timeout_sec=60.0)
    answer = future.result() if future.done() else None
    if answer is None or not answer.success:
        raise DemoError(f"{service}: {answer.message if answer else 'no answer'}")


def run_demo(bag: Path | None, out: Path, seed: int, frames: int, width: int, iterations: int, force: float, timeout: float) -> None:
    """Run the demo and leave video, contact sheet, model and recording in ``out``.

    Raises:
        ValueError: If something given cannot be used; one sentence.
        DemoError: If a stage fails; likewise.
    """
    # What cannot be used is told before anything starts, and before the results of an earlier run are gone.
    training = ReconstructionConfig(keyframes=8, image_width=width, iterations=iterations, max_gaussians=30_000)
    touching = ScriptedToolConfig(arm=_ARM, force=force)
    patient = PhantomConfig(seed=seed, frames=frames, width=width, height=width * 4 // 5)
    recording, models, video, shown = out / "recording", out / "models", out / "touch.mp4", out / "contact_sheet.png"
    if bag is not None:
        with BagReader(bag) as reader:
            reader.require_recording()
        if not {bag.resolve(), *bag.resolve().parents}.isdisjoint(path.resolve() for path in (recording, models)):
            raise ValueError(f"{bag}: the demo writes its own recording there; give another folder for the results")
    with claimed(out):
        for path in (recording, models):
            shutil.rmtree(path, ignore_errors=True)
        for path in (video, shown, *(out / name for name in _MODEL)):
            path.unlink(missing_ok=True)
        console = Console()
        texts = TextColumn("{task.description:<14}"), BarColumn(), TextColumn("{task.fields[note]}", table_column=Column())
        columns = (SpinnerColumn(), *texts, TimeElapsedColumn(table_column=Column(no_wrap=True)))
        graph = NodeGroup(out / "logs")
        try:
            with Progress(*columns, console=console) as progress, graph:
                if bag is None:
                    bag = _phantom_bag(out / f"phantom_{seed}", patient, progress)
                _touch_over_dds(graph, progress, bag, out, training, touching, timeout)
        finally:
            for text in graph.warnings():
                console.print(text, style="yellow", highlight=False, markup=False, soft_wrap=True)
        with console.status("writing the video and the contact sheet"):
            report = TouchReport(recording, _ARM)
            count = drawing.write_video(video, report.video(_FPS), _FPS)
            pictures, quality = report.moments()
            drawing.write_png(shown, drawing.sheet(pictures))
        size = sum(file.stat().st_size for file in recording.iterdir())
        for path, what in (
            (video, f"the tissue pulled by the tool, {count / _FPS:.1f} s"),
            (shown, quality),
            (out / _MODEL[0], "the Gaussian model"),
            (recording, f"every topic, as a rosbag2 (mcap), {size / 1e6:.0f} MB"),
        ):
            console.print(f"[bold]{path!s:<24}[/] {what}", highlight=False, soft_wrap=True)


def _phantom_bag(path: Path, patient: PhantomConfig, progress: Progress) -> Path:
    """The synthetic patient's bag; made anew each time so that it always fits the options."""
    task = progress.add_task("phantom", total=patient.frames, note="rendering the synthetic patient")
    shutil.rmtree(path, ignore_errors=True)
    write_bag(path, progress.track(phantom_sequence(patient), total=patient.frames, task_id=task))
    progress.update(task, note=f"{path}")
    return path


def _touch_over_dds(
    graph: NodeGroup,
    progress: Progress,
    bag: Path,
    out: Path,
    training: ReconstructionConfig,
    touching: ScriptedToolConfig,
    timeout: float,
) -> None:
    """Run the nodes until the tool has let go."""
    os.environ.update(graph.environment)  # this process joins the same graph
    rclpy.init()
    watcher, executor = Watcher("demo"), SingleThreadedExecutor()
    executor.add_node(watcher)

    @shutdown_interrupts()
    def wait(stage: str, done: Callable[[], bool], shown: str) -> None:
        """Show the progress of a node until a condition is true."""
        task, before, deadline = progress.add_task(stage, total=None, note=""), None, time.monotonic() + timeout
        if not progress.console.is_terminal:  # which shows no bars before the end
            progress.console.print(stage)
        while not done():
            executor.spin_once(timeout_sec=0.1)
            for name in ("recorder", shown):
                _, level, text, values = watcher.statuses.get(name, NodeStatus(name, OK, "starting", {}))
                if level == ERROR:
                    raise DemoError(f"{name}: {text}")
            completed = float(values.get("iteration", values.get("messages", 0)))
            total = float(values.get("iterations", values.get("of", 0)))
            progress.update(task, note=text, completed=completed, total=total or None)
            if (text, values) != before:
                before, deadline = (text, values), time.monotonic() + timeout
            for node in graph.dead():
                raise DemoError(f"{node.name} ended with status {node.exit_status}; its log is {node.log}")
            if time.monotonic() > deadline:
                late = f"{stage} made no progress for {timeout:g} s (last: {text})"
                raise DemoError(f"{late}; logs are in {out / 'logs'}")
        progress.update(task, completed=1, total=1)

    try:
        graph.start("recorder_node", bag=out / "recording", arms=[_ARM], topics=["all", messages.RENDERED_DEPTH.name])
        graph.start(
            "reconstruction_node",
            start_after=0.0,  # asked to, below
            output_dir=out / "models",
            keyframes=training.keyframes,
            image_width=training.image_width,
            iterations=training.iterations,
            max_gaussians=training.max_gaussians,
        )
        graph.start("rendering_node", image_width=training.image_width, idle_rate=1.0, arms=[_ARM])
        names = {"recorder", "reconstruction_node", "rendering_node"}
        wait("starting", lambda: names <= watcher.statuses.keys(), "recorder")
        player = graph.start("bag_player_node", bag=bag)
        wait("replaying", lambda: player.exit_status == 0, "bag_player")
        _request(watcher, "reconstruction_node/reconstruct", executor)
        done = lambda: watcher.in_state("reconstruction_node", ReconstructionState.DONE)  # noqa: E731
        wait("reconstructing", done, "reconstruction_node")
        newest = max((out / "models").glob("*/model.ply")).parent
        for name in _MODEL:
            shutil.copy(newest / name, out / name)
        graph.start("physics_node", arms=[_ARM])  # tissue at rest, 25 times a second, would fill the recording and slow the training
        settled = itertools.count()  # the final model reaches physics and rendering a moment after it is finished
        wait("binding", lambda: watcher.renders_control_nodes() and next(settled) > 20, "physics_node")
        graph.start("scripted_tool_node", arm=touching.arm, force=touching.force, listeners=2)  # physics and the recorder
        wait("touching", lambda: watcher.in_state("scripted_tool", ScriptedToolState.DONE), "scripted_tool")
    finally:
        executor.shutdown()
        watcher.destroy_node()
        with contextlib.suppress(RuntimeError):  # ROS may be shutting itself down at the same moment
            try_shutdown()
