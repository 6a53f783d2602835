"""A procedural patient: wet, vessel-covered organs in front of a peritoneal wall, filmed by an endoscope.

Everything is a deterministic function of the seed and known exactly: poses, depth, stereo, calibration. The four parts
are `_Anatomy` (surface: a height field of a wall, an organ, a ligament and a lobe, the nearest of which is seen),
`_Paint` (texture: mottling, fat, fibres and branching vessels), `render_phantom` (shading: a light beside the lens)
and `phantom_poses` (path: an endoscope that pivots about its trocar).

World frame: the wall is around z = 0.14 m and faces the endoscope, whose tip moves about the origin and looks along +z.
"""

import functools
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import cv2
import numpy as np
import warp as wp

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.config import Range, StageConfig
from endo_sim_ros.core.device import cpu_threads, init_warp
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.sequences import phantom_kernels as kernels


@dataclass(frozen=True)
class PhantomConfig(StageConfig):
    """The synthetic patient and the endoscope that films it."""

    seed: Annotated[int, Range(0, 2**31 - 1)] = 0
    """Patient: anatomy, colours, vessels and camera path all follow from it."""
    frames: Annotated[int, Range(1, 100_000)] = 250
    """Length of the sequence."""
    fps: Annotated[float, Range(0.1, 1000.0, "Hz")] = 25.0
    """Frame rate."""
    width: Annotated[int, Range(8, 4096, "px")] = 640
    """Image width."""
    height: Annotated[int, Range(8, 4096, "px")] = 512
    """Image height."""
    fov_deg: Annotated[float, Range(20.0, 90.0, "deg")] = 60.0
    """Horizontal field of view."""
    travel: Annotated[float, Range(0.0, 0.06, "m")] = 0.03
    """How far the tip of the endoscope moves sideways, end to end; it dives in and out by half as much."""
    rounds: Annotated[float, Range(0.05, 10.0)] = 1.0
    """How often it goes round its path; after whole rounds it is back where it began."""
    lever: Annotated[float, Range(0.05, 0.5, "m")] = 0.14
    """Distance from the trocar, about which the endoscope pivots, to its tip."""
    stereo: bool = True
    """Also render the right image."""
    baseline: Annotated[float, Range(0.0005, 0.05, "m")] = 0.0054
    """Distance between the lenses of the stereo endoscope."""
    exposure: Annotated[float, Range(0.1, 10.0)] = 1.0
    """Brightness of the light source."""
    auto_exposure: bool = False
    """Let the camera hold its mean brightness, as endoscopes do, instead of keeping the exposure fixed."""
    noise: Annotated[float, Range(0.0, 20.0, "grey levels")] = 1.2
    """Standard deviation of the sensor noise in 8-bit grey levels."""
    border: Annotated[float, Range(0.0, 0.3)] = 0.0
    """Black frame with round corners, as a fraction of the image height; masked out, without depth."""


# ----------------------------------------------------------------------------------------------- noise

CELLS = 2048  # of the height field, a side: a power of two
HALF_WIDTH = 0.16  # metres from the centre to where the surface is mirrored
CELL = 2 * HALF_WIDTH / CELLS
SIDE = CELLS + 1  # vertices


def _noise(rng: np.random.Generator, scale: float, octaves: int = 1, stretch: tuple[float, float] = (1.0, 1.0)) -> np.ndarray:
    """Smooth noise [SIDE, SIDE] of about zero mean and unit deviation.

    Args:
        rng: Where the randomness comes from.
        scale: Size of the largest features, metres.
        octaves: How often finer noise, half in size and strength, is added.
        stretch: Factors on the size along x and y.
    """
    finest = scale * min(stretch) * 0.5 ** (octaves - 1)
    factor = max(int(finest / (8 * CELL)), 1)
    side = math.ceil(SIDE / factor)  # drawn small, with eight samples per finest feature, and enlarged
    total, power = np.zeros((side, side), np.float32), 0.0
    for octave in range(octaves):
        amplitude = 0.5**octave
        across, down = (side * scale * s * amplitude / (2 * HALF_WIDTH) for s in stretch)  # samples per feature
        columns, rows = math.ceil(side / across) + 3, math.ceil(side / down) + 3
        grid = rng.standard_normal((rows, columns)).astype(np.float32)
        wide = cv2.resize(grid, (math.ceil(columns * across), math.ceil(rows * down)), interpolation=cv2.INTER_CUBIC)
        left, top = int(rng.uniform(1.0, 2.0) * across), int(rng.uniform(1.0, 2.0) * down)  # any phase, off the border
        total += amplitude * wide[top : top + side, left : left + side]
        power += amplitude**2
    total /= np.float32(0.65 * math.sqrt(power))
    if factor == 1:
        return total
    # Linear interpolation and two running means make a cubic B-spline: glints would betray any kink in the slope.
    total = cv2.resize(total, (SIDE, SIDE), interpolation=cv2.INTER_LINEAR)
    box = (factor | 1, factor | 1)
    return cv2.blur(cv2.blur(total, box, borderType=cv2.BORDER_REFLECT_101), box, borderType=cv2.BORDER_REFLECT_101)


