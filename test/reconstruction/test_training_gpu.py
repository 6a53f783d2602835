"""Training on a GPU as on the CPU. Skipped where there is none."""

from dataclasses import replace

import pytest
import torch

from endo_sim_ros.reconstruction import ReconstructionConfig, Trainer, prepare
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]


@pytest.mark.parametrize("before", (0, 35), ids=("first", "after replayed steps and refinement"))
@pytest.mark.parametrize("sh_degree", (0, 1))
def test_a_step_has_the_same_loss_and_gradients(before, sh_degree, tmp_path):
    """Other kernels on a CPU move gradients by 3e-5 of their norm, noise of 1e-5 in the Gaussians by 2 to 10 %, twice SSIM by half."""
    frames = list(phantom_sequence(PhantomConfig(frames=5, width=160, height=128, travel=0.01)))[::2]
    config = ReconstructionConfig(
        max_gaussians=8000, image_width=160, sh_degree=sh_degree, refine_every=10, dropout=0, device="cpu"
    )  # chance is another on each
    scene = prepare(frames, config)
    cpu, cuda = (Trainer(scene, replace(config, device=device)) for device in ("cpu", "cuda"))
    for _ in range(before):
        cuda.step()
    cuda.save_checkpoint(tmp_path / "checkpoint.pt")
    cpu.load_checkpoint(tmp_path / "checkpoint.pt")
    old = {name: 0.9 * state["exp_avg"] for name, state in cpu.optimizer.state.items()}
    cpu.step()
    cuda.step()
    assert cuda.progress.loss == pytest.approx(cpu.progress.loss, rel=1e-3)
    for name, state in cpu.optimizer.state.items():
        # What a step adds to Adam's first mean is a tenth of the gradient.
        gradient, other = (each.cpu() - old[name] for each in (state["exp_avg"], cuda.optimizer.state[name]["exp_avg"]))
        if before or name != "quats":  # Gaussians begin as spheres, which do not turn: that gradient is rounding
            assert 0 < gradient.norm() and (other - gradient).norm() < 0.1 * gradient.norm(), name
