"""Speed and memory of the simulation on this machine, beside the paper's methods and other solvers: `endo-sim bench physics`."""

import contextlib
import dataclasses
import importlib.util
import io
import math
import os
import statistics
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
import warp as wp

from endo_sim_ros.core.cameras import Camera, load_cameras, look_at
from endo_sim_ros.core.device import pick_device, single_threaded_torch
from endo_sim_ros.core.gaussians import GaussianModel, load_ply
from endo_sim_ros.core.kernels import compare_plain
from endo_sim_ros.evaluation.measurement import Row, Stage, machine, median_seconds, milliseconds, peak_megabytes, report, run_stages, short
from endo_sim_ros.instruments import build_instrument, link_poses, load_arm
from endo_sim_ros.physics import (
    ControlNodes,
    MpmSolver,
    PhysicsConfig,
    Skinning,
    TissueBatch,
    TissueSimulation,
    ToolLinks,
    build_control_nodes,
)
from endo_sim_ros.physics.links import JAW_LINKS
from endo_sim_ros.physics.tools import Tools
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_camera
from endo_sim_ros.sequences.phantom_model import phantom_model

PAPER_SUBSTEPS = 80
PLAIN = "plain Warp kernels"  # ours for GPUs, on a CPU: the same maths without vectors
DENSE = "dense"
PULL = np.array([0.6, 0.0, -0.8])  # where a tool drags the tissue: aside and to the camera, in camera axes


Driven = Literal["path", "force"]
"""What a tool prescribes: where it goes, or how hard it pulls, as the paper's does."""


class Plan(NamedTuple):
    """What to measure; smaller in tests."""

    gaussians: int = 30_000
    width: int = 640
    printed_nodes: int = 2000
    travel: float = 0.01  # of the tool, m
    force: float = 0.02  # of the tool, N: a bare skin of one layer goes a centimetre by it
    node_counts: tuple[int, ...] = (500, 1000, 2000, 4000, 8000)
    substeps: tuple[int, ...] = (10, 20, 40, 80, 160)
    skin_counts: tuple[int, ...] = (30_000, 100_000, 300_000)
    batch_nodes: tuple[int, ...] = (2000, 500)
    peer_grid: int = 0  # cells of the peer's grid a side; 0 = 48 on a CPU, 100 on a GPU
    seconds: float = 1.5  # for one median
    longest: float = 10.0  # s, of a step of many environments
    peer_dense: bool = True  # let the peer step every Gaussian, too


class Scene(NamedTuple):
    """Tissue, and how it is seen and touched."""

    model: GaussianModel
    camera: Camera  # at the viewpoint
    tip: np.ndarray  # where the tool takes hold: the surface in the middle of the image [3], m


@single_threaded_torch()
def bench_physics(
    device: str,
    json_file: Path | None = None,
    models: tuple[Path, ...] = (),
    environments: tuple[int, ...] = (),
    driven: Driven = "path",
    plan: Plan = Plan(),
) -> None:
    """Print the results on a device (see `pick_device`) and, if asked for, write them to a file.

    Args:
        device: Where to compute.
        json_file: File for the rows.
        models: PLY of each tissue, metres, seen by the first camera of the cameras.json beside it, else from the world's
            origin; default: a piece of the synthetic patient. The paper's comparison is the median over all, the rest is of the first.
        environments: Numbers of copies stepped together; default: 1 to 64 on a CPU, to 1024 on a GPU.
        driven: What the tool of the paper's comparison prescribes.
        plan: Sizes.
    """
    device = pick_device(device)
    environments = environments or ((1, 4, 16, 64) if device == "cpu" else (1, 4, 16, 64, 256, 1024))
    scenes = [load_scene(model, plan.width) for model in models] or [phantom_scene(plan.gaussians, plan.width)]
    notes: list[str] = []
    report(f"Simulation on {machine(device)}", run_stages(stages(scenes, device, environments, driven, plan, notes)), json_file)
    for note in notes:
        print(note)


