"""Differentiable rasterisation of 3D Gaussians into colour, depth, alpha and distortion.

`rasterize` runs Warp kernels, on the CPU or a CUDA device; `_rasterize` is what it computes, in plain torch.
"""

import contextlib
import contextvars
import functools
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from endo_sim_ros.cameras import Camera
from endo_sim_ros.device import cpu_threads, init_warp, on_torch_stream, run_in_threads
from endo_sim_ros.gaussians import GaussianModel
from endo_sim_ros.splatting import rasterizer_kernels as kernels
from endo_sim_ros.splatting import rasterizer_simd_kernels as simd_kernels

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
        means: Centres [N, 3], metres, world.
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
        ValueError: If shapes disagree, or a mean is not finite (CPU tensors only: on CUDA that test would stall the
            device). Any other Gaussian whose projection is not finite is not drawn and gets zero gradients.
    """
    options = {"covars": covars, "background": background, "masks": masks, "absgrad": absgrad}
    _check_inputs("rasterize", means, quats, scales, opacities, sh, viewmats, Ks, width, height, **options)
    if means.device.type == "cpu" and not means.isfinite().all():
        index = int((~means.detach().isfinite()).any(1).nonzero()[0])
        raise ValueError(f"rasterize: means[{index}] is not finite: {means[index].tolist()}")
    _load_kernels(str(means.device))
    settings = _Settings(int(width), int(height), float(near), float(eps2d), bool(median), _uses_vectors(means.device))
    if background is None:
        background = _black(means.device)
    arguments = [means, quats, scales, covars, opacities, sh, viewmats, background, absgrad]
    arguments = [None if x is None else x.to(means.device, torch.float32).contiguous() for x in arguments]
    Ks = Ks.to(means.device, torch.float32).contiguous()
    *images, owners = _Rasterize.apply(settings, Ks, masks, *arguments)
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
    name, means, quats, scales, opacities, sh, viewmats, Ks, width, height, *, covars, background, masks, absgrad
) -> None:
    """Raise ValueError, naming the argument and both shapes, unless all shapes agree."""
    if means.ndim != 2 or means.shape[1] != 3:
        raise ValueError(f"{name}: means shape {tuple(means.shape)} != expected shape (N, 3)")
    if viewmats.ndim != 3 or viewmats.shape[1:] != (4, 4):
        raise ValueError(f"{name}: viewmats shape {tuple(viewmats.shape)} != expected shape (C, 4, 4)")
    if sh.ndim != 3 or sh.shape[1] not in (1, 4, 9, 16):
        raise ValueError(f"{name}: sh shape {tuple(sh.shape)} != expected shape ({len(means)}, 1|4|9|16, 3)")
    if covars is None and (quats is None or scales is None):
        raise ValueError(f"{name}: either covars or both quats and scales must be given")
    if covars is not None and (quats is not None or scales is not None):
        raise ValueError(f"{name}: covars replaces quats and scales; pass None for those")
    if width < 1 or height < 1:
        raise ValueError(f"{name}: image size must be positive, got width {width} and height {height}")
    n, c = len(means), len(viewmats)
    expected = {
        "quats": (quats, (n, 4)),
        "scales": (scales, (n, 3)),
        "covars": (covars, (n, 3, 3)),
        "opacities": (opacities, (n,)),
        "sh": (sh, (n, sh.shape[1], 3)),
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
    if not len(means):
        return means.new_zeros(owners.shape)
    # Nobody is drawn at a mean that is not finite, but zero times such a mean would spoil the cameras' gradients.
    axes, means = viewmats[:, None, 2], means.nan_to_num(0, 0, 0)
    z = (axes[..., :3] * means).sum(-1) + axes[..., 3]  # [C, N]
    z = z.flatten().gather(0, owners.clamp_min(0).flatten().long()).view(owners.shape)
    return torch.where(owners >= 0, z, 0)


# ---------------------------------------------------------------- running the kernels


class _Settings(NamedTuple):
    """What `_Rasterize` needs besides tensors."""

    width: int
    height: int
    near: float
    eps2d: float
    median: bool
    vectors: bool  # whether to composite with the kernels made for CPUs, rather than one thread per pixel

    @property
    def tiles_x(self) -> int:
        return -(-self.width // kernels.TILE)

    @property
    def tiles_y(self) -> int:
        return -(-self.height // kernels.TILE)


@functools.cache
def _load_kernels(device: str) -> None:
    """Compile the kernels before several threads ask for them."""
    init_warp()
    for module in (kernels, simd_kernels) if device == "cpu" else (kernels,):
        wp.load_module(module, device)


@functools.cache
def _black(device: torch.device) -> Tensor:
    return torch.zeros(3, device=device)


def _array(tensor: Tensor | None, dtype=None):
    """A tensor as a kernel argument, without copying; None becomes an array that must not be read."""
    if tensor is None:
        return None
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False, return_ctype=True)


def _launch(kernel, count: int, arguments: list, device: torch.device, width: int = 1) -> None:
    """Launch a kernel whose first argument is an offset, over count items of some threads each.

    At once on CUDA, in shares of whole items on the CPU.
    """
    if count == 0:
        return
    if device.type != "cpu":
        wp.launch(kernel, dim=count * width, inputs=[0, *arguments], device=str(device))
        return
    threads = cpu_threads() if count * width >= 1024 else 1
    bounds = [width * (count * i // threads) for i in range(threads + 1)]

    def share(first, end):
        wp.launch(kernel, dim=end - first, inputs=[first, *arguments], device="cpu")

    run_in_threads([functools.partial(share, *pair) for pair in zip(bounds[:-1], bounds[1:])])


def _launch_tiles(kernel, tile_count: int, arguments: list) -> None:
    """Launch a CPU kernel that draws tiles from a counter, its first argument, in all threads."""
    counter = torch.zeros(1, dtype=torch.int32)
    inputs = [_array(counter), *arguments]
    command = wp.launch(kernel, dim=tile_count, inputs=inputs, device="cpu", record_cmd=True)
    run_in_threads([command.launch] * min(cpu_threads(), tile_count))


def _sort_pairs(keys: Tensor, values: Tensor, count: int, bits: int) -> None:
    """Stable sort of the first count keys, from 0 to 2^bits − 1, and their values; both have room for 2·count."""
    wp.utils.radix_sort_pairs(wp.from_torch(keys), wp.from_torch(values), count, 0, bits)


def _tile_mask(masks: Tensor | None, settings: _Settings, camera_count: int, device: torch.device) -> Tensor:
    """Whether any pixel of each tile matters, uint8 [C · tiles]."""
    s = settings
    if masks is None:
        return torch.ones(camera_count * s.tiles_x * s.tiles_y, dtype=torch.uint8, device=device)
    padding = (0, s.tiles_x * kernels.TILE - s.width, 0, s.tiles_y * kernels.TILE - s.height)
    padded = torch.nn.functional.pad(masks.to(device, torch.uint8), padding)
    return padded.reshape(camera_count, s.tiles_y, kernels.TILE, s.tiles_x, kernels.TILE).amax((2, 4)).flatten()


class _Intersections(NamedTuple):
    """Which splat meets which tile; the header of the kernels defines the terms."""

    owners: Tensor  # [I] splat of each intersection
    slots: Tensor  # [I] intersections by tile, then depth
    starts: Tensor  # [tiles + 1] first slot of each tile
    counts: Tensor  # [C·N] intersections of each splat
    firsts: Tensor  # [C·N] first intersection of each splat


def _intersect(splats, depth_keys, counts, tile_mask, gaussian_count, settings) -> _Intersections:
    """List the splats of every tile in depth order."""
    device = splats.device
    splat_count, tile_count = len(counts), len(tile_mask)
    order = torch.empty(2 * splat_count, dtype=torch.int32, device=device)
    torch.arange(splat_count, dtype=torch.int32, device=device, out=order[:splat_count])
    _sort_pairs(depth_keys, order, splat_count, 31)
    order = order[:splat_count]
    ends = counts[order].cumsum(0, dtype=torch.int32)
    count = int(ends[-1]) if splat_count else 0

    firsts = torch.empty_like(counts)
    tiles = torch.empty(2 * count, dtype=torch.int32, device=device)
    slots = torch.empty_like(tiles)
    owners = torch.empty(count, dtype=torch.int32, device=device)
    starts = torch.empty(tile_count + 1, dtype=torch.int32, device=device)
    arguments = [_array(order), _array(ends), _array(counts), gaussian_count, _array(splats), _array(tile_mask)]
    arguments += [settings.tiles_x, settings.tiles_y, _array(firsts), _array(tiles), _array(slots), _array(owners)]
    _launch(kernels.emit_intersections, splat_count if count else 0, arguments, device)
    if count:
        _sort_pairs(tiles, slots, count, (tile_count + 1).bit_length())
    _launch(kernels.find_tile_starts, count + 1, [_array(tiles), count, _array(starts)], device)
    return _Intersections(owners, slots, starts, counts, firsts)


_scalar = contextvars.ContextVar("scalar", default=False)


@contextlib.contextmanager
def scalar_kernels():
    """Within it, `rasterize` runs the kernels made for GPUs on the CPU too, pixel by pixel: to compare with."""
    token = _scalar.set(True)
    try:
        yield
    finally:
        _scalar.reset(token)


def _uses_vectors(device: torch.device) -> bool:
    return device.type == "cpu" and not _scalar.get()


def _composite(intersections, splats, background, settings, tile_count, images, owners) -> None:
    """Fill images (colours, depths, alphas, distortions) and, if wanted, the owners of median depths."""
    arguments = [*_image_arguments(intersections, splats, background, settings, images), int(settings.median), _array(owners)]
    if settings.vectors:
        _launch_tiles(simd_kernels.render_tiles, tile_count, arguments)
    else:
        _launch(kernels.render_pixels, tile_count, arguments, splats.device, kernels.TILE**2)


def _composite_backward(intersections, splats, background, settings, tile_count, images, v_images, absolute) -> Tensor:
    """The gradient records, from the gradients of the images."""
    # One kernel writes every record, the other adds to them.
    size = (len(intersections.owners), kernels.RECORD_SIZE)
    records = (torch.empty if settings.vectors else torch.zeros)(size, device=splats.device)
    arguments = _image_arguments(intersections, splats, background, settings, (*images, *v_images)) + [int(absolute)]
    if settings.vectors:
        _launch_tiles(simd_kernels.render_tiles_backward, tile_count, [*arguments, _array(records.view(-1))])
    else:
        # No two threads of a CPU share a tile, and with it a record.
        _launch(kernels.render_pixels_backward, tile_count, [*arguments, _array(records)], splats.device, kernels.TILE**2)
    return records


def _image_arguments(intersections, splats, background, settings, images) -> list:
    """The arguments with which all compositing kernels begin."""
    lists = [_array(x) for x in (intersections.owners, intersections.slots, intersections.starts)]
    if settings.vectors:
        arrays = [_array(x.view(-1)) for x in images]
        return [_array(splats.view(-1)), *lists, _array(background), settings.width, settings.height, *arrays]
    arrays = [_array(x.view(-1, 3), wp.vec3) if x.ndim == 4 else _array(x.view(-1)) for x in images]
    return [_array(splats), *lists, _array(background[None], wp.vec3), settings.width, settings.height, *arrays]


class _Rasterize(torch.autograd.Function):
    """Takes settings, Ks and masks, then the differentiable tensors; float32, contiguous, on one device."""

    @staticmethod
    def forward(ctx, settings, Ks, masks, means, quats, scales, covars, opacities, sh, viewmats, background, absgrad):
        device, n, camera_count = means.device, len(means), len(viewmats)
        splat_count = camera_count * n
        splats = torch.empty(splat_count, kernels.SPLAT_SIZE, device=device)
        radii = torch.empty(camera_count, n, dtype=torch.int32, device=device)
        counts = torch.empty(splat_count, dtype=torch.int32, device=device)
        depth_keys = torch.empty(2 * splat_count, dtype=torch.int32, device=device)
        size = (camera_count, settings.height, settings.width)
        images = [torch.empty(*size, 3, device=device)] + [torch.empty(size, device=device) for _ in range(3)]
        owners = torch.empty(size if settings.median else 0, dtype=torch.int32, device=device)
        tile_mask = _tile_mask(masks, settings, camera_count, device)
        with on_torch_stream(device):
            arguments = _gaussian_arguments(means, quats, scales, covars) + [_array(opacities)]
            arguments += _camera_arguments(sh, viewmats, Ks, settings) + [settings.near, settings.eps2d]
            outputs = (tile_mask, splats, radii.view(-1), depth_keys, counts)
            _launch(kernels.project, splat_count, arguments + [_array(x) for x in outputs], device)
            intersections = _intersect(splats, depth_keys, counts, tile_mask, n, settings)
            _composite(intersections, splats, background, settings, len(tile_mask), images, owners.view(-1))
        ctx.settings, ctx.intersections, ctx.tile_count = settings, intersections, len(tile_mask)
        ctx.splats, ctx.Ks = splats, Ks
        ctx.save_for_backward(means, quats, scales, covars, opacities, sh, viewmats, background, *images)
        ctx.mark_non_differentiable(radii, owners)
        return *images, radii, owners

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *v_outputs):
        means, quats, scales, covars, opacities, sh, viewmats, background, *images = ctx.saved_tensors
        settings, intersections, device = ctx.settings, ctx.intersections, means.device
        v_images = [v.float().contiguous() for v in v_outputs[:4]]
        wants_pose, wants_background, wants_absolute = ctx.needs_input_grad[9:12]

        v_means, v_opacities, v_sh = (torch.empty_like(x) for x in (means, opacities, sh))
        v_quats, v_scales, v_covars = (None if x is None else torch.empty_like(x) for x in (quats, scales, covars))
        shares = torch.empty(len(viewmats), len(means), 4, 4, device=device) if wants_pose else None
        v_absgrad = torch.empty(len(viewmats), len(means), 2, device=device) if wants_absolute else None
        with on_torch_stream(device):
            lists_and_images = (intersections, ctx.splats, background, settings, ctx.tile_count, images)
            records = _composite_backward(*lists_and_images, v_images, wants_absolute)
            arguments = _gaussian_arguments(means, quats, scales, covars)
            arguments += _camera_arguments(sh, viewmats, ctx.Ks, settings) + [settings.eps2d]
            arguments += [_array(x) for x in (intersections.counts, intersections.firsts, records)]
            arguments += [int(wants_pose), int(wants_absolute)]
            arguments += [_array(v_means, wp.vec3), _array(v_quats, wp.vec4), _array(v_scales, wp.vec3)]
            arguments += [_array(v_covars, wp.mat33), _array(v_opacities), _array(v_sh, wp.vec3)]
            arguments += [_array(shares, wp.mat44), _array(v_absgrad, wp.vec2)]
            _launch(kernels.project_backward, len(means), arguments, device)

        v_viewmats = v_background = None
        if wants_pose:
            v_viewmats = _repeatable_sum(shares, 1)
        if wants_background:
            v_background = _repeatable_sum((v_images[0] * (1 - images[2])[..., None]).view(-1, 3), 0)
        v_gaussians = (v_means, v_quats, v_scales, v_covars, v_opacities, v_sh)
        return None, None, None, *v_gaussians, v_viewmats, v_background, v_absgrad


def _gaussian_arguments(means, quats, scales, covars) -> list:
    """The arguments with which `project` and `project_backward` begin."""
    arrays = [_array(means, wp.vec3), _array(quats, wp.vec4), _array(scales, wp.vec3), _array(covars, wp.mat33)]
    return [*arrays, int(covars is not None)]


def _camera_arguments(sh, viewmats, Ks, settings) -> list:
    """The arguments that both kernels have next: colours and cameras."""
    arrays = [_array(sh, wp.vec3), _array(viewmats, wp.mat44), _array(Ks, wp.mat33)]
    return [*arrays, settings.width, settings.height]


def _repeatable_sum(x: Tensor, dim: int) -> Tensor:
    """Sum that does not depend on the number of torch threads."""
    return torch.from_numpy(x.numpy().sum(dim)) if x.device.type == "cpu" else x.sum(dim)


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
    _check_inputs("_rasterize", means, quats, scales, opacities, sh, viewmats, Ks, width, height, **options)
    if covars is None:
        rotations = _quat_to_matrix(quats)
        covars = rotations @ torch.diag_embed(scales**2) @ rotations.mT
    covars = (covars + covars.mT) / 2
    if background is None:
        background = means.new_zeros(3)
    if absgrad is None:
        absgrad = means.new_zeros(len(viewmats), len(means), 2)
    cameras = [
        _render_reference(means, covars, opacities, sh, viewmat, K, width, height, background, absgrad[c], near, eps2d)
        for c, (viewmat, K) in enumerate(zip(viewmats, Ks))
    ]
    *images, owners = (torch.stack(images) for images in zip(*cameras))
    first = len(means) * torch.arange(len(viewmats), device=means.device)[:, None, None]
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
