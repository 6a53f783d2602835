"""Speed, memory and precision of the rasteriser on this machine, beside its peers: `endo-sim bench raster`."""

import dataclasses
import importlib.util
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core.cameras import Camera, make_pose
from endo_sim_ros.core.device import pick_device, single_threaded_torch
from endo_sim_ros.core.gaussians import SH_C0, GaussianModel
from endo_sim_ros.core.kernels import compare_plain
from endo_sim_ros.core.light import Light
from endo_sim_ros.evaluation.measurement import Row, Stage, machine, milliseconds, peak_megabytes, report, run_stages, short
from endo_sim_ros.instruments import build_instrument, link_poses, load_arm, place_arm
from endo_sim_ros.instruments.drawing import DrawingConfig, InstrumentDrawing
from endo_sim_ros.physics import PhysicsConfig, build_control_nodes
from endo_sim_ros.reconstruction import ReconstructionConfig, Trainer, prepare
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence
from endo_sim_ros.splatting import RenderOutput, rasterize, rasterize_in_torch

DEPTH = 1.0  # of the scene's centre, metres: some peers do not draw what is nearer than 0.2


class Plan(NamedTuple):
    """What to measure; smaller in tests."""

    counts: tuple[int, ...] = (30_000, 100_000, 300_000)
    sizes: tuple[tuple[int, int], ...] = ((640, 512), (1280, 1024))
    curve_counts: tuple[int, ...] = (1_000, 10_000, 100_000, 1_000_000)
    curve_sizes: tuple[tuple[int, int], ...] = ((80, 64), (160, 128), (320, 256), (640, 512), (1280, 1024))
    overlaps: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    reference: tuple[int, int, int] = (1000, 96, 80)  # Gaussians, width, height
    training: tuple[int, int, int] = (30_000, 320, 256)
    seconds: float = 0.5  # for one median


class Scene(NamedTuple):
    """Arguments of a rasteriser."""

    gaussians: list[Tensor]  # means, quats, scales, opacities, sh
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int


def tissue(count: int, width: int, height: int, device: str = "cpu", overlap: float = 1.0) -> Scene:
    """A curved sheet of flat random Gaussians that fills the image; float32.

    Standard deviations along the sheet are about `overlap` times the distance between neighbours, so that a pixel sees
    about 25 overlap² Gaussians.
    """
    generator = torch.Generator().manual_seed(0)
    normal = lambda *shape: torch.randn(*shape, generator=generator)
    focal = 0.94 * width  # pixels
    extent = 1.05 * DEPTH / focal * torch.tensor([width, height])  # a little more than is seen, metres
    xy = (torch.rand(count, 2, generator=generator) - 0.5) * extent
    z = DEPTH + 0.5 / DEPTH * (xy**2).sum(1, keepdim=True) + 0.004 * DEPTH * normal(count, 1)
    spacing = math.sqrt(float(extent.prod()) / count)
    gaussians = [
        torch.cat([xy * z / DEPTH, z], 1),
        torch.cat([torch.ones(count, 1), 0.3 * normal(count, 3)], 1),
        overlap * spacing * (0.3 * normal(count, 3)).exp() * torch.tensor([1.0, 1.0, 0.3]),
        (1.5 * normal(count) + 0.5).sigmoid(),
        0.6 * normal(count, 1, 3),
    ]
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Scene([x.to(device) for x in gaussians], torch.eye(4, device=device)[None], K[None].to(device), width, height)


@single_threaded_torch()
def bench_raster(device: str, json_file: Path | None = None, plan: Plan = Plan()) -> None:
    """Print the results on a device (see `pick_device`) and, if asked for, write them to a file.

    Times are medians in milliseconds. "Forward" is colour, depth, alpha and distortion without gradients; "backward" the
    gradients of means, quaternions, scales, opacities and colours from all of these. Peers compute colour and depth.
    """
    device, seconds = pick_device(device), plan.seconds
    named = lambda count, size: f"{short(count)} {size[0]}x{size[1]}"
    few, width, height = plan.reference
    small, size, count = (width, height), plan.sizes[0], plan.counts[0]
    stages: list[Stage] = [
        *((named(n, s), partial(_speed, named(n, s), n, s, device, seconds)) for s in plan.sizes for n in plan.counts),
        ("torch reference", partial(_against_reference, named(few, small), few, small, device, seconds)),
        ("precision", partial(_precision, few, small, device)),
        ("instruments", partial(_instruments, count, size, device, seconds)),
        ("whole pictures", partial(_pictures, count, size, device, seconds)),
        *(("time and Gaussians", partial(_curve, "over Gaussians", n, size, 1.0, device, seconds)) for n in plan.curve_counts),
        *(("time and pixels", partial(_curve, "over pixels", count, s, 1.0, device, seconds)) for s in plan.curve_sizes),
        *(("time and overlap", partial(_curve, "over overlap", count, size, x, device, seconds)) for x in plan.overlaps),
        ("training", partial(_training, *plan.training, device, seconds)),
    ]
    report(f"Rasteriser on {machine(device)}", run_stages(stages), json_file)


