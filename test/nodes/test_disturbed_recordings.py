"""Disturbed recordings: repeated, swapped and unposed images, and gaps."""

import numpy as np
import pytest
import rclpy
from ros_bench import Bench, S, start_ros

from endo_sim_ros import messages
from endo_sim_ros.messages import OK
from endo_sim_ros.nodes.reconstruction_node import ReconstructionNode

pytestmark = pytest.mark.dds


@pytest.fixture
def bench(tmp_path):
    """A reconstruction in this process that is quick to take a pause for the end, and a user."""
    values = {"iterations": 5, "max_gaussians": 300, "image_width": 48, "keyframes": 3, "start_after": 0.4, "image_timeout": 1.0}
    values |= {"plane_sweep": "false", "extrapolation": 0.0, "output_dir": tmp_path}
    start_ros(reconstruction_node=values)
    bench = Bench()
    yield bench
    bench.close()
    rclpy.try_shutdown()


class Recording:
    """Sends the images and poses of a recording in any order."""

    def __init__(self, bench, frames):
        self._bench, self._frames = bench, frames
        camera = frames[0].camera
        info = messages.encode_camera_info(camera.K, camera.width, camera.height, S, "endoscope_left")
        bench.publish(messages.LEFT_INFO, info)

    def image(self, number, shift=0):
        frame = self._frames[number]
        self._bench.publish(messages.LEFT_IMAGE, messages.encode_image(frame.image, frame.stamp_ns + shift, "endoscope_left"))
        self._bench.spin(0.03)

    def pose(self, number, shift=0):
        frame = self._frames[number]
        self._bench.publish(messages.CAMERA_POSE, messages.encode_pose(frame.camera.pose, frame.stamp_ns + shift, "world"))
        self._bench.spin(0.01)


def finished(bench, node, views):
    """Wait for the reconstruction of all of so many views; what diagnostics say."""

    def said():
        for level, text, values in bench.statuses["reconstruction_node"][-1:]:
            return level == OK and "finished" in text and values["views"] == str(views) and values

    values = bench.until(said, lambda: f"{views} views: {bench.statuses['reconstruction_node'][-2:]}", 30)
    assert node.trained == (node.frames[0].stamp_ns, node.frames[-1].stamp_ns)
    return values


@pytest.mark.parametrize("lag", [pytest.param(-3, marks=pytest.mark.thorough), 3])
def test_repeated_swapped_and_unposed_images_are_counted_and_the_others_reconstructed(bench, small_frames, lag):
    """Poses come three images before or after theirs, two never; two images change places, some come twice."""
    node = bench.add(ReconstructionNode)
    recording = Recording(bench, small_frames)
    order = [0, 1, 2, 4, 3, 5, 6, 7, 8, 9, 10, 11]
    for step in range(-3, len(order) + 3):
        if 0 <= step < len(order):
            recording.image(order[step])
            if step % 4 == 1:
                recording.image(order[step])
        if 0 <= step - lag < len(order) and step - lag not in (6, 9):
            recording.pose(step - lag)
    recording.image(0)  # once more, long after it was used
    values = finished(bench, node, views=10)
    assert (values["images without pose"], values["images out of order"], values["images invalid"]) == ("2", "1", "0")
    assert [frame.stamp_ns for frame in node.frames] == [small_frames[k].stamp_ns for k in range(12) if k not in (6, 9)]
    for frame, k in zip(node.frames, (k for k in range(12) if k not in (6, 9)), strict=True):
        np.testing.assert_allclose(frame.camera.pose, small_frames[k].camera.pose, atol=1e-6)


@pytest.mark.thorough
def test_a_recording_with_a_gap_ends_with_the_views_of_both_its_parts(bench, small_frames):
    """The pause is longer than the silence that means the end: a first model comes early, the last is of everything."""
    node = bench.add(ReconstructionNode)
    recording = Recording(bench, small_frames)
    for number in range(12):
        shift = 3 * S * (number > 5)
        if number not in (2, 8):
            recording.pose(number, shift)
        recording.image(number, shift)
        if number == 5:
            bench.until(lambda: node.trained, "the first part to be reconstructed")
            bench.spin(1.0)
    values = finished(bench, node, views=10)
    assert values["images without pose"] == "2" and values["images out of order"] == "0"
