"""Random scenes, and the comparison with the reference."""

import numpy as np
import pytest
import torch

from endo_sim_ros.core.cameras import look_at
from endo_sim_ros.core.gaussians import rotation_matrices
from endo_sim_ros.splatting import RenderOutput, rasterize, rasterize_in_torch

DEVICES = ["cpu", *([pytest.param("cuda", marks=pytest.mark.gpu)] if torch.cuda.is_available() else [])]
WIDTH, HEIGHT = 70, 45  # no multiple of the tile
BACKGROUND = torch.tensor([0.2, 0.4, 0.1], dtype=torch.float64)


def make_gaussians(count=60, sh_count=1, seed=0):
    """Random means, quats, scales, opacities and sh in float64; some lie behind the cameras, some outside the image."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    means = normal(count, 3) * torch.tensor([0.04, 0.04, 0.05]) + torch.tensor([0.0, 0.0, 0.12])
    opacities = torch.rand(count, generator=generator, dtype=torch.float64)
    scales = (0.5 * normal(count, 3)).exp() * 0.006
    return [means, normal(count, 4), scales, opacities, 0.3 * normal(count, sh_count, 3)]


def make_cameras(count=2, width=WIDTH, height=HEIGHT):
    """View matrices and intrinsics in float64, around a point 12 cm in front of the origin."""
    target = np.array([0.0, 0.0, 0.12])
    poses = [look_at(np.array([0.03 * i, 0.01 * i, -0.02 * i]), target) for i in range(count)]
    viewmats = torch.stack([torch.from_numpy(np.linalg.inv(pose)) for pose in poses])
    K = torch.tensor([[0.8 * width, 0, 0.45 * width], [0, 0.75 * width, 0.55 * height], [0, 0, 1]], dtype=torch.float64)
    return viewmats, K.repeat(count, 1, 1)


def random_like(images, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(image.shape, generator=generator, dtype=torch.float64) for image in images]


def covariances(quats, scales):
    """World covariances [N, 3, 3]."""
    rotations = rotation_matrices(quats)
    return rotations @ torch.diag_embed(scales**2) @ rotations.mT


def run(function, gaussians, cameras, size=(WIDTH, HEIGHT), device="cpu", dtype=torch.float64, cotangents=None, **options):
    """The output of a rasteriser and the gradients of gaussians, view matrices and background for random cotangents."""
    viewmats, Ks = cameras
    leaves = [x.detach().to(device, dtype).requires_grad_() for x in (*gaussians, viewmats, BACKGROUND)]
    *gaussians, viewmats, background = leaves
    if len(gaussians) == 4:  # means, covars, opacities, sh
        options["covars"] = gaussians[1]
        gaussians = [gaussians[0], None, None, *gaussians[2:]]
    output = function(*gaussians, viewmats, Ks.to(device, dtype), *size, background=background, **options)
    cotangents = random_like(output[:4]) if cotangents is None else cotangents
    torch.autograd.backward(output[:4], [x.to(device, dtype) for x in cotangents])
    return output, [leaf.grad for leaf in leaves]


def assert_close(name, actual, expected, tolerance):
    """Both finite, and equal within a tolerance relative to the largest expected value."""
    actual, expected = actual.detach().cpu().double(), expected.detach().double()
    assert actual.isfinite().all() and expected.isfinite().all(), f"{name} is not finite"
    error = float((actual - expected).abs().max() / expected.abs().max())
    assert error < tolerance, f"{name}: relative error {error:.1e}"


GAUSSIAN_NAMES = ["means", "quats", "scales", "opacities", "sh", "viewmats", "background"]
IMAGE_TOLERANCE = 1e-5
GRADIENT_TOLERANCES = {"means": 5e-5, "quats": 5e-5, "scales": 5e-5, "covars": 5e-5, "opacities": 5e-5} | {
    name: 1e-4 for name in ("sh", "viewmats", "background")
}


def assert_matches_reference(gaussians, cameras, device="cpu", names=GAUSSIAN_NAMES, **options):
    expected, expected_gradients = run(rasterize_in_torch, gaussians, cameras, **options)
    output, gradients = run(rasterize, gaussians, cameras, device=device, dtype=torch.float32, **options)
    for name, actual, image in zip(RenderOutput._fields, output, expected):
        if name not in ("radii", "medians", "extras"):
            assert image.abs().max() > 0, f"{name} is empty, nothing is tested"
            assert_close(name, actual, image, IMAGE_TOLERANCE)
    assert torch.equal(output.radii.cpu() > 0, expected.radii > 0)
    assert (output.radii.cpu() - expected.radii).abs().max() <= 1
    for name, actual, gradient in zip(names, gradients, expected_gradients):
        assert gradient.abs().max() > 1e-6, f"the gradient of {name} vanishes, nothing is tested"
        assert_close(f"gradient of {name}", actual, gradient, GRADIENT_TOLERANCES[name])