# ---------------------------------------------------------------- what is measured


# What draws a scene: given its Gaussians, returns images, colours [1, H, W, 3] first. Made before time is taken.
Draw = Callable[[list[Tensor]], Sequence[Tensor]]


def _arguments(gaussians: Sequence[Tensor], scene: Scene) -> list[Any]:
    """Positional arguments of a rasteriser: Gaussians, then the cameras of a scene and the size of their images."""
    return [*gaussians, *scene[1:]]


def _ours(scene: Scene) -> Draw:
    return lambda gaussians: rasterize(*_arguments(gaussians, scene))[:4]


def _speed(name: str, count: int, size: tuple[int, int], device: str, seconds: float) -> list[Row]:
    """Time forward, time forward and backward, and memory of the latter, each beside the peers that are there."""
    scene = tissue(count, *size, device)
    peers = {peer: prepare(scene) for peer, prepare in _peers(device).items()}
    rows = _compare(name, scene, peers, device, seconds)
    peaks = [peak_megabytes(_forward_and_backward(draw, scene), device) for draw in peers.values() if device != "cpu"]
    ours = peak_megabytes(_forward_and_backward(_ours(scene), scene), device)
    if ours is not None:
        others = zip(peers, peaks) if peaks else [(None, None)]
        rows += [Row(f"{name} peak memory", ours, "MB", ours / peak if peak else None, peer) for peer, peak in others]
    return rows


def _compare(name: str, scene: Scene, peers: dict[str, Draw], device: str, seconds: float) -> list[Row]:
    """Our times, once for each peer, with the ratio to it, and how far its picture is from ours."""
    draws = [_ours(scene), *peers.values()]
    with torch.no_grad():
        ours, *theirs = [draw(scene.gaussians)[0] for draw in draws]
    rows = [Row(f"{name} mean colour difference", float((ours - x).abs().mean()), "", None, peer) for peer, x in zip(peers, theirs)]
    for what, action in (("forward", _forward), ("forward + backward", _forward_and_backward)):
        ours, *theirs = milliseconds([action(draw, scene) for draw in draws], device, seconds)
        rows += [Row(f"{name} {what}", ours, "ms", ours / value, peer) for peer, value in zip(peers, theirs)]
        if not peers:
            rows.append(Row(f"{name} {what}", ours, "ms"))
    return rows


def _forward(draw: Draw, scene: Scene) -> Callable[[], object]:
    """An action that draws a scene without gradients."""
    return lambda: torch.no_grad()(draw)(scene.gaussians)


def _forward_and_backward(draw: Draw, scene: Scene) -> Callable[[], object]:
    """An action that draws a scene and computes gradients for fixed random gradients of its images."""
    leaves = [x.detach().requires_grad_() for x in scene.gaussians]
    differentiable = lambda: [image for image in draw(leaves) if image.requires_grad]
    generator = torch.Generator().manual_seed(1)
    cotangents = [torch.randn(image.shape, generator=generator).to(image) for image in differentiable()]
    return lambda: torch.autograd.grad(differentiable(), leaves, cotangents)


def _against_reference(name: str, count: int, size: tuple[int, int], device: str, seconds: float) -> list[Row]:
    """The same small scene by the kernels and by plain torch, both float32."""
    scene = tissue(count, *size, device)
    in_torch = lambda gaussians: rasterize_in_torch(*_arguments(gaussians, scene))[:4]
    return _compare(name, scene, {"torch reference": in_torch}, device, seconds)


def _precision(count: int, size: tuple[int, int], device: str) -> list[Row]:
    """Errors relative to the largest value, of images and gradients, against the float64 reference on the CPU."""
    scene = tissue(count, *size)
    results = []
    for function, where, dtype in ((rasterize, device, torch.float32), (rasterize_in_torch, "cpu", torch.float64)):
        leaves = [x.detach().to(where, dtype).requires_grad_() for x in (*scene.gaussians, scene.viewmats)]
        absgrad = torch.zeros(1, count, 2, dtype=dtype, device=where, requires_grad=True)
        arguments: list[Any] = [*leaves, scene.Ks.to(where, dtype), *size]
        images = function(*arguments, absgrad=absgrad)[:4]
        generator = torch.Generator().manual_seed(1)
        cotangents = [torch.randn(image.shape, generator=generator).to(image) for image in images]
        gradients = torch.autograd.grad(images, [*leaves, absgrad], cotangents)
        results.append([x.detach().cpu().double() for x in (*images, *gradients)])
    names = [*RenderOutput._fields[:4]] + [f"gradient of {x}" for x in ("means", "quats", "scales", "opacities", "sh", "viewmats")]
    rows = []
    for name, actual, expected in zip([*names, "absolute gradient of mean2d"], *results):
        errors = ((actual - expected).abs() / expected.abs().max()).flatten()
        rows.append(Row(f"error of {name}, 95 %", float(errors.quantile(0.95)), "relative"))
        rows.append(Row(f"error of {name}, max", float(errors.max()), "relative"))
    return rows


