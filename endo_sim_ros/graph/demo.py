"""The main job end to end: a bag is replayed, reconstructed, made soft, pulled by a tool and rendered, over DDS."""

import itertools
import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from std_srvs.srv import Trigger

from endo_sim_ros import messages
from endo_sim_ros.core import drawing
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.evaluation.interaction_report import TouchReport
from endo_sim_ros.graph.processes import NodeGroup
from endo_sim_ros.messages import ERROR
from endo_sim_ros.nodes.base import EndoNode
from endo_sim_ros.sequences.bag import BagReader, write_bag
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

_ARM = "PSM1"
_FPS = 25.0


class DemoError(RuntimeError):
    """The demo cannot go on; the message says which stage and where its log is."""


class _Watcher(EndoNode):
    """Listens to what the other nodes say about themselves."""

    def __init__(self):
        super().__init__("demo")
        self.statuses: dict[str, tuple[int, str, dict[str, str]]] = {}
        self.subscribe(messages.DIAGNOSTICS, self._on_diagnostics)

    def request(self, service: str, executor: SingleThreadedExecutor) -> None:
        """Call a Trigger service.

        Raises:
            DemoError: If it does not answer, or refuses.
        """
        client = self.create_client(Trigger, service)
        if not client.wait_for_service(timeout_sec=20.0):
            raise DemoError(f"the service {service} is not there; see the log of its node")
        future = client.call_async(Trigger.Request())
        executor.spin_until_future_complete(future, timeout_sec=60.0)
        if not future.done() or not future.result().success:
            raise DemoError(f"{service}: {future.result().message if future.done() else 'no answer'}")

    def _on_diagnostics(self, message) -> None:
        for name, level, text, values in messages.decode_diagnostics(message):
            self.statuses[name] = (level, text, values)


def run_demo(bag: Path | None, out: Path, seed: int, frames: int, width: int, iterations: int, force: float, timeout: float) -> None:
    """Run the demo and leave video, contact sheet, model and recording in ``out``.

    Raises:
        DemoError, SequenceError: If a stage fails; one sentence.
    """
    console = Console()
    out.mkdir(parents=True, exist_ok=True)
    recording = out / "recording"
    for old in (recording, out / "models"):
        shutil.rmtree(old, ignore_errors=True)
    texts = TextColumn("{task.description:<14}"), BarColumn(), TextColumn("{task.fields[note]}")
    columns = (SpinnerColumn(), *texts, TimeElapsedColumn())
    with Progress(*columns, console=console) as progress, NodeGroup(out / "logs") as graph:
        if bag is None:
            bag = _phantom_bag(out / f"phantom_{seed}", seed, frames, width, progress)
        else:
            with BagReader(bag) as reader:  # a bag that cannot do is reported before anything starts
                reader.require_recording()
        _touch_over_dds(graph, progress, bag, recording, out, width, iterations, force, timeout)
    with console.status("writing the video and the contact sheet"):
        report = TouchReport(recording, _ARM)
        count = drawing.write_video(out / "touch.mp4", report.video(_FPS), _FPS)
        pictures, quality = report.moments()
        drawing.write_png(out / "contact_sheet.png", drawing.sheet(pictures))
        newest = max((out / "models").glob("*/model.ply")).parent
        for name in ("model.ply", "cameras.json"):
            shutil.copy(newest / name, out / name)
    for path, what in (
        (out / "touch.mp4", f"the tissue pulled by the tool, {count / _FPS:.1f} s"),
        (out / "contact_sheet.png", quality),
        (out / "model.ply", "the Gaussian model"),
        (recording, "every topic, as a rosbag2 (mcap)"),
    ):
        console.print(f"[bold]{path!s:<24}[/] {what}", highlight=False, soft_wrap=True)


