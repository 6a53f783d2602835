"""Training on a GPU as on the CPU. Skipped where there is none."""

import pytest
import torch
from trained import trainer_of

from endo_sim_ros.evaluation import metrics
from endo_sim_ros.reconstruction import ReconstructionConfig
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig
from endo_sim_ros.sequences.phantom import PhantomConfig, phantom_sequence

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]


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
