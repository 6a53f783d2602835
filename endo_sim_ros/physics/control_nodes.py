"""Control nodes: the sparse material points that stand for the tissue behind a reconstructed skin."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import warp as wp
from scipy.spatial import Delaunay, KDTree, QhullError

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.device import init_warp
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.tissue_motion import TissueMotion
from endo_sim_ros.physics.config import PhysicsConfig
from endo_sim_ros.physics.sampling_kernels import sample_farthest_points

OUTLIER_FACTOR = 5.0  # a Gaussian this many times farther from its neighbours than the median one floats
OUTLIER_NEIGHBOURS = 8
LEAST_IN_PICTURES = 0.3  # share of the Gaussians; with fewer the cameras are hardly those that saw the tissue
RIM_WIDTH = 0.4  # spacings from the border; a free node between pinned ones would only rattle
CARVING_VIEWS = 8  # that look for free space, spread over the cameras
CARVING_WIDTH = 160  # pixels
NORMAL_NEIGHBOURS = 9  # control nodes of the skin, itself among them, that tell the normal of one
GAP_FACTOR = 3.0  # a triangle with an edge this many spacings long bridges a gap and is not skin

RenderDepth = Callable[[GaussianModel, Camera], np.ndarray]  # depth [H, W] of a model's surface in a camera, m, 0 = none


@dataclass(frozen=True)
class ControlNodes:
    """M material points at rest.

    Args:
        rest: Positions [M, 3], metres, world, float32.
        pinned: Nodes that never move [M], bool.
        volumes: Tissue volume that each stands for [M], m³, float32.
        is_skin: Nodes on the reconstructed surface, where tools act [M], bool. Skin nodes come first.
        spacing: Typical distance between neighbours, metres; the grid's cells are sized by it.
        seen_from: From where the skin was seen [3], metres, world; None where nobody has seen it.
        motion: How the tissue moves by itself, where `MotionConfig.file` has that.
    """

    rest: np.ndarray
    pinned: np.ndarray
    volumes: np.ndarray
    is_skin: np.ndarray
    spacing: float
    seen_from: np.ndarray | None = None
    motion: TissueMotion | None = None

    def __len__(self) -> int:
        return len(self.rest)


def sample_farthest(points: np.ndarray, count: int, start: int = 0) -> np.ndarray:
    """Return the numbers [count] of samples of points [N, 3], the first being `start` (Qi et al. 2017); exact and deterministic.

    Each next sample is the point farthest from all samples so far; among equals the lowest number. One core of a CPU does it, as
    every sample has to wait for the one before.

    Raises:
        ValueError: If there are fewer points than samples.
    """
    points = np.asarray(points, np.float64)
    if not 1 <= count <= len(points):
        raise ValueError(f"sample_farthest: cannot pick {count} of {len(points)} points")
    init_warp()
    centred = (points - points.mean(0)).astype(np.float32)
    axes = wp.array(np.ascontiguousarray(centred.T), dtype=float, device="cpu")
    distances = wp.full(len(points), float("inf"), dtype=float, device="cpu")
    samples = wp.zeros(count, dtype=int, device="cpu")
    wp.launch(sample_farthest_points, 1, [axes, count, start, distances, samples], device="cpu")
    return samples.numpy().copy()


def select_solid(points: np.ndarray, opacities: np.ndarray, min_opacity: float) -> np.ndarray:
    """Indices of the Gaussians that may become nodes: opaque enough, and not floating far from the others.

    Args:
        points: Means [N, 3], metres.
        opacities: Opacities [N].
        min_opacity: Fainter Gaussians are left out.
    """
    solid = np.flatnonzero(opacities >= min_opacity)
    if len(solid) <= OUTLIER_NEIGHBOURS:
        return solid
    distances = KDTree(points[solid]).query(points[solid], k=OUTLIER_NEIGHBOURS + 1, workers=-1)[0][:, 1:].mean(1)
    return solid[distances <= OUTLIER_FACTOR * np.median(distances)]


@dataclass(frozen=True)
class Skin:
    """The skin as a triangulated sheet: what its nodes measure."""

    areas: np.ndarray  # of each node, across the viewing rays [S], m²
    rim: np.ndarray  # on the border as seen from the viewpoint [S], bool
    spacing: float  # m


def measure_skin(points: np.ndarray, viewpoint: np.ndarray) -> Skin:
    """Triangulate skin nodes [S, 3] as seen from the viewpoint [3]; areas, border and spacing follow.

    The triangulation is Delaunay's in the stereographic image of the viewing directions. Triangles across gaps in the
    image are left out, so concave borders are found; a jump in depth is not a border and has no area.

    Raises:
        ValueError: If the nodes do not span a sheet as seen from there.
    """
    rays = points - viewpoint
    rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    axis = rays.mean(0)
    axis /= np.linalg.norm(axis)
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    image = rays @ np.stack([side, np.cross(axis, side)], 1) / (1 + rays @ axis)[:, None]
    try:
        triangles = Delaunay(image).simplices
    except (QhullError, ValueError) as error:
        raise ValueError(
            f"{len(points)} skin nodes do not span a surface as seen from the viewpoint; the model needs more opaque"
            " Gaussians, or the viewpoint is wrong"
        ) from error

    def edge_lengths(coordinates: np.ndarray) -> np.ndarray:  # [T, 3]
        corners = coordinates[triangles]
        return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)

    in_image, in_space = edge_lengths(image), edge_lengths(points)
    near = in_space.max(1) <= GAP_FACTOR * np.median(in_space)
    seen = (in_image.max(1) <= GAP_FACTOR * np.median(in_image)) | near
    corners = points[triangles]
    normals = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # as long as the area
    surface = np.linalg.norm(normals, axis=1)
    across = np.abs((normals * rays[triangles].mean(1)).sum(1)).clip(0.1 * surface)  # not nothing at grazing angles
    areas = np.bincount(triangles[near].ravel(), np.repeat(across[near] / 3, 3), len(points))
    areas = np.where(areas > 0, areas, np.median(areas[areas > 0]))  # a node no near triangle touches

    edges = np.sort(np.concatenate([triangles[seen][:, pair] for pair in ([0, 1], [1, 2], [2, 0])]), 1)
    edges, uses = np.unique(edges, axis=0, return_counts=True)
    ends = points[edges[uses == 1]]  # [B, 2, 3]
    along = np.linspace(0, 1, 9)[:, None, None]
    border = (ends[:, 0] * (1 - along) + ends[:, 1] * along).reshape(-1, 3)
    spacing = float(np.sqrt(surface[near].sum() / len(points)))
    rim = KDTree(border).query(points)[0] <= RIM_WIDTH * spacing
    return Skin(areas, rim, spacing)


def in_free_space(
    points: np.ndarray, model: GaussianModel, cameras: Sequence[Camera], margin: float, render_depth: RenderDepth
) -> np.ndarray:
    """Return which points [N, 3] (m, world) some camera sees through: those over a margin (m) in front of the surface behind them.

    Args:
        points: Candidates.
        model: What the cameras see.
        cameras: Where it was seen from; a few of them, spread over all, are looked through.
        margin: How far in front of the surface counts, m.
        render_depth: Renders the model's depth, e.g. `endo_sim_ros.rendering.render_depth`.
    """
    free = np.zeros(len(points), bool)
    for index in np.unique(np.linspace(0, len(cameras) - 1, min(CARVING_VIEWS, len(cameras))).round().astype(int)):
        camera = cameras[index]
        width = min(CARVING_WIDTH, camera.width)
        camera = camera.resized(width, max(round(camera.height * width / camera.width), 1))
        depth = render_depth(model, camera)
        uv, z = camera.project(points)
        seen = camera.contains(uv, z)
        column, row = uv[seen].astype(int).T
        surface = np.zeros(len(points))
        surface[seen] = depth[row, column]
        free |= z + margin < surface
    return free


def _in_pictures(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Which points [N, 3] (m, world) lie in the picture of some camera; all without any, or if hardly any does."""
    inside = np.zeros(len(points), bool)
    for camera in cameras:
        inside |= camera.sees(points)
    return inside if inside.sum() > LEAST_IN_PICTURES * len(points) else np.ones(len(points), bool)


