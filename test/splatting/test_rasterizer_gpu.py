"""Rasterisation on a GPU as on the CPU. Skipped where there is none."""

import numpy as np
import pytest
import torch
from dense_sheet import sheet

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.splatting import rasterize

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]
CAMERA = Camera(np.array([[300.0, 0, 160], [0, 300, 128], [0, 0, 1]]), 320, 256)


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
