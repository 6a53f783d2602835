"""The Gaussian model (structure of arrays) and its PLY files, in the INRIA layout and in SuperSplat's compressed one."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from torch import Tensor

from endo_sim_ros.core import compressed_ply
from endo_sim_ros.core.cameras import rotation_numbers
from endo_sim_ros.core.compressed_ply import SH_C0
from endo_sim_ros.core.errors import ModelError as ModelError
from endo_sim_ros.core.folders import written_whole
from endo_sim_ros.core.light import Light

GLOSS_FIELDS = ("normal_x", "normal_y", "normal_z", "film_x", "film_y", "film_z", "sheen", "glint")
"""Field names of what is reflected, in files and messages."""
BARED_FIELDS = ("bared_0", "bared_1", "bared_2")
"""Field names of what is added to f_dc as tissue is strained, in files and messages."""
_LAYERS = {"gloss": GLOSS_FIELDS, "bared": BARED_FIELDS}  # elements of a PLY file: other programs read the vertices and ignore these
_COMPRESSED = ".compressed.ply"  # ending of the names of compressed models, as SuperSplat has it
_LIGHT = "endo_sim_light"  # mark of the comment that holds the light
_LONGEST_HEADER = 65536  # bytes of a PLY file; that of a model of degree 3 has 1500
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class GaussianModel:
    """N anisotropic 3D Gaussians as 3D Gaussian Splatting stores them (before activation).

    Args:
        means: Centres [N, 3], metres, world.
        quats: Rotations wxyz [N, 4], not necessarily normalised.
        log_scales: Logarithm of the standard deviations along the rotated axes [N, 3], log metres.
        logit_opacities: Logit of the opacity [N].
        sh: Spherical harmonic colour coefficients [N, (degree + 1)², 3], degree 0 to 3.
        light: What makes an image of the rendered colours; None: they are the image.
        gloss: How each reflects the light [N, 8]: the normals of its surface and of the wet film on it, world, not necessarily
            normalised, and what the strengths of sheen and of glints are the `softplus` of, see `reflections`. None: nothing reflects.
        bared: What is added to the coefficients sh[:, 0] as tissue is strained [N, 3], see `rendering.bared_colors`: from colours of what
            others hide to those that are seen in front of it. None: nothing.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    sh: Tensor
    light: Light | None = None
    gloss: Tensor | None = None
    bared: Tensor | None = None

    def __post_init__(self):
        n = len(self.means)
        shapes = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "logit_opacities": (n,)}
        shapes |= {name: (n, len(fields)) for name, fields in _LAYERS.items()}
        for name, shape in shapes.items():
            if getattr(self, name) is not None and tuple(getattr(self, name).shape) != shape:
                raise ModelError(f"Gaussian model: {name} has shape {tuple(getattr(self, name).shape)}, expected {shape}")
        if self.sh.ndim != 3 or self.sh.shape[0] != n or self.sh.shape[1] not in (1, 4, 9, 16) or self.sh.shape[2] != 3:
            raise ModelError(f"Gaussian model: sh has shape {tuple(self.sh.shape)}, expected [{n}, 1|4|9|16, 3]")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def reflects(self) -> bool:
        """Whether its colours depend on where it is seen from by `gloss`, whose lobes its light has; never beside harmonics that do so."""
        return self.gloss is not None and self.light is not None and not self.sh_degree

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return int(round(self.sh.shape[1] ** 0.5)) - 1

    @property
    def scales(self) -> Tensor:
        """Standard deviations [N, 3], metres."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """Opacities in (0, 1) [N]."""
        return self.logit_opacities.sigmoid()

    @property
    def base_colors(self) -> Tensor:
        """View-independent RGB [N, 3], clamped to [0, 1]."""
        return (self.sh[:, 0] * SH_C0 + 0.5).clamp(0, 1)

    @property
    def rotations(self) -> Tensor:
        """Rotation matrices [N, 3, 3]."""
        return rotation_matrices(self.quats)

    @property
    def covariances(self) -> Tensor:
        """World covariances R diag(s²) Rᵀ [N, 3, 3], m²."""
        R = self.rotations
        half = R * self.scales[:, None]
        return half @ half.transpose(1, 2)

    def tensors(self) -> dict[str, Tensor]:
        """The arrays by field name: five, `gloss` where something reflects, and `bared` where something hides."""
        names = ("means", "quats", "log_scales", "logit_opacities", "sh", *_LAYERS)
        return {name: value for name in names if (value := getattr(self, name)) is not None}

    def to(self, device: str | torch.device) -> GaussianModel:
        """The model on another device."""
        return dataclasses.replace(self, **{name: value.to(device) for name, value in self.tensors().items()})

    def detach(self) -> GaussianModel:
        """The model without gradients."""
        return dataclasses.replace(self, **{name: value.detach() for name, value in self.tensors().items()})

    def select(self, index: Tensor | np.ndarray | slice) -> GaussianModel:
        """Return the K Gaussians with these numbers [K], or at which a boolean mask [N] is true; the light stays."""
        return dataclasses.replace(self, **{name: value[index] for name, value in self.tensors().items()})

    @staticmethod
    def from_points(points: Tensor, colors: Tensor, scales: Tensor, opacity: float = 0.5, sh_degree: int = 0) -> GaussianModel:
        """Isotropic Gaussians at points [N, 3] (m) with RGB colours [N, 3] in [0, 1] and standard deviations [N] (m)."""
        n = len(points)
        sh = points.new_zeros(n, (sh_degree + 1) ** 2, 3)
        sh[:, 0] = (colors - 0.5) / SH_C0
        quats = points.new_zeros(n, 4)
        quats[:, 0] = 1
        return GaussianModel(
            points.clone(),
            quats,
            scales.clamp_min(1e-9).log()[:, None].repeat(1, 3),
            torch.full_like(scales, opacity).logit(),
            sh,
        )


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions wxyz [N, 4], which need not be normalised; zero means no rotation."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    return torch.stack(rotation_numbers(w, x, y, z), 1).view(-1, 3, 3)


def ply_fields(sh_degree: int) -> list[str]:
    """Field names of the INRIA layout, in file order, without the unused normals."""
    rest = 3 * ((sh_degree + 1) ** 2 - 1)
    return (
        ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"]
        + [f"f_rest_{i}" for i in range(rest)]
        + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    )


def to_columns(model: GaussianModel) -> np.ndarray:
    """The model as a float32 matrix [N, len(ply_fields(degree))] whose columns are `ply_fields`."""
    t = {name: value.detach().cpu().float() for name, value in model.tensors().items()}
    rest = t["sh"][:, 1:].transpose(1, 2).flatten(1)  # channel-major, as INRIA's files have it
    columns = [t["means"], t["sh"][:, 0], rest, t["logit_opacities"][:, None], t["log_scales"], t["quats"]]
    return torch.cat(columns, 1).numpy()


def from_columns(columns: dict[str, np.ndarray], source: str) -> GaussianModel:
    """The model of named columns [N] each; other columns are ignored.

    Raises:
        ModelError: If a field or a row of some is missing, values are not finite, or the number of f_rest fields fits no SH degree.
    """
    rest_count = sum(name.startswith("f_rest_") for name in columns)
    degrees = {3 * ((degree + 1) ** 2 - 1): degree for degree in range(4)}
    if rest_count not in degrees:
        raise ModelError(f"{source}: {rest_count} f_rest_* fields fit no SH degree; expected one of {sorted(degrees)}")
    layers = {name: fields for name, fields in _LAYERS.items() if fields[0] in columns}
    missing = [name for name in (*ply_fields(degrees[rest_count]), *sum(layers.values(), ())) if name not in columns]
    if missing:
        raise ModelError(f"{source}: missing field {', '.join(missing[:4])}; a Gaussian model has INRIA's field names")

    for name, fields in layers.items():
        if (rows := len(columns[fields[0]])) != len(columns["x"]):
            raise ModelError(f"{source}: {name} has {rows} rows for {len(columns['x'])} Gaussians; write or reconstruct it again")

    def stack(names: Iterable[str]) -> Tensor:
        return torch.from_numpy(np.stack([np.asarray(columns[name], np.float32) for name in names], 1))

    dc, rest = stack([f"f_dc_{i}" for i in range(3)]), None
    if rest_count:
        rest = stack([f"f_rest_{i}" for i in range(rest_count)]).reshape(len(dc), 3, -1).transpose(1, 2)
    model = GaussianModel(
        stack("xyz"),
        stack([f"rot_{i}" for i in range(4)]),
        stack([f"scale_{i}" for i in range(3)]),
        stack(["opacity"])[:, 0],
        dc[:, None] if rest is None else torch.cat([dc[:, None], rest], 1),
        gloss=stack(GLOSS_FIELDS) if "gloss" in layers else None,
        bared=stack(BARED_FIELDS) if "bared" in layers else None,
    )
    for name, value in model.tensors().items():
        # An opacity of exactly 0 or 1 has an infinite logit, which the sigmoid maps back.
        bad = value.isnan() if name == "logit_opacities" else ~value.isfinite()
        if bad.any():
            index = int(bad.reshape(len(model), -1).any(1).nonzero()[0])
            raise ModelError(f"{source}: {name} of Gaussian {index} is not finite; remove it or reconstruct again")
    return model


def save_ply(model: GaussianModel, path: str | Path) -> None:
    """Write a binary PLY that SuperSplat, viser and other 3DGS viewers open. Written whole or not at all.

    What they ignore follows: the light is a comment in the header, what is reflected and what is bared are elements behind the vertices. A
    name that ends in .compressed.ply makes it SuperSplat's compressed layout, which other viewers may not read.
    """
    path = Path(path)
    columns, names = to_columns(model), ply_fields(model.sh_degree)
    layers = {name: tensor.detach().cpu().float().numpy() for name, tensor in model.tensors().items() if name in _LAYERS}
    for name, values in layers.items():
        if not np.isfinite(values).all():
            raise ModelError(f"{path}: {name} is not finite in {(~np.isfinite(values)).any(1).sum()} Gaussians; nothing is written")
    if path.name.endswith(_COMPRESSED) and len(model):
        chunks, vertices, harmonics, layers = compressed_ply.pack(dict(zip(names, columns.T)), layers)
        elements = [
            ("chunk", "float", compressed_ply.CHUNK_FIELDS, chunks.astype("<f4")),
            ("vertex", "uint", compressed_ply.VERTEX_FIELDS, vertices.astype("<u4")),
        ]
        if harmonics.size:
            elements.append(("sh", "uchar", [name for name in names if name.startswith("f_rest_")], harmonics))
    else:
        columns = np.concatenate([columns[:, :3], np.zeros((len(model), 3), np.float32), columns[:, 3:]], 1)
        elements = [("vertex", "float", names[:3] + ["nx", "ny", "nz"] + names[3:], columns.astype("<f4"))]
    for name, values in layers.items():
        elements.append((name, "char" if values.dtype == np.int8 else "float", list(_LAYERS[name]), values))
    lines = ["ply", "format binary_little_endian 1.0"]
    if model.light is not None:
        lines.append(f"comment {_LIGHT} {model.light.to_json()}")
    for name, kind, fields, array in elements:
        lines += [f"element {name} {len(array)}", *(f"property {kind} {field}" for field in fields)]
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as partial, partial.open("wb") as file:
        file.write("\n".join([*lines, "end_header", ""]).encode())
        for *_, array in elements:
            file.write(np.ascontiguousarray(array).data)


def load_ply(path: str | Path) -> GaussianModel:
    """Read a 3DGS PLY of SH degree 0 to 3, binary or ASCII, or one in SuperSplat's compressed layout.

    Raises:
        ModelError: If the file is absent, a folder, not a PLY, truncated, or lacks a field; the message names the file.
    """
    path = Path(path)
    if path.is_dir():
        raise ModelError(f"{path}: a folder; give a PLY file, as its model.ply")
    if not path.is_file():
        raise ModelError(f"{path}: no such file")
    try:
        with path.open("rb") as file:
            elements, light = _read_elements(file, path.stat().st_size)
        columns, layers = elements.pop("vertex"), {name: elements.pop(name) for name in _LAYERS if name in elements}
        if elements:
            columns = compressed_ply.unpack(elements.get("chunk", {}), columns, elements.get("sh", {}))
            layers = compressed_ply.unpack_layers(layers)
        for fields in layers.values():
            columns |= fields
    except (OSError, ValueError) as error:
        raise ModelError(f"{path}: not a readable PLY model ({error})") from error
    return dataclasses.replace(from_columns(columns, str(path)), light=light)


def _read_elements(file: BinaryIO, size: int) -> tuple[dict[str, dict[str, np.ndarray]], Light | None]:
    """The columns of the elements of a PLY file of a size in bytes, and the light: of `vertex`, and of a compressed model's others.

    What the header claims is held against the size of the file before any memory is asked for.
    """
    head = file.read(_LONGEST_HEADER)
    end = re.search(rb"\nend_header[ \t\r]*\n", head)
    if not head.startswith(b"ply") or end is None:
        raise ValueError(f"no PLY header within {_LONGEST_HEADER} bytes")
    order, light, fields = "", None, []
    elements: dict[str, tuple[int, list[tuple[str, str]]]] = {}
    for line in head[: end.start()].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case ["format", layout, "1.0"] if layout in _ORDERS:
                order = _ORDERS[layout]
            case ["element", name, _] if "vertex" in elements and name not in ("sh", *_LAYERS):
                break  # what follows the vertices does not matter
            case ["element", name, number] if name not in elements:
                fields = []
                elements[name] = int(number), fields
            case ["property", kind, field] if kind in _TYPES and elements:
                fields.append((field, order + _TYPES[kind]))
            case ["comment", mark, *_] if mark == _LIGHT:
                light = Light.from_json(line.split(_LIGHT, 1)[1])
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"its header has {line[:60]!r}, which no Gaussian model has")
    begins = ("vertex",) if order == "=" else ("vertex", "chunk")
    if next(iter(elements), "") not in begins or "vertex" not in elements or not order or not all(f for _, f in elements.values()):
        raise ValueError("its header has no format, or its data does not begin with vertices")
    columns, start = {}, end.end()
    for name, (count, fields) in elements.items():
        array = _read_rows(file, start, size - start, name, count, np.dtype(fields), order == "=")
        columns[name] = {field: array[field] for field, _ in fields}
        start += array.nbytes
        if order == "=":
            break
    return columns, light


def _read_rows(file: BinaryIO, start: int, room: int, name: str, count: int, dtype: np.dtype, text: bool) -> np.ndarray:
    """Rows of an element as a structured array [count], from where they start, of so many bytes as there are."""
    least = 2 * len(dtype.names or ()) if text else dtype.itemsize  # bytes of a row; as text a digit and a blank, the last one optional
    if not 0 <= count <= (room + text) // least:
        what = "vertices" if name == "vertex" else f"rows of {name}"
        raise ValueError(f"its header claims {count} {what} of {least} bytes or more, {room} bytes follow")
    if not count:
        return np.empty(0, dtype)
    if not text:
        return np.memmap(file, dtype, "r", start, (count,))
    file.seek(start)
    rows = np.loadtxt(file, dtype, comments=None, max_rows=count, ndmin=1)
    if len(rows) < count:
        raise ValueError(f"its header claims {count} vertices, {len(rows)} follow")
    return rows
