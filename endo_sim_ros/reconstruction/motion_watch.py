"""Whether tissue moves periodically by itself, as by breath and heart: told from tracks of points through a posed recording."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import cv2
import numpy as np

from endo_sim_ros.core.features import follow, followable
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.tissue_motion import TissueMotion
from endo_sim_ros.reconstruction.periodic_fit import BAND, FEWEST, HARMONICS, Rays, Seen, Track
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import useless_right
from endo_sim_ros.reconstruction.stage_configs import MotionSearchConfig

_LEAST = 2e-4  # metres: less is noise
_SEARCHED = 200  # longest tracks that tell periods: more take longer and tell the same
_DISTANCE = 7  # pixels between tracked points
_LEAST_TRACKS = 10  # that tell a way


class MotionWatch:
    """Looks for periodic motion of tissue while the frames of a recording go by.

    For a period, every track is triangulated as a point that moves with it: linear least squares with its rays, of both eyes where
    there are two, so that poses tell the motion of the camera from that of the tissue. The period that explains most of what a still
    point leaves over is the motion's: the periodogram of Lomb (1976) and Scargle (1982), of all tracks at once.
    Beside a heartbeat, and where ways are fitted, every point may also slide in proportion to place and axis of the lens, as highlights do.

    Args:
        options: Of the search.
    """

    def __init__(self, options: MotionSearchConfig = MotionSearchConfig()):
        self.options = options
        self._times: list[float] = []
        self._eyes: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []  # pose, K of the left and of the right camera
        self._baseline = 0.0
        self._ended: list[Track] = []  # those through enough images: points that are lost at once would fill the memory
        self._tracks: list[Track] = []
        self._before: np.ndarray | None = None

    @property
    def complete(self) -> bool:
        """Whether it has looked at as many images as it may."""
        return len(self._times) >= self.options.images

    def watch(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """All frames, each looked at as it goes by until the watch is complete."""
        for frame in frames:
            if not self.complete:
                self.look(frame)
            yield frame

    def look(self, frame: Frame) -> None:
        """Follow points into a frame; one that comes too soon after the last is left out."""
        seconds = frame.stamp_ns * 1e-9
        if self._times and seconds - self._times[-1] < 0.999 / self.options.rate:
            return
        scale = min(self.options.width / frame.camera.width, 1.0)
        size = max(round(frame.camera.width * scale), 1), max(round(frame.camera.height * scale), 1)
        eyes = frame.image, None if useless_right(frame) else frame.right
        gray = [None if image is None else cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
                for image in eyes]  # fmt: skip
        image, right = gray
        assert image is not None
        fit = np.diag([size[0] / frame.camera.width, size[1] / frame.camera.height, 1.0])
        number = len(self._times)
        self._times.append(seconds)
        self._eyes.append((frame.camera.pose, fit @ frame.camera.K, fit @ frame.right_intrinsics))
        self._baseline = (right is not None and frame.baseline) or self._baseline
        free = followable(cv2.resize(frame.tissue, size, interpolation=cv2.INTER_AREA) > 0.999)  # pixels that are tissue alone
        if self._before is not None and self._before.shape != image.shape:
            self._ended, self._tracks = self._ended + self._tracks, []
        if self._before is not None and self._tracks:
            was = np.array([track.left[-1] for track in self._tracks], np.float32)
            now, good = follow(self._before, image, was, was)
            columns, rows = now.round().astype(int).clip(0, np.array(size) - 1).T
            good &= free[rows, columns] > 0  # else the edge of a mask takes them along
            self._ended += [track for track, kept in zip(self._tracks, good) if not kept and len(track.left) >= FEWEST]
            self._tracks = [track for track, kept in zip(self._tracks, good) if kept]
            for track, place in zip(self._tracks, now[good]):
                track.left.append(place)
        for track in self._tracks:
            cv2.circle(free, (round(float(track.left[-1][0])), round(float(track.left[-1][1]))), _DISTANCE, 0, -1)
        wanted = self.options.points - len(self._tracks)
        if wanted > self.options.points // 10:
            found = cv2.goodFeaturesToTrack(image, wanted, 0.01, _DISTANCE, mask=free)
            self._tracks += [Track(number, [place], []) for place in (() if found is None else found[:, 0])]
        if right is not None and self._tracks:
            places = np.array([track.left[-1] for track in self._tracks], np.float32)
            guesses = [track.left[-1] - (track.left[-2] - track.right[-1] if track.right else 0) for track in self._tracks]
            guesses = np.where(np.isfinite(guesses), guesses, places).astype(np.float32)
            found, good = follow(image, right, places, guesses)
            good &= np.abs(found[:, 1] - places[:, 1]) < 1.5
            for track, place, kept in zip(self._tracks, found, good):
                track.right += [np.full(2, np.nan)] * (len(track.left) - 1 - len(track.right)) + [place if kept else np.full(2, np.nan)]
        self._before = image

    def found(self, progress: StageProgress = StageProgress()) -> tuple[TissueMotion | None, str]:
        """The motion, breath before heart, and a sentence that says so or why nothing can be told.

        Raises:
            Cancelled: If the progress does.
        """
        options, times = self.options, np.array(self._times)
        length = float(np.ptp(times)) if len(times) else 0.0
        if length < options.least_cycles * options.shortest_beat or len(times) < 10:
            return None, f"whether the tissue moves by itself cannot be told from {length:.1f} s"
        if (interval := float(np.median(np.diff(times)))) > BAND * options.shortest_breath:
            return None, f"whether the tissue moves by itself cannot be told from images {interval:.1f} s apart"
        lenses = np.array([pose[:3, 3] for pose, *_ in self._eyes])
        if not self._baseline and np.ptp(lenses, axis=0).max() < options.least_travel:
            return None, "whether the tissue moves by itself cannot be told: one lens that stays where it is sees no depth"
        every = Rays.of(self._ended + self._tracks, times, self._eyes, self._baseline, options, progress)
        rays = every.longest(2 * options.shortest_breath)
        if len(rays.counts) < _LEAST_TRACKS:
            return None, "whether the tissue moves by itself cannot be told: too few points could be followed for long"
        searched = rays.first(_SEARCHED)
        between, drift = options.shortest_breath, 1 + int(2 * length / options.shortest_breath)
        share, cycles = options.least_explained, options.least_cycles
        # What is slower than a heart is drift to it. A knock has many harmonics.
        # A breath is as slow as the lens: what follows that would follow it, too.
        breath = replace(searched, lens=searched.lens[:, :0]).search(
            "breathing", 1, 1, between, options.longest_breath, options.least_pixels, share, cycles
        )
        unclear = breath.pixels > 0 and not breath.sure
        slowest = 0.8 * between
        blurs = ""
        if unclear:  # its harmonics may look like a heart
            share, slowest = 2 * share, min(slowest, 1 / ((HARMONICS + 1) * breath.rate))
            blurs = (
                f"points move by {breath.pixels:.1f} pixels in {length:.0f} s, but no regular breath is seen {cycles:g} times, "
                f"so this stays in the pictures and blurs the model: film {cycles:g} regular breaths or more; "
                "where nothing breathes, check poses and stamps"
            )
        if breath.pixels:
            moved_by = lambda rays: rays.moved(breath._replace(harmonics=HARMONICS), options.most_irregular)
            if not self._baseline:
                searched = searched.about(moved_by(searched))
            searched = searched.less(moved_by(searched))
        heart = searched.search("heartbeat", drift, 4, options.shortest_beat, slowest, options.least_pixels / 20, share / 2, cycles)
        seen = [each for each in (breath, heart) if each.sure]
        motion, irregular = self._motion(every, seen, drift)
        if motion is not None:
            large = [part.name for part, amplitude in zip(motion.parts, motion.amplitudes) if amplitude >= _LEAST]
            if len(large) < len(motion.parts):
                motion, irregular = self._motion(every, [each for each in seen if each.name in large], drift)
        if motion is not None:
            parts = []
            for each, amplitude, off in zip(motion.parts, motion.amplitudes, irregular):
                how_sure = f"explains {each.explained:.0%}"
                if len(each.beside):
                    how_sure += f"; not regular, or poses err: off by {off:.0%}, and followed image by image"
                parts.append(f"{1e3 * amplitude:.1f} mm every {each.period:.2f} s ({how_sure})")
            return motion, f"the tissue moves by itself: {' and '.join(parts)}, seen for {length:.0f} s" + f"; besides, {blurs}" * unclear
        counts = f"less than {options.least_pixels:g} px (root mean square, watch.least_pixels) counts as no breath"
        return None, blurs or f"no breath and no heartbeat seen in {length:.0f} s; {counts}"

    def _motion(self, every: Rays, seen: list[Seen], drift: int) -> tuple[TissueMotion | None, list[float]]:
        """The motion of what was seen, and how irregular each part of it is; None where nothing was."""
        if not seen:
            return None, []
        shortest, start, most_irregular = 2 * self.options.shortest_breath, self._times[0], self.options.most_irregular
        told = lambda rays: rays.longest(shortest).motion_of(seen, start, rays, most_irregular, drift)
        motion, irregular = told(every)
        return (motion, irregular) if self._baseline else told(every.about(motion.moved(every.times)))  # once more tells the same
