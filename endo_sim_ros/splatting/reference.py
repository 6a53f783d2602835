"""What `rasterize` computes, in plain torch, as its formulas are written: every Gaussian at every pixel."""

from typing import Any

import torch
from torch import Tensor

from endo_sim_ros.core.gaussians import rotation_matrices
from endo_sim_ros.splatting.api import RenderOutput, check_inputs, median_depths
from endo_sim_ros.splatting.constants import ALPHA_MAX, ALPHA_MIN, EXTRAS, LOG_ALPHA_SLACK, MEDIAN, TRANSMITTANCE_MIN
from endo_sim_ros.splatting.scene import Scene, Settings


def rasterize_in_torch(
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
    background: Tensor | None = None,
    masks: Tensor | None = None,
    absgrad: Tensor | None = None,
    signed: bool = False,
    median: bool = False,
    near: float = 1e-3,
    eps2d: float = 0.3,
) -> RenderOutput:
    """Return what `rasterize` returns, in plain torch and in the dtype of means, for small scenes.

    Arguments and errors are those of `rasterize`; masks are checked, but nothing is skipped.
    """
    background = means.new_zeros(3) if background is None else background
    own = means.new_zeros(len(viewmats), means.shape[-2], EXTRAS) if extras is None else extras.expand(len(viewmats), *extras.shape[-2:])
    scene = Scene(means, quats, scales, covars, opacities, sh, own, viewmats, Ks, background)
    settings = Settings(width, height, near, eps2d, median, signed)
    check_inputs("rasterize_in_torch", scene, settings, masks, absgrad)
    if covars is None:
        assert quats is not None and scales is not None  # else the check has refused
        rotations = rotation_matrices(quats)
        covars = rotations @ torch.diag_embed(scales**2) @ rotations.mT
    covars = (covars + covars.mT) / 2
    count = means.shape[-2]
    if absgrad is None:
        absgrad = means.new_zeros(len(viewmats), count, 2)
    cameras = [_render_camera(scene, settings, index, covars, absgrad[index]) for index in range(len(viewmats))]
    *images, carried, radii, owners = (torch.stack(images) for images in zip(*cameras))
    first = count * torch.arange(len(viewmats), device=means.device)[:, None, None]
    owners = torch.where(owners >= 0, owners + first, -1)
    medians = median_depths(owners, means, viewmats) if median else None
    return RenderOutput(*images, radii=radii, medians=medians, extras=None if extras is None else carried)


def sh_basis(directions: Tensor, count: int) -> Tensor:
    """Return the first 1, 4, 9 or 16 real spherical harmonics [N, count] in unit directions [N, 3], ordered and signed as in 3DGS files."""
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
    """Returns the first argument [N, H, W]; the gradient of the second [N] is the sum of its gradient's absolute values."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, probe: Tensor) -> Tensor:
        return x.clone()

    @staticmethod
    def backward(ctx: Any, v: Tensor) -> tuple[Tensor, Tensor]:
        return v, v.abs().sum((1, 2))


def _render_camera(scene: Scene, settings: Settings, camera: int, covars: Tensor, absgrad: Tensor) -> tuple[Tensor, ...]:
    """Return images of one camera, radii [N] and, per pixel, the Gaussian at the median depth or −1 [H, W]."""
    means, opacities, sh, viewmat, K = scene.means, scene.opacities, scene.sh, scene.viewmats[camera], scene.Ks[camera]
    if means.ndim == 3:
        means, covars = means[camera], covars[camera]
    if sh.ndim == 4:
        sh = sh[camera]
    assert scene.extras is not None  # zeros if nothing else
    width, height, near, eps2d, *_ = settings
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    points = means @ rotation.T + translation
    drawn = (points[:, 2] >= near) & (opacities >= ALPHA_MIN)
    radii = torch.zeros(len(means), dtype=torch.int32, device=means.device)

    # The Gaussians that are drawn, front to back.
    index = drawn.nonzero()[:, 0]
    index = index[points[index, 2].argsort(stable=True)]
    points, covars, opacities, sh = points[index], covars[index], opacities[index], sh[index]
    extras = scene.extras[camera, index]
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
    if settings.signed:
        probe = (absgrad - absgrad.detach())[index]
        center_x, center_y, absgrad = center_x + probe[:, 0], center_y + probe[:, 1], absgrad.detach()

    level = 2 * ((255 * opacities).log() + LOG_ALPHA_SLACK)
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
        torch.einsum("nhw,nc->hwc", weights, colors) + (1 - alphas)[..., None] * scene.background,
        (weights * z).sum(0),
        alphas,
        (2 * weights * (z * before_weight - before_depth)).sum(0),
        torch.einsum("nhw,nc->chw", weights, extras),
    )
    crosses = (before > MEDIAN) & (after <= MEDIAN)  # once, as transmittance only falls
    owners = torch.where(crosses, index[:, None, None] + 1, 0).sum(0) - 1
    return *images, radii, owners
