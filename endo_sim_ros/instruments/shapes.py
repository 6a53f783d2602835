"""The shapes of instruments: closed triangle meshes for pictures, and capsules for contact, built from a few dimensions of each tool.

Every part moves with one link, in whose frame its vertices are: ``roll``, ``wrist_pitch`` and ``wrist_yaw`` are the frames of these joints
(`ArmKinematics.link_frames`); ``jaw_left`` and ``jaw_right`` are that of the wrist's yaw turned about its z by minus and plus half the
opening angle.
"""

import functools
import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from endo_sim_ros.core.config import ConfigError
from endo_sim_ros.instruments.kinematics import ArmKinematics

__all__ = ["LINKS", "Capsule", "JawShape", "Material", "Part", "ToolShape", "build_instrument", "link_poses", "part_links"]

log = logging.getLogger(__name__)

LINKS = ("roll", "wrist_pitch", "wrist_yaw", "jaw_left", "jaw_right")
"""Names of the links, in the order in which `link_poses` gives them."""

_DISTAL_Z = np.eye(3)
"""Axes of a frame whose z points at the tip, in which shafts are built."""
_DISTAL_X = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
"""From those axes to the frame of the wrist's pitch, which turns about z and whose x points at the tip."""
_DISTAL_Y = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""From those axes to the frame of the wrist's yaw and the jaws, which turn about z and whose y points at the tip."""

_CREASE = np.cos(np.radians(35))  # faces that meet at a smaller angle are one smooth surface


class Material(IntEnum):
    """What a surface is made of."""

    STEEL = 0
    SHAFT = 1
    """Carbon-fibre composite: black, dull."""
    INSULATION = 2
    """Polymer sleeves and covers of instruments for electrosurgery."""
    VESSEL = 3
    """The wet wall of a vessel or a duct."""
    DYE = 4
    """The same, dyed with methylene blue."""
    CLIP = 5
    """The polymer of clips that lock."""


@dataclass(frozen=True)
class Part:
    """A piece of an instrument: rigid, or bent where its corners move with several links.

    Args:
        link: Name of the link that it moves with, or counts as.
        material: What it is made of.
        vertices: Corners [V, 3], m, in the frame of the link.
        faces: Triangles [F, 3], whose corners go round counter-clockwise seen from outside.
        bones: Names of the links that the corners move with instead, and in whose frames they are, V of them; empty = all with `link`.
            Poses of these links may also scale.
        normals: At the corners [V, 3], in the same frames; None = those of the faces around.
    """

    link: str
    material: Material
    vertices: np.ndarray
    faces: np.ndarray
    bones: tuple[str, ...] = ()
    normals: np.ndarray | None = None

    @functools.cached_property
    def corner_normals(self) -> np.ndarray:
        """Normals [F, 3, 3] at the corners of each face: those of the part, or the mean of the faces around that lie about as it does."""
        if self.normals is not None:
            return self.normals[self.faces].astype(np.float64)
        corners = self.vertices[self.faces].astype(np.float64)
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # as long as the face is large
        unit = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-20)
        order = np.argsort(self.faces.ravel(), kind="stable")
        bounds = np.searchsorted(self.faces.ravel()[order], np.arange(len(self.vertices) + 1))
        normals = np.empty((len(self.faces), 3, 3))
        for first, last in zip(bounds[:-1], bounds[1:]):
            at = order[first:last]
            around = at // 3
            alike = unit[around] @ unit[around].T > _CREASE
            normals[around, at % 3] = alike @ across[around]
        return normals / np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-20)


def part_links(parts: Iterable[Part]) -> tuple[str, ...]:
    """Names of the links of parts, and then of those that only bend some, each once."""
    parts = list(parts)
    return tuple(dict.fromkeys([*(part.link for part in parts), *(bone for part in parts for bone in part.bones)]))


@dataclass(frozen=True)
class Capsule:
    """All points nearer than ``radius`` (m) to the line between ``start`` and ``end`` [3] (m, in the frame of the link).

    Where ``cuts`` the line is a cutting edge, such as a blade of scissors or the wire of a hook.
    """

    link: str
    start: np.ndarray
    end: np.ndarray
    radius: float
    cuts: bool = False


