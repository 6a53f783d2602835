"""Recordings that `default` was developed with look as good as they did: a rule that is right for some may ruin another."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from endo_sim_ros.evaluation import metrics
from endo_sim_ros.evaluation.held_out import model_renderer
from endo_sim_ros.evaluation.sources import open_named
from endo_sim_ros.evaluation.splits import split_views
from endo_sim_ros.reconstruction import Trainer, prepare, preset, shrink

SHARED = Path(__file__).resolve().parents[3] / "shared/data"
RECORDED, TRAINED = 480, 80  # pixels: what a recording is shrunk to, and the width that is trained on
HELD_OUT = 8  # views measured at most
LESS = 1.5  # dB that other versions of libraries and small changes may cost

# Gain-fitted PSNR, dB. Hamlyn06 has 21.3 dB without the light of a lens that looks beside the middle of its picture.
TODAY = [
    pytest.param("hamlyn06", "every-12th", 28.5, id="hamlyn06"),
    pytest.param("sinus", "two-views", 26.8, id="sinus", marks=pytest.mark.thorough),
    pytest.param("gallbladder,fx=907.4,distortion=-0.083", "every-12th", 25.3, id="gallbladder", marks=pytest.mark.thorough),
    pytest.param("phantom:0,frames=9,width=320,height=256", "two-views", 30.9, id="phantom:0", marks=pytest.mark.thorough),
]


@pytest.mark.slow
@pytest.mark.parametrize("source, split, today", TODAY)
def test_held_out_views_look_as_good_as_they_did(source, split, today):
    if not source.startswith("phantom"):
        if not (SHARED / source.split(",")[0]).is_dir():
            pytest.skip(f"no recording at ../shared/data/{source.split(',')[0]}")
        source = str(SHARED / source)
    frames = [dataclasses.replace(shrink(frame, RECORDED), depth=None) for frame in open_named(source)]
    parts = split_views(split, len(frames), HELD_OUT)
    config = preset("default", image_width=TRAINED, iterations=80, max_gaussians=3000, device="cpu")
    trainer = Trainer(prepare([frames[i] for i in parts.train], config), config)
    renderer, light = model_renderer(trainer.run(), "cpu"), trainer.model.light
    psnr = []
    for frame in (shrink(frames[i], TRAINED) for i in parts.held_out):
        image, _ = renderer.render(frame.camera, light=trainer.drift.at(light, frame.stamp_ns))
        psnr.append(metrics.psnr(metrics.gain_fitted(image, frame.image, frame.mask), frame.image, frame.mask))
    assert np.mean(psnr) > today - LESS
