"""Whether tissue moves periodically by itself, as by breath and heart: told from tracks of points through a posed recording."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from endo_sim_ros.core.cameras import Camera
from endo_sim_ros.core.features import follow, followable
from endo_sim_ros.core.frames import Frame
from endo_sim_ros.core.tissue_motion import TissueMotion
from endo_sim_ros.reconstruction.bundle import Bundle
from endo_sim_ros.reconstruction.camera_errors import displacement
from endo_sim_ros.reconstruction.periodic_fit import BAND, FEWEST, HARMONICS, Eyes, Rays, Seen, Track
from endo_sim_ros.reconstruction.progress import StageProgress
from endo_sim_ros.reconstruction.scene import useless_right
from endo_sim_ros.reconstruction.stage_configs import MatchingConfig, MotionSearchConfig, PosesConfig
from endo_sim_ros.sequences.recording import spread

_LEAST = 2e-4  # metres: less is noise
_SEARCHED = 200  # longest tracks that tell periods: more take longer and tell the same
_DISTANCE = 7  # pixels between tracked points
_LEAST_TRACKS = 10  # that tell a way
_IMAGES = 24  # that tell by how much poses are all off alike; sixty tell the same
_TURNS = 2  # of telling that and the motion; three tell the same


class Told(NamedTuple):
    """What is told of a recording by some poses."""

    motion: TissueMotion | None
    text: str
    odd: bool = False
    """Whether points move otherwise than tissue does that is at rest or breathes regularly."""
    rays: Rays | None = None
    """Of points that tell where the lens is."""
    moved: np.ndarray | None = None
    """How far these move by a period [N, T, 3], m."""

    @property
    def breathes(self) -> bool:
        """Whether a breath is told, if an irregular one."""
        return self.motion is not None and any(part.name == "breathing" for part in self.motion.parts)


class MotionWatch:
    """Looks for periodic motion of tissue while the frames of a recording go by.

    For a period, every track is triangulated as a point that moves with it: linear least squares with its rays, of both eyes where
    there are two, so that poses tell the motion of the camera from that of the tissue. The period that explains most of what a still
    point leaves over is the motion's: the periodogram of Lomb (1976) and Scargle (1982), of all tracks at once.
    Beside a heartbeat, and where ways are fitted, every point may also slide in proportion to place and axis of the lens, as highlights do.

    Args:
        options: Of the search.
        poses: Whether poses may be corrected, and by how much they are likely off.
        matching: How far features may lie beside where poses have them.
    """

    def __init__(
        self,
        options: MotionSearchConfig = MotionSearchConfig(),
        poses: PosesConfig = PosesConfig(),
        matching: MatchingConfig = MatchingConfig(),
    ):
        self.options, self._poses, self._matching = options, poses, matching
        self._times: list[float] = []
        self._eyes: Eyes = []
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

        Where the lens sits elsewhere on its arm than a hand-eye calibration says, poses are all off alike, and a breath looks irregular or
        like points that move without a period. If it is regular by poses that are changed so, these are taken: see `TissueMotion.lens`.

        Raises:
            Cancelled: If the progress does.
        """
        told = self._told(self._eyes, progress)
        if told.odd and self._poses.correct:
            # Where no breath is told, the one that fits best may be any that goes with the lens.
            guesses = [told] if told.breathes else [told, told._replace(moved=np.zeros_like(told.moved))]
            told = next(filter(None, (self._regular(guess, progress) for guess in guesses)), told)
        return told.motion, told.text

    def _regular(self, told: Told, progress: StageProgress) -> Told | None:
        """What is told by poses that are all changed alike, if that is a regular breath, of what the recorded ones tell."""
        for turn in range(_TURNS):
            if (lens := self._lens(told, progress)) is None:
                return None
            told = self._told([(pose @ lens, left, right) for pose, left, right in self._eyes], progress)
            if told.motion is None or not told.breathes or told.odd and turn == _TURNS - 1:
                return None
            told = told._replace(motion=replace(told.motion, lens=lens))
        return told._replace(text=f"{told.text}, by poses that are all changed alike; by the recorded ones it is not regular")

    def _lens(self, told: Told, progress: StageProgress) -> np.ndarray | None:
        """Where the lens likely is in the frame of the recorded camera [4, 4], m, if points move as is told. None: too few tell it."""
        rays, moved = told.rays, told.moved
        assert self._before is not None and rays is not None and moved is not None
        height, width = self._before.shape
        chosen = spread(range(len(self._eyes)), _IMAGES)
        recorded, theirs = ({n: Camera(eyes[n][1], width, height, eyes[n][0]) for n in chosen} for eyes in (self._eyes, rays.eyes))
        tracks = rays.features(theirs, moved, _SEARCHED)
        bundle = Bundle(list(recorded.values()), tracks, self._poses, self._matching.reprojection_error)
        return displacement(bundle.alike(progress)[0] * bundle.likely) if bundle.told >= self._matching.min_points else None

    def _told(self, eyes: Eyes, progress: StageProgress) -> Told:
        """What is told by these poses."""
        options, times = self.options, np.array(self._times)
        length = float(np.ptp(times)) if len(times) else 0.0
        if length < options.least_cycles * options.shortest_beat or len(times) < 10:
            return Told(None, f"whether the tissue moves by itself cannot be told from {length:.1f} s")
        if (interval := float(np.median(np.diff(times)))) > BAND * options.shortest_breath:
            return Told(None, f"whether the tissue moves by itself cannot be told from images {interval:.1f} s apart")
        lenses = np.array([pose[:3, 3] for pose, *_ in eyes])
        if not self._baseline and np.ptp(lenses, axis=0).max() < options.least_travel:
            return Told(None, "whether the tissue moves by itself cannot be told: one lens that stays where it is sees no depth")
        every = Rays.of(self._ended + self._tracks, times, eyes, self._baseline, options, progress)
        rays = every.longest(2 * options.shortest_breath)
        if len(rays.counts) < _LEAST_TRACKS:
            return Told(None, "whether the tissue moves by itself cannot be told: too few points could be followed for long")
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
        moved_by = lambda rays, most_irregular=options.most_irregular: rays.moved(breath._replace(harmonics=HARMONICS), most_irregular)
        whole = searched
        if breath.pixels:
            if not self._baseline:
                whole = searched.about(moved_by(searched))
            searched = whole.less(moved_by(whole))
        heart = searched.search("heartbeat", drift, 4, options.shortest_beat, slowest, options.least_pixels / 20, share / 2, cycles)
        seen = [each for each in (breath, heart) if each.sure]
        motion, irregular, about = self._motion(every, seen, drift)
        if motion is not None:
            large = [part.name for part, amplitude in zip(motion.parts, motion.amplitudes) if amplitude >= _LEAST]
            if len(large) < len(motion.parts):
                motion, irregular, about = self._motion(every, [each for each in seen if each.name in large], drift)
        if motion is not None:
            parts = []
            for each, amplitude, off in zip(motion.parts, motion.amplitudes, irregular):
                how_sure = f"explains {each.explained:.0%}"
                if len(each.beside):
                    how_sure += f"; not regular, or poses err: off by {off:.0%}, and followed image by image"
                parts.append(f"{1e3 * amplitude:.1f} mm every {each.period:.2f} s ({how_sure})")
            text = f"the tissue moves by itself: {' and '.join(parts)}, seen for {length:.0f} s" + f"; besides, {blurs}" * unclear
            if not unclear and not any(len(part.beside) for part in motion.parts):
                return Told(motion, text, False, about, motion.moved(about.times))
            return Told(motion, text, True, whole, moved_by(whole, np.inf))
        counts = f"less than {options.least_pixels:g} px (root mean square, watch.least_pixels) counts as no breath"
        if unclear:
            return Told(None, blurs, True, whole, moved_by(whole, np.inf))
        return Told(None, f"no breath and no heartbeat seen in {length:.0f} s; {counts}")

    def _motion(self, every: Rays, seen: list[Seen], drift: int) -> tuple[TissueMotion | None, list[float], Rays]:
        """The motion of what was seen, how irregular each part of it is, and the rays of its points; None where nothing was."""
        if not seen:
            return None, [], every
        shortest, start, most_irregular = 2 * self.options.shortest_breath, self._times[0], self.options.most_irregular
        told = lambda rays: rays.longest(shortest).motion_of(seen, start, rays, most_irregular, drift)
        motion, irregular = told(every)
        if not self._baseline:
            every = every.about(motion.moved(every.times))
            motion, irregular = told(every)  # once more tells the same
        return motion, irregular, every
