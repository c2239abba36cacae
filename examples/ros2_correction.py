"""A ROS 2 node that runs a correction beside a base, which stays where it is. `Beside` is its core, and needs no ROS.

    cuelearner export policies/arm --only-correction --format onnx --out exported/arm
    python examples/ros2_correction.py exported/arm

It hears `observation` (std_msgs/Float32MultiArray, as the policy sees it), says `base_observation` (the same type, what
to ask the base about), hears `base_action` (what the base decided about that), and says `action` for each base action.
Where the base is to be asked twice, both observations stand one after the other, and so do its actions. Where the
observation is older than a fifth of a second, or a number is not finite, it passes the base's last action on as it is
and says so once: a robot goes on without the correction, never without its base.
"""

# pyright: reportMissingImports=false
# (ROS 2 brings its own Python packages)

import sys
from typing import Any

import numpy as np

from cuelearner_jax.export.runner import ContractError, Decision  # on a robot: the decide.py beside the decision

STALE = 0.2  # [s]


class Beside:
    """A correction and what was seen last. Times in seconds."""

    def __init__(self, folder):
        """Read a correction. Raises ContractError for a damaged one, ValueError for a whole policy."""
        self.decide = Decision(folder)
        contract = self.decide.contract
        if "base" not in contract:
            raise ValueError(f"{folder} holds a whole policy: export its correction alone, with --only-correction")
        self.calls = contract["base"].get("questions", 1)
        self.entries = self.calls * contract["base"]["size"]
        self.size = contract["observation"]["size"] - self.entries
        self.latest: Any = None  # (observation (size,), time)
        self.trouble = ""  # why the last action was the base's own; empty: it was corrected

    def hear(self, observation, now):
        """Return what to ask the base about an observation. Raises ValueError for one of another size."""
        obs = np.asarray(observation, np.float32)
        if obs.shape != (self.size,):
            raise ValueError(f"an observation has {obs.size} entries: the contract says {self.size}")
        self.latest = obs, now
        try:
            return np.concatenate(self.decide.base_observations(obs))
        except ContractError:  # which `action` will meet too
            return np.tile(obs, self.calls)

    def action(self, base_action, now):
        """Return the corrected action, or the base's own where nothing corrects it; then `trouble` says why."""
        base = np.asarray(base_action, np.float32)
        if base.shape != (self.entries,):
            raise ValueError(f"a base action has {base.size} entries: the contract says {self.entries}")
        actions = np.split(base, self.calls)
        if self.latest is None or now - self.latest[1] > STALE:
            self.trouble = "no fresh observation"
            return actions[-1]
        try:
            result = self.decide(self.latest[0], *actions)
        except ContractError as error:
            self.trouble = str(error)
            return actions[-1]
        self.trouble = ""
        return result


def main(folder):
    """Run the node."""
    import rclpy  # of a ROS 2 installation
    from rclpy.node import Node
    from std_msgs.msg import Float32MultiArray

    rclpy.init()
    node, beside = Node("cuelearner_correction"), Beside(folder)
    actions, questions = (node.create_publisher(Float32MultiArray, name, 1) for name in ("action", "base_observation"))

    def now():
        return node.get_clock().now().nanoseconds * 1e-9

    def hear(message):
        questions.publish(Float32MultiArray(data=beside.hear(message.data, now()).tolist()))

    def correct(message):
        before = beside.trouble
        actions.publish(Float32MultiArray(data=beside.action(message.data, now()).tolist()))
        if beside.trouble and beside.trouble != before:
            node.get_logger().warning(f"the base acts alone: {beside.trouble}")

    node.create_subscription(Float32MultiArray, "observation", hear, 1)
    node.create_subscription(Float32MultiArray, "base_action", correct, 1)
    rclpy.spin(node)


if __name__ == "__main__":
    main(sys.argv[1])