def build_control_nodes(
    model: GaussianModel,
    viewpoint: np.ndarray,
    config: PhysicsConfig,
    cameras: Sequence[Camera] = (),
    render_depth: RenderDepth | None = None,
) -> ControlNodes:
    """Nodes of the tissue behind a model's skin.

    The skin is sampled from the opaque Gaussians by farthest points and extruded along the viewing rays: layer l of L
    lies l/L of the thickness deeper. A node stands for its share of the skin's area (growing with the squared distance
    from the viewpoint) times its share of the depth (half a layer at the skin and at the back). With ``carve`` the part of
    a column that some camera sees through, as behind the edge of an organ in front of another, is left out.

    Args:
        model: Gaussians, world.
        viewpoint: Camera position [3] or positions [V, 3] (their mean is used), metres, world.
        config: Node count, layers, thickness, what is pinned, and the file of its motion.
        cameras: Those that the model was seen from, for carving; without any nothing is carved. Gaussians beyond the pictures
            of all of them, which nobody has seen, give no nodes.
        render_depth: Renders the model's depth in these cameras, for carving, e.g. `endo_sim_ros.rendering.render_depth`.

    Raises:
        ValueError: If the viewpoint or means are not finite, too few opaque Gaussians span a surface, or carving lacks
            ``render_depth``; MotionError if the file of the motion cannot be used, or is of another model.
    """
    motion = TissueMotion.load(Path(config.motion.file).expanduser(), model) if config.motion.file else None
    carves = config.carve and config.layers > 0 and len(cameras) > 0 and not config.dense
    if carves and render_depth is None:
        raise ValueError("carving needs the model's depth: pass render_depth, e.g. that of endo_sim_ros.rendering, or set carve=False")
    eye = np.asarray(viewpoint, np.float64).reshape(-1, 3)
    means = model.means.detach().cpu().double().numpy()
    opacities = model.opacities.detach().cpu().double().numpy()
    if not len(eye) or not np.isfinite(eye).all():
        raise ValueError(f"viewpoint must be a finite position [3] or positions [V, 3], got {eye.tolist()}")
    broken = np.flatnonzero(~np.isfinite(means).all(1))
    if len(broken):
        raise ValueError(f"mean of Gaussian {broken[0]} is not finite; remove it or reconstruct again")
    # Distances to the viewpoint decide everything below, so work relative to it.
    eye = eye.mean(0)
    points = means - eye
    solid = select_solid(points, opacities, config.min_opacity)
    solid = solid[_in_pictures(means[solid], cameras)]
    if len(solid) < 4:
        raise ValueError(
            f"only {len(solid)} of {len(means)} Gaussians are as opaque as min_opacity {config.min_opacity:g} and near"
            " others; tissue needs at least 4"
        )
    count = min(config.node_count // (config.layers + 1), len(solid))
    skin = points[solid[sample_farthest(points[solid], max(count, 4))]]
    skin = skin[np.sort(np.unique(skin, axis=0, return_index=True)[1])]  # Gaussians may coincide, nodes must not
    sheet = measure_skin(skin, np.zeros(3))
    if config.dense:
        return replace(_dense_nodes(points[solid], eye, skin, sheet, config), motion=motion)

    distance = np.maximum(np.linalg.norm(skin, axis=1, keepdims=True), sheet.spacing)  # a viewpoint in the tissue
    gap = config.thickness / config.layers if config.layers else sheet.spacing
    rest, volumes = [], []
    for layer in range(config.layers + 1):
        stretch = 1 + layer * gap / distance
        depth = gap if 0 < layer < config.layers or not config.layers else gap / 2
        rest.append(skin * stretch)
        volumes.append(sheet.areas * stretch[:, 0] ** 2 * depth)
    layer_of = np.repeat(np.arange(config.layers + 1), len(skin))
    pinned = np.tile(sheet.rim & config.pin_rim, config.layers + 1)
    if config.pin_back and config.layers:
        pinned |= layer_of == config.layers
    positions, kept = np.concatenate(rest) + eye, np.ones(len(pinned), bool)
    if carves and render_depth is not None:
        free = in_free_space(positions[len(skin) :], model, cameras, gap / 2, render_depth).reshape(config.layers, -1)
        kept[len(skin) :] = ~np.logical_or.accumulate(free, axis=0).ravel()  # nor does tissue go on behind free space
    return ControlNodes(
        positions[kept].astype(np.float32),
        pinned[kept],
        np.concatenate(volumes)[kept].astype(np.float32),
        (layer_of == 0)[kept],
        max(sheet.spacing, gap),
        eye,
        motion,
    )


def _dense_nodes(points: np.ndarray, eye: np.ndarray, skin: np.ndarray, sheet: Skin, config: PhysicsConfig) -> ControlNodes:
    """Every solid Gaussian a node, as PhysGaussian has it: cells of 1/50 of the scene, shared evenly by their points.

    Points [N, 3] and sampled skin [S, 3] are relative to the viewpoint eye [3].
    """
    spacing = float(np.ptp(points, axis=0).max()) / 50
    cells = np.floor((points - points.min(0)) / spacing).astype(np.int64)
    _, cell_of, occupancy = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    pinned = np.zeros(len(points), bool)
    if config.pin_rim:
        pinned = KDTree(skin[sheet.rim]).query(points)[0] <= max(sheet.spacing, spacing)
    volumes = spacing**3 / occupancy[cell_of.ravel()]
    rest = (points + eye).astype(np.float32)
    return ControlNodes(rest, pinned, volumes.astype(np.float32), np.ones(len(points), bool), spacing, eye)


def skin_normals(nodes: ControlNodes) -> np.ndarray:
    """Unit normals [S, 3] at the control nodes of the skin at rest, out of the tissue: of the planes that fit their neighbours best."""
    skin = nodes.rest[nodes.is_skin].astype(np.float64)
    near = KDTree(skin).query(skin, k=min(NORMAL_NEIGHBOURS, len(skin)))[1].reshape(len(skin), -1)
    around = skin[near] - skin[near].mean(1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("ski,skj->sij", around, around))[1][:, :, 0]
    if nodes.seen_from is not None:
        outwards = nodes.seen_from - skin
    elif not nodes.is_skin.all():
        outwards = skin - nodes.rest[~nodes.is_skin].mean(0)
    else:
        outwards = normals
    return normals * np.where((normals * outwards).sum(1, keepdims=True) < 0, -1, 1)


def held_sets(nodes: ControlNodes) -> tuple[np.ndarray, np.ndarray]:
    """Which pinned control nodes are of the back and which of the rim, each [M], bool: those behind pinned skin are of the rim."""
    rim, pinned, skin = np.zeros(len(nodes), bool), np.flatnonzero(nodes.pinned), np.flatnonzero(nodes.is_skin)
    if len(pinned) and len(skin):
        rest = np.asarray(nodes.rest, np.float64)
        eye = rest[skin].mean(0) - [0, 0, 1] if nodes.seen_from is None else np.asarray(nodes.seen_from, np.float64)
        rays = (rest - eye) / np.linalg.norm(rest - eye, axis=1, keepdims=True)
        rim[pinned] = nodes.pinned[skin[KDTree(rays[skin]).query(rays[pinned])[1]]]
    return nodes.pinned & ~rim, rim