def _instruments(count: int, size: tuple[int, int], device: str, seconds: float) -> list[Row]:
    """Drawing instruments, with and without their shadows, beside rasterising the tissue that they are drawn into."""
    scene = tissue(count, *size, device)
    draw = _ours(scene)
    with torch.no_grad():
        colors, depths, alphas, *_ = draw(scene.gaussians)
    depths = 0.1 * depths  # tissue at 10 cm, and instruments at 8
    camera, rows = Camera(scene.Ks[0].cpu().numpy(), *size), []
    for arms in (("PSM1",), ("PSM1", "PSM2")):
        psm = load_arm("PSM", "LARGE_NEEDLE_DRIVER")
        parts, capsules = build_instrument(psm)
        places = [place_arm(arm, psm, camera, 0.08) for arm in arms]
        poses = [{link: place.base @ pose for link, pose in link_poses(psm, place.joints, 0.6).items()} for place in places]
        for shadows in (False, True):
            drawing = InstrumentDrawing([parts] * len(arms), DrawingConfig(shadows=shadows), device, [capsules] * len(arms))
            action = partial(drawing.draw, poses, camera, colors[0], depths[0], alphas[0])
            ours, theirs = milliseconds([action, _forward(draw, scene)], device, seconds)
            what = f"{len(arms)} instrument{'s' * (len(arms) > 1)}{' with shadows' * shadows}"
            rows.append(Row(f"{what} {size[0]}x{size[1]}", ours, "ms", ours / theirs, f"image of {short(count)} Gaussians"))
    return rows


def _pictures(count: int, size: tuple[int, int], device: str, seconds: float) -> list[Row]:
    """What rendering_node does for a picture, beside rasterising alone: tissue that follows its control nodes, and an instrument."""
    scene, psm = tissue(count, *size, device), load_arm("PSM", "LARGE_NEEDLE_DRIVER")
    means, _, scales, opacities, sh = scene.gaussians
    model = GaussianModel.from_points(0.1 * means, (0.5 + SH_C0 * sh[:, 0]).clamp(0, 1), 0.1 * scales.mean(1), float(opacities.mean()))
    left = Camera(scene.Ks[0].cpu().numpy(), *size)
    rest = build_control_nodes(model, left.position, PhysicsConfig(device=device)).rest
    film = torch.nn.functional.normalize(torch.cat([0.2 * sh[:, 0, :2], -torch.ones_like(sh[:, 0, :1])], 1))
    gloss = torch.cat([film, film, torch.zeros_like(film[:, :2])], 1)
    lit = dataclasses.replace(model, light=Light(sheen_sharpness=12.0, glint_sharpness=150.0, facing=0.45))
    looks = model, lit, dataclasses.replace(lit, gloss=gloss)
    renderer, matt, glossy = (DeformableRenderer(each, rest, RenderingConfig(device=device)) for each in looks)
    place, (parts, capsules) = place_arm("PSM1", psm, left, 0.08), build_instrument(psm)
    links = {link: place.base @ pose for link, pose in link_poses(psm, place.joints, 0.6).items()}
    posed = InstrumentDrawing([parts], DrawingConfig(), device, [capsules]).at([links])
    moved = rest + 1e-4 * np.sin(200 * rest), np.tile(np.eye(3), (len(rest), 1, 1))
    right, rows = left.at(make_pose([0.004, 0, 0], [1, 0, 0, 0])), []
    for name, eyes in (("one eye", [left]), ("both eyes", [left, right])):
        alone = partial(renderer.views, eyes, *moved, depth=False)
        actions = [partial(alone, instruments=posed), alone, _forward(_ours(scene), scene)]
        actions += [partial(each.views, eyes, *moved, depth=False) for each in (glossy, matt)]
        both, tissue_alone, theirs, reflecting, dull = milliseconds(actions, device, seconds)
        what, peer = f"{name} {size[0]}x{size[1]}", f"image of {short(count)} Gaussians"
        rows.append(Row(f"whole picture, {what}", both, "ms", both / theirs, peer))
        more = both - tissue_alone
        rows.append(Row(f"of it the instrument, {what}", more, "ms", more / tissue_alone, "the picture without"))
        rows.append(Row(f"what reflects, {what}", reflecting - dull, "ms", (reflecting - dull) / dull, "a matt picture"))
    return rows


