"""The pictures of a recorded run: the one at rest shows tissue alone."""

import numpy as np
import pytest

from endo_sim_ros import messages
from endo_sim_ros.core.frames import SequenceError
from endo_sim_ros.evaluation.interaction_report import TouchReport
from endo_sim_ros.sequences.bag import BagWriter

TYPES = messages.bag_types()
TISSUE, STEEL = 100, 200  # grey levels
BEGAN = 10.0  # s: the first stamp of the tool's pose
K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])


def recording(path, shown_from, times, first_depth=0.1, force=(0.0, 0, 1)):
    """A bag with images of tissue, with an instrument in half of each from some time on, and a tool that acts from `BEGAN` on.

    The tool is 0.1 m before the lens; in its first tenth of a second it is at the first depth, and feels nothing.
    """
    with BagWriter(path) as bag:

        def write(topic, encode, time, *values):
            stamp = round(time * 1e9)
            bag.write(topic, encode(*values[:-1], stamp, values[-1], TYPES), stamp)

        tissue, pose = np.full((48, 64, 3), TISSUE, np.uint8), np.eye(4)
        write(messages.LEFT_IMAGE, messages.encode_image, 1.0, tissue, "endoscope_left")
        write(messages.CAMERA_POSE, messages.encode_pose, 1.0, pose, "world")
        for time in times:
            image = tissue.copy()
            image[24:] = STEEL if time >= shown_from else TISSUE
            write(messages.RENDERED_IMAGE, messages.encode_image, time, image, "endoscope_left")
            write(messages.RENDERED_DEPTH, messages.encode_image, time, np.full((48, 64), 0.1, np.float32), "endoscope_left")
            write(messages.RENDERED_POSE, messages.encode_pose, time, pose, "world")
            info = messages.encode_camera_info(K, 64, 48, round(time * 1e9), "endoscope_left", types=TYPES)
            bag.write(messages.RENDERED_INFO, info, round(time * 1e9))
            if time >= BEGAN:
                tip = np.eye(4)
                felt = np.array(force) * (time >= BEGAN + 0.1)
                tip[2, 3] = 0.1 if felt.any() else first_depth
                write(messages.tool_pose("PSM1"), messages.encode_pose, time, tip, "world")
                write(messages.tool_reaction("PSM1"), messages.encode_wrench, time, felt, np.zeros(3), "PSM1")
    return path


@pytest.mark.parametrize("ahead", [0.0, 0.1, 0.4])
def test_the_picture_at_rest_is_from_before_an_instrument_can_be_in_it(tmp_path, ahead):
    report = TouchReport(recording(tmp_path / "bag", BEGAN - ahead, np.arange(9.0, 11.0, 0.05)), "PSM1")
    pictures, quality = report.moments()
    (_, reference), (_, at_rest) = pictures[:2]
    assert (at_rest == TISSUE).all() and np.array_equal(at_rest, reference)
    rest, force = quality.split("; ")
    assert float(rest.split()[-3]) > 60 and force == "at most 1.00 N on the tool", quality  # dB, N
    assert all((picture == STEEL).any() for _, picture in pictures[3:])


def test_the_first_picture_stands_for_rest_where_the_tool_acts_at_once(tmp_path):
    report = TouchReport(recording(tmp_path / "bag", BEGAN, np.arange(9.8, 11.0, 0.05)), "PSM1")
    assert (report.moments()[0][1][1] == TISSUE).all()


def test_a_tool_that_missed_the_tissue_is_told_so(tmp_path):
    report = TouchReport(recording(tmp_path / "bag", BEGAN, np.arange(9.0, 11.0, 0.05), force=(0, 0, 0)), "PSM1")
    assert report.moments()[1].endswith("; the tool felt no tissue")


def test_a_run_without_pictures_before_the_tool_is_refused(tmp_path):
    with pytest.raises(SequenceError, match="no images were rendered before and while the tool PSM1 acted"):
        TouchReport(recording(tmp_path / "bag", BEGAN, np.arange(BEGAN, 11.0, 0.05)), "PSM1")


@pytest.mark.parametrize("first_depth", [0.1, 1e-6, -0.01])
def test_arrows_are_as_long_wherever_the_tool_comes_from(tmp_path, first_depth):
    bag = recording(tmp_path / "bag", np.inf, np.arange(9.0, 11.0, 0.05), first_depth, force=(-1.0, 0, 0))
    _, picture = TouchReport(bag, "PSM1").moments()[0][-1]
    green = np.flatnonzero((picture[..., 1] > picture[..., 0] + 50).any(0))  # columns; the force on the tissue points to the right
    assert green.min() > 29 and abs(green.max() - (32 + 0.3 * 64)) <= 3, green