def stages(scenes: list[Scene], device: str, environments: tuple[int, ...], driven: Driven, plan: Plan, notes: list[str]) -> list[Stage]:
    """What is measured, in order."""
    scene, nodes, seconds = scenes[0], plan.printed_nodes, plan.seconds
    return [
        ("dense and sparse", partial(_over_scenes, scenes, device, driven, plan)),
        *((f"{short(n)} nodes", partial(_over_nodes, scene, n, device, seconds)) for n in plan.node_counts),
        *((f"{n} substeps", partial(_over_substeps, scene, n, nodes, device, seconds)) for n in plan.substeps),
        ("contact", partial(_contact, scene, nodes, device, seconds)),
        *((f"{short(n)} Gaussians", partial(_over_gaussians, n, plan, device)) for n in plan.skin_counts),
        *((f"environments of {short(n)} nodes", partial(_many, scene, n, environments, device, plan)) for n in plan.batch_nodes),
        (f"{PEER} solver", partial(beside_peer, scene, device, plan, notes)),
        ("memory", partial(_memory, scene, nodes, device)),
    ]


# ---------------------------------------------------------------- scenes


def phantom_scene(count: int, width: int) -> Scene:
    """About `count` Gaussians on what an endoscope sees of the synthetic patient, in an image of a width in pixels."""
    return _seen(*phantom_model(count, width))


def load_scene(path: Path, width: int) -> Scene:
    """A model as its first camera sees it, or from the world's origin where no cameras.json lies beside it."""
    model = load_ply(path)
    if (path.parent / "cameras.json").is_file():
        camera = load_cameras(path.parent / "cameras.json")[0]
        return _seen(model, camera.resized(width, max(round(width * camera.height / camera.width), 1)))
    target = model.means.median(0).values.double().numpy()
    up = np.array([0.0, -1.0, 0.0]) if np.linalg.norm(target[::2]) > 0.1 * abs(target[1]) else np.array([0.0, 0.0, 1.0])
    return _seen(model, phantom_camera(PhantomConfig(width=width, height=round(0.8 * width)), look_at(np.zeros(3), target, up)))


def _seen(model: GaussianModel, camera: Camera) -> Scene:
    """With the tip on the surface in the middle of the image, or nearest to it."""
    _, depth = DeformableRenderer(model, None, RenderingConfig(device="cpu")).render(camera)
    v, u = np.nonzero(depth > 0)
    if not len(u):
        raise ValueError("nothing of the model is seen from its viewpoint; put a cameras.json beside it")
    middle = np.hypot(u - camera.width / 2, v - camera.height / 2).argmin()
    return Scene(model, camera, camera.backproject(depth)[v[middle], u[middle]])


# ---------------------------------------------------------------- the paper's comparison