@dataclass(frozen=True)
class JawShape:
    """One of two jaws, or of two blades; lengths in metres.

    Args:
        length: From the axis of the wrist's yaw to the tip.
        base, tip: Width along that axis, and height across it, next to the axis and at the tip.
        curve: How far the tip lies off along that axis: dissectors and scissors are curved sideways.
        tooth: Distance between teeth of the gripping face; 0 = smooth.
        slot: Share of the width that a slot takes, as in fenestrated jaws; 0 = none.
        blade: Whether it is one of two blades that pass each other, side by side.
    """

    length: float
    base: tuple[float, float]
    tip: tuple[float, float]
    curve: float = 0.0
    tooth: float = 0.0
    slot: float = 0.0
    blade: bool = False


@dataclass(frozen=True)
class ToolShape:
    """The dimensions of a tool, metres.

    Args:
        jaws: Its two jaws, or None where a hook takes their place.
        hook: Length of the hook and of its bend, if there is one.
        radius: Of the shaft: 4 mm, or 2.5 mm of small instruments.
        cover: Whether a polymer sleeve covers the wrist.
        shaft: Length of shaft that is modelled; more is never in a picture.
    """

    jaws: JawShape | None = None
    hook: tuple[float, float] | None = None
    radius: float = 4.0e-3
    cover: bool = False
    shaft: float = 0.3


SHAPES: dict[str, ToolShape] = {
    "LARGE_NEEDLE_DRIVER": ToolShape(JawShape(10.2e-3, (4.2e-3, 2.4e-3), (2.6e-3, 1.3e-3), tooth=0.5e-3)),
    "PROGRASP_FORCEPS": ToolShape(JawShape(17.5e-3, (4.6e-3, 2.4e-3), (3.6e-3, 1.5e-3), tooth=1.0e-3, slot=0.34)),
    "MARYLAND_BIPOLAR_FORCEPS": ToolShape(JawShape(20.0e-3, (4.2e-3, 2.2e-3), (1.5e-3, 0.9e-3), curve=4.0e-3, tooth=0.9e-3), cover=True),
    "CURVED_SCISSORS": ToolShape(JawShape(15.0e-3, (1.7e-3, 2.9e-3), (0.7e-3, 0.8e-3), curve=2.6e-3, blade=True), cover=True),
    "LARGE_CLIP_APPLIER": ToolShape(JawShape(17.0e-3, (4.4e-3, 2.2e-3), (3.8e-3, 1.6e-3), slot=0.3)),
    "PERMANENT_CAUTERY_HOOK": ToolShape(hook=(12.0e-3, 4.5e-3), cover=True),
}
"""Dimensions of tools by the name of their kind, read off published photographs and drawings: right to about a millimetre."""


@dataclass
class _Builder:
    parts: list[Part] = field(default_factory=list)
    capsules: list[Capsule] = field(default_factory=list)

    def loft(self, link: str, material: Material, rings: Sequence[np.ndarray] | np.ndarray, axes: np.ndarray = _DISTAL_Z) -> None:
        """A closed tube through rings [S, K, 3], turned into the link's axes."""
        vertices, faces = lofted(np.asarray(rings))
        self.parts.append(Part(link, material, (vertices @ axes.T).astype(np.float32), faces))

    def capsule(
        self, link: str, start: ArrayLike, end: ArrayLike, radius: float, axes: np.ndarray = _DISTAL_Z, cuts: bool = False
    ) -> None:  # fmt: skip
        """A capsule between two points in the axes of a shaft, turned into the link's axes."""
        self.capsules.append(Capsule(link, axes @ np.asarray(start), axes @ np.asarray(end), radius, cuts))


def build_instrument(arm: ArmKinematics, shape: ToolShape | None = None) -> tuple[list[Part], list[Capsule]]:
    """The parts and capsules of the instrument of an arm: some thousand triangles.

    Args:
        arm: An arm with a wrist, such as a PSM.
        shape: Its dimensions; None = those in `SHAPES` of its tool, or of the most usual tool with a jaw or without one, with a warning.

    Raises:
        ConfigError: If the arm has no wrist.
    """
    if len(arm.joints) < 6:
        raise ConfigError(f"{arm.name} with {arm.tool or 'no tool'} has no wrist; only an arm with an instrument has a shape")
    kind = arm.tool.rstrip("_0123456789")
    if shape is None and kind not in SHAPES:
        kind = "LARGE_NEEDLE_DRIVER" if arm.jaw else "PERMANENT_CAUTERY_HOOK"
        log.warning("%s: nobody knows the shape of %s; it looks like a %s", arm.name, arm.tool or "its tool", kind)
    parts, capsules = _built(shape or SHAPES[kind], arm.joints[5].a)
    return list(parts), list(capsules)


