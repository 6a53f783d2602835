"""How the tissue of a recording moves by itself, as it was found there."""

import functools
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import yaml
from torch import Tensor

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.errors import MotionError
from endo_sim_ros.core.gaussians import GaussianModel
from endo_sim_ros.core.motion import MOTION_FILE, MOTION_PARAMETERS, MOTIONS
from endo_sim_ros.core.smooth_fields import interpolated_between

CELL = 8  # pixels, of a frame, between places whose way is interpolated: motion is smooth
_PHASES = 64  # places along a period at which a way is looked at
_NUMBERS = "name", "period", "explained", "cycles"  # of each part, in a file
_PLACE = "gaussians", "centre", "spread"  # of the model, in a file
_SHORTEST, _MOST = 0.01, 1e6  # s, of a period; m of an amplitude, and s
_APART = 1e-3  # of its spread: as near to each other a model and its compressed copy are


@dataclass(frozen=True)
class PeriodicMotion:
    """A motion of tissue in which every place goes a share of one way.

    Args:
        name: breathing or heartbeat.
        period: s.
        explained: Share, 0 to 1, of what still points leave over that it explains, where it explains most.
        cycles: Number of periods that were watched.
        way: Coefficients [2 H, 3] of cosine and sine of each harmonic, m, world: of a place whose share is 1. Where it is not regular a
            last row is the axis of `beside`, without a unit.
        shares: Of the points [N].
        beside: How it differs from its period while it is watched: coefficients [K] of a cosine series over that time, m. Empty where it is
            regular.
    """

    name: str
    period: float
    explained: float
    cycles: float
    way: np.ndarray
    shares: np.ndarray
    beside: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def path(self, seconds: np.ndarray) -> np.ndarray:
        """Where a place whose share is 1 is by the period alone, at times [T] (s) since the phase was 0, from its mean [T, 3], m."""
        return waves(seconds / self.period, len(self.way) // 2) @ self.way[: len(self.way) // 2 * 2]

    def where(self, seconds: np.ndarray) -> np.ndarray:
        """Where that place is at these times as it was watched, from its mean [T, 3], m; outside of what was watched as in `path`."""
        if not len(self.beside):
            return self.path(seconds)
        whole = seconds / (self.cycles * self.period)
        inside = (whole >= 0) & (whole <= 1 + 1e-6)  # a last image is rounded
        return self.path(seconds) + np.outer(inside * (cosines(whole, len(self.beside)) @ self.beside), self.way[-1])

    @property
    def direction(self) -> np.ndarray:
        """Direction [3], world, of the way, from where tissue rests longest."""
        path = self.path(np.arange(_PHASES) * self.period / _PHASES)
        direction = np.linalg.svd(path)[2][0]
        along = path @ direction
        return -direction if along.mean() > (along.max() + along.min()) / 2 else direction

    @property
    def reach(self) -> float:
        """How far a place whose share is 1 goes, there or back, m."""
        path = self.path(np.arange(_PHASES) * self.period / _PHASES)
        return float(np.linalg.norm(path[:, None] - path, axis=-1).max())


@dataclass(frozen=True)
class TissueMotion:
    """Where tissue is displaced to from its mean position, over time.

    Args:
        start: When phases are 0, s, by the stamps of the recording.
        points: Mean positions [N, 3] of points that were followed, m, world.
        parts: Breath, heart or both.
        lens: Pose [4, 4] of the lens in the frame of the recorded camera, m, where it was told by such poses. None: by the recorded ones.
            It is for the preparation of the same frames, and not saved.
    """

    start: float
    points: np.ndarray
    parts: tuple[PeriodicMotion, ...]
    lens: np.ndarray | None = None

    @property
    def end(self) -> float:
        """Until when it was watched, s, by the stamps of the recording."""
        return self.start + self.parts[0].cycles * self.parts[0].period

    def moved(self, seconds: np.ndarray) -> np.ndarray:
        """How far its points are from their mean positions after so many seconds [T]: [N, T, 3], m, world."""
        return sum((part.shares[:, None, None] * part.where(seconds) for part in self.parts), np.zeros((len(self.points), len(seconds), 3)))

    @functools.cached_property
    def amplitudes(self) -> list[float]:
        """How far tissue goes by each part, there or back, m, where it goes farthest; all points but a hundredth go less far."""
        # Of what is smooth between points: the largest share of all would be the one that is most wrong.
        shares = np.quantile(np.abs(self.shares(self.points)), 0.99, axis=0)
        return [float(share * part.reach) for share, part in zip(shares, self.parts)]

    @property
    def told(self) -> str:
        """How far each part goes and how often, in words."""
        return " and ".join(f"{1e3 * far:.1f} mm every {part.period:.2f} s" for far, part in zip(self.amplitudes, self.parts))

    def watched(self, stamp_ns: int) -> bool:
        """Whether it was still watched at the time of a stamp (ns)."""
        return stamp_ns <= 1e9 * self.end + 1000  # seconds of today hold no single nanoseconds

    @property
    def parameters(self) -> dict[str, float]:
        """What physics calls amplitudes (m) and periods (s) of the motion that was found: options of `MotionConfig` beside its `file`."""
        found = {}
        for part, amplitude in zip(self.parts, self.amplitudes):
            found |= {part.name: round(amplitude, 6), f"{part.name}_period": round(part.period, 6)}
        return found

    def save(self, folder: Path, model: GaussianModel) -> None:
        """Write it into a folder beside the model that it moves: `MOTION_FILE`, and `MOTION_PARAMETERS` for that."""
        written: dict[str, Any] = {name: np.array([getattr(part, name) for part in self.parts]) for name in _NUMBERS}
        written |= {f"way {part.name}": part.way for part in self.parts} | dict(zip(_PLACE, _place(model)))
        written |= {f"beside {part.name}": part.beside for part in self.parts if len(part.beside)}
        written |= {"start": self.start, "points": self.points, "shares": np.stack([part.shares for part in self.parts])}
        np.savez_compressed(folder / MOTION_FILE, **written)
        parameters = {f"motion.{name}": value for name, value in {"file": MOTION_FILE, **self.parameters}.items()}
        (folder / MOTION_PARAMETERS).write_text(yaml.safe_dump({"/**/physics_node": {"ros__parameters": parameters}}, sort_keys=False))

    @classmethod
    def load(cls, path: Path, model: GaussianModel | None) -> "TissueMotion":
        """What `save` wrote beside a model.

        Args:
            path: Of the file.
            model: The model. None: whose motion it is cannot be told yet.

        Raises:
            MotionError: If the file cannot be read, or is of another model.
        """
        try:
            with path.open("rb") as opened:
                if not zipfile.is_zipfile(opened):  # numpy would tell to trust it
                    raise ValueError("it is no .npz file")
            with np.load(path) as file:
                read = {name: file[name] for name in file.files}
            numbers = zip(*(read[name].tolist() for name in _NUMBERS), read["shares"], strict=True)
            beside = lambda name: read.get(f"beside {name}", np.zeros(0))
            parts = tuple(
                PeriodicMotion(name, T, explained, n, read[f"way {name}"], own, beside(name)) for name, T, explained, n, own in numbers
            )
            motion = cls(float(read["start"]), read["points"], parts)
            count, *place = (read[name] for name in _PLACE)
            values = [motion.points, *place, [motion.start], *([part.period, part.explained, part.cycles] for part in parts)]
            values += [each for part in parts for each in (part.way, part.shares, part.beside)]
            names = [part.name for part in parts]
            good = len({*names}) == len(names) and {*names} <= {*MOTIONS}
            good = good and all(np.isrealobj(each) and np.isfinite(each).all() for each in values)
            good = (
                good
                and np.ndim(count) == 0
                and motion.points.shape == (len(parts[0].shares), 3)
                and place[0].shape == place[1].shape == (3,)
            )
            good = good and all(_SHORTEST < part.period < _MOST and part.cycles > 0 and part.beside.ndim == 1 for part in parts)
            good = good and all(part.way.shape == (len(part.way) // 2 * 2 + (len(part.beside) > 0), 3) for part in parts)
            with np.errstate(over="ignore", invalid="ignore"):
                good = good and all(0 < far < _MOST for far in motion.amplitudes)
            if not good:
                raise ValueError("its numbers do not fit together")
        except FileNotFoundError:
            raise MotionError(f"{path}: there is no such file; give the motion.npz beside the model") from None
        except (OSError, ValueError, TypeError, LookupError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise MotionError(f"{path}: this is no motion that a reconstruction has written ({error})") from error
        if model is None:
            return motion
        here, *own = _place(model)
        if here != count or np.abs(np.subtract(own, place)).max() > _APART * np.linalg.norm(place[1]):
            was, now = (f"{n} Gaussians about {np.round(at, 6).tolist()} m" for n, at in ((count, place[0]), (here, own[0])))
            raise MotionError(f"{path}: this is the motion of another model, of {was}; the model here has {now}; give the file beside it")
        return motion

    def shares(self, places: np.ndarray) -> np.ndarray:
        """Of each part, those of places [M, 3] (m, world), mean positions: [M, parts]."""
        return self.follows(places)[..., 0]

    def follows(self, places: np.ndarray) -> np.ndarray:
        """How places [M, 3] (m, world), mean positions, follow each part: their shares, and the slopes of these, 1/m [M, parts, 4]."""
        return interpolated_between(self.points, np.stack([part.shares for part in self.parts], 1), places)

    def paths(self, stamp_ns: int) -> np.ndarray:
        """Where places whose share is 1 are by each part at the time of a stamp (ns), from their mean [parts, 3], m."""
        seconds = np.array([stamp_ns * 1e-9 - self.start])
        return np.concatenate([part.where(seconds) for part in self.parts])

    def ways_from(self, camera: Camera, depth: np.ndarray, since: int | None) -> Callable[[int | None], np.ndarray]:
        """How far tissue goes between two times, which a camera sees at a depth [H, W] (m) at the first: a function of the second time that
        returns ways [H, W, 3], m, world. Times are stamps (ns), or None: when tissue is in its mean position."""
        at = lambda stamp_ns: np.zeros((len(self.parts), 3)) if stamp_ns is None else self.paths(stamp_ns)
        height, width = depth.shape
        columns, rows = (np.arange(-(-size // CELL)) * CELL + CELL // 2 for size in (width, height))  # shares are smooth
        uv = np.stack(np.meshgrid(columns, rows), -1)
        places = camera.unproject(uv.reshape(-1, 2), depth[rows.clip(max=height - 1)][:, columns.clip(max=width - 1)].ravel())
        shares = self.shares(places)
        for _ in range(0 if since is None else 2):  # they are of mean positions
            shares = self.shares(places - shares @ at(since))
        size = uv.shape[1] * CELL, uv.shape[0] * CELL

        def ways(until: int | None) -> np.ndarray:
            cells = (shares @ (at(until) - at(since))).reshape(*uv.shape[:2], 3)
            return cv2.resize(cells, size, interpolation=cv2.INTER_LINEAR)[:height, :width]

        return ways


class MovingModel:
    """A model of tissue in its mean position that moves.

    Args:
        model: In the mean position.
        motion: None moves nothing.
    """

    def __init__(self, model: GaussianModel, motion: TissueMotion | None):
        self._model, self._motion = model, motion
        means = model.means
        self._follows = None if motion is None else means.new_tensor(motion.follows(means.cpu().numpy().astype(np.float64)))

    def at(self, stamp_ns: int) -> GaussianModel:
        """The model at the time of a stamp (ns)."""
        if self._motion is None or self._follows is None:
            return self._model
        return displaced(self._model, self._follows, self._follows.new_tensor(self._motion.paths(stamp_ns)))


def moved(means: Tensor, follows: Tensor, paths: Tensor) -> Tensor:
    """Where Gaussians whose mean positions are these [N, 3] are, m. Other arguments are those of `displaced`."""
    # Without a matrix product: libraries give other last bits with other numbers of threads.
    return means + (follows[..., :1] * paths).sum(1)


def displaced(model: GaussianModel, follows: Tensor, paths: Tensor) -> GaussianModel:
    """The model where its tissue has moved to; with gradients. Gaussians keep their shapes, normals turn with the tissue.

    Args:
        model: In the mean position.
        follows: How its Gaussians follow each part [N, parts, 4], as `TissueMotion.follows` has it.
        paths: Where places whose share is 1 are by each part, from their mean [parts, 3], m.
    """
    gloss, model = model.gloss, replace(model, means=moved(model.means, follows, paths))
    if gloss is None:
        return model
    # Those of a surface turn by the inverse transposed deformation gradient, (I + Σ path ⊗ slope)⁻ᵀ; here to first order.
    normals = gloss[:, :6].unflatten(1, (2, 1, 3))
    turned = normals[:, :, 0] - ((normals * paths).sum(3, keepdim=True) * follows[:, None, :, 1:]).sum(2)
    return replace(model, gloss=torch.cat([turned.flatten(1), gloss[:, 6:]], 1))


def waves(phases: np.ndarray, harmonics: int) -> np.ndarray:
    """Cosines and sines of so many harmonics at phases [T], in periods, [T, 2 H]."""
    return np.stack([wave(2 * np.pi * k * phases) for k in range(1, harmonics + 1) for wave in (np.cos, np.sin)], 1)


def cosines(whole: np.ndarray, terms: int) -> np.ndarray:
    """So many terms of a cosine series at parts [T] of a whole, 0 to 1, [T, K]; the first is one."""
    return np.cos(np.pi * np.outer(whole, np.arange(terms)))


def _place(model: GaussianModel) -> tuple[int, np.ndarray, np.ndarray]:
    """What tells a model from others: its number of Gaussians, their centre [3] and their spread [3], m, world."""
    means = model.means.detach().cpu().double().numpy()
    return len(means), means.mean(0), means.std(0)