class _Dragged:
    """Tissue held by a closed jaw, what it looked like on its way and what each step cost.

    Args:
        scene: Tissue and camera.
        config: How it is simulated.
        pull: By how much the tool pulls at most, in camera axes [3]: m that it goes, or N.
        driven: Which of the two.
        renderings: How it is rendered; only the first is timed.
    """

    def __init__(self, scene: Scene, config: PhysicsConfig, pull: np.ndarray, driven: Driven, *renderings: RenderingConfig):
        self.scene, self._pull, self._driven = scene, scene.camera.pose[:3, :3] @ pull, driven
        self.simulation = TissueSimulation(scene.model, scene.camera.position, config)
        self.renderers = [DeformableRenderer(scene.model, self.simulation.nodes.rest, each) for each in renderings]
        self.images: list[list[np.ndarray]] = [[] for _ in renderings]  # [H, W, 3] uint8, after each step
        self.steps, self.wholes = [], []  # s: the step; the step, skinning and rendering
        self.farthest = 0.0  # m, of any node
        self._state = self.simulation.state()
        if not self._act(1.0 if driven == "force" else 0.0):
            where = scene.tip.round(3).tolist()
            raise ValueError(f"no moving tissue within {config.force_radius:g} m of {where}, where the tool should hold it")
        self.renderers[0].render(scene.camera)  # compiled and warm

    def _act(self, share: float) -> bool:
        """Let the tool pull by a share of the most; returns whether it has tissue."""
        if self._driven == "force":
            return self.simulation.set_wrench("tool", self.scene.tip, share * self._pull)
        pose = np.eye(4)
        pose[:3, 3] = self.scene.tip + share * self._pull
        return self.simulation.set_grasp("tool", pose, True)

    def drag(self, share: float) -> None:
        """A step in which the tool pulls by a share of the most."""
        self._act(share)
        timed = partial(median_seconds, repeats=1, device=self.simulation.solver.device, warm_up=0)
        self.steps.append(timed(self.simulation.step))
        self.wholes.append(self.steps[-1] + timed(self._show))
        self.farthest = max(self.farthest, float(np.linalg.norm(self._state.positions - self._state.rest, axis=1).max()))
        for renderer, images in zip(self.renderers[1:], self.images[1:]):
            images.append(renderer.render(self.scene.camera, self._state.positions, self._state.F)[0])
        if self.simulation.faults:
            raise RuntimeError(f"the comparison went wrong: {self.simulation.last_fault}")

    def _show(self) -> None:
        self._state = self.simulation.state()
        self.images[0].append(self.renderers[0].render(self.scene.camera, self._state.positions, self._state.F)[0])


def _over_scenes(scenes: list[Scene], device: str, driven: Driven, plan: Plan) -> list[Row]:
    """`_paper` of each scene; of several, medians."""
    each = [_paper(scene, device, driven, plan) for scene in scenes]
    if len(each) == 1:
        return each[0]
    middle = lambda values: None if None in values else statistics.median(values)
    return [
        dataclasses.replace(rows[0], name=f"{rows[0].name}, median of {len(each)} scenes", value=middle([row.value for row in rows]),
                            ratio=middle([row.ratio for row in rows]))
        for rows in zip(*each)
    ]  # fmt: skip


def _paper(scene: Scene, device: str, driven: Driven, plan: Plan) -> list[Row]:
    """Every Gaussian a node, the printed method and the default, pulled by the same tool.

    The tool holds the tissue at one point and swings, towards the camera and aside and then in, in one second. What is prescribed is by
    default a displacement of a centimetre, so that neither mass nor stiffness, which these methods give the tissue differently, decides
    how far it moves; or the force. The default's tissue is 2 cm thick and pinned behind, that of the others a bare
    skin held at its rim: their images differ because the tissue does.
    """
    common = {"substeps": PAPER_SUBSTEPS, "device": device}
    printed = PhysicsConfig(node_count=plan.printed_nodes, layers=0, kinematics="current", **common)
    softmax = RenderingConfig(skinning="softmax", device=device)
    compact = RenderingConfig(device=device)
    own = RenderingConfig(neighbours=1, device=device)  # every Gaussian is its own node
    pull = (plan.force if driven == "force" else plan.travel) * PULL
    dense = _Dragged(scene, PhysicsConfig.baseline(**common), pull, driven, own)
    methods = {
        "printed": _Dragged(scene, printed, pull, driven, softmax, compact),
        "default": _Dragged(scene, PhysicsConfig(device=device), pull, driven, compact),
    }
    everyone = {DENSE: dense, **methods}
    count = round(1 / printed.step_duration)
    for number in range(1, count + 1):  # in turns: a busy machine slows all alike
        for tissue in everyone.values():
            tissue.drag(math.sin(2 * math.pi * number / count))
    step = {name: statistics.median(tissue.steps) for name, tissue in everyone.items()}
    whole = {name: statistics.median(tissue.wholes) for name, tissue in everyone.items()}
    size = f"{scene.camera.width}x{scene.camera.height}"
    rows = []
    for name in everyone:
        for what, seconds in (("simulation alone", step), (f"with images {size}", whole)):
            ratio = (None, None) if name == DENSE else (seconds[DENSE] / seconds[name], DENSE)
            rows.append(Row(f"{name}: {what}", 1 / seconds[name], "FPS", *ratio))
    rows.append(Row("paper: its sparse nodes, RTX 3090", 57, "FPS", 57 / 4, "PhysGaussian, in the paper"))
    rows.append(Row("paper: PhysGaussian, RTX 3090", 4, "FPS"))
    rest = DeformableRenderer(scene.model, None, compact).render(scene.camera)[0]
    shown = {"at rest": [rest] * count} | {name: tissue.images[0] for name, tissue in methods.items()}
    shown["printed, compact weights"] = methods["printed"].images[1]
    for name, images in shown.items():
        values = [_psnr(*pair) for pair in zip(images, dense.images[0])]
        rows.append(Row(f"{name}: PSNR, mean", statistics.fmean(values), "dB", None, f"{DENSE}'s images"))
        rows.append(Row(f"{name}: PSNR, lowest", min(values), "dB", None, f"{DENSE}'s images"))
    for name, tissue in everyone.items():
        rows.append(Row(f"{name}: farthest any node went", 1000 * tissue.farthest, "mm"))
    return rows