@functools.lru_cache(maxsize=64)
def _built(shape: ToolShape, wrist: float) -> tuple[list[Part], list[Capsule]]:
    """Those of a tool whose axes of pitch and yaw are `wrist` m apart; kept, as each environment draws all tools."""
    build, r = _Builder(), shape.radius
    _shaft(build, shape)
    # Two ears hold the pin of the pitch; between them turns the second clevis, which holds that of the yaw.
    _clevis(build, -2.2 * r, 0.92 * r, 0.62 * r)
    _block(build, wrist, 0.9 * r, 0.5 * r)
    build.capsule("roll", (0, 0, -2.2 * r), (0, 0, -0.3 * r), 0.66 * r)
    build.capsule("wrist_pitch", (0, 0, 0), (0, 0, wrist), 0.8 * r, _DISTAL_X)
    if shape.cover:
        sleeve = [_circle(k * r, s * wrist, 40) for k, s in ((0.74, 0.3), (0.86, 0.38), (0.86, 0.68), (0.66, 0.82))]
        build.loft("wrist_pitch", Material.INSULATION, sleeve, _DISTAL_X)
    if shape.jaws:
        _jaw(build, "jaw_left", shape.jaws, 1.0, r)
        _jaw(build, "jaw_right", shape.jaws, -1.0, r)
    if shape.hook:
        _hook(build, shape)
    return build.parts, build.capsules


def link_poses(arm: ArmKinematics, joints: ArrayLike, jaw: ArrayLike = 0.0, base: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Poses [..., 4, 4] of the links that parts and capsules move with, by name.

    Args:
        arm: An arm with a wrist.
        joints: Joint positions [..., n], rad and m.
        jaw: Angle between the jaws [...], rad.
        base: Pose [..., 4, 4] of the base in the frame of the result; None = that is the base frame.

    Raises:
        ValueError: As `ArmKinematics.check_joints` does.
    """
    frames = arm.link_frames(joints)
    poses = {name: frames[..., i, :, :] for i, name in enumerate(LINKS[:3], 3)}  # files may name them otherwise
    for name, side in zip(LINKS[3:], (-0.5, 0.5)):
        angle = side * np.broadcast_to(np.asarray(jaw, np.float64), frames.shape[:-3])
        turn = np.zeros((*angle.shape, 4, 4))
        turn[..., 0, 0], turn[..., 0, 1], turn[..., 1, 0], turn[..., 1, 1] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
        turn[..., 2, 2] = turn[..., 3, 3] = 1
        poses[name] = poses["wrist_yaw"] @ turn
    return poses if base is None else {name: base @ pose for name, pose in poses.items()}


def lofted(rings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [S·K + 2, 3] and faces [F, 3] of a closed tube through rings [S, K, 3], whose ends are fans about their means.

    Faces go round counter-clockwise seen from outside, whichever way the rings go round.
    """
    count, size = rings.shape[:2]
    vertices = np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(1)])
    step, around = size * np.arange(count - 1)[:, None], np.arange(size)
    a, b = (step + around).ravel(), (step + np.roll(around, -1)).ravel()
    sides = np.concatenate([np.stack([a, b, b + size], 1), np.stack([a, b + size, a + size], 1)])
    last, following = size * (count - 1), np.roll(around, -1)
    first_cap = np.stack([np.full(size, count * size), following, around], 1)
    last_cap = np.stack([np.full(size, count * size + 1), last + around, last + following], 1)
    faces = np.concatenate([sides, first_cap, last_cap]).astype(np.int32)
    corners = vertices[faces]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return vertices, faces if volume > 0 else faces[:, ::-1]


def _circle(radius: float, z: float, count: int) -> np.ndarray:
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)], 1)


def _shaft(build: _Builder, shape: ToolShape) -> None:
    r, end = shape.radius, -2.2 * shape.radius
    stations = np.linspace(-shape.shaft, end - 1.6e-3, 13)  # long triangles would vanish whole where one corner is behind the lens
    build.loft("roll", Material.SHAFT, [_circle(r, z, 28) for z in stations])
    collar = [(0.99, 0.0), (1.03, 0.25e-3), (1.03, 1.3e-3), (0.93, 1.6e-3)]
    build.loft("roll", Material.STEEL, [_circle(k * r, end - 1.6e-3 + z, 40) for k, z in collar])
    build.capsule("roll", (0, 0, -shape.shaft), (0, 0, end), r)


