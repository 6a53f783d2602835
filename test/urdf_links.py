"""Where the links of a robot description are, as robot_state_publisher finds it: by the description and joint positions alone."""

from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation


def matrix(origin):
    """Pose [4, 4] of an origin."""
    pose = np.eye(4)
    pose[:3, 3] = list(map(float, origin.get("xyz").split()))
    pose[:3, :3] = Rotation.from_euler("xyz", list(map(float, origin.get("rpy").split()))).as_matrix()
    return pose


def poses_of_links(text, positions, world):
    """The description, and poses [4, 4] of all its links in the world by name, for positions of joints by name."""
    robot = ElementTree.fromstring(text)
    found = {world: np.eye(4)}
    for joint in robot.findall("joint"):
        name, mimic = joint.get("name"), joint.find("mimic")
        position = positions.get(name, 0.0)
        if mimic is not None:
            position = float(mimic.get("multiplier")) * positions[mimic.get("joint")]
        move = np.eye(4)
        if joint.get("type") == "prismatic":
            move[2, 3] = position
        elif joint.get("type") == "revolute":
            move[:3, :3] = Rotation.from_rotvec([0, 0, position]).as_matrix()
        found[joint.find("child").get("link")] = found[joint.find("parent").get("link")] @ matrix(joint.find("origin")) @ move
    return robot, found
