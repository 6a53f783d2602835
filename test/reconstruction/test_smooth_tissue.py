"""Depth of smooth tissue without scene points: ray-cast recordings, whose truth is exact."""

import numpy as np
import pytest
from smooth_tissue import film, tissue

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("shape", ["organ", "flap", "funnel", "saddle"])
def test_rays_end_on_the_surface(shape):
    frame = next(film(shape, seed=3, width=80))
    assert (frame.depth > 0.01).all()
    assert np.abs(tissue(shape, 3).distance(frame.camera.backproject(frame.depth))).max() < 1e-6  # depth has single precision