def _stadium(half: float, start: float, end: float) -> np.ndarray:
    """Outline [K, 2] of a strip from ``start`` to a round end about ``end``, in (across, distal), counter-clockwise."""
    angle = np.linspace(0, np.pi, 13)
    return np.concatenate([[[-half, start], [half, start]], np.stack([half * np.cos(angle), end + half * np.sin(angle)], 1)])


def _slab(outline: np.ndarray, low: float, high: float, across: int, within: float = np.inf, bevel: float = 0.25e-3) -> np.ndarray:
    """Rings of an outline [K, 2] in (sideways, distal), extruded along the axis ``across`` (0 = x, 1 = y) with bevelled rims.

    Nothing reaches out of a cylinder of radius ``within`` about z.
    """
    middle = outline.mean(0)
    rings = []
    for at in np.concatenate([[low], np.linspace(low + bevel, high - bevel, 5), [high]]):
        rim = bevel if at in (low, high) else 0.0
        points = middle + (outline - middle) * (1 - rim / np.abs(outline - middle).max())
        side = np.sqrt(max(within**2 - at**2, 0.0))
        ring = np.empty((len(points), 3))
        ring[:, across], ring[:, 1 - across], ring[:, 2] = at, points[:, 0].clip(-side, side), points[:, 1]
        rings.append(ring)
    return np.array(rings)


def _fork(build: _Builder, link: str, ear: np.ndarray, inner: float, outer: float, half: float, pin: float, axes: np.ndarray) -> None:
    """Two ears, whose outline [K, 2] ends round about the next link's origin, and along y a pin, about which that turns.

    They reach from ``inner`` to ``outer`` on either side of the middle, within a cylinder of radius ``half``; ``pin`` is that of the pin.
    """
    for side in (-1.0, 1.0):
        build.loft(link, Material.STEEL, _slab(ear, *sorted((side * inner, side * outer)), across=1, within=half), axes)
    end = ear[:, 1].max() - np.abs(ear[:, 0]).max()
    rim = 1.05 * outer
    build.loft(link, Material.STEEL, _slab(_round(pin, end), -rim, rim, across=1), axes)


def _clevis(build: _Builder, start: float, half: float, gap: float) -> None:
    """The end of the shaft: a base and a fork in the gap of which the wrist pitches."""
    base = [_circle(k * half, start * (1 - s), 40) for k, s in ((1.0, 0.0), (1.0, 0.35), (0.9, 0.45))]
    build.loft("roll", Material.STEEL, base)
    _fork(build, "roll", _stadium(0.72 * half, 0.7 * start, 0.0), gap, 0.88 * half, half, 0.3 * half, _DISTAL_Z)


def _block(build: _Builder, end: float, half: float, gap: float) -> None:
    """The wrist: a hub about the pin of the pitch, and a fork, square to it, in the gap of which the jaws turn."""
    build.loft("wrist_pitch", Material.STEEL, _slab(_round(0.62 * half, 0.0), -0.6 * half, 0.6 * half, across=0), _DISTAL_X)
    base = [_circle(k * half, s * end, 40) for k, s in ((0.6, 0.15), (0.8, 0.3), (0.8, 0.5), (0.7, 0.6))]
    build.loft("wrist_pitch", Material.STEEL, base, _DISTAL_X)
    _fork(build, "wrist_pitch", _stadium(0.62 * half, 0.35 * end, end), gap, 0.8 * half, half, 0.28 * half, _DISTAL_X)


def _round(radius: float, at: float) -> np.ndarray:
    return _circle(radius, 0.0, 28)[:, :2] + [0.0, at]


def _jaw(build: _Builder, link: str, shape: JawShape, side: float, radius: float) -> None:
    """One jaw: a hub about the pin of the yaw and a beam that tapers to the tip; its gripping face lies in the plane x = 0."""
    half = 0.4 * radius / 2  # a hub takes one half of the gap between the ears
    middle = side * half if not shape.blade else side * shape.base[0] / 2
    turn = lambda ring: ring if side > 0 else ring * [-1, 1, 1]  # the other jaw is the mirror image
    build.loft(link, Material.STEEL, _slab(_round(0.5 * radius, 0.0), middle - half, middle + half, 1), _DISTAL_Y)
    count = max(int(shape.length / shape.tooth) * 2, 12) if shape.tooth else 24
    stations = np.linspace(0.15, 1.0, count + 1)
    for low, high in _prongs(shape.slot):
        rings = [turn(_beam(shape, s, i, low, high, side)) for i, s in enumerate(stations)]
        build.loft(link, Material.STEEL, rings, _DISTAL_Y)
    bend = lambda s: np.array([side * 0.25 * (shape.base[1] + shape.tip[1]), _bend(shape, s, side), s * shape.length])
    thick = lambda s: 0.5 * min(_mix(shape.base, shape.tip, s))
    for s in (0.0, 0.5):
        build.capsule(link, bend(s), bend(s + 0.5), thick(s + 0.25), _DISTAL_Y, shape.blade)


