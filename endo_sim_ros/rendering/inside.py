"""The flesh that an open cut shows: a reconstruction knows the skin alone, so what lies below it is made up here.

The colour of a point is a function of where it is at rest: the skin's own colour below the skin, then fat, then dark flesh, each as bright
as the skin nearby. The colour of the skin around tells the organ: below yellow skin fat is deep, below dark red skin, as that of a liver,
there is none, and flesh has the colour of the organ.

Cuts are triangles in the tissue at rest. Both faces of each are covered with flat Gaussians, which then follow the control nodes on their
own side as the skin beside a cut does. They count as far as the two faces have moved apart. A line of blood on the skin, along both edges,
counts always.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import softplus

from endo_sim_ros.core.gaussians import SH_C0, GaussianModel
from endo_sim_ros.core.reflections import without_glints
from endo_sim_ros.physics.control_nodes import select_solid
from endo_sim_ros.rendering.config import InsideConfig

_NEIGHBOURS = 64  # Gaussians of the skin that tell its place and colour: those of few views are a cloud, not a sheet
_CELLS = 64  # pieces of skin, a quarter of its width each way, in the bell curve that tells the colour of an organ
_FEET = 32  # control nodes that tell how deep the tissue is, of a few columns
SOLID = 0.1  # opacity of what is skin, as for control nodes
_OPACITY = 0.97
# Lengths in grains:
_OFFSET, _FLAT, _WIDE = 0.02, 0.008, 0.65  # of a face from the cut, and standard deviations of its Gaussians across and along it
_THINNEST = 3  # tissue that is thinner is a bare skin
_HIDDEN = 0.2  # by which two faces must have moved apart to be there; less is thinner than a pixel, and a needle at the end of a cut
# Colours as parts of that of the skin nearby (what is just below it), or of its brightness (fat, flesh, blood).
_BELOW_SKIN, _FAT = np.array([0.95, 0.8, 0.78]), np.array([0.98, 0.66, 0.48])
_FLESH, _BLOOD = np.array([0.62, 0.18, 0.15]), np.array([0.5, 0.06, 0.06])
_PARENCHYMA = np.array([0.85, 0.7, 0.66])  # as parts of the colour of the organ
# Of skin that is red, green and blue: from where to where of (green − blue) / red it grows yellow, and of green / red dark red. Livers,
# gall bladders and bowels of recordings lie well within, or beyond.
_YELLOW, _DARK_RED = (0.12, 0.25), (0.55, 0.42)
_DEEP_FAT = 4  # how much deeper fat goes below yellow skin
_BURIED = 3  # in roughnesses of the skin: by which flesh lies deeper than it is, as it would show through where skin is uneven
_SEEPS = 0.6  # share of blood at the edges of a cut, about
_LINE = 0.35  # half the width of the line of blood on each edge, of the depth to which blood seeps
_LONGER = 1.5  # times as long as on the faces: edges are stretched
_UNSURE = 0.5  # part of the roughness of the skin by which where it is jumps from place to place
_IN_THE_SKIN = 0.99  # cosine from which on a cut runs along the skin and not through it
_ABOVE = 0.5  # in roughnesses of the skin: by which that line lies above it
_NOISES = 0.004, 0.0018  # m: sizes of irregularities, coarse and fine
_DIM = 0.008  # m: at such a depth half the light comes, as the faces of a cut keep it off each other
_DIM_BY = np.array([0.6, 1.2, 1.2])  # of red, green and blue: what comes has met flesh, which is red


class Inside:
    """What lies below the skin of a model, on the CPU.

    Args:
        model: Gaussians at rest, world.
        node_rest: Control nodes at rest [M, 3], m, world.
        config: Of the flesh.
    """

    def __init__(self, model: GaussianModel, node_rest: np.ndarray, config: InsideConfig) -> None:
        self._model, self._config = model.detach().to("cpu"), config
        node_rest = np.asarray(node_rest, np.float64)
        self._low, self._high = node_rest.min(0) - config.grain, node_rest.max(0) + config.grain
        means = self._model.means.double().numpy()
        self._solid = select_solid(means, self._model.opacities.double().numpy(), SOLID)
        self._covered: set[tuple[int, ...]] = set()
        if len(self._solid):
            self._skin, self._tree = means[self._solid], KDTree(means[self._solid])
            self._colors = self._model.base_colors.double().numpy()[self._solid]
            self._organs = None
            if config.organ:
                seen = self._model  # without the colours that others hide
                if seen.bared is not None:
                    seen = replace(seen, sh=seen.sh[:, :1] + seen.bared[:, None])
                seen = seen.base_colors.double().numpy()[self._solid]
                self._organs = OrganColors(self._skin, seen, max(config.organ, config.grain))
            feet = self._skin[self._nearest(node_rest)[:, 0]]
            self._columns, self._below = KDTree(feet), node_rest - feet

    def _nearest(self, points: np.ndarray) -> np.ndarray:
        """Numbers of a few Gaussians of the skin [P, K] that are nearest to points [P, 3], m, nearest first."""
        return _query(self._tree, points, _NEIGHBOURS)

    def measure(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """How far points [P, 3] lie below the skin, m, negative above it, how deep the tissue is there [P], m; 0 is beside it, and where
        there is a bare skin; how far the Gaussians of the skin lie off their plane, standard deviation [P], m; and the way inwards, of
        length one [P, 3]."""
        near = self._skin[self._nearest(points)]
        feet = near.mean(1)
        below = self._below[_query(self._columns, feet, _FEET)]
        inward = below.sum(1)  # those that are deep have most to say
        inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-12)
        depth = ((points - feet) * inward).sum(1)
        aside = np.linalg.norm(points - feet - depth[:, None] * inward, axis=1)
        thickness = (below * inward[:, None]).sum(2).max(1)
        least = _THINNEST * self._config.grain
        off = near - feet[:, None]
        rough = np.sqrt(np.maximum(np.linalg.eigvalsh(off.swapaxes(1, 2) @ off / off.shape[1])[:, 0], 0))
        return depth, np.where((aside < np.maximum(depth, least)) & (thickness > least), thickness, 0), rough, inward

    def colors(self, points: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """RGB [P, 3] of points [P, 3], m, at rest, so far below the skin [P], m."""
        config = self._config
        near = self._nearest(points)
        skin = self._colors[near].mean(1)
        bright, depth = skin.max(1, keepdims=True), depth[:, None]
        coarse, fine = (value_noise(points, size, config.seed)[:, None] for size in _NOISES)
        color, at = skin * _BELOW_SKIN, depth * (1 + 0.4 * coarse + 0.2 * fine)
        flesh, yellow, dark_red = bright * _FLESH, 0.0, 0.0
        if self._organs is not None:
            organ = self._organs.at(points)
            red, green, blue = np.maximum(organ, 1e-3).T[:, :, None]
            yellow = _share((green - blue) / red, *_YELLOW)
            dark_red = _share(green / red, *_DARK_RED) * (1 - yellow)
            flesh = flesh + dark_red * (organ * _PARENCHYMA - flesh)
        flesh_from = config.flesh_from * (1 + (_DEEP_FAT - 1) * yellow)
        for start, layer, most in ((config.fat_from, bright * _FAT, 1 - dark_red), (flesh_from, flesh, 1)):
            share = most * _share(at / np.maximum(start, 1e-9), 0.5, 1.5)
            color = color + share * (layer - color)
        color = color * (1 + 0.12 * coarse + 0.12 * fine) / (1 + np.minimum(depth / _DIM, 1.5) * _DIM_BY)
        # Blood seeps: from the edge down it gets less, and is not everywhere the same.
        share = np.clip(1 - 0.5 * depth / max(config.blood, 1e-9), 0, 1) * (_SEEPS + 0.3 * coarse + 0.2 * fine) if config.blood else 0.0
        return np.clip(color + share * (bright * _BLOOD - color), 0, 1)

    def heal(self) -> None:
        """Forget all cuts."""
        self._covered.clear()

    def faces(self, triangles: np.ndarray) -> tuple[GaussianModel, np.ndarray]:
        """Return N Gaussians on both faces of new cuts [T, 3, 3], m, world, at rest: pairs, one on each side of the cut; and which of them
        are blood on the skin [N], bool, that counts always.

        Just below the skin they have half the distance, below the layers near it twice. What older ones cover gets no more.
        """
        grain = self._config.grain
        rows = [self._cover(triangle) for triangle in np.asarray(triangles, np.float64)] if len(self._solid) else []
        rows = np.concatenate([np.zeros((0, 8)), *rows])
        if not len(rows):
            return self._model.select(np.zeros(0, int)), np.zeros(0, bool)
        depth, thickness, rough, inward = self.measure(rows[:, :3])
        fine = np.abs(depth) < self._config.fat_from + grain  # there colours change within a grain
        finer = _divided(rows[fine], grain)
        order = np.argsort(np.concatenate([np.flatnonzero(~fine), np.tile(np.flatnonzero(fine), 4)]), kind="stable")  # of the triangles
        pairs = zip((rows, depth, thickness, rough, inward), (finer, *self.measure(finer[:, :3])))
        rows, depth, thickness, rough, inward = (np.concatenate([old[~fine], new])[order] for old, new in pairs)
        along = np.abs((rows[:, 3:6] * inward).sum(1)) > _IN_THE_SKIN
        line = (np.abs(depth) < (grain + _UNSURE * rough) / 2) & (thickness > 0) & ~along & (self._config.blood > 0)
        blood = self._line(rows[line], depth[line], rough[line], inward[line]) if line.any() else None
        deep = depth > 1.5 * self._config.flesh_from
        shown = (depth > 0) & (depth < thickness) & ((rows[:, 7] > 0) | ~deep)
        at, normal, wide, depth = rows[shown, :3], rows[shown, 3:6], rows[shown, 6] * np.where(deep, 2, 1)[shown], depth[shown]
        colors, rough = self.colors(at, depth), rough[shown, None] * inward[shown]
        gloss = self._gloss(at, colors, normal)
        at = at + _BURIED * (rough - (rough * normal).sum(1, keepdims=True) * normal)  # along the cut, so that skin covers it
        up = np.where(normal[:, 2:] < 0, -normal, normal)
        quats = np.stack([1 + up[:, 2], -up[:, 1], up[:, 0], np.zeros(len(at))], 1)  # turn z to the normal
        scales = np.stack([wide, wide, np.full(len(at), _FLAT * grain)], 1)
        faces = self._pairs(at, _OFFSET * grain * normal, quats, scales, colors, gloss)
        if blood is None:
            return faces, np.zeros(len(faces), bool)
        order = np.argsort(np.repeat(np.concatenate([np.flatnonzero(shown), np.flatnonzero(line)]), 2), kind="stable")  # of the rows
        both = {name: torch.cat([value, getattr(blood, name)])[order] for name, value in faces.tensors().items()}
        return replace(faces, **both), order >= len(faces)

    def _line(self, rows: np.ndarray, depth: np.ndarray, rough: np.ndarray, inward: np.ndarray) -> GaussianModel:
        """The line of blood on both edges: pairs on the skin beside the cut, at rows [P, 8] that lie so far below it, as `measure` has it.

        They lie a little above it, as its Gaussians would hide them, and are as wet as it.
        """
        config, at, normal = self._config, rows[:, :3], rows[:, 3:6]
        near = self._nearest(at)
        coarse, fine = (value_noise(at, size, config.seed)[:, None] for size in _NOISES)
        colors = self._colors[near].mean(1).max(1, keepdims=True) * _BLOOD * (1 + 0.2 * coarse + 0.2 * fine)
        half = _LINE * config.blood * (1 + 0.4 * coarse + 0.3 * fine)  # of its width on each side
        across = normal - (normal * inward).sum(1, keepdims=True) * inward
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
        quats = Rotation.from_matrix(np.stack([across, np.cross(inward, across), inward], 2)).as_quat()[:, [3, 0, 1, 2]]
        scales = np.concatenate([2 / 3 * half, _LONGER * rows[:, 6:7], np.full((len(at), 1), _FLAT * config.grain)], 1)
        gloss = None
        if self._model.gloss is not None:
            skin = self._model.gloss[self._solid[near]]
            gloss = torch.cat([skin[:, 0, :6], skin[..., 6:].median(1).values], 1).repeat_interleave(2, 0)
        at = at - (depth + _ABOVE * rough + _OFFSET * config.grain)[:, None] * inward
        return self._pairs(at, half * across, quats, scales, colors.clip(0, 1), gloss)

    def _pairs(
        self, at: np.ndarray, away: np.ndarray, quats: np.ndarray, scales: np.ndarray, colors: np.ndarray, gloss: Tensor | None
    ) -> GaussianModel:
        """Gaussians on both sides of places [P, 3], which are so far away from these [P, 3], m, world; `gloss` [2 P, 8]."""
        both = lambda array: torch.from_numpy(np.repeat(array, 2, 0)).float()
        sh = torch.zeros((2 * len(at), *self._model.sh.shape[1:]))
        sh[:, 0] = (both(colors) - 0.5) / SH_C0
        return GaussianModel(
            torch.from_numpy(np.stack([at + away, at - away], 1).reshape(-1, 3)).float(),
            both(quats),
            both(scales).log(),
            torch.full((len(sh),), _OPACITY).logit(),
            sh,
            self._model.light,
            gloss,
            None if self._model.bared is None else torch.zeros_like(sh[:, 0]),
        )

    def _gloss(self, points: np.ndarray, colors: np.ndarray, normals: np.ndarray) -> Tensor | None:
        """`gloss` [2 P, 8] of the faces at points [P, 3], m, at rest, of colours [P, 3] and with normals [P, 3] of the cut: of their own
        light they reflect as much as the skin nearby."""
        if self._model.gloss is None:
            return None
        near = self._nearest(points)
        skin = self._model.gloss[self._solid[near]]
        share = light_of(colors) / np.maximum(light_of(self._colors[near]).mean(1), 1e-9)
        sheen = softplus(skin[..., 6]).mean(1) * torch.from_numpy(share).float()
        normals = np.stack([-normals, normals], 1).reshape(-1, 3)  # each face looks at the other
        gloss = torch.cat([torch.from_numpy(normals).float(), skin[:, 0, 3:].repeat_interleave(2, 0)], 1)
        return without_glints(gloss, sheen.repeat_interleave(2, 0))

    def _cover(self, triangle: np.ndarray) -> np.ndarray:
        """New places on a triangle [3, 3], as rows [P, 8]: where, the normal, the standard deviation that covers it, m, and 1 for each
        fourth, which are a square lattice of their own.

        They are where lines through a square lattice along the axis that is nearest to the normal meet the triangle, so that triangles
        side by side share no place and leave no gap.
        """
        grain, nothing = self._config.grain, np.zeros((0, 8))
        normal = np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
        normal = normal / max(np.linalg.norm(normal), 1e-30)
        axis = int(np.abs(normal).argmax())
        plane = [each for each in range(3) if each != axis]
        low, high = (np.clip(corner, self._low, self._high)[plane] for corner in (triangle.min(0), triangle.max(0)))
        first, last = np.ceil(low / grain - 0.5), np.floor(high / grain - 0.5)
        if not normal.any() or (last < first).any():
            return nothing
        cells = np.stack(np.meshgrid(*(np.arange(*ends) for ends in zip(first, last + 1)), indexing="ij"), -1).reshape(-1, 2)
        flat, corners = (cells + 0.5) * grain, triangle[:, plane]
        ahead = np.roll(corners, -1, 0) - corners
        side = ahead[:, 0] * (flat[:, None, 1] - corners[:, 1]) - ahead[:, 1] * (flat[:, None, 0] - corners[:, 0])
        within = (side >= 0).all(1) | (side <= 0).all(1)
        cells, flat = cells[within], flat[within]
        height = triangle[0, axis] - (flat - triangle[0, plane]) @ normal[plane] / normal[axis]
        keys = [(axis, *key) for key in np.column_stack([cells, np.round(height / grain)]).astype(int).tolist()]
        new = [key not in self._covered for key in keys]
        self._covered.update(keys)
        rows = np.empty((len(flat), 8))
        rows[:, plane], rows[:, axis], rows[:, 3:6] = flat, height, normal
        rows[:, 6], rows[:, 7] = _WIDE * grain / abs(normal[axis]), (cells % 2 == 0).all(1)
        return rows[new]


def _divided(rows: np.ndarray, grain: float) -> np.ndarray:
    """Four rows of half the size in place of each of those that `_cover` gives [P, 8]."""
    axis = np.abs(rows[:, 3:6]).argmax(1)
    parts = []
    for signs in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        part, lines = rows.copy(), np.arange(len(rows))
        along = np.zeros((len(rows), 3))
        for step, sign in zip((1, 2), signs):
            along[lines, (axis + step) % 3] = sign * grain / 4
        along[lines, axis] = -(along * rows[:, 3:6]).sum(1) / rows[lines, 3 + axis]  # stay on the triangle's plane
        part[:, :3] += along
        part[:, 6] /= 2
        part[:, 7] = 1
        parts.append(part)
    return np.concatenate(parts)


def open_share(rest: Tensor, means: Tensor, grain: float) -> Tensor:
    """Return how much of pairs on the faces of cuts counts [2 P], 0 to 1: nothing until the two have moved apart.

    Args:
        rest: Their centres at rest [2 P, 3], m.
        means: The same now.
        grain: Of the configuration, m.
    """
    gap, before = ((each[::2] - each[1::2]).norm(dim=1) for each in (means, rest))
    return ((gap - before) / (_HIDDEN * grain) - 0.2).clamp(0, 1).repeat_interleave(2)


def light_of(colors: np.ndarray) -> np.ndarray:
    """Light [...] of encoded colours [..., 3], which are roughly its root."""
    return (colors**2).mean(-1)


class OrganColors:
    """Colours of points, averaged with a bell curve.

    Args:
        points: [P, 3], m.
        colors: [P, 3].
        size: Width of the curve, m.
    """

    def __init__(self, points: np.ndarray, colors: np.ndarray, size: float) -> None:
        _, cells, counts = np.unique(np.floor((points - points.min(0)) / (size / 4)), axis=0, return_inverse=True, return_counts=True)
        sums = np.stack([np.bincount(cells.ravel(), each) for each in np.hstack([points, colors]).T], 1)
        self._centres, self._colors, self._counts, self._size = sums[:, :3] / counts[:, None], sums[:, 3:], counts, size
        self._tree = KDTree(self._centres)

    def at(self, places: np.ndarray) -> np.ndarray:
        """Colours [M, 3] around places [M, 3], m."""
        near = _query(self._tree, places, _CELLS)
        off = ((places[:, None] - self._centres[near]) ** 2).sum(2)
        weights = np.exp(-2 * (off - off.min(1, keepdims=True)) / self._size**2)  # of the nearest cell 1, however far it is
        return (weights[..., None] * self._colors[near]).sum(1) / (weights * self._counts[near]).sum(1)[:, None]


def _share(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Values as parts of the way from low to high, 0 to 1."""
    return np.clip((values - low) / (high - low), 0, 1)


