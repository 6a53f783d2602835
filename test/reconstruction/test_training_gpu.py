"""Training on a GPU as on the CPU. Skipped where there is none."""

from dataclasses import replace

import pytest
import torch
from trained import trainer_of

from endo_sim_ros.evaluation import metrics
from endo_sim_ros.reconstruction import ReconstructionConfig, Trainer, prepare
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]


def test_the_first_step_has_the_same_loss_and_gradients():
    """Noise of 1e-5 in the Gaussians moves the loss by 2e-4 and gradients by 2 % of their norm; twice the weight of SSIM, by half."""
    frames = list(phantom_sequence(PhantomConfig(frames=5, width=160, height=128, travel=0.01)))[::2]
    config = ReconstructionConfig(max_gaussians=8000, image_width=160, sh_degree=1, device="cpu")
    scene = prepare(frames, config)
    cpu, cuda = (Trainer(scene, replace(config, device=device)) for device in ("cpu", "cuda"))
    cpu.step()
    cuda.step()
    assert cuda.progress.loss == pytest.approx(cpu.progress.loss, rel=1e-3)
    for name, state in cpu.optimizer.state.items():
        gradient, other = state["exp_avg"], cuda.optimizer.state[name]["exp_avg"].cpu()  # Adam's first mean is a tenth of it
        if name != "quats":  # Gaussians begin as spheres, which do not turn: that gradient is rounding
            assert 0 < gradient.norm() and (other - gradient).norm() < 0.1 * gradient.norm(), name


@pytest.mark.parametrize("sh_degree", (0, 1))
def test_training_reaches_the_same_quality(sh_degree):
    frames = list(phantom_sequence(PhantomConfig(frames=5, width=160, height=128, travel=0.01)))
    quality = {}
    for device in ("cpu", "cuda"):
        config = ReconstructionConfig(iterations=150, max_gaussians=8000, image_width=160, sh_degree=sh_degree, device=device)
        model = trainer_of(frames[::2], config).run()
        image, _ = DeformableRenderer(model, None, RenderingConfig(device="cpu")).render(frames[1].camera)
        quality[device] = metrics.psnr(image, frames[1].image)
    assert quality["cpu"] > 20
    assert abs(quality["cpu"] - quality["cuda"]) < 0.7
