"""What the reflections of a model start from: the normals of its surface, and films that face the lens where views show highlights."""

import dataclasses
import math
from collections.abc import Iterable, Sequence

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (it is public)
from torch import Tensor
from torch.nn.functional import normalize

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.gaussians import SH_C0, GaussianModel
from endo_sim_ros.core.light import Light
from endo_sim_ros.core.reflections import facing, seen_colors, stored_strengths, unlit
from endo_sim_ros.reconstruction.highlights import highlights
from endo_sim_ros.reconstruction.photometry import Unlit
from endo_sim_ros.reconstruction.priors.inverse_depth import scaled
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import TrainingView
from endo_sim_ros.reconstruction.stage_configs import GlossConfig

_PART = 2000  # points whose normals are told together, by one core
_FAR = 2**19  # cubes to either side of the middle, so that their numbers fit into 64 bits; all that is farther away is in the last one
_AGREE = 0.7, 0.9  # length of a mean normal up to which neighbours do not count, and from which on they count wholly. On half a post it is
# 0.64; normals that err by 25 degrees have 0.9.


def lobes(options: GlossConfig) -> Light:
    """A light that does nothing but reflect as the options say."""
    return Light(sheen_sharpness=options.sheen_sharpness, glint_sharpness=options.glint_sharpness, facing=options.facing)


def start_gloss(
    model: GaussianModel, cameras: Sequence[Camera], options: GlossConfig = GlossConfig(), progress: StageProgress = StageProgress()
) -> GaussianModel:
    """Return the model with `gloss`. Seen from the camera nearest to it, a Gaussian has the colour that it had.

    Args:
        model: Gaussians without gloss, of spherical harmonics of degree 0, on the CPU.
        cameras: Those of the training views; normals point to the nearest.
        options: Strengths at first, and how many neighbours tell a normal.
        progress: Reported to by parts of the model.
    """
    means = model.means.double().numpy()
    eyes = np.array([camera.position for camera in cameras])
    distances, nearest = cKDTree(eyes).query(means)
    eyes = eyes[nearest]
    normals = surface_normals(means, options.neighbours, progress)
    normals *= np.where(((eyes - means) * normals).sum(1, keepdims=True) < 0, -1.0, 1.0)
    normals = smoothed_normals(means, normals, options.smoothing * float(np.median(distances)), progress)
    strengths = _own_light(model)[:, None] * torch.tensor([options.sheen, options.glint])
    gloss = torch.cat([torch.from_numpy(np.concatenate([normals, normals], 1).astype(np.float32)), stored_strengths(strengths)], 1)
    glossy = dataclasses.replace(model, gloss=gloss, light=lobes(options))
    return dataclasses.replace(glossy, sh=unlit(glossy, facing(glossy, torch.from_numpy(eyes).float()).cosines), light=model.light)


def start_films(
    model: GaussianModel, unlit_colors: Iterable[Unlit], reflection: float, options: GlossConfig = GlossConfig()
) -> GaussianModel:
    """Return the model whose films face the lens where a view shows a highlight, with the base colour there of what is around.

    Training finds a film only if it nearly faces the lens already: a glint is no wider than a few degrees. What views from farther
    apart than that all show as bright is white, and stays so.

    Args:
        model: Gaussians with `gloss`, on the CPU.
        unlit_colors: Those of its means in the training views.
        reflection: By how much all channels of a highlight are above what is around it, grey levels.
        options: What the light reflects by, the widest highlight, the largest strength, and how many Gaussians tell the colour below.
    """
    assert model.gloss is not None
    means, (seen, shown, peaks), towards = model.means, torch.zeros(3, len(model)), torch.zeros_like(model.means)
    for view, index, pixels, colors in unlit_colors:
        seen[index] += 1
        bright = torch.from_numpy(_narrow_highlights(view, reflection, options.widest)).flatten()[pixels]
        index = index[bright]
        shown[index] += 1
        towards[index] += normalize(torch.from_numpy(view.camera.position).float() - means[index], dim=1)
        peaks[index] = torch.maximum(peaks[index], colors[bright].square().mean(1))
    half_as_bright = 1 - math.log(2) / options.glint_sharpness  # cosine of the angle from the middle of a glint
    white = (shown == seen) & (towards.norm(dim=1) < half_as_bright * shown)
    shine, around = (shown > 0) & ~white, (seen > 0) & (shown == 0)
    if not shine.any() or not around.any():
        return model
    ranks = [*range(1, min(options.neighbours, int(around.sum())) + 1)]
    apart, near = cKDTree(means[around].numpy()).query(means[shine].numpy(), k=ranks)
    weights = torch.from_numpy(np.maximum(apart, 1e-9) ** -2).float()
    sh, gloss, towards = model.sh.clone(), model.gloss.clone(), normalize(towards, dim=1)
    sh[shine, 0] = (weights[..., None] * model.sh[around, 0][near]).sum(1) / weights.sum(1, keepdim=True)
    gloss[shine, 3:6] = towards[shine]
    covered = dataclasses.replace(model, sh=sh, light=lobes(options))
    without_glint = (seen_colors(covered, (model.gloss[:, :3] * towards).sum(1))[:, 0] * SH_C0 + 0.5).square().mean(1)
    strengths = stored_strengths((peaks - without_glint).clamp(1e-3, options.strongest))
    gloss[shine, 7] = torch.maximum(gloss[:, 7], strengths)[shine]
    return dataclasses.replace(model, sh=sh, gloss=gloss)


