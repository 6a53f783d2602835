"""SuperSplat's compressed PLY: 16 bytes a Gaussian instead of 68, without colours that change with the direction.

Gaussians are ordered along a Morton curve. Every 256 of them share a chunk with the bounds of their positions, logarithmic
scales and colours, between which each has 8 to 11 bits: the layout has no scale of its own, so that millimetres of tissue
keep their sharpness. Source: `read-compressed-ply` and `write-compressed-ply` of PlayCanvas's splat-transform.
"""

import numpy as np

SH_C0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))
CHUNK = 256
_QUANTITIES = (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
CHUNK_FIELDS = [f"{end}_{name}" for names in _QUANTITIES for end in ("min", "max") for name in names]
VERTEX_FIELDS = [f"packed_{name}" for name in ("position", "rotation", "scale", "color")]
_VECTOR, _COLOR, _OTHERS = (11, 10, 11), (8, 8, 8, 8), (10, 10, 10)  # bits of a position or scale, colour, three of a quaternion
_LARGEST_SCALE = 20.0  # logarithm
_STEPS = {  # of a byte for one: of normals and strengths, and of coefficients of colours
    "gloss": np.array([127] * 6 + [16] * 2),
    "bared": np.array([32] * 3),
}


def pack(
    columns: dict[str, np.ndarray], layers: dict[str, np.ndarray] = {}
) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Chunks [C, 18] float32, vertices [N, 4] uint32, harmonics [N, 0 | 9 | 24 | 45] uint8 and layers [N, fields] int8 of a model.

    Args:
        columns: `gaussians.ply_fields` by name, [N] each.
        layers: `gloss` [N, 8] and `bared` [N, 3] of the model where it has them, which SuperSplat does not know.
    """
    stack = lambda *names: np.stack([columns[name] for name in names], 1).astype(np.float64)
    means = stack("x", "y", "z")
    order = _morton(means)
    scales = stack("scale_0", "scale_1", "scale_2").clip(-_LARGEST_SCALE, _LARGEST_SCALE)
    colors = stack("f_dc_0", "f_dc_1", "f_dc_2") * SH_C0 + 0.5
    of_chunk, starts = np.arange(len(order)) // CHUNK, np.arange(0, len(order), CHUNK)
    chunks, shares = [], []
    for values in (means[order], scales[order], colors[order]):
        values = values.astype(np.float32).astype(np.float64)
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        chunks += [low, high]
        shares.append((values - low[of_chunk]) / np.maximum(high - low, 1e-30)[of_chunk])
    quats = stack("rot_0", "rot_1", "rot_2", "rot_3")[order]
    quats /= np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)
    largest = np.abs(quats).argmax(1)
    quats *= np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1, 1)
    others = quats[np.arange(4) != largest[:, None]].reshape(-1, 3)
    opacity = 1 / (1 + np.exp(-stack("opacity")[order].clip(-80, 80)))
    vertices = [
        _join(shares[0], _VECTOR),
        _join(others * 0.5**0.5 + 0.5, _OTHERS) | largest.astype(np.uint32) << 30,
        _join(shares[1], _VECTOR),
        _join(np.column_stack([shares[2], opacity]), _COLOR),
    ]
    rest = [f"f_rest_{i}" for i in range(len(columns) - 14)]
    harmonics = (stack(*rest)[order] * 32 + 128).clip(0, 255) if rest else np.empty((len(order), 0))
    layers = {name: values[order] for name, values in layers.items()}
    if "gloss" in layers:
        for normals in np.split(layers["gloss"][:, :6], 2, 1):
            normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-30)
    layers = {name: np.rint(values * _STEPS[name]).clip(-127, 127).astype(np.int8) for name, values in layers.items()}
    return np.concatenate(chunks, 1).astype(np.float32), np.stack(vertices, 1), harmonics.astype(np.uint8), layers


def unpack_layers(layers: dict[str, dict[str, np.ndarray]]) -> dict[str, dict[str, np.ndarray]]:
    """The columns of the elements gloss and bared as they were before `pack`, normals of length one."""
    return {
        layer: {name: np.asarray(values, np.float32) / steps for (name, values), steps in zip(fields.items(), _STEPS[layer])}
        for layer, fields in layers.items()
    }


def unpack(chunks: dict[str, np.ndarray], vertices: dict[str, np.ndarray], harmonics: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns that `pack` took, in the order of the file, of the elements chunk, vertex and sh.

    Raises:
        ValueError: If a field is missing, or there are not as many chunks or harmonics as Gaussians need.
    """
    colored = "min_r" in chunks  # older files have plain colours
    missing = [name for name in CHUNK_FIELDS[: 18 if colored else 12] if name not in chunks]
    missing += [name for name in VERTEX_FIELDS if name not in vertices]
    if missing:
        raise ValueError(f"missing field {', '.join(missing[:4])} of a compressed model")
    count, found = len(vertices["packed_position"]), len(chunks["min_x"])
    if found != -(-count // CHUNK) or any(len(values) != count for values in harmonics.values()):
        raise ValueError(f"{found} chunks or their harmonics do not fit {count} Gaussians, {CHUNK} a chunk")
    of_chunk = np.arange(count) // CHUNK

    def between(shares: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
        low, high = (np.stack([chunks[f"{end}_{name}"] for name in names], 1).astype(np.float64)[of_chunk] for end in ("min", "max"))
        return low + shares * (high - low)

    packed = [np.asarray(vertices[name]).astype(np.uint32) for name in VERTEX_FIELDS]
    means, scales = between(_split(packed[0], _VECTOR), _QUANTITIES[0]), between(_split(packed[2], _VECTOR), _QUANTITIES[1])
    colors = _split(packed[3], _COLOR)
    base = between(colors[:, :3], _QUANTITIES[2]) if colored else colors[:, :3]
    others = (_split(packed[1], _OTHERS) - 0.5) * 2**0.5
    largest, quats = packed[1] >> 30, np.empty((count, 4))
    here = np.arange(4) == largest[:, None]
    quats[~here], quats[here] = others.ravel(), np.sqrt(np.maximum(1 - (others**2).sum(1), 0))
    opacity = colors[:, 3].clip(0.5 / 255, 1 - 0.5 / 255)  # within what was rounded, so that its logit is finite
    opacity = np.log(opacity) - np.log1p(-opacity)
    names = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
    values = np.column_stack([means, (base - 0.5) / SH_C0, opacity, scales, quats])
    return dict(zip(names, values.T)) | {name: (np.asarray(v) + 0.5) / 32 - 4 for name, v in harmonics.items()}


def _join(shares: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Numbers in [0, 1] [N, M] as one integer [N], the first in the highest bits."""
    joined = np.zeros(len(shares), np.uint32)
    for share, count in zip(shares.T, bits):
        joined = joined << count | (share.clip(0, 1) * (2**count - 1) + 0.5).astype(np.uint32)
    return joined


def _split(joined: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """The inverse of `_join` [N, M]."""
    ends = np.cumsum(bits[::-1])[::-1]
    return np.stack([(joined >> (end - count) & (2**count - 1)) / (2**count - 1) for end, count in zip(ends, bits)], 1)


def _morton(points: np.ndarray) -> np.ndarray:
    """Order [N] of points [N, 3] along a curve that keeps neighbours together."""
    low = points.min(0)
    grid = ((points - low) / max(float((points.max(0) - low).max()), 1e-30) * 1023).astype(np.uint64)
    code = sum((grid[:, axis] >> bit & 1) << (3 * bit + axis) for bit in range(10) for axis in range(3))
    return np.argsort(code, kind="stable")