def _psnr(image: np.ndarray, other: np.ndarray) -> float:
    """Peak signal-to-noise ratio of 8-bit images, dB; equal ones have that of a single grey level in one value."""
    squares = ((image.astype(np.float64) - other) ** 2).sum()
    return 10 * math.log10(255**2 * image.size / max(squares, 1.0))


# ---------------------------------------------------------------- what a step costs


def _pulled(scene: Scene, config: PhysicsConfig, pressed: bool = False) -> MpmSolver:
    """A solver whose tissue a tool pulls by 5 mm, or presses with its capsule: nothing is at rest."""
    nodes = build_control_nodes(scene.model, scene.camera.position, config)
    solver = MpmSolver(nodes, config)
    _pull(Tools(solver, nodes, config), scene, pressed)
    return solver


def _pressed_by_instrument(scene: Scene, config: PhysicsConfig) -> MpmSolver:
    """A solver into whose tissue a needle driver reaches with open jaws by 5 mm."""
    psm, joints = load_arm("PSM", "LARGE_NEEDLE_DRIVER"), np.array([0.0, 0.0, 0.12, 0.0, 0.0, 0.0])
    capsules = build_instrument(psm)[1]
    links, jaws = ToolLinks(capsules), [float(np.linalg.norm(each.end)) for each in capsules if each.link in JAW_LINKS]
    nodes = build_control_nodes(scene.model, scene.camera.position, config)
    solver = MpmSolver(nodes, config, capsules=len(links))
    tools, tip = Tools(solver, nodes, config), psm.tip_pose(joints)
    hinge = scene.camera.pose.copy()  # z goes into the tissue
    hinge[:3, 3] = scene.tip + (0.005 - max(jaws)) * hinge[:3, 2]
    poses = link_poses(psm, joints, 0.5)
    base = hinge @ np.linalg.inv(tip)
    tools.set_links(0, links, torch.from_numpy(np.stack([base @ poses[link] for link in links.links]))[None])
    tools.tips[:], tools.rotations[:] = torch.from_numpy(hinge[:3, 3]), torch.from_numpy(hinge[:3, :3].copy())
    tools.present[:] = 1
    return solver


def _pull(tools: Tools, scene: Scene, pressed: bool = False) -> None:
    """Command all tools to close and pull, or to press."""
    into = scene.camera.pose[:3, :3] @ np.array([0.0, 0.0, 1.0])
    tools.tips[:] = torch.from_numpy(scene.tip)
    tools.rotations[:] = torch.eye(3, dtype=torch.float64)
    tools.present[:] = 1
    tools.closed[:] = int(not pressed)
    tools.take_hold()
    tools.tips += torch.from_numpy(0.005 * into * (1 if pressed else -1)).to(tools.tips)