def _narrow_highlights(view: TrainingView, reflection: float, widest: float) -> np.ndarray:
    """Mask [H, W] of the highlights of a view that are no wider than that, pixels of an image 640 wide: wider ones may be white things."""
    mask = highlights(view.image, view.tissue, reflection)
    count, labels = (np.asarray(each) for each in cv2.connectedComponents(mask.astype(np.uint8)))
    radii = np.zeros(int(count))
    np.maximum.at(radii, labels, cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3))
    return mask & (2 * radii <= scaled(widest, view.camera.width))[labels]


def smoothed_normals(points: np.ndarray, normals: np.ndarray, width: float, progress: StageProgress = StageProgress()) -> np.ndarray:
    """Return unit normals [N, 3] averaged over neighbours; where these disagree, as on a post thinner than that, they stay as they are.

    Points are gathered in cubes. At each point the means of the eight nearest cubes count by a Gaussian of their distance: as quick for
    many points as for few.

    Args:
        points: [N, 3], m.
        normals: Their unit normals [N, 3], all to the side that is seen.
        width: Side of the cubes, and where the Gaussian has fallen to 1/e, m; 0 averages nothing.
        progress: Reported to by parts of the points.
    """
    if not width:
        return normals
    steps = np.floor((points - np.median(points, 0)) / width).clip(-_FAR, _FAR - 1).astype(np.int64) + _FAR
    cubes, counts = np.unique(np.ravel_multi_index(steps.T, [2 * _FAR] * 3), return_inverse=True, return_counts=True)[1:]
    sums = np.stack([np.bincount(cubes, column) for column in np.concatenate([points, normals], 1).T], 1)
    middles = sums[:, :3] / counts[:, None]
    tree, ranks = cKDTree(middles), [*range(1, min(8, len(middles)) + 1)]

    def averaged(part: slice) -> np.ndarray:
        apart, near = tree.query(points[part], k=ranks)
        weights = np.exp(-((apart / width) ** 2))
        mean = np.einsum("nk,nki->ni", weights, sums[near, 3:]) / ((weights * counts[near]).sum(1, keepdims=True) + 1e-300)
        agreement = np.linalg.norm(mean, axis=1, keepdims=True)
        low, high = _AGREE
        share = ((agreement - low) / (high - low)).clip(0, 1) * ((mean * normals[part]).sum(1, keepdims=True) > 0)
        mixed = share * mean / np.maximum(agreement, low) + (1 - share) * normals[part]
        return mixed / np.linalg.norm(mixed, axis=1, keepdims=True)

    return np.concatenate(progress.map(averaged, [slice(i, i + _PART) for i in range(0, len(points), _PART)]))


def strongest_sheen(model: GaussianModel, eyes: Tensor, options: GlossConfig) -> Tensor:
    """Return the largest strength of the broad lobe that each Gaussian may have [N].

    A lobe that no view sees from near its middle tells nothing of its strength, but the optimiser moves it as far as any other. It would
    flash once the tissue turns. So a strength may be as much of the strongest as the most that a view sees of the lobe.

    Args:
        model: Gaussians with `gloss`.
        eyes: Where the views are [V, 3], m, world.
        options: The strength at first, which every lobe may have, the strongest, and the sharpness.
    """
    nearest = torch.full_like(model.means[:, 0], -1.0)
    for eye in eyes:
        nearest = torch.maximum(nearest, facing(model, eye).cosines)
    seen = (options.sheen_sharpness * (nearest - 1)).exp()
    return (options.sheen * _own_light(model) + options.strongest * seen).clamp_max(options.strongest)


def _own_light(model: GaussianModel) -> Tensor:
    """How bright Gaussians are by themselves, in light [N], the mean of the channels."""
    return (model.sh[:, 0] * SH_C0 + 0.5).square().mean(1)


def surface_normals(points: np.ndarray, neighbours: int, progress: StageProgress = StageProgress()) -> np.ndarray:
    """Return normals [N, 3] of a surface through points [N, 3], of either sign: across the plane of the nearest so many of them."""
    tree, ranks = cKDTree(points), [*range(1, min(neighbours, len(points)) + 1)]

    def normals(part: np.ndarray) -> np.ndarray:
        near = points[tree.query(part, k=ranks)[1]]
        near = near - near.mean(1, keepdims=True)
        return np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]

    return np.concatenate(progress.map(normals, [points[i : i + _PART] for i in range(0, len(points), _PART)]))
