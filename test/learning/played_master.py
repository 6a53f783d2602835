"""Masters of a dVRK console that a test plays, in a process of their own. Each line on its input is JSON and says what holds from then on:
`name` and `place` (m, in the frame of the surgeon's display), or `gripper` (rad), `clutch`, `present` (buttons)."""

import json
import sys
import threading

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState, Joy


def main():
    rclpy.init()
    node = rclpy.create_node("console")
    names = sys.argv[1:]
    poses = {name: node.create_publisher(PoseStamped, f"{name}/measured_cp", 10) for name in names}
    grippers = {name: node.create_publisher(JointState, f"{name}/gripper/measured_js", 10) for name in names}
    pedals = {
        "clutch": node.create_publisher(Joy, "footpedals/clutch", 10),
        "present": node.create_publisher(Joy, "console/operator_present", 10),
    }
    places, angles = {name: [0.0, 0.0, 0.3] for name in names}, dict.fromkeys(names, 1.0)
    rng = np.random.default_rng(0)

    def publish():
        for name in names:
            message = PoseStamped()
            place = message.pose.position
            place.x, place.y, place.z = (rng.normal(places[name], 5e-6)).tolist()  # as encoders tell it
            message.pose.orientation.w = 1.0
            poses[name].publish(message)
            grippers[name].publish(JointState(name=["gripper"], position=[angles[name]]))

    def listen():
        for line in sys.stdin:
            said = json.loads(line)
            name = said.get("name", names[0])
            places[name], angles[name] = said.get("place", places[name]), said.get("gripper", angles[name])
            for pedal in pedals.keys() & said.keys():
                pedals[pedal].publish(Joy(buttons=[said[pedal]]))

    node.create_timer(0.005, publish)
    threading.Thread(target=listen, daemon=True).start()
    rclpy.spin(node)


if __name__ == "__main__":
    main()
