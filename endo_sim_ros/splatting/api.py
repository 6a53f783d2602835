"""Differentiable rasterisation of 3D Gaussians into colour, depth, alpha and distortion.

`rasterize` runs Warp kernels, on the CPU or a CUDA device; `_rasterize` is what it computes, in plain torch.
"""

import contextlib
import contextvars
import functools
import types
from typing import NamedTuple

import numpy as np
import torch
import warp as wp
from torch import Tensor

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import init_warp
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.splatting import cpu, cuda
from endo_sim_ros.splatting.backend import Scene, Settings
from endo_sim_ros.splatting.common_kernels import TILE

ALPHA_MIN = 1 / 255  # fainter contributions are skipped
ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4  # a pixel is finished before its transmittance drops below this
MEDIAN = 0.5  # transmittance at the median depth


class RenderOutput(NamedTuple):
    """Images of C cameras."""

    colors: Tensor  # [C, H, W, 3] Σ w_i c_i, linear, plus background
    depths: Tensor  # [C, H, W] Σ w_i z_i, metres, not divided by alpha
    alphas: Tensor  # [C, H, W] Σ w_i
    distortions: Tensor  # [C, H, W] Σ_ij w_i w_j |z_i − z_j|, metres
    radii: Tensor  # [C, N] int32, half size of the footprint's bounding box, pixels; 0 = not in the image; no gradient
    medians: Tensor | None = None  # [C, H, W] z where half of the light is blocked, metres; 0 = never; None = not asked for

    @property
    def expected_depths(self) -> Tensor:
        """Mean depth of what is seen, Σ w_i z_i / Σ w_i [C, H, W], metres; 0 where nothing is drawn."""
        return self.depths / self.alphas.clamp_min(ALPHA_MIN / 2)  # alpha is 0 or at least ALPHA_MIN


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
    background: Tensor | None = None,
    masks: Tensor | None = None,
    absgrad: Tensor | None = None,
    median: bool = False,
    near: float = 1e-3,
    eps2d: float = 0.3,
) -> RenderOutput:
    """Render Gaussians by EWA splatting (Kerbl et al. 2023, eq. 2, 3 and 5), float32.

    Gradients flow to means, quats, scales, covars, opacities, sh, viewmats and background, not to Ks.
    On the CPU results repeat bit for bit whatever the number of threads; on CUDA gradients are summed with atomics.

    Args:
        means: Centres [N, 3], metres, world. Or of each camera its own [C, N, 3], e.g. of as many copies of tissue; then
            covars [C, N, 3, 3] must be, too, sh [C, N, K, 3] may be, and there are no gradients.
        quats: Rotations wxyz [N, 4], not necessarily normalised; zero means no rotation. None when covars is given.
        scales: Standard deviations along the rotated axes [N, 3], metres. None when covars is given.
        opacities: Opacities in [0, 1] [N].
        sh: Spherical harmonic coefficients [N, K, 3], K = 1, 4, 9 or 16; colour = max(Σ_k Y_k sh_k + 0.5, 0).
        viewmats: World-to-camera transforms [C, 4, 4], rigid, metres, optical frames.
        Ks: Intrinsics [C, 3, 3], pixels, without skew; pixel (0, 0) has its centre at (0.5, 0.5).
        width: Image width, pixels.
        height: Image height, pixels.
        covars: World covariances [N, 3, 3], m², used instead of quats and scales, e.g. of deformed Gaussians.
        background: Colour behind everything [3]; black by default.
        masks: True where the image matters [C, H, W]. Tiles of 16×16 pixels without any True show background only.
        absgrad: Receives the statistics of AbsGS densification: its values are not used, its gradient is
            Σ_pixels |∂L/∂mean2d| per image coordinate [C, N, 2], 1/pixel (Ye et al. 2024). Costs time only where it
            requires a gradient.
        median: Whether to compute median depths. Their gradient is that of the depth of the Gaussian at the median.
        near: Gaussians nearer than this are not drawn, metres.
        eps2d: Added to the variances in the image, pixel²: no splat is thinner than about a pixel.

    Returns:
        The images, see :class:`RenderOutput`.

    Raises:
        ValueError: If shapes disagree, there is no camera, near or eps2d is negative, or a mean is not finite (this on
            the CPU only: on CUDA that test would stall the device). Any other Gaussian whose projection is not finite
            is not drawn and gets zero gradients.
    """
    options = {"covars": covars, "background": background, "masks": masks, "absgrad": absgrad}
    _check_inputs("rasterize", means, quats, scales, opacities, sh, viewmats, Ks, width, height, near, eps2d, **options)
    if means.device.type == "cpu" and not means.isfinite().all():
        index = tuple((~means.detach().isfinite()).any(-1).nonzero()[0].tolist())
        raise ValueError(f"rasterize: means[{', '.join(map(str, index))}] is not finite: {means[index].tolist()}")
    differentiable = (means, covars, opacities, sh, viewmats, background, absgrad)
    if means.ndim == 3 and torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in differentiable):
        raise ValueError("rasterize: means of each camera have no gradients; call it under torch.no_grad()")
    settings = Settings(int(width), int(height), float(near), float(eps2d), bool(median))
    if background is None:
        background = _black(means.device)
    arguments = [means, quats, scales, covars, opacities, sh, viewmats, background, absgrad]
    arguments = [None if x is None else x.to(means.device, torch.float32).contiguous() for x in arguments]
    Ks = Ks.to(means.device, torch.float32).contiguous()
    *images, owners = _Rasterize.apply(settings, masks, Ks, *arguments)
    return RenderOutput(*images, _depths_of(owners, arguments[0], arguments[6]) if median else None)


