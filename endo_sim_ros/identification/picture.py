"""Maps of stiffness in pictures: colours, and a map over the model that it is of."""

from dataclasses import replace

import cv2
import numpy as np
import torch
from scipy.spatial import KDTree

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.compressed_ply import SH_C0
from endo_sim_ros.core.drawing import label
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.physics import ControlNodes
from endo_sim_ros.rendering import DeformableRenderer, RenderingConfig

_LEAST_RANGE = 4.0  # from the softest to the stiffest of a scale, so that hardly different tissue looks alike
_ENDS = 26, 236  # of the colours that are used, as both ends of them are so dark that they hide the tissue
_UNKNOWN = (110, 110, 110)
_WIDTH = 640  # pixels of the picture
_STRIPES = 12  # pixels from stripe to stripe where nothing is known
_FAINT = 0.35  # of the colour in them
_NEIGHBOURS = 4  # control nodes of the skin that colour a Gaussian
_BAR = 0.035  # width of the scale, of the picture's


def color_scale(young_modulus: np.ndarray) -> tuple[float, float]:
    """The moduli, Pa, that are shown blue and red: those of the softest and the stiffest, or farther apart."""
    low, high = float(np.min(young_modulus)), float(np.max(young_modulus))
    widen = max(_LEAST_RANGE / (high / low), 1.0) ** 0.5
    return low / widen, high * widen


def modulus_colors(young_modulus: np.ndarray, known: np.ndarray, scale: tuple[float, float]) -> np.ndarray:
    """Colours [M, 3] uint8 of moduli [M], Pa, on a logarithmic scale, as `color_scale` gives it; grey where they are not known [M]."""
    share = np.log(np.asarray(young_modulus) / scale[0]) / np.log(scale[1] / scale[0])
    levels = (_ENDS[0] + (_ENDS[1] - _ENDS[0]) * share.clip(0, 1)).astype(np.uint8)
    colors = cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
    return np.where(np.asarray(known)[:, None], colors, np.array(_UNKNOWN, np.uint8))


def most_different(nodes: ControlNodes, young_modulus: np.ndarray) -> np.ndarray:
    """Numbers [S] of the control nodes to show for those of the skin: of each and of what hides behind it, the one whose modulus differs
    most from that of most tissue."""
    skin = np.flatnonzero(nodes.is_skin)
    rest = nodes.rest.astype(np.float64)
    eye = nodes.seen_from
    if eye is None:
        return skin
    rays = (rest - eye) / np.linalg.norm(rest - eye, axis=1, keepdims=True)
    column = np.asarray(KDTree(rays[skin]).query(rays)[1])
    different = np.abs(np.log(young_modulus / np.median(young_modulus)))
    order = np.lexsort((np.arange(len(rest))[::-1], different))  # among equals the one nearest to the skin comes last
    shown = skin.copy()
    shown[column[order]] = order
    return shown


def draw_map(
    model: GaussianModel,
    camera: Camera,
    nodes: ControlNodes,
    young_modulus: np.ndarray,
    known: np.ndarray,
    text: str,
    device: str = "auto",
) -> np.ndarray:
    """The model, coloured by the stiffness of what is seen and of what hides behind it, with a scale; striped and faint where that is
    not known: RGB [H, W, 3] uint8.

    Args:
        model: At rest.
        camera: That looks at it.
        nodes: Its control nodes.
        young_modulus: Of each [M], Pa.
        known: Where it is known [M].
        text: Above the picture.
        device: Compute device.
    """
    shown, scale = most_different(nodes, young_modulus), color_scale(young_modulus)
    colors = modulus_colors(young_modulus[shown], np.ones(len(shown), bool), scale)
    camera = camera.resized(_WIDTH, max(round(_WIDTH * camera.height / camera.width), 1))
    config = RenderingConfig(device=device, image_width=0, background=0.0)
    image, depth = DeformableRenderer(model, None, config).render(camera)
    means = model.means.detach().cpu().double().numpy()
    count = min(_NEIGHBOURS, len(shown))
    distance, near = KDTree(nodes.rest[nodes.is_skin]).query(means, k=count)
    distance, near = distance.reshape(-1, count), near.reshape(-1, count)
    weights = 1 / np.maximum(distance, 1e-6) ** 2
    weights /= weights.sum(1, keepdims=True)
    flat, sure = (weights[..., None] * colors[near]).sum(1) / 255, (weights * known[shown][near]).sum(1)
    painted = [_painted(model, values, camera, config) for values in (flat, np.repeat(sure[:, None], 3, 1))]
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)[..., None]
    tissue = depth > 0
    bright = gray / max(float(gray[tissue].mean()) if tissue.any() else 1.0, 1.0)
    colored = painted[0] * (0.45 + 0.55 * bright.clip(0, 1.6))
    rows, columns = np.indices(depth.shape)
    stripe = (rows + columns) % _STRIPES < _STRIPES // 3
    faint = np.where(stripe[..., None], 0.75 * gray, (1 - _FAINT) * gray + _FAINT * colored)
    picture = np.where((painted[1][..., :1] > 127) & tissue[..., None], colored, np.where(tissue[..., None], faint, image))
    return label(_with_scale(picture.clip(0, 255).astype(np.uint8), scale), text)


def _painted(model: GaussianModel, colors: np.ndarray, camera: Camera, config: RenderingConfig) -> np.ndarray:
    """A picture [H, W, 3] of the model in colours [N, 3], 0 to 1, of its own."""
    sh = (torch.from_numpy(colors).float() - 0.5) / SH_C0
    flat = replace(model, sh=sh[:, None].to(model.means.device), light=None, gloss=None)
    return DeformableRenderer(flat, None, config).render(camera)[0].astype(np.float32)


def _with_scale(image: np.ndarray, scale: tuple[float, float]) -> np.ndarray:
    """The picture with a scale of moduli at its right."""
    height, width = image.shape[:2]
    bar, top, bottom = max(round(_BAR * width), 8), round(0.08 * height), round(0.92 * height)
    left = width - 4 * bar
    levels = np.linspace(1, 0, bottom - top)
    moduli = scale[0] * (scale[1] / scale[0]) ** levels
    image = image.copy()
    image[top - 8 : bottom + 8, left - 6 :] = (0.35 * image[top - 8 : bottom + 8, left - 6 :]).astype(np.uint8)
    image[top:bottom, left : left + bar] = modulus_colors(moduli, np.ones(len(moduli), bool), scale)[:, None]
    for modulus in _ticks(*scale):
        row = top + round((1 - np.log(modulus / scale[0]) / np.log(scale[1] / scale[0])) * (bottom - top - 1))
        cv2.line(image, (left + bar, row), (left + bar + 4, row), (255, 255, 255), 1)
        told = (f"{modulus / 1e3:.3g}", (left + bar + 7, row + 4))
        cv2.putText(image, *told, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
    cv2.putText(image, "kPa", (left, top - 12), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
    return image


def _ticks(low: float, high: float) -> list[float]:
    """Round moduli between two, some of them."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    for digits in ((1,), (1, 3), (1, 2, 5), range(1, 10)):
        found = [digit * 10.0**power for power in powers for digit in digits if low <= digit * 10.0**power <= high]
        if len(found) >= 4:
            break
    return found