def _smoothstep(x: np.ndarray, low: float, high: float) -> np.ndarray:
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _blur(image: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur with a standard deviation in metres; wide ones work on a reduced image."""
    pixels = sigma / CELL
    if pixels < 8:
        return cv2.GaussianBlur(image, (0, 0), pixels, borderType=cv2.BORDER_REFLECT_101)
    factor = 2 ** int(math.log2(pixels / 3))
    small = cv2.resize(image, (SIDE // factor, SIDE // factor), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), pixels / factor, borderType=cv2.BORDER_REFLECT_101)
    return cv2.resize(small, (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)


def _grid() -> tuple[np.ndarray, np.ndarray]:
    """World x and y of every vertex, each [SIDE, SIDE], metres."""
    axis = np.linspace(-HALF_WIDTH, HALF_WIDTH, SIDE, dtype=np.float32)
    return np.meshgrid(axis, axis)


# --------------------------------------------------------------------------------------------- palette


class Tissue(NamedTuple):
    """Look of one tissue: display colours (0-255) and the strengths of its marks."""

    base: tuple[int, int, int]
    second: tuple[int, int, int]  # what the mottling drifts towards: congestion, muscle, bile
    patch: tuple[int, int, int]  # lobules of fat, or pale spots
    patches: float
    vessels: float  # darkness of the branching vessels
    capillaries: float
    wetness: float


_WALLS = (
    Tissue((212, 136, 126), (176, 84, 82), (238, 168, 134), 0.75, 0.85, 0.30, 0.9),  # peritoneum over fat
    Tissue((196, 116, 104), (158, 66, 62), (230, 152, 112), 0.60, 0.80, 0.30, 0.9),  # muscle shining through
    Tissue((210, 138, 128), (176, 90, 92), (226, 164, 142), 0.70, 0.85, 0.35, 0.9),
)
_ORGANS = (
    Tissue((206, 126, 122), (186, 100, 98), (222, 154, 148), 0.50, 1.05, 0.50, 0.7),  # stomach
    Tissue((222, 152, 108), (196, 114, 92), (236, 186, 148), 0.45, 0.85, 0.30, 0.8),  # gallbladder
    Tissue((200, 112, 106), (164, 72, 72), (222, 150, 142), 0.40, 0.95, 0.60, 0.8),  # uterus
    Tissue((220, 148, 130), (196, 110, 100), (236, 186, 162), 0.55, 0.95, 0.45, 0.8),  # small bowel
)
_LOBES = (
    Tissue((154, 94, 86), (126, 62, 58), (150, 112, 112), 0.70, 0.95, 0.9, 0.7),  # congested bowel
    Tissue((124, 50, 46), (94, 32, 34), (146, 74, 66), 0.30, 0.45, 0.7, 1.0),  # liver
    Tissue((136, 62, 54), (104, 42, 42), (150, 88, 76), 0.35, 0.50, 0.7, 1.0),
)
_BLOOD = np.float32([0.50, 1.50, 1.30])  # absorption per unit of blood, red to blue, of a soft red vessel
_DEEP_BLOOD = np.float32([1.05, 1.20, 0.95])  # of veins seen through tissue, which scatters blue back


def _linear(display: tuple[int, int, int]) -> np.ndarray:
    """Albedo [3] that a display colour (0-255) stands for."""
    return (np.float32(display) / 255.0) ** np.float32(2.2)


# --------------------------------------------------------------------------------------------- surface


class _Anatomy:
    """The surface, nearest of its parts: `heights` z [SIDE, SIDE], metres, and what of each part is seen where.

    `shares` [parts, SIDE, SIDE] sums to one at every vertex; `fan_angle` (-1..1 over the ligament's width) and
    `fan_radius` (metres from where it is held) [SIDE, SIDE] are coordinates on the ligament.
    """

    WALL, ORGAN, LIGAMENT, LOBE = range(4)

    def __init__(self, rng: np.random.Generator):
        x, y = _grid()
        # Bend the plane in which the outlines are drawn, so that none of them is a textbook curve.
        bend_x, bend_y = 0.006 * _noise(rng, 0.07, 2), 0.006 * _noise(rng, 0.07, 2)
        bent_x, bent_y = x + bend_x, y + bend_y

        # where the ligament holds the organ
        self.apex = np.float32([rng.uniform(-0.030, -0.005), rng.uniform(-0.020, -0.008)])
        wall = self._wall(rng, x, y)
        organ = self._organ(rng, bent_x, bent_y)
        lobe = self._lobe(rng, bent_x, bent_y)
        ligament, self.fan_angle, self.fan_radius = self._ligament(rng, bent_x, bent_y, organ, wall)

        heights = np.stack([wall, organ, ligament, lobe])
        nearest = heights.min(0)
        # The parts meet in a narrow fillet; its weights also blend their textures.
        weights = np.exp((nearest - heights) / np.float32(0.0005))
        self.shares = weights / weights.sum(0)
        fillet = nearest - np.float32(0.0005) * np.log(weights.sum(0))
        self.heights = _blur(fillet, 0.0004)  # no edge of tissue is sharper than this

    def _wall(self, rng, x, y):
        """A cavity that closes in on the camera away from the axis, with hanging folds."""
        turn = rng.normal(0.0, 0.25)
        across = x * math.cos(turn) + y * math.sin(turn) + 0.012 * _noise(rng, 0.06, 2)
        wave = np.cos(across * (2.0 * math.pi / rng.uniform(0.028, 0.038)) + rng.uniform(0, 2.0 * math.pi))
        folds = (0.5 + 0.5 * wave) ** 1.5
        strength = _smoothstep(_noise(rng, 0.09), -0.8, 1.0)
        cavity = 0.9 * (x * x + y * y) * (1.0 + 0.3 * rng.standard_normal() * x / HALF_WIDTH)
        return 0.144 - 0.008 * folds * strength - 0.0030 * _noise(rng, 0.045, 3, (0.7, 1.4)) - cavity

    def _organ(self, rng, x, y):
        """A rounded body, hung from its apex, that turns away steeply at its outline."""
        angle = rng.uniform(0.35, 0.75)  # its long axis runs down and to the right
        long, short = rng.uniform(0.066, 0.078), rng.uniform(0.036, 0.043)
        centre = self.apex + np.float32([math.cos(angle), math.sin(angle)]) * long * 0.62 + np.float32([0.0, 0.012])
        a = (x - centre[0]) * math.cos(angle) + (y - centre[1]) * math.sin(angle)
        b = -(x - centre[0]) * math.sin(angle) + (y - centre[1]) * math.cos(angle)
        radius = ((np.abs(a) / long) ** 2.3 + (np.abs(b) / (short * np.clip(1.0 + 0.28 * a / long, 0.5, 1.5))) ** 2.3) ** (1 / 2.3)
        dome = np.maximum(1.0 - radius * radius, 0.0) ** 0.62
        height = rng.uniform(0.022, 0.027)
        relief = 0.0008 * _noise(rng, 0.022, 2) + 0.00018 * _noise(rng, 0.006, 2)
        beyond = np.maximum(radius - 1.0, 0.0) * 0.12  # falls behind the wall outside its outline
        return 0.143 - height * dome + beyond - relief * _smoothstep(dome, 0.0, 0.4)

    def _lobe(self, rng, x, y):
        """The next organ, its rounded rim entering from below, close to the camera."""
        rim = rng.uniform(0.030, 0.040) + rng.normal(0, 0.06) * x + 0.10 * np.abs(x) * rng.uniform(0, 1)
        inside = y - rim - 0.004 * _noise(rng, 0.05, 2)
        rise = 1.0 - np.exp(-np.maximum(inside, 0.0) / 0.011)
        furrows = 0.0012 * _noise(rng, 0.02, 3, (0.7, 1.6)) + 0.0003 * _noise(rng, 0.004, 2)
        return 0.138 - rng.uniform(0.024, 0.030) * rise - furrows * rise - np.minimum(inside, 0.0) * 2.0

    def _ligament(self, rng, x, y, organ, wall):
        """A taut translucent fan from the apex of the organ up to the wall; returns its angle and radius maps, too."""
        heading = rng.uniform(-1.75, -1.15)  # image y points down: upwards
        spread = rng.uniform(0.24, 0.34)
        dx, dy = x - self.apex[0], y - self.apex[1] - np.float32(0.012)
        radius = np.hypot(dx, dy)
        angle = (np.arctan2(dy, dx) - heading + math.pi) % (2 * math.pi) - math.pi
        column, row = ((self.apex + HALF_WIDTH) / CELL).astype(int)
        start = organ[row + int(0.010 / CELL), column]
        along = _smoothstep(radius, 0.0, 0.075)
        slack = 0.0060 * _smoothstep(angle / spread, -1.0, 0.6) - 0.0015  # one side lies on the wall, one is free
        sheet = start + along * (_blur(wall, 0.008) - slack - start) + 0.0015 * (1.0 - along)
        edge = np.maximum(np.abs(angle) - spread, 0.0) * radius
        behind = np.maximum(0.020 - radius, 0.0)  # grows out of the organ instead of ending on it
        return sheet + np.where(angle > 0.0, 4.0, 0.7) * edge + 0.35 * behind, angle / spread, radius


# --------------------------------------------------------------------------------------------- texture


class _Vessels:
    """Blood vessels, drawn as trees that do not cross: a branch ends where it meets tissue that another supplies.

    Args:
        rng: Where the randomness comes from.
        room: Width of the strip that a vessel keeps to itself, metres.
    """

    CALIBRES = (0.00022, 0.00055)  # radii between fine, middle and large vessels, metres

    def __init__(self, rng: np.random.Generator, room: float = 0.0016):
        self.canvas = np.zeros((len(self.CALIBRES) + 1, SIDE, SIDE), np.float32)  # blood of each calibre, finest first
        self._rng, self._room, self._count = rng, room, 0
        self._owners = np.zeros((int(2 * HALF_WIDTH / room) + 1,) * 2, np.int64)

    def grow(self, origin, heading, radius, *, wander=0.3, reach=1.0, smallest=0.00010) -> None:
        """Draw one tree. A vessel keeps its course but wanders, tapers, and forks by Murray's law r³ = r1³ + r2³.

        Args:
            origin: Root [2], metres.
            heading: Initial direction, radians.
            radius: Radius at the root, metres.
            wander: How far a vessel strays from its course, radians.
            reach: Length of vessels as a multiple of the usual.
            smallest: Radius at which branches end, metres.
        """
        rng = self._rng
        branches, strokes = [(np.float64(origin), heading, radius, 0)], []
        while branches:
            point, course, r, parent = branches.pop(0)  # the large ones first, so that they find room
            self._count += 1
            name, stray, since_fork = self._count, 0.0, 0.0
            fork_after = reach * rng.uniform(0.5, 1.4) * (0.004 + 12.0 * r)
            points = [point]
            while r > smallest and since_fork < fork_after:
                stray = 0.80 * stray + wander * rng.standard_normal()
                course += 0.04 * wander * rng.standard_normal()
                step = max(0.0007, 0.9 * r)
                point = point + step * np.array([math.cos(course + stray), math.sin(course + stray)])
                if not self._claim(point, name, parent):
                    break
                points.append(point)
                since_fork += step
                r *= 1.0 - 1.8 * step  # tapers by a sixth per decimetre
                if len(points) == 4:
                    strokes.append((points, r))
                    points = [point]
                if rng.random() < 90.0 * step and r > 1.5 * smallest:  # a twig that leaves the trunk as it is
                    side = rng.choice([-1.0, 1.0])
                    branches.append((point, course + side * rng.uniform(0.6, 1.3), r * rng.uniform(0.3, 0.55), name))
            else:
                if r > smallest:
                    share, side = rng.uniform(0.35, 0.65), rng.choice([-1.0, 1.0])
                    for part, sign in ((share, side), (1.0 - share, -side)):  # the weaker branch turns the farther
                        turn = sign * (0.15 + 0.8 * (1.0 - part))
                        branches.append((point, course + turn, r * part ** (1 / 3), name))
            strokes.append((points, r))
        if len(strokes) > 5:  # a tree that found no room to grow is no vessel
            for points, r in strokes:
                self._stroke(points, r)

    def _claim(self, point, name, parent) -> bool:
        """Take the place at a point unless it is outside or another vessel's, the parent's excepted."""
        if np.abs(point).max() > HALF_WIDTH:
            return False
        place = tuple(((point + HALF_WIDTH) / self._room).astype(int))
        owner = self._owners[place]
        if owner == 0:
            self._owners[place] = name
        return owner in (0, name, parent)

    def _stroke(self, points, r) -> None:
        level = sum(r > calibre for calibre in self.CALIBRES)
        thickness = 2.0 * r / CELL
        # A line is at least one cell wide: thinner ones are drawn fainter instead.
        strength = min(thickness, 1.0) * (0.5 + 0.5 * min(r / 0.0007, 1.0))
        cells = np.round((np.array(points) + HALF_WIDTH) / CELL * 16).astype(np.int32)
        cv2.polylines(self.canvas[level], [cells], False, strength, max(round(thickness), 1), cv2.LINE_AA, 4)


class _Paint:
    """Albedo, wetness and micro-relief of the surface, from its anatomy."""

    def __init__(self, rng: np.random.Generator, seed: int, anatomy: _Anatomy):
        first = seed == 0  # the first patient is the one of the figures: peritoneum, stomach, congested bowel
        wall, organ, lobe = (kinds[0 if first else rng.integers(len(kinds))] for kinds in (_WALLS, _ORGANS, _LOBES))
        tissues = (
            wall,
            organ,
            wall,
            lobe,
        )  # of the parts in the order of their shares; the wall shines through the ligament

        by_vertex = np.ascontiguousarray(np.moveaxis(anatomy.shares, 0, -1))

        def look(name):  # one property over the whole surface [SIDE, SIDE] or, a colour, [SIDE, SIDE, 3]
            table = np.float32([_linear(v) if isinstance(v := getattr(tissue, name), tuple) else v for tissue in tissues])
            return cv2.transform(by_vertex, table.reshape(len(tissues), -1).T)

        # Mottling: wide drifts between two colours, and patches with softly lobed outlines.
        colour = look("base")
        drift = _smoothstep(_noise(rng, 0.045, 3) + 0.3 * _noise(rng, 0.006, 2), -1.2, 2.0)
        colour += drift[..., None] * (look("second") - colour)
        patch = look("patches") * _smoothstep(_noise(rng, 0.030, 4), -0.1, 1.6)
        colour += patch[..., None] * (look("patch") - colour)
        # Connective tissue lies over it as a whitish haze in streaks.
        haze = 0.30 * _smoothstep(_noise(rng, 0.022, 4, (0.8, 1.4)), 0.2, 2.2)
        haze *= 1.0 - 0.7 * anatomy.shares[anatomy.LOBE]
        colour += haze[..., None] * (_linear((228, 190, 190)) - colour)

        red, deep = self._blood(rng, anatomy, look("vessels"), look("capillaries"))
        grain = 0.065 * _noise(rng, 0.0024, 3) + 0.065 * _noise(rng, 0.011, 3)
        # Crevices see little of the light that other tissue scatters: darken what lies behind its neighbourhood.
        z = anatomy.heights
        hidden = sum(strength * np.maximum(z - _blur(z, sigma), 0.0) for sigma, strength in ((0.0025, 200.0), (0.010, 60.0)))
        for c, tint in enumerate(((0.6, 0.75), (1.1, 1.1), (1.0, 1.1))):
            colour[..., c] *= np.exp(tint[0] * grain - tint[1] * hidden - _BLOOD[c] * red - _DEEP_BLOOD[c] * deep)
        self._veil(rng, anatomy, colour)
        self.colour = np.minimum(colour, 1.0)
        """Linear albedo [SIDE, SIDE, 3]."""
        # The film pools: some regions are dry, and lie under few glints or none.
        self.wetness = look("wetness") * _smoothstep(_noise(rng, 0.018, 3), -0.6, 1.2)
        """Strength of the wet reflection [SIDE, SIDE]."""
        self.film = 0.00013 * _noise(rng, 0.0045, 2, (0.7, 1.4)) + 0.00003 * _noise(rng, 0.0012)
        """Height of the ripples in the wet film [SIDE, SIDE], metres."""

    def _blood(self, rng, anatomy, vessels, capillaries):
        """Optical depth [SIDE, SIDE] of blood at the surface and of blood deeper down; raises large vessels, too."""
        shares = anatomy.shares
        canvas = shares[anatomy.ORGAN] * self._organ_vessels(rng, anatomy) + shares[anatomy.LOBE] * self._lobe_vessels(rng)
        canvas += (shares[anatomy.WALL] + shares[anatomy.LIGAMENT]) * self._wall_vessels(rng)
        fine, middle, large = canvas
        self.relief = 0.00025 * _blur(large + 0.6 * middle, 0.0005)
        """How far vessels stand out of the surface [SIDE, SIDE], metres."""
        fine, middle = _blur(fine, 0.00022), _blur(middle, 0.00032)
        core, halo = _blur(large, 0.00050), _blur(large + 0.6 * middle, 0.0018)
        mesh = np.exp(-np.abs(_noise(rng, 0.006, 3)) / 0.10) * _smoothstep(_noise(rng, 0.02, 2), -0.8, 1.4)
        red = vessels * (1.25 * fine + 1.50 * middle + 0.80 * core + 0.45 * halo) + 0.40 * capillaries * mesh
        return red, vessels * 0.75 * core

    def _veil(self, rng, anatomy, colour):
        """Draw the ligament over the wall's colour: a milky, fibrous veil with a bright free edge."""
        angle, radius = anatomy.fan_angle, anatomy.fan_radius
        fibres = np.zeros((SIDE, SIDE), np.float32)
        for count, amplitude in (
            (14.0, 0.8),
            (45.0, 0.7),
            (110.0, 0.5),
        ):  # noise over the angle alone makes a fan of fibres
            line = cv2.resize(rng.standard_normal((1, 1024)).astype(np.float32), (8192, 1), interpolation=cv2.INTER_CUBIC)[0]
            position = (0.5 * count * angle + 30.0 * radius) * 8.0 + 4096.0
            fibres += amplitude * line[np.clip(position, 0, 8191).astype(np.int32)]
        edge = np.exp(-np.abs(angle - 1.0) * radius / 0.0010)
        alpha = 0.50 * _smoothstep(angle, -1.0, 0.1) * (1.0 + 0.12 * fibres) + 0.35 * edge
        alpha = np.clip(alpha, 0.0, 0.9) * anatomy.shares[anatomy.LIGAMENT]
        colour += alpha[..., None] * (_linear((214, 178, 178)) * np.exp(0.06 * fibres)[..., None] - colour)

    def _wall_vessels(self, rng):
        vessels = _Vessels(rng, 0.0026)
        for _ in range(10):  # down the wall
            origin = rng.uniform(-0.12, 0.12), rng.uniform(-0.14, -0.03)
            vessels.grow(origin, rng.normal(math.pi / 2, 0.35), rng.uniform(0.0003, 0.0006), reach=1.8)
        for _ in range(30):
            vessels.grow(rng.uniform(-0.13, 0.13, 2), rng.uniform(0, 2 * math.pi), 0.00028, wander=0.4, reach=1.4)
        return vessels.canvas

    def _organ_vessels(self, rng, anatomy):
        vessels = _Vessels(rng, 0.0017)
        for side in np.linspace(-0.6, 1.3, 6):  # from the hilum, left, fanning out across the body
            origin = anatomy.apex + np.float32([-0.026 - 0.002 * side, 0.022 + 0.024 * side])
            vessels.grow(origin, 0.55 * side + 0.2 + rng.normal(0.0, 0.1), rng.uniform(0.0005, 0.0009), wander=0.26, reach=2.0)
        for _ in range(28):  # and smaller ones from all around
            origin = anatomy.apex + rng.uniform([0.0, -0.01], [0.12, 0.10])
            vessels.grow(origin, rng.uniform(0, 2 * math.pi), rng.uniform(0.00022, 0.00042), reach=1.3)
        return vessels.canvas

    def _lobe_vessels(self, rng):
        vessels = _Vessels(rng, 0.0022)
        for x in np.linspace(-0.14, 0.14, 30):  # climbing to the rim, side by side
            origin = x + rng.normal(0.0, 0.003), rng.uniform(0.055, 0.10)
            vessels.grow(origin, rng.normal(-math.pi / 2, 0.25), rng.uniform(0.0004, 0.0007), wander=0.35, reach=1.3)
        return vessels.canvas

    def _ligament(self, rng, anatomy, behind):
        """A milky, fibrous veil over what lies behind it, with a bright free edge."""
        angle, radius = anatomy.fan_angle, anatomy.fan_radius
        fibres = np.zeros((SIDE, SIDE), np.float32)
        for count, amplitude in (
            (18.0, 1.0),
            (55.0, 0.7),
            (130.0, 0.4),
        ):  # noise over the angle alone makes a fan of fibres
            line = rng.standard_normal(1024).astype(np.float32)
            line = cv2.resize(line[None], (8192, 1), interpolation=cv2.INTER_CUBIC)[0]
            position = (angle * count * 0.5 + radius * 40.0) * 8.0 + 4096.0
            fibres += amplitude * line[np.clip(position, 0, 8191).astype(np.int32)]
        edge = np.exp(-np.abs(np.abs(angle) - 1.0) * radius / 0.0012)
        veil = np.clip(0.46 + 0.07 * fibres + 0.30 * edge, 0.0, 0.9)
        milk = _linear((206, 168, 166)) * np.exp(0.07 * fibres)[..., None]
        return behind + veil[..., None] * (milk - behind)


# --------------------------------------------------------------------------------------------- phantom


class Phantom:
    """One synthetic patient, ready to be seen from anywhere; `build_phantom` makes it once per seed.

    Args:
        seed: What everything about the patient follows from.
    """

    def __init__(self, seed: int):
        init_warp()
        rng = np.random.default_rng([seed, 0x7155])
        anatomy = _Anatomy(rng)
        paint = _Paint(rng, seed, anatomy)
        self.heights = np.ascontiguousarray(anatomy.heights - paint.relief, np.float32)
        """Depth coordinate z of the surface over the vertices of its grid [y, x], metres, world."""

        slopes = np.stack([_slope(self.heights, 1), _slope(self.heights, 0), -_slope(paint.film, 1), -_slope(paint.film, 0)], -1)
        colours = np.concatenate([paint.colour, paint.wetness[..., None]], -1)
        surface = kernels.Surface()
        surface.n, surface.cell = CELLS, CELL
        surface.lowest, surface.highest = float(self.heights.min()), float(self.heights.max())
        surface.heights = wp.array(self.heights.ravel(), dtype=float, device="cpu", copy=False)
        surface.nearest = wp.array(_minimum_pyramid(self.heights), dtype=float, device="cpu", copy=False)
        surface.colours = wp.array(_detail_pyramid(colours), dtype=wp.vec4, device="cpu", copy=False)
        surface.slopes = wp.array(_detail_pyramid(slopes), dtype=wp.vec4, device="cpu", copy=False)
        self.surface = surface

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """World z of the surface, metres, at world x and y (any common shape), in double precision."""
        u, v = (np.abs((np.asarray(c, np.float64) / CELL + 1.5 * CELLS) % (2 * CELLS) - CELLS) for c in (x, y))
        i, j = np.minimum(u.astype(int), CELLS - 1), np.minimum(v.astype(int), CELLS - 1)
        a, b = u - i, v - j
        z = self.heights.astype(np.float64)
        return (1 - b) * ((1 - a) * z[j, i] + a * z[j, i + 1]) + b * ((1 - a) * z[j + 1, i] + a * z[j + 1, i + 1])


@functools.lru_cache(maxsize=4)
def build_phantom(seed: int) -> Phantom:
    """The patient of a seed; the last few are kept."""
    return Phantom(seed)


def _slope(field: np.ndarray, axis: int) -> np.ndarray:
    """Central difference of a field on the surface's grid, per metre."""
    return np.gradient(field, CELL, axis=axis).astype(np.float32)


def _minimum_pyramid(heights: np.ndarray) -> np.ndarray:
    """Minimal height over every cell of every level, flat; level l has (CELLS >> l)² cells."""
    level = np.minimum(np.minimum(heights[:-1, :-1], heights[:-1, 1:]), np.minimum(heights[1:, :-1], heights[1:, 1:]))
    levels = [level.ravel()]
    while len(level) > CELLS >> kernels.TOP_LEVEL:
        level = np.minimum(np.minimum(level[::2, ::2], level[::2, 1::2]), np.minimum(level[1::2, ::2], level[1::2, 1::2]))
        levels.append(level.ravel())
    return np.concatenate(levels)


def _detail_pyramid(texture: np.ndarray) -> np.ndarray:
    """Levels of detail of a texture [SIDE, SIDE, 4] on the surface's vertices, flat [sum, 4]."""
    levels = [texture.astype(np.float32)]
    for _ in range(5):
        levels.append(cv2.pyrDown(levels[-1]))
    return np.concatenate([level.reshape(-1, 4) for level in levels])


# --------------------------------------------------------------------------------------------- shading

_WORKING_DISTANCE = 0.115  # metres, at which the exposure is right
_LIGHT_OFFSET = np.array([0.0027, -0.004, 0.0])  # of the fibre's end from the left lens, camera frame, metres


def _radiance(phantom: Phantom, camera: Camera, rig: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Linear image [H, W, 3] and depth [H, W] of a camera, in the light of the endoscope whose left camera is `rig`."""
    light = kernels.Light()
    light.position = wp.vec3(*(rig.pose[:3, :3] @ _LIGHT_OFFSET + rig.position))
    light.power = 1.12 * _WORKING_DISTANCE**2
    light.wrap = wp.vec3(0.30, 0.16, 0.14)
    light.sheen, light.glint, light.sharpness = 0.13, 9.0, 700.0
    depth = np.zeros((camera.height, camera.width), np.float32)
    radiance = np.zeros((camera.height, camera.width, 3), np.float32)
    wp.launch(
        kernels.render,
        dim=depth.shape,
        inputs=[
            phantom.surface,
            light,
            wp.mat44(camera.pose.astype(np.float32)),
            wp.vec2(camera.K[0, 0], camera.K[1, 1]),
            wp.vec2(camera.K[0, 2], camera.K[1, 2]),
            wp.array(depth, dtype=float, device="cpu", copy=False),
            wp.array(radiance, dtype=wp.vec3, device="cpu", copy=False),
        ],
        device="cpu",
    )
    return radiance, depth


def _develop(radiance: np.ndarray, camera: Camera, exposure: float, auto: bool) -> np.ndarray:
    """What the optics and the sensor make of a linear image: vignette, bloom, lens blur, tone curve; float32, 0-255."""
    rays = camera.rays()
    radius2 = ((rays[..., 0] / rays[0, 0, 0]) ** 2 + (rays[..., 1] / rays[0, 0, 0]) ** 2).astype(np.float32)
    image = radiance * (exposure / (1.0 + 0.45 * radius2 + 0.35 * radius2**2))[..., None]
    if auto:
        image *= np.float32(0.22 / max(float(np.minimum(image, 1.0).mean()), 1e-6))
    scale = camera.width / 640
    highlights = np.maximum(np.minimum(image, 6.0) - 1.0, 0.0)
    image = image + 0.10 * cv2.GaussianBlur(highlights, (0, 0), 4.0 * scale) if scale > 0.2 else image
    image = cv2.GaussianBlur(image, (0, 0), max(0.75 * scale, 0.35))
    tone = 1.0 - np.exp(-1.85 * image ** np.float32(1.15))  # a toe for the shadows, a shoulder for the highlights
    return 255.0 * np.minimum(1.04 * tone, 1.0) ** np.float32(1 / 2.2)


def render_phantom(phantom: PhantomConfig | Phantom, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """What an endoscope at any pose sees of the patient, without noise or border.

    Args:
        phantom: The configuration (its seed, exposure and auto_exposure count), or a built phantom.
        camera: Where to look from; its light moves with it.

    Returns:
        The RGB image [H, W, 3], uint8, and the depth along the optical axis [H, W], float32, metres, 0 where the
        camera looks past the surface.
    """
    config = phantom if isinstance(phantom, PhantomConfig) else PhantomConfig()
    built = build_phantom(config.seed) if isinstance(phantom, PhantomConfig) else phantom
    radiance, depth = _radiance(built, camera, camera)
    return _quantise(_develop(radiance, camera, config.exposure, config.auto_exposure)), depth


def _quantise(image: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


# ------------------------------------------------------------------------------------------------ path


def phantom_poses(config: PhantomConfig) -> np.ndarray:
    """Camera-to-world poses [frames, 4, 4] of an endoscope that pivots about its trocar; it starts and ends at rest."""
    rng = np.random.default_rng([config.seed, 0x9A7])
    s = np.linspace(0.0, 1.0, config.frames)
    phase = config.rounds * 2.0 * math.pi * (s - np.sin(2.0 * math.pi * s) / (2.0 * math.pi))  # slow in, slow out
    swing = config.travel / (2.0 * config.lever)  # radians
    start = rng.uniform(0.0, 2.0 * math.pi)
    yaw = swing * np.cos(phase + start)
    pitch = 0.65 * swing * np.sin(2.0 * phase + rng.uniform(0.0, 2.0 * math.pi))
    depth = config.lever + 0.25 * config.travel * np.sin(phase + rng.uniform(0.0, 2.0 * math.pi))
    roll = 0.06 * np.sin(phase + rng.uniform(0.0, 2.0 * math.pi))
    poses = np.tile(np.eye(4), (config.frames, 1, 1))
    for pose, a, b, c, d in zip(poses, yaw, pitch, roll, depth):
        turn = cv2.Rodrigues(np.array([0.0, a, 0.0]))[0] @ cv2.Rodrigues(np.array([b, 0.0, 0.0]))[0]
        pose[:3, :3] = turn @ cv2.Rodrigues(np.array([0.0, 0.0, c]))[0]
        pose[:3, 3] = turn[:, 2] * d - [0.0, 0.0, config.lever]
    return poses


def phantom_camera(config: PhantomConfig, pose: np.ndarray | None = None) -> Camera:
    """The left camera of the phantom's endoscope, at a pose [4, 4] or at the origin."""
    focal = 0.5 * config.width / math.tan(math.radians(config.fov_deg) / 2)
    K = np.array([[focal, 0.0, config.width / 2], [0.0, focal, config.height / 2], [0.0, 0.0, 1.0]])
    return Camera(K, config.width, config.height, np.eye(4) if pose is None else pose)


def _border(config: PhantomConfig) -> np.ndarray:
    """Transmission [H, W] in 0..1 of the round-cornered window through which the endoscope looks."""
    margin = config.border * config.height
    x = np.abs(np.arange(config.width) + 0.5 - config.width / 2)
    y = np.abs(np.arange(config.height) + 0.5 - config.height / 2)
    corner = 3.0 * margin
    dx = np.maximum(x - (config.width / 2 - margin - corner), 0.0)
    dy = np.maximum(y - (config.height / 2 - margin - corner), 0.0)
    return np.clip((corner - np.hypot(dx, dy[:, None])) / max(0.4 * margin, 1.0), 0.0, 1.0).astype(np.float32)


def phantom_sequence(config: PhantomConfig) -> Iterator[Frame]:
    """Film the patient: frames with exact pose and depth, rendered as they are asked for, a few at a time.

    Args:
        config: The patient and the endoscope.

    Yields:
        Frames `1 / fps` apart from stamp 1 s on. The depth is exact and positive everywhere but under the border.
    """
    phantom = build_phantom(config.seed)
    window = _border(config)[..., None] if config.border > 0 else None
    mask = np.full((config.height, config.width), 255, np.uint8)
    if window is not None:
        mask[window[..., 0] < 1.0] = 0

    def expose(camera, rig, index, eye):
        radiance, depth = _radiance(phantom, camera, rig)
        image = _develop(radiance, camera, config.exposure, config.auto_exposure)
        if window is not None:
            image *= window
        if config.noise > 0:
            rng = np.random.default_rng([config.seed, index, eye])
            image += np.float32(config.noise) * rng.standard_normal(image.shape, np.float32)
        return _quantise(image), depth

    def film(index: int, pose: np.ndarray) -> Frame:
        camera = phantom_camera(config, pose)
        image, depth = expose(camera, camera, index, 0)
        right = None
        if config.stereo:
            shifted = pose.copy()
            shifted[:3, 3] += config.baseline * pose[:3, 0]
            right = expose(camera.at(shifted), camera, index, 1)[0]
        return Frame(
            stamp_ns=1_000_000_000 + round(index * 1e9 / config.fps),
            image=image,
            camera=camera,
            right=right,
            baseline=config.baseline if config.stereo else None,
            depth=np.where(mask > 0, depth, np.float32(0.0)),
            mask=mask,
        )

    poses = phantom_poses(config)
    yield film(0, poses[0])  # alone, since it may compile
    step = cpu_threads()
    with ThreadPoolExecutor(step) as pool:
        for start in range(1, config.frames, step):
            numbers = range(start, min(start + step, config.frames))
            yield from pool.map(film, numbers, poses[numbers])