def render(
    model: GaussianModel,
    camera: Camera,
    *,
    covars: Tensor | None = None,
    background: Tensor | None = None,
    mask: Tensor | None = None,
    median: bool = False,
    near: float = 1e-3,
    eps2d: float = 0.3,
) -> RenderOutput:
    """Render a Gaussian model with one camera: `rasterize` with C = 1.

    Args:
        model: The Gaussians; the images are computed on their device.
        camera: The camera.
        covars: World covariances [N, 3, 3], m², instead of the model's own.
        background: Colour behind everything [3]; black by default.
        mask: True where the image matters [H, W]; whole tiles without any True are skipped.
        median: Whether to compute median depths.
        near: Nearest distance drawn, metres.
        eps2d: Added to the variances in the image, pixel².
    """
    viewmat = torch.tensor(camera.viewmat, dtype=torch.float32, device=model.means.device)
    K = torch.tensor(camera.K, dtype=torch.float32, device=model.means.device)
    return rasterize(
        model.means,
        None if covars is not None else model.quats,
        None if covars is not None else model.scales,
        model.opacities,
        model.sh,
        viewmat[None],
        K[None],
        camera.width,
        camera.height,
        covars=covars,
        background=background,
        masks=None if mask is None else mask[None],
        median=median,
        near=near,
        eps2d=eps2d,
    )


def _check_inputs(
    name, means, quats, scales, opacities, sh, viewmats, Ks, width, height, near, eps2d, *, covars, background, masks, absgrad
) -> None:
    """Raise ValueError, naming the argument and both shapes, unless all shapes agree and numbers make sense."""
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
        "Ks": (Ks, (c, 3, 3)),
        "background": (background, (3,)),
        "masks": (masks, (c, height, width)),
        "absgrad": (absgrad, (c, n, 2)),
    }
    for argument, (tensor, shape) in expected.items():
        if tensor is not None and tuple(tensor.shape) != shape:
            raise ValueError(f"{name}: {argument} shape {tuple(tensor.shape)} != expected shape {shape}")


def _depths_of(owners: Tensor, means: Tensor, viewmats: Tensor) -> Tensor:
    """Depth z [C, H, W] in its camera of the splat c·N + n named at each pixel; 0 for none, −1; differentiable."""
    if not means.shape[-2]:
        return means.new_zeros(owners.shape)
    # Nobody is drawn at a mean that is not finite, but zero times such a mean would spoil the cameras' gradients.
    axes, means = viewmats[:, None, 2], means.nan_to_num(0, 0, 0)
    z = (axes[..., :3] * means).sum(-1) + axes[..., 3]  # [C, N]
    z = z.flatten().gather(0, owners.clamp_min(0).flatten().long()).view(owners.shape)
    return torch.where(owners >= 0, z, 0)


# ---------------------------------------------------------------- running the kernels

_scalar = contextvars.ContextVar("scalar", default=False)


@contextlib.contextmanager
def scalar_kernels():
    """Within it, `rasterize` runs the kernels made for GPUs on the CPU too, in one thread, pixel by pixel: to compare with."""
    token = _scalar.set(True)
    try:
        yield
    finally:
        _scalar.reset(token)


def _way(device: torch.device) -> types.ModuleType:
    """The module with the functions `forward` and `backward` for a device."""
    way = cpu if device.type == "cpu" and not _scalar.get() else cuda
    _load_kernels(way, str(device))
    return way


@functools.cache
def _load_kernels(way: types.ModuleType, device: str) -> None:
    """Compile the kernels before several threads ask for them."""
    init_warp()
    for module in way.MODULES:
        wp.load_module(module, device)


# Tensors made in inference mode could not be saved for a backward pass later.