def _query(tree: KDTree, points: np.ndarray, count: int) -> np.ndarray:
    """Numbers of the count points of a tree [P, count] that are nearest to points [P, 3], nearest first; all where there are fewer."""
    ranks: Any = list(range(1, min(count, tree.n) + 1))
    return np.asarray(tree.query(points, k=ranks)[1])


def value_noise(points: np.ndarray, size: float, seed: int) -> np.ndarray:
    """Value noise [P] from −1 to 1 at points [P, 3], m, that varies over so many metres."""
    lattice = np.floor(points / size)
    share = points / size - lattice
    share = share * share * (3 - 2 * share)
    corner, noise = lattice.astype(np.int64), np.zeros(len(points))
    for step in np.ndindex(2, 2, 2):
        weight = np.where(step, share, 1 - share).prod(1)
        noise += weight * _random(corner + step, seed)
    return 2 * noise - 1


def _random(cells: np.ndarray, seed: int) -> np.ndarray:
    """A number from 0 to 1 [P] for each cell [P, 3] of a lattice, the same on all machines."""
    x, y, z = cells.astype(np.uint64).T
    with np.errstate(over="ignore"):
        h = x * np.uint64(0x9E3779B97F4A7C15) ^ y * np.uint64(0xC2B2AE3D27D4EB4F) ^ z * np.uint64(0x165667B19E3779F9) ^ np.uint64(seed)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            h = (h ^ h >> np.uint64(shift)) * np.uint64(factor)
    return (h >> np.uint64(40)).astype(np.float64) / 2**24
