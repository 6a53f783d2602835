"""Texture of the surface: mottling, fat, fibres and branching vessels."""

import math

import cv2
import numpy as np

from endo_sim_ros.sequences.phantom.anatomy import Anatomy
from endo_sim_ros.sequences.phantom.height_field import SIDE, blur, noise, smoothstep
from endo_sim_ros.sequences.phantom.palette import BLOOD, DEEP_BLOOD, LOBES, ORGANS, WALLS, Tissue, linear
from endo_sim_ros.sequences.phantom.vessels import Vessels


class Paint:
    """Albedo, wetness and micro-relief of a section of the surface, from its anatomy; the wall may be that of another section."""

    def __init__(self, rng: np.random.Generator, seed: int, anatomy: Anatomy, wall: Tissue | None = None):
        first = seed == 0 and wall is None  # the first patient is the one of the figures: peritoneum, stomach, congested bowel
        own_wall, organ, lobe = (kinds[0 if first else rng.integers(len(kinds))] for kinds in (WALLS, ORGANS, LOBES))
        self.wall = wall = wall or own_wall
        tissues = wall, organ, wall, lobe  # of the parts in the order of their shares; the wall shines through the ligament

        by_vertex = np.ascontiguousarray(np.moveaxis(anatomy.shares, 0, -1))

        def look(name: str) -> np.ndarray:  # one property over the whole surface [SIDE, SIDE] or, a colour, [SIDE, SIDE, 3]
            table = np.array([linear(v) if isinstance(v := getattr(tissue, name), tuple) else v for tissue in tissues], np.float32)
            return cv2.transform(by_vertex, table.reshape(len(tissues), -1).T)

        # Mottling: wide drifts between two colours, and patches with softly lobed outlines.
        colour = look("base")
        drift = smoothstep(noise(rng, 0.045, 3) + 0.3 * noise(rng, 0.006, 2), -1.2, 2.0)
        colour += drift[..., None] * (look("second") - colour)
        patch = look("patches") * smoothstep(noise(rng, 0.030, 4), -0.1, 1.6)
        colour += patch[..., None] * (look("patch") - colour)
        # Connective tissue lies over it as a whitish haze in streaks.
        haze = 0.30 * smoothstep(noise(rng, 0.022, 4, (0.8, 1.4)), 0.2, 2.2)
        haze *= 1.0 - 0.7 * anatomy.shares[anatomy.LOBE]
        colour += haze[..., None] * (linear((228, 190, 190)) - colour)

        red, deep = self._blood(rng, anatomy, look("vessels"), look("capillaries"))
        grain = 0.065 * noise(rng, 0.0024, 3) + 0.065 * noise(rng, 0.011, 3)
        # Crevices see little of the light that other tissue scatters: darken what lies behind its neighbourhood.
        z = anatomy.heights
        hidden = sum(strength * np.maximum(z - blur(z, sigma), 0.0) for sigma, strength in ((0.0025, 200.0), (0.010, 60.0)))
        for c, tint in enumerate(((0.6, 0.75), (1.1, 1.1), (1.0, 1.1))):
            colour[..., c] *= np.exp(tint[0] * grain - tint[1] * hidden - BLOOD[c] * red - DEEP_BLOOD[c] * deep)
        self._veil(rng, anatomy, colour)
        self.colour = np.minimum(colour, 1.0)
        """Linear albedo [SIDE, SIDE, 3]."""
        # The film pools: some regions are dry, and lie under few glints or none.
        self.wetness = look("wetness") * smoothstep(noise(rng, 0.018, 3), -0.6, 1.2)
        """Strength of the wet reflection [SIDE, SIDE]."""
        self.film = 0.00013 * noise(rng, 0.0045, 2, (0.7, 1.4)) + 0.00003 * noise(rng, 0.0012)
        """Height of the ripples in the wet film [SIDE, SIDE], metres."""

    def _blood(
        self, rng: np.random.Generator, anatomy: Anatomy, vessels: np.ndarray, capillaries: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Optical depth [SIDE, SIDE] of blood at the surface and of blood deeper down; raises large vessels, too."""
        shares = anatomy.shares
        canvas = shares[anatomy.ORGAN] * self._organ_vessels(rng, anatomy) + shares[anatomy.LOBE] * self._lobe_vessels(rng)
        canvas += (shares[anatomy.WALL] + shares[anatomy.LIGAMENT]) * self._wall_vessels(rng)
        fine, middle, large = canvas
        self.relief = 0.00025 * blur(large + 0.6 * middle, 0.0005)
        """How far vessels stand out of the surface [SIDE, SIDE], metres."""
        fine, middle = blur(fine, 0.00022), blur(middle, 0.00032)
        core, halo = blur(large, 0.00050), blur(large + 0.6 * middle, 0.0018)
        mesh = np.exp(-np.abs(noise(rng, 0.006, 3)) / 0.10) * smoothstep(noise(rng, 0.02, 2), -0.8, 1.4)
        red = vessels * (1.25 * fine + 1.50 * middle + 0.80 * core + 0.45 * halo) + 0.40 * capillaries * mesh
        return red, vessels * 0.75 * core

    def _veil(self, rng: np.random.Generator, anatomy: Anatomy, colour: np.ndarray) -> None:
        """Draw the ligament over the wall's colour: a milky, fibrous veil with a bright free edge."""
        angle, radius = anatomy.fan_angle, anatomy.fan_radius
        fibres = np.zeros((SIDE, SIDE), np.float32)
        # Noise over the angle alone makes a fan of fibres.
        for count, amplitude in ((14.0, 0.8), (45.0, 0.7), (110.0, 0.5)):
            line = cv2.resize(rng.standard_normal((1, 1024)).astype(np.float32), (8192, 1), interpolation=cv2.INTER_CUBIC)[0]
            position = (0.5 * count * angle + 30.0 * radius) * 8.0 + 4096.0
            fibres += amplitude * line[np.clip(position, 0, 8191).astype(np.int32)]
        edge = np.exp(-np.abs(angle - 1.0) * radius / 0.0010)
        alpha = 0.50 * smoothstep(angle, -1.0, 0.1) * (1.0 + 0.12 * fibres) + 0.35 * edge
        alpha = np.clip(alpha, 0.0, 0.9) * anatomy.shares[anatomy.LIGAMENT]
        colour += alpha[..., None] * (linear((214, 178, 178)) * np.exp(0.06 * fibres)[..., None] - colour)

    def _wall_vessels(self, rng: np.random.Generator) -> np.ndarray:
        vessels = Vessels(rng, 0.0026)
        for _ in range(10):  # down the wall
            origin = rng.uniform(-0.12, 0.12), rng.uniform(-0.14, -0.03)
            vessels.grow(origin, rng.normal(math.pi / 2, 0.35), rng.uniform(0.0003, 0.0006), reach=1.8)
        for _ in range(30):
            vessels.grow(rng.uniform(-0.13, 0.13, 2), rng.uniform(0, 2 * math.pi), 0.00028, wander=0.4, reach=1.4)
        return vessels.canvas

    def _organ_vessels(self, rng: np.random.Generator, anatomy: Anatomy) -> np.ndarray:
        vessels = Vessels(rng, 0.0017)
        for side in np.linspace(-0.6, 1.3, 6):  # from the hilum, left, fanning out across the body
            origin = anatomy.apex + np.array([-0.026 - 0.002 * side, 0.022 + 0.024 * side], np.float32)
            vessels.grow(origin, 0.55 * side + 0.2 + rng.normal(0.0, 0.1), rng.uniform(0.0005, 0.0009), wander=0.26, reach=2.0)
        for _ in range(28):  # and smaller ones from all around
            origin = anatomy.apex + rng.uniform([0.0, -0.01], [0.12, 0.10])
            vessels.grow(origin, rng.uniform(0, 2 * math.pi), rng.uniform(0.00022, 0.00042), reach=1.3)
        return vessels.canvas

    def _lobe_vessels(self, rng: np.random.Generator) -> np.ndarray:
        vessels = Vessels(rng, 0.0022)
        for x in np.linspace(-0.14, 0.14, 30):  # climbing to the rim, side by side
            origin = x + rng.normal(0.0, 0.003), rng.uniform(0.055, 0.10)
            vessels.grow(origin, rng.normal(-math.pi / 2, 0.25), rng.uniform(0.0004, 0.0007), wander=0.35, reach=1.3)
        return vessels.canvas