@functools.cache
@torch.inference_mode(False)
def _black(device: torch.device) -> Tensor:
    return torch.zeros(3, dtype=torch.float32, device=device)


@functools.cache
@torch.inference_mode(False)
def _all_tiles(count: int, device: torch.device) -> Tensor:
    return torch.ones(count, dtype=torch.uint8, device=device)


def _tile_mask(masks: Tensor | None, settings: Settings, camera_count: int, device: torch.device) -> Tensor:
    """Whether any pixel of each tile matters, uint8 [C · tiles]."""
    s = settings
    if masks is None:
        return _all_tiles(camera_count * s.tiles_x * s.tiles_y, device)
    padding = (0, s.tiles_x * TILE - s.width, 0, s.tiles_y * TILE - s.height)
    padded = torch.nn.functional.pad(masks.to(device, torch.bool).view(torch.uint8), padding)
    return padded.reshape(camera_count, s.tiles_y, TILE, s.tiles_x, TILE).amax((2, 4)).flatten()


class _Rasterize(torch.autograd.Function):
    """Takes settings, masks and Ks, then the differentiable tensors; float32, contiguous, on one device."""

    @staticmethod
    def forward(ctx, settings, masks, Ks, means, quats, scales, covars, opacities, sh, viewmats, background, absgrad):
        device = means.device
        scene = Scene(means, quats, scales, covars, opacities, sh, viewmats, Ks, background)
        ctx.way, ctx.settings = _way(device), settings
        tile_mask = _tile_mask(masks, settings, len(viewmats), device)
        images, radii, owners, ctx.state = ctx.way.forward(scene, tile_mask, settings)
        ctx.save_for_backward(*scene, *images)
        ctx.mark_non_differentiable(radii, owners)
        return *images, radii, owners

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *v_outputs):
        scene, images = Scene(*ctx.saved_tensors[:-4]), ctx.saved_tensors[-4:]
        v_images = [v.float().contiguous() for v in v_outputs[:4]]
        wants_pose, wants_background, wants_absolute = ctx.needs_input_grad[9:12]
        v = ctx.way.backward(scene, ctx.state, ctx.settings, images, v_images, wants_pose, wants_absolute)
        v_viewmats = v_background = None
        if wants_pose:
            v_viewmats = _repeatable_sum(v.camera_shares, 1)
        if wants_background:
            v_background = _repeatable_sum((v_images[0] * (1 - images[2])[..., None]).view(-1, 3), 0)
        return None, None, None, *v[:6], v_viewmats, v_background, v.absolutes


def _repeatable_sum(x: Tensor, dim: int) -> Tensor:
    """Sum that does not depend on the number of torch threads; numpy adds one by one, which float32 is too coarse for."""
    return torch.from_numpy(x.numpy().sum(dim, dtype=np.float64)).to(x.dtype) if x.device.type == "cpu" else x.sum(dim)


# ---------------------------------------------------------------- reference


def _rasterize(
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
    background: Tensor | None = None,
    masks: Tensor | None = None,
    absgrad: Tensor | None = None,
    median: bool = False,
    near: float = 1e-3,
    eps2d: float = 0.3,
) -> RenderOutput:
    """What `rasterize` computes, in plain torch in the dtype of means: every Gaussian at every pixel, for small scenes.

    Same arguments, errors and result as `rasterize`; masks are checked, but nothing is skipped.
    """
    options = {"covars": covars, "background": background, "masks": masks, "absgrad": absgrad}
    _check_inputs("_rasterize", means, quats, scales, opacities, sh, viewmats, Ks, width, height, near, eps2d, **options)
    if covars is None:
        rotations = _quat_to_matrix(quats)
        covars = rotations @ torch.diag_embed(scales**2) @ rotations.mT
    covars = (covars + covars.mT) / 2
    if background is None:
        background = means.new_zeros(3)
    count = means.shape[-2]
    if absgrad is None:
        absgrad = means.new_zeros(len(viewmats), count, 2)
    shared = means.ndim == 2
    cameras = [
        _render_reference(
            *((means, covars) if shared else (means[c], covars[c])), opacities, sh if sh.ndim == 3 else sh[c],
            viewmat, K, width, height, background, absgrad[c], near, eps2d,
        )
        for c, (viewmat, K) in enumerate(zip(viewmats, Ks))
    ]  # fmt: skip
    *images, owners = (torch.stack(images) for images in zip(*cameras))
    first = count * torch.arange(len(viewmats), device=means.device)[:, None, None]
    owners = torch.where(owners >= 0, owners + first, -1)
    return RenderOutput(*images, _depths_of(owners, means, viewmats) if median else None)