def _against_plain(name: str, make: Callable[[], Callable[[], object]], device: str, seconds: float) -> list[Row]:
    """Time of the action that `make` returns, on a CPU beside the same by plain kernels."""
    actions = [make()]
    if device == "cpu":
        with compare_plain():
            actions.append(make())
    ours, *plain = milliseconds(actions, device, seconds)
    return [Row(name, ours, "ms", ours / plain[0], PLAIN) if plain else Row(name, ours, "ms")]


def _step_rows(name: str, scene: Scene, config: PhysicsConfig, device: str, seconds: float, pressed: bool = False) -> list[Row]:
    return _against_plain(name, lambda: _pulled(scene, config, pressed).step, device, seconds)


def _over_nodes(scene: Scene, count: int, device: str, seconds: float) -> list[Row]:
    """A step of the printed method, 80 substeps, and one of the default, as few substeps as are safe.

    The printed method's tissue is softened, which costs the same, so that 80 substeps are stable at any spacing.
    """
    common = {"node_count": count, "device": device}
    printed = PhysicsConfig(layers=0, kinematics="current", substeps=PAPER_SUBSTEPS, young_modulus=100.0, **common)
    return [
        *_step_rows(f"over nodes: {short(count)}, printed, 80 substeps", scene, printed, device, seconds),
        *_step_rows(f"over nodes: {short(count)}, default", scene, PhysicsConfig(**common), device, seconds),
    ]


def _over_substeps(scene: Scene, substeps: int, nodes: int, device: str, seconds: float) -> list[Row]:
    """The default method in steps of so many substeps of half a millisecond, the paper's."""
    config = PhysicsConfig(node_count=nodes, step_duration=0.0005 * substeps, substeps=substeps, device=device)
    return _step_rows(f"over substeps: {substeps}, {short(nodes)} nodes", scene, config, device, seconds)


def _contact(scene: Scene, nodes: int, device: str, seconds: float) -> list[Row]:
    """A step of the default method with a tool that presses, one capsule or an instrument, and the same without contact."""
    config = PhysicsConfig(node_count=nodes, device=device)
    touching = dataclasses.replace(config, contact_radius=0.005, contact_length=0.03)
    name = f"{short(nodes)} nodes, pressed by a capsule"
    rows = _step_rows(name, scene, touching, device, seconds, pressed=True)
    with_it, without = milliseconds([_pulled(scene, each, pressed=True).step for each in (touching, config)], device, seconds)
    rows.append(Row(name, with_it, "ms", with_it / without, "no contact"))
    name = f"{short(nodes)} nodes, pressed by an instrument"
    pressed = lambda: _pressed_by_instrument(scene, config).step  # noqa: E731
    rows += _against_plain(name, pressed, device, seconds)
    with_it, without = milliseconds([pressed(), _pulled(scene, config, pressed=True).step], device, seconds)
    return [*rows, Row(name, with_it, "ms", with_it / without, "no contact")]


def _over_gaussians(count: int, plan: Plan, device: str) -> list[Row]:
    """Skinning alone, and a step with skinning as its end, on a GPU as one graph."""
    scene = phantom_scene(count, plan.width)
    config = PhysicsConfig(device=device)
    nodes = build_control_nodes(scene.model, scene.camera.position, config)

    def moving() -> TissueBatch:
        batch = TissueBatch(nodes, config, 1)
        _pull(batch.tools, scene)
        batch.step()
        return batch

    batch = moving()
    positions, F = batch.positions()[0], batch.F[0].clone()

    def skinning() -> Skinning:
        return Skinning(scene.model, nodes.rest, device=device)

    name, seconds = short(count), plan.seconds
    rows = _against_plain(f"skin {name}", lambda: partial(skinning().deform, positions, F), device, seconds)
    rows += _against_plain(f"step and skin {name}", lambda: _pulled_with_skin(scene, config).step, device, seconds)
    one, apart, skin = moving(), moving(), skinning()
    one.append_skinning(skin)
    together, separate = milliseconds([one.step, lambda: (apart.step(), skin.deform(apart.positions()[0], apart.F[0]))], device, seconds)
    return [*rows, Row(f"step and skin {name}", together, "ms", together / separate, "step, then skin")]