def _phantom_bag(path: Path, seed: int, frames: int, width: int, progress: Progress) -> Path:
    """The synthetic patient's bag; made anew each time so that it always fits the options."""
    task = progress.add_task("phantom", total=frames, note="rendering the synthetic patient")
    shutil.rmtree(path, ignore_errors=True)
    config = PhantomConfig(seed=seed, frames=frames, width=width, height=width * 4 // 5)

    def counted() -> Iterator:
        for frame in phantom_sequence(config):
            yield frame
            progress.advance(task)

    write_bag(path, counted())
    progress.update(task, note=f"{path}")
    return path


def _touch_over_dds(
    graph: NodeGroup,
    progress: Progress,
    bag: Path,
    recording: Path,
    out: Path,
    width: int,
    iterations: int,
    force: float,
    timeout: float,
) -> None:
    """Run the nodes until the tool has let go."""
    os.environ.update(graph.environment)  # this process joins the same graph
    rclpy.init()
    watcher, executor = _Watcher(), SingleThreadedExecutor()
    executor.add_node(watcher)
    deadline = time.monotonic() + timeout

    def wait(stage: str, done: Callable[[dict], bool], note: Callable[[dict], tuple[str, float, float]]) -> None:
        task = progress.add_task(stage, total=None, note="")
        while not done(watcher.statuses):
            executor.spin_once(timeout_sec=0.1)
            text, completed, total = note(watcher.statuses)
            progress.update(task, note=text, completed=completed, total=total or None)
            for node in graph.dead():
                raise DemoError(f"{node.name} ended with status {node.exit_status}; its log is {node.log}")
            if time.monotonic() > deadline:
                late = f"{stage} did not finish within {timeout:.0f} s (last: {text})"
                raise DemoError(f"{late}; logs are in {out / 'logs'}")
        progress.update(task, completed=1, total=1)

    def text_of(name: str) -> Callable[[dict], tuple[str, float, float]]:
        def note(statuses: dict) -> tuple[str, float, float]:
            level, text, values = statuses.get(name, (0, "starting", {}))
            if level == ERROR:
                raise DemoError(f"{name}: {text}")
            completed = values.get("iteration", values.get("messages", 0))
            return text, float(completed), float(values.get("iterations", values.get("of", 0)))

        return note

    def says(name: str, begin: str) -> Callable[[dict], bool]:
        return lambda statuses: name in statuses and statuses[name][1].startswith(begin)

    try:
        graph.start("recorder_node", bag=recording, arms=[_ARM])
        graph.start(
            "reconstruction_node",
            start_after=0.0,  # asked to, below
            output_dir=out / "models",
            image_width=width,
            iterations=iterations,
            max_gaussians=30_000,
        )
        graph.start("physics_node", arms=[_ARM])
        graph.start("rendering_node", image_width=width, idle_rate=1.0)
        names = {"recorder", "reconstruction_node", "physics_node", "rendering_node"}
        wait("starting", names.issubset, text_of("recorder"))
        player = graph.start("bag_player_node", bag=bag)
        wait("replaying", lambda _: player.exit_status == 0, text_of("bag_player"))
        watcher.request("reconstruction_node/reconstruct", executor)
        wait("reconstructing", says("reconstruction_node", "finished"), text_of("reconstruction_node"))
        final = lambda s: s.get("rendering_node", (0, "", {}))[2].get("following control nodes") == "True"  # noqa: E731
        settled = itertools.count()  # the final model reaches physics and rendering a moment after it is finished
        wait("binding", lambda s: final(s) and next(settled) > 20, text_of("physics_node"))
        graph.start("scripted_tool_node", arm=_ARM, force=force, listeners=2)  # physics and the recorder
        wait("touching", says("scripted_tool", "finished"), text_of("scripted_tool"))
    except ExternalShutdownException:  # ROS heard the signal to stop before Python did
        raise KeyboardInterrupt from None
    finally:
        executor.shutdown()
        watcher.destroy_node()
        rclpy.try_shutdown()


__all__ = ["DemoError", "SequenceError", "run_demo"]
