"""A ROS 2 node that simulates an exported vessel model; it needs rclpy, NumPy and onnxruntime.

    python vessel_node.py --ros-args -p model:=boat.onnx

It subscribes to `commands` (std_msgs/Float64MultiArray, the model's inputs in the card's order, SI
units) and publishes `odometry` (nav_msgs/Odometry) in ROS' own frames: the world is
east-north-up, the vessel forward-left-up. Commands that are older than a second become zero.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "onnx_runtime"))
from vessel import Vessel

PATIENCE = 1.0


class VesselNode(Node):
    """Steps the model by a timer and publishes its motion."""

    def __init__(self) -> None:
        super().__init__("vessel")
        file = self.declare_parameter("model", "boat.onnx").value
        self.vessel = Vessel(str(file))
        self.x = np.zeros(6)
        self.s = self.vessel.initial_state()
        self.w = np.zeros(len(self.vessel.inputs))
        self.heard = self.get_clock().now()
        self.odometry = self.create_publisher(Odometry, "odometry", 10)
        self.create_subscription(Float64MultiArray, "commands", self.command, 10)
        self.create_timer(self.vessel.dt, self.advance)

    def command(self, message: Float64MultiArray) -> None:
        """Take the inputs of the next steps."""
        if len(message.data) != len(self.w):
            self.get_logger().error(
                f"{len(message.data)} commands, expected {', '.join(self.vessel.inputs)}"
            )
            return
        self.w = np.array(message.data)
        self.heard = self.get_clock().now()

    def advance(self) -> None:
        """Step once and publish."""
        now = self.get_clock().now()
        if (now - self.heard).nanoseconds > 1e9 * PATIENCE:
            self.w[:] = 0.0
        after, self.s, outside = self.vessel.step(self.x, self.w, self.s)
        self.x = after[0].astype(float)
        if outside[0]:
            self.get_logger().warning("outside the training range", throttle_duration_sec=5.0)
        self.odometry.publish(self.message(now))

    def message(self, now: rclpy.time.Time) -> Odometry:
        """Return the motion in ROS' frames."""
        north, east, psi, u, v, r = self.x
        out = Odometry()
        out.header.stamp = now.to_msg()
        out.header.frame_id = "map"
        out.child_frame_id = "base_link"
        out.pose.pose.position.x, out.pose.pose.position.y = east, north
        half = 0.5 * (0.5 * math.pi - psi)
        out.pose.pose.orientation.z, out.pose.pose.orientation.w = math.sin(half), math.cos(half)
        out.twist.twist.linear.x, out.twist.twist.linear.y = u, -v
        out.twist.twist.angular.z = -r
        return out


def main() -> None:
    """Run the node until it is stopped."""
    rclpy.init()
    node = VesselNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()


if __name__ == "__main__":
    main()