def _quat_to_matrix(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions wxyz [N, 4]; zero means no rotation."""
    norms = quats.norm(dim=1, keepdim=True)
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0]).expand_as(quats)
    zero = norms < 1e-12
    w, x, y, z = torch.where(zero, identity, quats / norms.where(~zero, 1)).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def sh_basis(directions: Tensor, count: int) -> Tensor:
    """The first 1, 4, 9 or 16 real spherical harmonics [N, count] in unit directions [N, 3], as in 3DGS files."""
    x, y, z = directions.unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    basis = [
        torch.full_like(x, 0.28209479177387814),
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return torch.stack(basis[:count], 1)


class _SumOfAbsolutes(torch.autograd.Function):
    """The first argument [N, H, W]; the gradient of the second [N] is the sum of its gradient's absolute values."""

    @staticmethod
    def forward(ctx, x, probe):
        return x.clone()

    @staticmethod
    def backward(ctx, v):
        return v, v.abs().sum((1, 2))


def _render_reference(means, covars, opacities, sh, viewmat, K, width, height, background, absgrad, near, eps2d):
    """One camera of `_rasterize`: its images, radii and, per pixel, the Gaussian at the median depth or −1."""
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    points = means @ rotation.T + translation
    drawn = (points[:, 2] >= near) & (opacities >= ALPHA_MIN)
    radii = torch.zeros(len(means), dtype=torch.int32, device=means.device)

    # The Gaussians that are drawn, front to back.
    index = drawn.nonzero()[:, 0]
    index = index[points[index, 2].argsort(stable=True)]
    points, covars, opacities, sh = points[index], covars[index], opacities[index], sh[index]
    x, y, z = points.unbind(1)
    slope_x = (x / z).clamp(-cx / fx - 0.15 * width / fx, (width - cx) / fx + 0.15 * width / fx)
    slope_y = (y / z).clamp(-cy / fy - 0.15 * height / fy, (height - cy) / fy + 0.15 * height / fy)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * slope_x / z, zero, fy / z, -fy * slope_y / z], 1).view(-1, 2, 3)
    to_image = jacobian @ rotation
    cov = to_image @ covars @ to_image.mT + eps2d * torch.eye(2, dtype=means.dtype, device=means.device)
    xx, xy, yy = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    det = xx * yy - xy * xy
    center_x, center_y = fx * x / z + cx, fy * y / z + cy

    level = 2 * ((255 * opacities).log() + 0.01)
    extent_x, extent_y = (level * xx).sqrt(), (level * yy).sqrt()
    inside = (center_x + extent_x >= 0) & (center_x - extent_x <= width)
    inside &= (center_y + extent_y >= 0) & (center_y - extent_y <= height)
    radii[index] = torch.where(inside, torch.maximum(extent_x, extent_y).ceil(), 0).detach().to(torch.int32)

    directions = torch.nn.functional.normalize(means[index] + translation @ rotation, dim=1)
    colors = ((sh_basis(directions, sh.shape[1])[..., None] * sh).sum(1) + 0.5).clamp_min(0)

    rows = torch.arange(height, dtype=means.dtype, device=means.device) + 0.5
    columns = torch.arange(width, dtype=means.dtype, device=means.device) + 0.5
    shape = (len(index), height, width)
    dx = _SumOfAbsolutes.apply((columns - center_x[:, None])[:, None, :].expand(shape), absgrad[index, 0])
    dy = _SumOfAbsolutes.apply((rows - center_y[:, None])[:, :, None].expand(shape), absgrad[index, 1])
    a, b, c = (x[:, None, None] for x in (yy / det, -xy / det, xx / det))
    sigma = (a * dx**2 + c * dy**2) / 2 + b * dx * dy
    alpha = (opacities[:, None, None] * (-sigma).exp()).clamp_max(ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0)
    after = (1 - alpha).cumprod(0)
    alpha = torch.where(after < TRANSMITTANCE_MIN, 0, alpha)  # a product of factors up to one never rises again
    after = (1 - alpha).cumprod(0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    weights = alpha * before

    z = z[:, None, None]
    before_depth = (weights * z).cumsum(0) - weights * z
    before_weight = weights.cumsum(0) - weights
    alphas = weights.sum(0)
    images = (
        torch.einsum("nhw,nc->hwc", weights, colors) + (1 - alphas)[..., None] * background,
        (weights * z).sum(0),
        alphas,
        (2 * weights * (z * before_weight - before_depth)).sum(0),
    )
    crosses = (before > MEDIAN) & (after <= MEDIAN)  # once, as transmittance only falls
    owners = torch.where(crosses, index[:, None, None] + 1, 0).sum(0) - 1
    return *images, radii, owners
