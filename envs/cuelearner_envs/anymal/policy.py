"""The walking policy: its observation, its network as a plain function, and its file.

policy/policy.npz    the network in half precision
policy/policy.json   how it was trained and what it was measured to do
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_envs.anymal import model as robot
from cuelearner_jax.errors import UserError

OBS = 48
WEIGHTS, ABOUT = "policy.npz", "policy.json"
SHIPPED = Path(__file__).parent / "policy"

# Largest error of each entry of an observation, as `observe` orders them: of velocity [m/s], turning [rad/s], down,
# command (none), joints [rad], their speeds [rad/s], and the last action (none).
NOISE = np.repeat([0.1, 0.2, 0.05, 0.0, 0.01, 1.5, 0.0], [3, 3, 3, 3, 12, 12, 12])


class WalkingPolicy(struct.PyTreeNode):
    """Observation -> targets of the joints in [-1, 1]: swish layers on normalised entries, the mean of PPO's policy."""

    mean: Float[Array, "48"]
    std: Float[Array, "48"]
    layers: tuple[tuple[Float[Array, "inputs outputs"], Float[Array, " outputs"]], ...]  # kernel and bias of each

    def __call__(self, obs: Float[Array, "... 48"]) -> Float[Array, "... 12"]:
        """Return joint targets for observations with any leading axes."""
        for_each = lambda vector: jnp.broadcast_to(vector, (*obs.shape[:-1], *vector.shape))  # noqa: E731
        x = (obs - for_each(self.mean)) / for_each(self.std)
        for kernel, bias in self.layers[:-1]:
            x = jax.nn.swish(x @ kernel + for_each(bias))
        kernel, bias = self.layers[-1]
        return jnp.tanh(x @ kernel + for_each(bias))


def observe(
    qpos: Float[Array, "19"], qvel: Float[Array, "18"], last_action: Float[Array, "12"], command: Float[Array, "3"]
) -> Float[Array, "48"]:
    """Return the walking policy's observation, without sensor errors.

    - 3: the trunk's velocity [m/s], 3: its angular velocity [rad/s], 3: which way is down; all in its own frame
    - 3: the command: velocity forward and to the left [m/s], turning rate [rad/s]
    - 12: joints' angles from home [rad], 12: their speeds [rad/s]; 12: the last action
    """
    turn = robot.rotation(qpos[3:7])
    trunk = [robot.in_body(turn, qvel[:3]), qvel[3:6], -turn[2]]
    joints = [qpos[7:] - jnp.asarray(robot.HOME, jnp.float32), qvel[6:]]
    return jnp.concatenate([*trunk, command, *joints, last_action])


def add_noise(key: PRNGKeyArray, obs: Float[Array, "48"], level: float | Float[Array, ""]) -> Float[Array, "48"]:
    """Add uniform errors to an observation, at `level` 1 up to `NOISE`."""
    return obs + level * jnp.asarray(NOISE, jnp.float32) * jax.random.uniform(key, (OBS,), minval=-1.0, maxval=1.0)


def from_brax(params: Any) -> WalkingPolicy:
    """Make the policy from brax PPO's parameters (normaliser, policy, ...), using the network's mean action."""
    normaliser, dense = params[0], params[1]["params"]
    layers = [(dense[f"hidden_{number}"]["kernel"], dense[f"hidden_{number}"]["bias"]) for number in range(len(dense))]
    kernel, bias = layers[-1]
    layers[-1] = kernel[:, : robot.JOINTS], bias[: robot.JOINTS]  # the rest is the logarithm of the standard deviation
    return WalkingPolicy(normaliser.mean, normaliser.std, tuple(layers))


def save(folder: Path, policy: WalkingPolicy, about: dict[str, Any]) -> None:
    """Write a policy and what is to be known about it."""
    folder.mkdir(parents=True, exist_ok=True)
    arrays = {"mean": policy.mean, "std": policy.std}
    for number, (kernel, bias) in enumerate(policy.layers):
        arrays |= {f"kernel_{number}": kernel, f"bias_{number}": bias}
    halves: dict[str, Any] = {name: np.asarray(leaf, np.float16) for name, leaf in arrays.items()}
    np.savez_compressed(folder / WEIGHTS, **halves)
    (folder / ABOUT).write_text(json.dumps(about, indent=1) + "\n")


def load(folder: Path = SHIPPED) -> WalkingPolicy:
    """Load a policy that `save` wrote (default: the shipped one). Raises UserError if it is missing."""
    file = folder / WEIGHTS
    if not file.is_file():
        command = f"python experiments/train_walking.py train --out {folder}"
        raise UserError(f"no walking policy in {folder}: train one with `{command}`")
    with np.load(file) as stored:
        arrays = {name: jnp.asarray(stored[name], jnp.float32) for name in stored.files}
    count = sum(name.startswith("kernel_") for name in arrays)
    layers = tuple((arrays[f"kernel_{number}"], arrays[f"bias_{number}"]) for number in range(count))
    return WalkingPolicy(arrays["mean"], arrays["std"], layers)