def _curve(name: str, count: int, size: tuple[int, int], overlap: float, device: str, seconds: float) -> list[Row]:
    """One point of a curve: forward and backward."""
    scene = tissue(count, *size, device, overlap)
    point = f"{short(count)} {size[0]}x{size[1]}" + (f" overlap x{overlap:g}" if "overlap" in name else "")
    return [Row(f"{name}: {point}", milliseconds([_forward_and_backward(_ours(scene), scene)], device, seconds)[0], "ms")]


def _training(count: int, width: int, height: int, device: str, seconds: float) -> list[Row]:
    """Iterations per second of a training, each with a training view and a virtual view, losses and optimiser."""
    frames = list(phantom_sequence(PhantomConfig(frames=8, width=width, height=height)))
    size = {"max_gaussians": count, "image_width": width, "mcmc.growth": 1.0, "refine_every": 1}
    terms = {"virtual_every": 1, "lambda_dist": 0.1, "lambda_tv": 0.5}
    config = ReconstructionConfig.from_mapping(size | terms | {"device": device})
    trainer = Trainer(prepare(frames, config), config)
    while len(trainer.model) < count and trainer.iteration < 20:
        trainer.step()
    # Refinement is rare in a training; here it has done its part.
    trainer.config = dataclasses.replace(trainer.config, refine_every=100)
    name = f"training {short(len(trainer.model))} {width}x{height}"
    return [Row(name, 1000 / milliseconds([trainer.step], device, 3 * seconds)[0], "iterations/s")]


# ---------------------------------------------------------------- peers


def _peers(device: str) -> dict[str, Callable[[Scene], Draw]]:
    """What else could draw a scene here."""
    if device == "cpu":
        return {"plain scalar kernel, one thread": _plain}
    peers = {"gsplat": _gsplat, "gswarp": _gswarp}
    return {name: prepare for name, prepare in peers.items() if importlib.util.find_spec(name)}


def _plain(scene: Scene) -> Draw:
    """Our kernels for GPUs, on the CPU, one pixel after the other."""

    def draw(gaussians: list[Tensor]) -> Sequence[Tensor]:
        with compare_plain():
            return _ours(scene)(gaussians)

    return draw


def _gsplat(scene: Scene) -> Draw:
    from gsplat import rasterization  # pyright: ignore[reportMissingImports]  (optional)

    def draw(gaussians: list[Tensor]) -> Sequence[Tensor]:
        options = {"sh_degree": 0, "packed": False, "render_mode": "RGB+ED"}
        images, alphas, _ = rasterization(*gaussians, *scene[1:], **options)
        return images[..., :3], images[..., 3], alphas

    return draw


def _gswarp(scene: Scene) -> Draw:
    """Has the interface of the rasteriser of 3DGS: OpenGL's projection, matrices transposed."""
    from gswarp import (  # pyright: ignore[reportMissingImports]  (optional)
        GaussianRasterizationSettings,
        GaussianRasterizer,
    )

    width, height, viewmat = scene.width, scene.height, scene.viewmats[0]
    fx, fy, near, far = float(scene.Ks[0, 0, 0]), float(scene.Ks[0, 1, 1]), 0.01, 100.0
    projection = viewmat.new_tensor(
        [
            [2 * fx / width, 0, 0, 0],
            [0, 2 * fy / height, 0, 0],
            [0, 0, far / (far - near), -far * near / (far - near)],
            [0, 0, 1, 0],
        ]
    )
    rasterizer = GaussianRasterizer(
        GaussianRasterizationSettings(
            image_height=height,
            image_width=width,
            tanfovx=width / (2 * fx),
            tanfovy=height / (2 * fy),
            bg=viewmat.new_zeros(3),
            scale_modifier=1.0,
            viewmatrix=viewmat.T.contiguous(),
            projmatrix=(projection @ viewmat).T.contiguous(),
            sh_degree=0,
            campos=viewmat.inverse()[:3, 3].contiguous(),
            prefiltered=False,
            auto_tune_verbose=False,
        )
    )

    def draw(gaussians: list[Tensor]) -> Sequence[Tensor]:
        means, quats, scales, opacities, sh = gaussians
        in_image = torch.zeros_like(means, requires_grad=True)
        color, _, meta = rasterizer(means, in_image, opacities[:, None], shs=sh, scales=scales, rotations=quats)
        return color.permute(1, 2, 0)[None], meta.depth

    return draw