# ---------------------------------------------------------------- many environments and memory


def _many(scene: Scene, count: int, environments: tuple[int, ...], device: str, plan: Plan) -> list[Row]:
    """Steps per second of B copies stepped together, each with its tool; as many as fit in memory and in patience."""
    config = PhysicsConfig(node_count=count, device=device)
    nodes = build_control_nodes(scene.model, scene.camera.position, config)
    rows, last, alone = [], None, None
    for B in environments:
        if last is not None and (last[1] * B / last[0] > plan.longest or last[2] * B / last[0] > 0.5 * _free_bytes(device)):
            break
        try:
            batch = TissueBatch(nodes, config, B)
        except (ValueError, RuntimeError):  # a grid beyond bounds, or memory
            break
        _pull(batch.tools, scene)
        duration = milliseconds([batch.step], device, plan.seconds)[0] / 1000
        each, together = 1 / duration, B / duration
        ratio = (together / alone[1], f"{alone[0]} x {short(count)} nodes") if alone else (None, None)
        rows.append(Row(f"{B} x {short(count)} nodes: steps of all", together, "1/s", *ratio))
        rows.append(Row(f"{B} x {short(count)} nodes: steps of each", each, "1/s"))
        alone = alone or (B, together)
        last = B, duration, _bytes(_arrays(batch.solver))
    return rows


def _free_bytes(device: str) -> float:
    if device != "cpu":
        return torch.cuda.mem_get_info(device)[0]
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError):
        return math.inf


def _arrays(holder: Any) -> Iterator[wp.array]:
    """Arrays among the attributes of an object or a Warp struct, and of the structs among them."""
    for name in holder._cls.vars if hasattr(holder, "_cls") else vars(holder):
        value = getattr(holder, name)
        if isinstance(value, wp.array):
            yield value
        elif hasattr(value, "_cls"):  # a Warp struct
            yield from _arrays(value)


def _bytes(arrays: Iterable[wp.array]) -> int:
    """The memory of arrays; what several of them share counts once."""
    total = end = 0
    for first, last in sorted((a.ptr, a.ptr + a.size * wp.types.type_size_in_bytes(a.dtype)) for a in arrays if a.ptr):
        total, end = total + max(last - max(first, end), 0), max(end, last)
    return total


def _memory(scene: Scene, count: int, device: str) -> list[Row]:
    """Bytes of state, and what building and stepping one tissue, and 16 together, takes."""
    config = PhysicsConfig(node_count=count, device=device)
    nodes = build_control_nodes(scene.model, scene.camera.position, config)
    solver = MpmSolver(nodes, config)
    state = _bytes(_arrays(solver.state))
    rows = [Row("state of a node", state / len(nodes), "B"), Row("solver per node", _bytes(_arrays(solver)) / len(nodes), "B")]
    for B in (1, 16):
        peak = peak_megabytes(lambda B=B: TissueBatch(nodes, config, B).step(), device)
        rows += [] if peak is None else [Row(f"{B} x {short(count)} nodes: peak memory", peak, "MB")]
    return rows


# ---------------------------------------------------------------- a peer

PEER = "PhysGaussian's"
PEER_GAUSSIANS = 100_000  # of the scene that both move on a GPU, beside the plan's own


