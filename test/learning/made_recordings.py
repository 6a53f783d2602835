"""Recordings made by hand, in lockstep and in real time."""

import numpy as np

from endo_sim_ros import messages
from endo_sim_ros.instruments import JOINTS
from endo_sim_ros.messages import ControlNodeCloud, bag_types
from endo_sim_ros.sequences.bag import BagWriter

S = 1_000_000_000
STEP = S // 25
BEGIN = 1000 * S
WIDTH, HEIGHT = 96, 80
TURNED = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # a quarter turn about z


def picture(number):
    """An image that tells its number in its brightness."""
    image = np.full((HEIGHT, WIDTH, 3), 40, np.uint8)
    image[..., 0] = 2 * number % 256
    image[:, : WIDTH // 2, 1] = 200
    return image


def labels(number):
    """What is in each pixel of the picture of a number."""
    found = np.ones((HEIGHT, WIDTH), np.uint8)
    found[:, number % WIDTH] = 2 + number % 5
    return found


def joints(number):
    """Joints of an arm, rad and m."""
    return np.array([0.01, 0.02, 0.001, 0.03, 0.04, 0.05]) * number


REST = np.stack(np.meshgrid(*[np.linspace(-0.02, 0.02, 4)] * 2, [0.1], indexing="ij"), -1).reshape(-1, 3).astype(np.float32)


def nodes(number):
    """Control nodes that moved by a tenth of a millimetre per number along x; one of them twice as far."""
    moved = np.zeros_like(REST)
    moved[:, 0] = 1e-4 * number
    moved[3, 0] *= 2
    return ControlNodeCloud(REST, REST + moved, np.tile(np.eye(3, dtype=np.float32), (len(REST), 1, 1)), S)


def tip(number, arm="PSM1"):
    pose = TURNED.copy()
    pose[:3, 3] = (0.001 * number, 0.01 if arm == "PSM1" else -0.01, 0.1)
    return pose


class Recording:
    """Writes messages of a graph, images as JPEG or raw; times in nanoseconds since the beginning."""

    def __init__(self, path, compressed=False):
        self.bag, self.types, self.clock, self.compressed = BagWriter(path), bag_types(), 7 * S, compressed

    def __enter__(self):
        self.bag.__enter__()
        return self

    def __exit__(self, *error):
        self.bag.__exit__(*error)

    def observe(self, time_ns, number, arms=("PSM1",), leave_out=()):
        """What the graph says in a step."""
        stamp = BEGIN + time_ns
        image = (messages.RENDERED_IMAGE, messages.encode_image(picture(number), stamp, "camera", self.types))
        if self.compressed:
            image = (messages.RENDERED_COMPRESSED, messages.encode_compressed(picture(number), stamp, "camera", 95, self.types))
        said = [(messages.CONTROL_NODES, messages.encode_control_nodes(nodes(number), stamp, "world", self.types)), image]
        for arm in arms:
            reaction = messages.encode_wrench((number, 0, 0), (0, 0, number), stamp, arm, self.types)  # in axes of the tip
            said.append((messages.tool_reaction(arm), reaction))
        self.write(said, leave_out)

    def see(self, time_ns, number, arms=("PSM1",)):
        """What the graph says beside that, of a step."""
        stamp, types = BEGIN + time_ns, self.types
        right = (messages.RENDERED_RIGHT_IMAGE, messages.encode_image(picture(number)[:, ::-1], stamp, "camera", types))
        if self.compressed:
            right = (messages.RENDERED_RIGHT_COMPRESSED, messages.encode_compressed(picture(number)[:, ::-1], stamp, "camera", 95, types))
        said = [right, (messages.RENDERED_SEGMENTATION, messages.encode_image(labels(number), stamp, "camera", types))]
        outcome = messages.encode_outcome(0.5 * number, number == 11, number == 11, 7, np.array([1.0, 2.0, 3.0]), stamp, types)
        said.append((messages.TASK_OUTCOME, outcome))
        said.append((messages.RENDERED_POSE, messages.encode_pose(tip(number), stamp, "world", types)))
        for arm in arms:
            none = np.zeros(0)
            said.append((messages.tool_joints(arm), messages.encode_joints(JOINTS, joints(number), none, none, stamp, types)))
        self.write(said)

    def act(self, time_ns, number, arms=("PSM1",), leave_out=(), frame="world", base=None):
        """What a policy says; poses in the world, or in the frame of a robot's base with its pose in the world."""
        stamp = BEGIN + time_ns
        name, pose_of_base = base or ("world", np.eye(4))
        said = []
        for arm in arms:
            pose = np.linalg.inv(pose_of_base) @ tip(number, arm)
            said.append((messages.tool_pose(arm), messages.encode_pose(pose, stamp, name, self.types)))
            wrench = messages.encode_wrench((0, 0, -number), (0, number, 0), stamp, frame, self.types)
            said.append((messages.tool_wrench(arm), wrench))
            said.append((messages.tool_jaw(arm), messages.encode_jaw(0.01 * number, stamp, self.types)))
        self.write(said, leave_out)

    def tell_joints(self, time_ns, number, arms):
        """What physics_node says of all arms, the camera's too, which lies first here."""
        names, positions = ["ECM_yaw", "ECM_pitch", "ECM_insertion", "ECM_roll"], [9.0, 9.0, 9.0, 9.0]
        for place, arm in enumerate(arms):
            names += [f"{arm.replace('/', '_')}_{joint}" for joint in (*JOINTS, "jaw")]
            positions += [*(joints(number) + place), 0.5]
        none, stamp = np.zeros(0), BEGIN + time_ns
        self.write([(messages.JOINT_STATES, messages.encode_joints(names, np.array(positions), none, none, stamp, self.types))])

    def command(self, time_ns, number, arm="PSM1"):
        """A command of the arm's tip, 2 cm beside where `act` has it."""
        pose = tip(number, arm)
        pose[1, 3] += 0.02
        self.write([(messages.tool_pose_command(arm), messages.encode_pose(pose, BEGIN + time_ns, "world", self.types))])

    def write(self, said, leave_out=()):
        for topic, message in said:
            if topic not in leave_out:
                self.clock += S // 1000  # when it was recorded means nothing
                self.bag.write(topic, message, self.clock)


def lockstep(path, steps=12, missing=(), step=STEP, compressed=False, everything=False, **options):
    """A first observation, then commands with the observations that they lead to, with equal stamps; everything: what `see` writes."""
    with Recording(path, compressed) as recording:
        recording.act(0, 0, **options)
        recording.observe(0, 0)
        if everything:
            recording.see(0, 0)
        for number in range(1, steps):
            if number not in missing:
                recording.act(step * number, number, **options)
                recording.observe(step * number, number)
                if everything:
                    recording.see(step * number, number)
    return path


def realtime(path, seconds=2.0, leave_out=(), arms=("PSM1",), **options):
    """Observations at 25 Hz, commands at 100 Hz, out of phase; both count up from 0 at 0 s."""
    with Recording(path) as recording:
        for tick in range(int(seconds * 100)):
            recording.act(tick * S // 100 + 1_000_000, tick, arms, leave_out, **options)
            if tick % 4 == 0:
                recording.observe(tick * S // 100 + 3_000_000, tick // 4, arms, leave_out)
    return path
