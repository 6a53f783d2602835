"""Deformed-view PSNR against truth: a synthetic patient's tissue is pulled, and filmed anew with its true reflections."""

import dataclasses
import logging
import math
from collections.abc import Sequence

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.evaluation import metrics
from endo_sim_ros.evaluation.deformed_views import changed_pixels
from endo_sim_ros.physics import PhysicsConfig, build_control_nodes
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig, render_depth
from endo_sim_ros.sequences.phantom import PhantomConfig, displacement_at, render_phantom

log = logging.getLogger(__name__)

_PULL = 0.012  # m: how far the tissue is pulled


def deformed_truth_psnr(
    model: GaussianModel, patient: PhantomConfig, trained: Sequence[Camera], seen_from: Sequence[Camera], device: str
) -> tuple[float, float]:
    """PSNR, dB, of pictures of a model whose tissue is displaced as the patient's, over the pixels that the true pictures change.

    The patient is displaced by a known field (`displacement_at`) and filmed anew; the model's control nodes are moved by the same
    field. What reflects stays with the light and the lens in the true pictures.

    Args:
        model: Gaussians at rest.
        patient: What was reconstructed.
        trained: The cameras of the training views.
        seen_from: Cameras of the pictures that are compared. True pictures are averaged from the size of the patient's recording to theirs.
        device: Compute device.

    Returns:
        The mean over the cameras that see a change, and that of the same pixels while both are at rest; displacement costs the difference.
        NaN if the patient was moving or flown over, no picture changes, or the model holds no control nodes.
    """
    if displacement_at(patient, 0.0) is not None or patient.flight:
        return math.nan, math.nan
    pulled = dataclasses.replace(patient, deformed=_PULL)
    try:
        rest = build_control_nodes(model, np.stack([each.position for each in trained]), PhysicsConfig(), trained, render_depth).rest
    except ValueError as error:  # next to nothing was reconstructed: the other figures stand
        log.warning("PSNR, deformed against truth, is left out: %s", error)
        return math.nan, math.nan
    displacement = displacement_at(pulled, 0.0)
    assert displacement is not None
    renderer = DeformableRenderer(model, rest, RenderingConfig(device=device))
    moved = tuple(each.astype(np.float32) for each in (rest + displacement.at(rest), displacement.gradients(rest)))
    found = []
    for camera in seen_from:
        still, truth = (_filmed(each, camera) for each in (patient, pulled))
        changed = changed_pixels(truth, still)
        if changed.any():
            pairs = ((moved, truth), ((), still))
            found.append([metrics.psnr(renderer.views([camera], *state, depth=False)[0].image, image, changed) for state, image in pairs])
    deformed, at_rest = np.mean(found, 0) if found else (math.nan, math.nan)
    return float(deformed), float(at_rest)


def _filmed(patient: PhantomConfig, camera: Camera) -> np.ndarray:
    """What a camera sees of the patient [H, W, 3] (uint8), averaged from the size of its recording as held-out views are."""
    if camera.width >= patient.width:
        return render_phantom(patient, camera)[0]
    image = render_phantom(patient, camera.resized(patient.width, patient.height))[0]
    return cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
