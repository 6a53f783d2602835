"""The same numbers on a GPU as on the CPU. Skipped where there is none."""

import numpy as np
import pytest
import torch

from endo_sim_ros.cameras import Camera
from endo_sim_ros.gaussians import GaussianModel
from endo_sim_ros.physics import PhysicsConfig, Skinning, TissueSimulation
from endo_sim_ros.reconstruction import ReconstructionConfig, Trainer
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence
from endo_sim_ros.splatting import rasterize, render

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")

CAMERA = Camera(np.array([[300.0, 0, 160], [0, 300, 128], [0, 0, 1]]), 320, 256)
TIP = np.array([0.0, 0.0, 0.12])


def sheet(count: int = 20_000) -> GaussianModel:
    """A curved sheet of random Gaussians 12 cm in front of the camera."""
    g = torch.Generator().manual_seed(0)
    xy = torch.rand(count, 2, generator=g) * torch.tensor([0.14, 0.11]) - torch.tensor([0.07, 0.055])
    points = torch.cat([xy, 0.12 + 0.5 * (xy**2).sum(1, keepdim=True)], 1)
    model = GaussianModel.from_points(points, torch.rand(count, 3, generator=g), torch.full((count,), 8e-4))
    quats = torch.randn(count, 4, generator=g)
    scales = model.log_scales + 0.5 * torch.randn(count, 3, generator=g)
    return GaussianModel(points, quats, scales, torch.randn(count, generator=g), model.sh)


def test_rasteriser_images_and_gradients_agree():
    results = {}
    for device in ("cpu", "cuda"):
        model = sheet().to(device)
        inputs = [model.means, model.quats, model.scales, model.opacities, model.sh]
        inputs = [tensor.detach().clone().requires_grad_() for tensor in inputs]
        viewmats = torch.eye(4, device=device)[None].requires_grad_()
        K = torch.as_tensor(CAMERA.K, dtype=torch.float32, device=device)[None]
        output = rasterize(*inputs, viewmats, K, CAMERA.width, CAMERA.height)
        g = torch.Generator().manual_seed(1)
        loss = sum((image * torch.randn(image.shape, generator=g).to(device)).sum() for image in output[:4])
        loss.backward()
        results[device] = [image.detach().cpu() for image in output[:4]] + [t.grad.cpu() for t in (*inputs, viewmats)]
    for index, (cpu, cuda) in enumerate(zip(results["cpu"], results["cuda"])):
        scale = float(cpu.abs().max())
        assert scale > 0 and cuda.isfinite().all()
        # A pixel on the threshold of a faint splat may fall to either side: bounded, and rare.
        error = (cpu - cuda).abs() / scale
        assert float(error.max()) < 2e-2 and float(error.flatten().quantile(0.999) if error.numel() < 1e7 else 0) < 1e-4, index


def test_physics_agrees_step_for_step():
    states = {}
    for device in ("cpu", "cuda"):
        simulation = TissueSimulation(sheet(), np.zeros(3), PhysicsConfig(device=device, node_count=2000))
        assert simulation.set_wrench("PSM1", TIP, [0.3, 0.0, -1.0])
        for _ in range(10):
            simulation.step()
        assert simulation.faults == 0
        states[device] = simulation.state()
    np.testing.assert_array_equal(states["cpu"].rest, states["cuda"].rest)
    moved = np.abs(states["cpu"].positions - states["cpu"].rest).max()
    assert moved > 2e-3
    np.testing.assert_allclose(states["cuda"].positions, states["cpu"].positions, atol=1e-3 * moved)
    np.testing.assert_allclose(states["cuda"].F, states["cpu"].F, atol=2e-3)


def test_grasp_agrees():
    moved = {}
    for device in ("cpu", "cuda"):
        simulation = TissueSimulation(sheet(), np.zeros(3), PhysicsConfig(device=device, node_count=1000))
        pose = np.eye(4)
        pose[:3, 3] = TIP
        assert simulation.set_grasp("PSM1", pose, True)
        pose[2, 3] -= 0.005
        simulation.set_grasp("PSM1", pose, True)
        for _ in range(5):
            simulation.step()
        moved[device] = simulation.state().positions, simulation.reaction("PSM1")[0]
    np.testing.assert_allclose(moved["cuda"][0], moved["cpu"][0], atol=1e-5)
    np.testing.assert_allclose(moved["cuda"][1], moved["cpu"][1], rtol=0.02, atol=1e-3)


def test_skinning_agrees():
    model, rng = sheet(), np.random.default_rng(0)
    rest = model.means[::10].numpy()
    positions = (rest + rng.normal(0, 1e-3, rest.shape)).astype(np.float32)
    F = (np.eye(3) + rng.normal(0, 0.1, (len(rest), 3, 3))).astype(np.float32)
    for weighting in ("compact", "softmax"):
        (m1, c1), (m2, c2) = (Skinning(model, rest, weighting=weighting, device=d).deform(positions, F) for d in ("cpu", "cuda"))
        torch.testing.assert_close(m2.cpu(), m1, atol=1e-6, rtol=1e-5)
        torch.testing.assert_close(c2.cpu(), c1, atol=1e-9, rtol=1e-3)


def test_training_reaches_the_same_quality():
    frames = list(phantom_sequence(PhantomConfig(frames=5, width=160, height=128, travel=0.01)))
    quality = {}
    for device in ("cpu", "cuda"):
        config = ReconstructionConfig(iterations=150, max_gaussians=8000, image_width=160, device=device)
        model = Trainer(frames[::2], config).run()
        image = render(model, frames[1].camera).colors[0].detach().cpu()
        quality[device] = float(-10 * torch.log10(((image - torch.from_numpy(frames[1].image) / 255) ** 2).mean()))
    assert quality["cpu"] > 20
    assert abs(quality["cpu"] - quality["cuda"]) < 0.7
