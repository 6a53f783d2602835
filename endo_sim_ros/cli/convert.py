"""`endo-sim convert`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.progress import Progress
from tyro.conf import Positional

from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.core.progress_bar import stages_in


@dataclass(frozen=True)
class Command:
    """Turn a recording (StereoMIS, SCARED, EndoNeRF, COLMAP, folder of images, video) into a rosbag2."""

    source: Positional[Path]
    """Folder or file of the recording."""
    bag: Positional[Path]
    """Folder of the new bag; it must not exist."""
    kind: str = "auto"
    """Layout: stereomis, scared, endonerf, colmap, folder or video; auto recognises it."""
    start: int | None = None
    """First frame number."""
    stop: int | None = None
    """Frame number to stop before."""
    step: int | None = None
    """Take every n-th frame."""
    fps: float | None = None
    """Frame rate, Hz; default: that of the recording."""
    split: Literal["train", "test"] | None = None
    """StereoMIS: only the frame ranges of this split."""
    pose_lag: int | None = None
    """StereoMIS: frame n has the pose in row n - pose_lag of groundtruth.txt; default: found from the images."""
    mask_polarity: Literal["auto", "tool", "tissue"] | None = None
    """StereoMIS, EndoNeRF, COLMAP, folder, video: what white means in the masks."""
    max_mask_gap: int | None = None
    """StereoMIS: a frame without a mask borrows one from at most this many frames away (default 1)."""
    first_mask: int | None = None
    """StereoMIS: number of the first frame's mask, 0 or 1; default: found from the images."""
    masks_rectified: bool | None = None
    """StereoMIS: whether the masks belong to rectified images; default: found from the images."""
    frames_rectified: bool | None = None
    """StereoMIS: whether the images in video_frames are rectified; folder, video: whether the images are, where the calibration is one of
    ROS or OpenCV. Default: found from stereo pairs; images of one eye are raw."""
    mask_border: bool | None = None
    """COLMAP, folder, video: ignore the black border and round vignette around the image, and burnt-in writing or a logo (default true)."""
    depth_scale: float | None = None
    """EndoNeRF, folder: metres per unit of the depth images (default 0.001)."""
    pose_scale: float | None = None
    """EndoNeRF: metres per unit of the camera positions; default: as the depth images."""
    depth: Literal["scene_points", "keyframe", "none"] | None = None
    """SCARED: depth of every frame (default), of the keyframe alone, which is measured, or none."""
    pose_direction: Literal["auto", "world_to_camera", "camera_to_world"] | None = None
    """SCARED: direction of the poses; auto finds it by comparing images."""
    poses: str | None = None
    """All but EndoNeRF and COLMAP: "sfm" estimates camera poses by structure from motion (COLMAP), "vggt" or "vggt:FOLDER" by that
    network, of whose checkpoint it is the folder; default: those of the recording, else sfm. Video: also a file of poses (frame tx ty
    tz qx qy qz qw, camera-to-world); default: poses.txt beside the video."""
    scale: float | None = None
    """Folder, video: metres per unit of the poses (default 1). The unit of those that are estimated with one eye is the median depth of the
    tissue over all frames, and so is that of COLMAP: 0.06 says that it is 6 cm away."""
    sfm_step: int | None = None
    """Video: structure from motion uses every n-th frame (default 1 with --step, else 6, less of a short video)."""
    threads: int | None = None
    """Video: threads of structure from motion; -1 = all cores (default), 1 = repeatable to the last bit."""
    calibration: Path | None = None
    """Video: YAML file with fx, fy, cx, cy and optional distortion, or a calibration of ROS or OpenCV."""
    fx: float | None = None
    """Video, folder: focal length, pixels, instead of a file; fy, cx and cy follow from it where not given."""
    fy: float | None = None
    """Video, folder: vertical focal length, pixels."""
    cx: float | None = None
    """Video, folder: principal point, pixels."""
    cy: float | None = None
    """Video, folder: principal point, pixels."""
    distortion: tuple[float, ...] | None = None
    """Video, folder of one eye: coefficients k1 [k2 [p1 p2 [k3]]]."""
    baseline_m: float | None = None
    """Video, folder of rectified pairs: metres between the eyes, with fx instead of a file."""
    eyes: Literal["auto", "one", "left_right", "right_left", "top_bottom", "bottom_top"] | None = None
    """Video, folder without right/: whether each picture holds one eye or both, side by side or one above the other, and which is
    first; auto (default) finds out, but not which is first: the left or top one is the left eye."""
    mask: Path | None = None
    """Video: image of one mask for all frames, or a folder of numbered ones."""

    def run(self) -> None:
        """Write the bag; raises SequenceError if it exists or the recording cannot be read."""
        from endo_sim_ros.sequences.bag import write_bag
        from endo_sim_ros.sequences.readers import open_sequence
        from endo_sim_ros.sequences.recording import Recording

        if self.bag.exists():  # before any work
            raise SequenceError(f"{self.bag} exists already; choose another name or remove it first")
        fixed = ("source", "bag", "kind")
        options = {name: value for name, value in vars(self).items() if name not in fixed and value is not None}
        frames = open_sequence(self.source, self.kind, **options)
        if isinstance(frames, Recording) and frames.prepare:
            with Progress() as bar:
                frames.prepare(stages_in(bar, bar.add_task("poses", total=None)))
        points = frames.points() if isinstance(frames, Recording) else None  # what is wrong with them is told first
        with Progress() as bar:
            task = bar.add_task(f"converting {self.source.name}", total=None)
            count = write_bag(self.bag, bar.track(frames, task_id=task), points)
            bar.update(task, total=count, completed=count)  # images without a pose were counted
        print(f"{self.bag}: {count} frame{'s' * (count != 1)}")