def _prongs(slot: float) -> list[tuple[float, float]]:
    """Shares of the width, from −1 to 1, that the beams of a jaw take."""
    return [(-1.0, -slot), (slot, 1.0)] if slot else [(-1.0, 1.0)]


def _mix(base: tuple[float, float], tip: tuple[float, float], share: float) -> tuple[float, float]:
    """Width and height at a share of the length; they taper late, and round off in the end."""
    taper = share**1.4
    close = np.sqrt(max(1 - max(share - 0.93, 0) ** 2 / 0.0064, 0.12))
    width, height = (a + (b - a) * taper for a, b in zip(base, tip))
    return width * close, height * close


def _bend(shape: JawShape, share: float, side: float) -> float:
    """Where the middle of a jaw lies along the axis of the yaw, at a share of its length."""
    return shape.curve * share**2 + (side * shape.base[0] / 2 * (1 - 0.6 * share) if shape.blade else 0.0)


def _beam(shape: JawShape, share: float, index: int, low: float, high: float, side: float) -> np.ndarray:
    """The section [K, 3] of the jaw on the side of positive x at a share of its length; every second one is the bottom of a tooth."""
    width, height = _mix(shape.base, shape.tip, share)
    face = 0.12 * height * (index % 2) if shape.tooth and 0.3 < share < 0.97 else 0.0
    back = np.linspace(0, np.pi, 9)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    # Round on its back, flat on the face; a blade is a wedge whose edge lies on the face.
    x = face + (height - face) * (0.35 + 0.65 * np.sin(back)) if not shape.blade else height * (0.25 + 0.75 * np.sin(back) ** 0.7)
    y = 0.5 * width * (middle - half * np.cos(back))
    x, y = np.concatenate([[face], x, [face]]), np.concatenate([[y[0]], y, [y[-1]]])
    if shape.blade:
        x[0] = x[-1] = -0.15 * height  # blades overlap, so that they shear
    return np.stack([x, y[::-1] + _bend(shape, share, side), np.full(len(x), share * shape.length)], 1)


def _hook(build: _Builder, shape: ToolShape) -> None:
    """An L-shaped wire that leaves an insulated cone."""
    assert shape.hook
    length, bend = shape.hook
    r = shape.radius
    cone = [_circle(k * r, z, 32) for k, z in ((0.55, -0.3 * r), (0.6, 0.3 * r), (0.34, 0.35 * length), (0.3, 0.5 * length))]
    build.loft("wrist_yaw", Material.INSULATION, cone, _DISTAL_Y)
    wire, turn = 0.6e-3, 1.6e-3
    path = [np.array([0.0, 0, z]) for z in np.linspace(0.45, 1.0, 6) * (length - turn)]
    path += [np.array([turn * (1 - np.cos(a)), 0, length - turn + turn * np.sin(a)]) for a in np.linspace(0.2, np.pi / 2, 8)]
    path += [np.array([x, 0, length]) for x in np.linspace(turn, bend, 4)[1:]]
    build.loft("wrist_yaw", Material.STEEL, _swept(np.array(path), lambda s: wire * (1.0 if s < 0.9 else 1.0 - 4 * (s - 0.9))), _DISTAL_Y)
    build.capsule("wrist_yaw", (0, 0, 0), (0, 0, 0.5 * length), 0.35 * r, _DISTAL_Y)
    build.capsule("wrist_yaw", (0, 0, 0.5 * length), (0, 0, length), wire, _DISTAL_Y, cuts=True)
    build.capsule("wrist_yaw", (0, 0, length), (bend, 0, length), wire, _DISTAL_Y, cuts=True)


def _swept(path: np.ndarray, radius: Callable[[float], float]) -> np.ndarray:
    """Circles [S, K, 3] about a path [S, 3] in the plane of x and z, of a radius that depends on the share of the way."""
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.stack([along[:, 2], np.zeros(len(path)), -along[:, 0]], 1)
    angle = 2 * np.pi * np.arange(20) / 20
    shares = np.linspace(0, 1, len(path))
    circles = [radius(s) * (np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * np.array([0.0, 1, 0])) for s, x in zip(shares, side)]
    return path[:, None] + np.array(circles)
