"""Messages that a node must refuse."""

import numpy as np
from ros_bench import HEIGHT, WIDTH

from endo_sim_ros import messages


def bad_image(change):
    def make(frame):
        message = messages.encode_image(frame.image, frame.stamp_ns, "endoscope_left")
        change(message)
        return messages.LEFT_IMAGE, message

    return make


def bad_pose(change):
    def make(frame):
        message = messages.encode_pose(frame.camera.pose, frame.stamp_ns, "world")
        change(message)
        return messages.CAMERA_POSE, message

    return make


def bad_info(frame):
    message = messages.encode_camera_info(np.zeros((3, 3)), WIDTH, HEIGHT, frame.stamp_ns, "endoscope_left")
    return messages.LEFT_INFO, message


def damaged_jpeg(frame):
    message = messages.ros_class(messages.LEFT_COMPRESSED.type)(format="jpeg", data=b"\xff\xd8 not a picture")
    message.header.stamp.sec = 1
    return messages.LEFT_COMPRESSED, message


BAD_RECORDINGS = {
    "wrong_encoding": (bad_image(lambda m: setattr(m, "encoding", "yuv422")), "encoding 'yuv422' is not supported"),
    "mismatched_sizes": (bad_image(lambda m: setattr(m, "width", 200)), "size and data disagree"),
    "stamp_of_zero": (bad_image(lambda m: setattr(m.header, "stamp", type(m.header.stamp)())), "a stamp of zero"),
    "damaged_jpeg": (damaged_jpeg, "not a readable jpeg or png"),
    "zero_K": (bad_info, "the camera is not calibrated"),
    "non_finite_pose": (bad_pose(lambda m: setattr(m.pose.position, "x", float("nan"))), "the pose is not finite"),
    "non_unit_pose": (bad_pose(lambda m: setattr(m.pose.orientation, "w", 2.0)), "normalise it before publishing"),
    "unknown_frame": (bad_pose(lambda m: setattr(m.header, "frame_id", "base_link")), "unknown frame 'base_link'"),
}


def truncate(message):
    message.data = message.data[:-100]
