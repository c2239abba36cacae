"""The skeleton of a ROS 2 node round an exported navigation policy. `Walk` is its core, and needs no ROS.

    cuelearner export docs/data/navigation_agent --format onnx --out runs/walker
    python examples/ros2_node.py runs/walker

It hears `scan` (sensor_msgs/LaserScan), `odom` (nav_msgs/Odometry) and `goal` (geometry_msgs/PoseStamped, in the frame
of the odometry), decides every 0.2 s and says `cmd_vel` (geometry_msgs/Twist) ten times as often: what was decided
holds in the world's frame while the body turns under it, as it did in training. It stands still without a goal, at the
goal, and when what it heard is older than half a second.
"""

# pyright: reportMissingImports=false
# (ROS 2 brings its own Python packages)

import sys
from typing import Any

import numpy as np

from cuelearner_jax.export.runner import Decision  # on a robot: the decide.py that lies beside the decision

PERIOD, RATE = 0.2, 0.02  # of decisions and of commands [s]
STALE = 0.5  # [s]
SPEED, TURN_RATE = 1.0, 1.5  # [m/s], [rad/s]
MAX_RANGE, FARTHEST, ARRIVED = 10.0, 15.0, 0.5  # of the lidar, what goal distances are divided by, and the goal [m]
STILL = (0.0, 0.0, 0.0)


def yaw_of(quaternion):
    """Return the yaw of a geometry_msgs/Quaternion [rad]."""
    x, y, z, w = quaternion.x, quaternion.y, quaternion.z, quaternion.w
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


class Walk:
    """The robot's state, and the decision. Times in seconds, angles counterclockwise in radians."""

    def __init__(self, folder):
        """Read a decision. Raises ContractError for a damaged one, ValueError for one of another task."""
        self.decide = Decision(folder)
        observed = self.decide.contract["observation"]["slices"]
        self.slices = {each["name"]: slice(each["from"], each["to"]) for each in observed}
        wanted = {"lidar": 271, "goal: direction": 2, "goal: distance": 1, "previous actions": 6}
        if {each["name"]: each["size"] for each in observed} != wanted:
            raise ValueError(f"{folder} sees {', '.join(self.slices)}: this node is for the navigation task")
        self.beams = np.deg2rad(np.linspace(-135.0, 135.0, 271))
        self.scan: Any = None  # (ranges (271,) [m], time)
        self.pose: Any = None  # ((x, y, yaw), time)
        self.goal: Any = None  # (x, y) [m]
        self.previous = np.zeros((3, 2))
        self.direction: Any = None  # decided last, in the frame of the odometry

    def hear_scan(self, message, now):
        """A LaserScan. Raises ValueError if it does not reach as far round as the policy looks."""
        angles = message.angle_min + message.angle_increment * np.arange(len(message.ranges))
        if angles[0] > self.beams[0] + 0.02 or angles[-1] < self.beams[-1] - 0.02:
            raise ValueError("the scan does not reach from -135 to +135 degrees: turn it, or take another policy")
        ranges = np.asarray(message.ranges, float)
        seen = np.isfinite(ranges) & (ranges >= message.range_min)  # the others met nothing, or nothing true
        self.scan = np.interp(self.beams, angles, np.where(seen, np.minimum(ranges, MAX_RANGE), MAX_RANGE)), now

    def hear_odometry(self, message, now):
        """An Odometry: only its pose."""
        pose = message.pose.pose
        self.pose = (pose.position.x, pose.position.y, yaw_of(pose.orientation)), now

    def hear_goal(self, message):
        """A PoseStamped: only its place."""
        self.goal = np.array([message.pose.position.x, message.pose.position.y])
        self.previous, self.direction = np.zeros((3, 2)), None

    def step(self, now):
        """Decide where to walk until it is called again."""
        self.direction = None
        if self.goal is None or not self.awake(now):
            return
        *place, yaw = self.pose[0]
        turn = self.turned(yaw)
        offset = (self.goal - place) @ turn
        distance = np.linalg.norm(offset)
        if distance < ARRIVED:
            self.goal = None
            return
        obs = np.zeros(self.decide.contract["observation"]["size"], np.float32)
        obs[self.slices["lidar"]] = np.exp(-self.scan[0])
        obs[self.slices["goal: direction"]] = offset / distance
        obs[self.slices["goal: distance"]] = distance / FARTHEST
        obs[self.slices["previous actions"]] = self.previous.ravel()
        action = self.decide(obs)
        self.previous = np.stack([action, *self.previous[:2]])
        limit = TURN_RATE * PERIOD
        self.direction, self.turning = turn @ action, np.clip(np.arctan2(action[1], action[0]), -limit, limit) / PERIOD

    def command(self, now):
        """Return a Twist's linear.x and linear.y [m/s] and angular.z [rad/s], in the body's present frame."""
        if self.direction is None or not self.awake(now):
            return STILL
        ahead, left = SPEED * self.direction @ self.turned(self.pose[0][2])
        return float(ahead), float(left), float(self.turning)

    def awake(self, now):
        """Whether the last observation is fresh."""
        return all(heard is not None and now - heard[1] <= STALE for heard in (self.scan, self.pose))

    @staticmethod
    def turned(yaw):
        """The matrix from the body's frame to that of the odometry."""
        return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])


def main(folder):
    """Run the node."""
    import rclpy  # of a ROS 2 installation
    from geometry_msgs.msg import PoseStamped, Twist
    from nav_msgs.msg import Odometry
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import LaserScan

    rclpy.init()
    node, walk = Node("cuelearner_walk"), Walk(folder)
    said = node.create_publisher(Twist, "cmd_vel", 1)

    def now():
        return node.get_clock().now().nanoseconds * 1e-9

    def command():
        twist = Twist()
        twist.linear.x, twist.linear.y, twist.angular.z = walk.command(now())
        said.publish(twist)

    node.create_subscription(LaserScan, "scan", lambda heard: walk.hear_scan(heard, now()), qos_profile_sensor_data)
    node.create_subscription(Odometry, "odom", lambda heard: walk.hear_odometry(heard, now()), qos_profile_sensor_data)
    node.create_subscription(PoseStamped, "goal", walk.hear_goal, 1)
    node.create_timer(PERIOD, lambda: walk.step(now()))
    node.create_timer(RATE, command)
    rclpy.spin(node)


if __name__ == "__main__":
    main(sys.argv[1])