def beside_peer(scene: Scene, device: str, plan: Plan, notes: list[str]) -> list[Row]:
    """The solver that PhysGaussian uses, where it can be imported: with the nodes that we step, and its way, with every Gaussian.

    All take a step of the same duration, PhysGaussian's solver and the rows that say so in 80 substeps.
    """
    if not importlib.util.find_spec("mpm_solver_warp"):
        return []
    sparse = PhysicsConfig(node_count=plan.printed_nodes, layers=0, substeps=PAPER_SUBSTEPS, device=device)
    ours = {f"{sparse.substeps} substeps": sparse, "default": PhysicsConfig(node_count=plan.printed_nodes, device=device)}
    dense = PhysicsConfig.baseline(substeps=PAPER_SUBSTEPS, device=device)
    nodes = short(plan.printed_nodes)
    tried = [(scene, sparse, f"{nodes} nodes", {f"{nodes} nodes, {name}": _pulled(scene, config).step for name, config in ours.items()})]
    for each in [scene, *([] if device == "cpu" else [phantom_scene(PEER_GAUSSIANS, plan.width)])] if plan.peer_dense else []:
        count = short(len(each.model))
        actions = {f"{nodes} nodes and skin of {count}, {name}": _pulled_with_skin(each, config).step for name, config in ours.items()}
        if each is scene:
            actions[f"{count} dense nodes, {dense.substeps} substeps"] = _pulled(each, dense).step
        tried.append((each, dense, f"{count} dense nodes", actions))
    rows = []
    for each, config, what, actions in tried:
        try:
            stepped = build_control_nodes(each.model, each.camera.position, config)
            grid = plan.peer_grid or (48 if device == "cpu" else 100)
            with contextlib.redirect_stdout(io.StringIO()):
                theirs = _physgaussian(stepped, config, grid, device)
                theirs()  # compiles
                *durations, peer = milliseconds([*actions.values(), theirs], device, plan.seconds)
        except Exception as error:  # whatever is installed under that name, and however it fails with this Warp
            notes.append(f"{PEER} solver could not be measured: {type(error).__name__}: {error}".splitlines()[0])
            break
        rows.append(Row(f"{PEER} solver, {what}, {grid}³ grid", peer, "ms"))
        rows += [Row(name, duration, "ms", duration / peer, f"{PEER} solver, {what}") for name, duration in zip(actions, durations)]
    return rows


def _pulled_with_skin(scene: Scene, config: PhysicsConfig) -> MpmSolver:
    """A solver whose tissue a tool pulls and whose step ends with the Gaussians where it took them."""
    solver = _pulled(scene, config)
    nodes = build_control_nodes(scene.model, scene.camera.position, config)
    skinning = Skinning(scene.model, nodes.rest, device=config.device)
    solver.append_launches(skinning.work(solver.state.u, solver.state.F, nodes.pinned, solver.motion, 1)[0])
    return solver


def _physgaussian(nodes: ControlNodes, config: PhysicsConfig, grid: int, device: str) -> Callable[[], None]:
    """A step by `MPM_Simulator_WARP` of github.com/zeshunzong/warp-mpm, which PhysGaussian uses, as an action.

    The nodes fill three quarters of its cube and move a little; its substeps are short, which costs the same, so that
    its finer grid is stable.
    """
    from mpm_solver_warp import MPM_Simulator_WARP  # pyright: ignore[reportMissingImports]  (optional)

    rest = nodes.rest.astype(np.float64)
    size = 4 / 3 * float(np.ptp(rest, axis=0).max())
    solver = MPM_Simulator_WARP(len(nodes), n_grid=grid, grid_lim=size, device=device)
    state = solver.mpm_state
    rng = np.random.default_rng(0)
    array = lambda values, dtype: wp.array(values.astype(np.float32), dtype=dtype, device=device)
    state.particle_x = array(rest - (rest.min(0) + rest.max(0)) / 2 + size / 2, wp.vec3)
    state.particle_v = array(rng.normal(0, 0.01, rest.shape), wp.vec3)
    state.particle_vol = array(nodes.volumes, float)
    state.particle_F_trial = array(np.tile(np.eye(3), (len(nodes), 1, 1)), wp.mat33)
    material = {"E": config.young_modulus, "nu": config.poisson_ratio, "density": config.density}
    solver.set_parameters_dict({"material": "jelly", "g": [0.0, 0.0, 0.0], **material}, device=device)
    finalize = getattr(solver, "finalize_mu_lam_bulk", None) or solver.finalize_mu_lam  # the name within PhysGaussian
    finalize(device=device)

    def step() -> None:
        for number in range(config.substeps):
            solver.p2g2p(number, 1e-4, device=device)

    return step
