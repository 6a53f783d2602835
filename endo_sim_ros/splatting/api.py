"""Differentiable rasterisation of 3D Gaussians into colour, depth, alpha and distortion.

`rasterize` runs Warp kernels on the CPU or a CUDA device; `reference.rasterize_in_torch` computes the same in plain torch.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core import reflections
from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import upload
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.reflections import Seen, add_glints, seen_colors
from endo_sim_ros.splatting.backend import backend_for
from endo_sim_ros.splatting.constants import EXTRAS, TILE
from endo_sim_ros.splatting.scene import Gradients, Scene, Settings


class RenderOutput(NamedTuple):
    """Images of C cameras."""

    colors: Tensor  # [C, H, W, 3] Σ w_i c_i, linear, plus background
    depths: Tensor  # [C, H, W] Σ w_i z_i, metres, not divided by alpha
    alphas: Tensor  # [C, H, W] Σ w_i
    distortions: Tensor  # [C, H, W] Σ_ij w_i w_j |z_i − z_j|, metres
    radii: Tensor  # [C, N] int32, half size of the footprint's bounding box, pixels; 0 = not in the image; no gradient
    medians: Tensor | None = None  # [C, H, W] z where half of the light is blocked, metres; 0 = never; None = not asked for
    extras: Tensor | None = None  # [C, 4, H, W] Σ w_i e_i; None = none were given, or they made glints


def rasterize(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    sh: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    covars: Tensor | None = None,
    extras: Tensor | None = None,
    glints: float | None = None,
    background: Tensor | None = None,
    masks: Tensor | None = None,
    absgrad: Tensor | None = None,
    signed: bool = False,
    median: bool = False,
    near: float = 1e-3,
    eps2d: float = 0.3,
) -> RenderOutput:
    """Return images of Gaussians by EWA splatting (Kerbl et al. 2023, eq. 2, 3 and 5), float32.

    Gradients flow to means, quats, scales, covars, opacities, sh, extras, viewmats and background, not to Ks.
    On the CPU results repeat bit for bit whatever the number of threads; on CUDA gradients are summed with atomics.

    Args:
        means: Centres [N, 3], metres, world. Each camera may have its own [C, N, 3], e.g. of as many copies of tissue; then
            covars are [C, N, 3, 3], sh may be [C, N, K, 3], and there are no gradients.
        quats: Rotations wxyz [N, 4], not necessarily normalised; zero means no rotation. None when covars is given.
        scales: Standard deviations along the rotated axes [N, 3], metres. None when covars is given.
        opacities: Opacities in [0, 1] [N].
        sh: Spherical harmonic coefficients [N, K, 3], K = 1, 4, 9 or 16; colour = max(Σ_k Y_k sh_k + 0.5, 0).
        viewmats: World-to-camera transforms [C, 4, 4], rigid, metres, optical frames.
        Ks: Intrinsics [C, 3, 3], pixels, without skew; pixel (0, 0) has its centre at (0.5, 0.5).
        width: Image width, pixels.
        height: Image height, pixels.
        covars: World covariances [N, 3, 3], m², used instead of quats and scales, e.g. of deformed Gaussians.
        extras: Four more numbers of each Gaussian [N, 4], or of each in each camera [C, N, 4], that are drawn as colours are.
        glints: Sharpness of glints that are added to colours as light, where extras are the films of a `Seen`, whose strengths are not
            negative; None: extras are images of their own.
        background: Colour behind everything [3]; black by default.
        masks: True where the image matters [C, H, W]. Tiles of 16×16 pixels without any True show background only.
        absgrad: Receives the statistics of AbsGS densification: its values are not used, its gradient is
            Σ_pixels |∂L/∂mean2d| per image coordinate [C, N, 2], 1/pixel (Ye et al. 2024). Costs time only where it
            requires a gradient.
        signed: Whether that gradient is Σ_pixels ∂L/∂mean2d instead, the statistics of 3DGS.
        median: Whether to compute median depths. Their gradient is that of the depth of the Gaussian at the median.
        near: Gaussians nearer than this are not drawn, metres.
        eps2d: Added to the variances in the image, pixel²: no splat is thinner than about a pixel.

    Returns:
        The images, see :class:`RenderOutput`.

    Raises:
        ValueError: If shapes disagree, there is no camera, near, eps2d or glints are negative, means of each camera require
            gradients, or a mean is not finite. The last is tested on the CPU only: on CUDA the test would stall the device.
            Any other Gaussian whose projection is not finite is not drawn and gets zero gradients.
    """
    if glints is not None and not glints >= 0:
        raise ValueError(f"rasterize: glints must not be negative, got {glints}")
    background = black(means.device) if background is None else background
    if extras is not None and extras.ndim == 2:
        extras = extras.expand(len(viewmats), *extras.shape)
    scene = Scene(means, quats, scales, covars, opacities, sh, extras, viewmats, Ks, background)
    sharpness = -1.0 if glints is None else float(glints)
    settings = Settings(int(width), int(height), float(near), float(eps2d), bool(median), bool(signed), sharpness)
    check_inputs("rasterize", scene, settings, masks, absgrad)
    if means.device.type == "cpu" and not means.isfinite().all():
        index = tuple((~means.detach().isfinite()).any(-1).nonzero()[0].tolist())
        raise ValueError(f"rasterize: means[{', '.join(map(str, index))}] is not finite: {means[index].tolist()}")
    differentiable = (means, quats, scales, covars, opacities, sh, extras, viewmats, background, absgrad)
    learns = torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in differentiable)
    if means.ndim == 3 and learns:
        raise ValueError("rasterize: means of each camera have no gradients; call it under torch.no_grad()")
    *tensors, absgrad = (None if x is None else x.to(means.device, torch.float32).contiguous() for x in (*scene, absgrad))
    scene = Scene._make(tensors)
    # Gradients of glints need the images of films.
    drawn = settings._replace(glints=-1.0) if learns else settings
    colors, depths, alphas, distortions, carried, radii, owners = _Rasterize.apply(drawn, masks, absgrad, *scene)
    if learns and extras is not None and glints is not None:
        colors = add_glints(colors, carried, alphas, scene.viewmats, scene.Ks, glints)
    medians = median_depths(owners, scene.means, scene.viewmats) if median else None
    return RenderOutput(colors, depths, alphas, distortions, radii, medians, None if extras is None or glints is not None else carried)


def render(
    model: GaussianModel,
    camera: Camera,
    *others: Camera,
    covars: Tensor | None = None,
    background: Tensor | None = None,
    median: bool = False,
    seen: Seen | None = None,
) -> RenderOutput:
    """Return images of a Gaussian model in one camera, or in C of one size at once: `rasterize` with their matrices, and with the colours
    that each of them sees where the model reflects.

    Args:
        model: Gaussians, world; the images are computed on their device.
        camera: Intrinsics, pose and image size.
        others: More cameras.
        covars: World covariances [N, 3, 3], m², instead of the model's own.
        background: Colour behind everything [3]; black by default.
        median: Whether to compute median depths.
        seen: What `Skinning.seen` returned for the cameras, where the model reflects, without gradients; that at rest by default.

    Raises:
        ValueError: As `rasterize` does.
    """
    cameras = camera, *others
    viewmats, Ks, positions = upload(model.means.device, *camera_arrays(cameras))
    options: dict[str, Any] = {"covars": covars, "background": background, "median": median, "seen": seen}
    return render_from(model, viewmats, Ks, positions, camera.width, camera.height, **options)


def camera_arrays(cameras: Sequence[Camera]) -> list[np.ndarray]:
    """What `render_from` takes of C cameras, once it is on a device."""
    return [np.array([getattr(each, name) for each in cameras]) for name in ("viewmat", "K", "position")]


def render_from(
    model: GaussianModel,
    viewmats: Tensor,
    Ks: Tensor,
    positions: Tensor,
    width: int,
    height: int,
    *,
    covars: Tensor | None = None,
    background: Tensor | None = None,
    median: bool = False,
    seen: Seen | None = None,
) -> RenderOutput:
    """Return what `render` does, for cameras that are on the device of the model already.

    Args:
        model: Gaussians, world.
        viewmats: World-to-camera transforms [C, 4, 4].
        Ks: Intrinsics [C, 3, 3], pixels.
        positions: Where the cameras are [C, 3], m, world.
        width, height: Size of the images, pixels.
        covars, background, median, seen: As for `render`.
    """
    means, sh, films = model.means, model.sh, None
    if model.reflects:
        if seen is None:
            cosines, films = reflections.facing(model, positions[:, None])
            seen = Seen(seen_colors(model, cosines), films)
        sh, films = seen
        if len(viewmats) > 1:
            covars = model.covariances if covars is None else covars
            means, covars = (each.expand(len(viewmats), *each.shape) for each in (means, covars))
        else:
            sh = sh[0]
    shapes = (None, None) if covars is not None else (model.quats, model.scales)
    arguments = viewmats, Ks, width, height
    options: dict[str, Any] = {"covars": covars, "background": background, "median": median, "extras": films}
    if films is not None and model.light is not None:
        options["glints"] = model.light.glint_sharpness
    return rasterize(means, *shapes, model.opacities, sh, *arguments, **options)


def check_inputs(name: str, scene: Scene, settings: Settings, masks: Tensor | None, absgrad: Tensor | None) -> None:
    """Check the arguments of `rasterize`, or of the reference.

    Raises:
        ValueError: If shapes disagree or a number makes no sense; the message begins with ``name`` and names the argument
            and both shapes.
    """
    means, quats, scales, covars, opacities, sh, extras, viewmats, Ks, background = scene
    width, height, near, eps2d, *_ = settings
    if means.ndim not in (2, 3) or means.shape[-1] != 3:
        raise ValueError(f"{name}: means shape {tuple(means.shape)} != expected shape (N, 3)")
    if viewmats.ndim != 3 or viewmats.shape[1:] != (4, 4):
        raise ValueError(f"{name}: viewmats shape {tuple(viewmats.shape)} != expected shape (C, 4, 4)")
    if not len(viewmats):
        raise ValueError(f"{name}: viewmats has no camera; at least one must be given")
    if sh.ndim not in (3, means.ndim + 1) or sh.shape[-2] not in (1, 4, 9, 16):
        raise ValueError(f"{name}: sh shape {tuple(sh.shape)} != expected shape {(*means.shape[:-1], '1|4|9|16', 3)}")
    if covars is None and (quats is None or scales is None):
        raise ValueError(f"{name}: either covars or both quats and scales must be given")
    if covars is not None and (quats is not None or scales is not None):
        raise ValueError(f"{name}: covars replaces quats and scales; pass None for those")
    if width < 1 or height < 1:
        raise ValueError(f"{name}: image size must be positive, got width {width} and height {height}")
    if not (near >= 0 and eps2d >= 0):
        raise ValueError(f"{name}: near and eps2d must not be negative, got near {near} and eps2d {eps2d}")
    n, c = means.shape[-2], len(viewmats)
    own = (c,) if means.ndim == 3 else ()
    if own and covars is None:
        raise ValueError(f"{name}: means of each camera need covars of each camera, {(c, n, 3, 3)}")
    expected = {
        "means": (means, (*own, n, 3)),
        "quats": (quats, (n, 4)),
        "scales": (scales, (n, 3)),
        "covars": (covars, (*own, n, 3, 3)),
        "opacities": (opacities, (n,)),
        "sh": (sh, (*own[: sh.ndim - 3], n, sh.shape[-2], 3)),
        "extras": (extras, (c, n, EXTRAS)),
        "Ks": (Ks, (c, 3, 3)),
        "background": (background, (3,)),
        "masks": (masks, (c, height, width)),
        "absgrad": (absgrad, (c, n, 2)),
    }
    for argument, (tensor, shape) in expected.items():
        if tensor is not None and tuple(tensor.shape) != shape:
            raise ValueError(f"{name}: {argument} shape {tuple(tensor.shape)} != expected shape {shape}")


def median_depths(owners: Tensor, means: Tensor, viewmats: Tensor) -> Tensor:
    """Return depths z [C, H, W] (m, in the camera) of the splats c·N + n that own the pixels [C, H, W]; 0 for owner −1, none.

    Gradients flow to means [N, 3] or [C, N, 3] and to viewmats [C, 4, 4].
    """
    if not means.shape[-2]:
        return means.new_zeros(owners.shape)
    # Nobody is drawn at a mean that is not finite, but zero times such a mean would spoil the cameras' gradients.
    axes, means = viewmats[:, None, 2], means.nan_to_num(0, 0, 0)
    z = (axes[..., :3] * means).sum(-1) + axes[..., 3]  # [C, N]
    z = z.flatten().gather(0, owners.clamp_min(0).flatten().long()).view(owners.shape)
    return torch.where(owners >= 0, z, 0)


# ---------------------------------------------------------------- gradients

# Tensors made in inference mode could not be saved for a backward pass later.


@functools.cache
@torch.inference_mode(False)
def black(device: torch.device) -> Tensor:
    """A background, made once a device."""
    return torch.zeros(3, dtype=torch.float32, device=device)


def _tile_mask(masks: Tensor | None, settings: Settings, device: torch.device) -> Tensor | None:
    """Return whether any pixel of each tile matters, uint8 [C · tiles]; None if all do."""
    if masks is None:
        return None
    s = settings
    padding = (0, s.tiles_x * TILE - s.width, 0, s.tiles_y * TILE - s.height)
    padded = torch.nn.functional.pad(masks.to(device, torch.bool).view(torch.uint8), padding)
    return padded.reshape(len(masks), s.tiles_y, TILE, s.tiles_x, TILE).amax((2, 4)).flatten()


class _Rasterize(torch.autograd.Function):
    """Draws a scene, whose tensors are float32, contiguous, and on one device; absgrad is there for its gradient alone."""

    @staticmethod
    def forward(ctx: Any, settings: Settings, masks: Tensor | None, absgrad: Tensor | None, *tensors: Tensor | None):
        scene = Scene._make(tensors)
        ctx.backend, ctx.settings = backend_for(scene.means.device), settings
        tile_mask = _tile_mask(masks, settings, scene.means.device)
        images, radii, owners, ctx.state = ctx.backend.forward(scene, tile_mask, settings)
        ctx.save_for_backward(*scene, *images)
        ctx.mark_non_differentiable(radii, owners)
        return *images, radii, owners

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *v_outputs: Tensor):
        scene, images = Scene(*ctx.saved_tensors[:-5]), ctx.saved_tensors[-5:]
        v_images = [v.float().contiguous() for v in v_outputs[:5]]
        wants_image, wants_pose, wants_background = (ctx.needs_input_grad[i] for i in (2, 10, 12))
        v = Gradients.empty(scene, wants_pose, wants_image)
        ctx.backend.backward(scene, ctx.state, ctx.settings, images, v_images, v)
        v_viewmats = v_background = None
        if v.camera_shares is not None:
            v_viewmats = _repeatable_sum(v.camera_shares, 1)
        if wants_background:
            v_background = _repeatable_sum((v_images[0] * (1 - images[2])[..., None]).view(-1, 3), 0)
        return None, None, v.image, *v[:7], v_viewmats, None, v_background


def _repeatable_sum(x: Tensor, dim: int) -> Tensor:
    """Return the sum over a dimension; on a CPU it does not depend on the number of torch's threads.

    Numpy adds one number after the other, which float32 is too coarse for.
    """
    return torch.from_numpy(x.numpy().sum(dim, dtype=np.float64)).to(x.dtype) if x.device.type == "cpu" else x.sum(dim)
