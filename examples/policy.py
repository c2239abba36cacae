"""Policies of one's own on the lake of `reach`: a pytree, a plain NumPy function, and a policy as a teacher.

Run in the folder above this one; it prints what each is worth and films the last:

    python -m examples.policy pictures
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.evaluate import episodes, evaluate_policy
from cuelearner_jax.policies import Opaque, Policy, PolicyNode, Taught, Teaching
from cuelearner_jax.runs import filming
from cuelearner_jax.spaces.directions import retract
from cuelearner_jax.types import EnvState
from examples.reach import TASK, Reach, ReachConfig


class Leaning(PolicyNode):
    """Heads for the buoy and leans into the wind. A pytree: another `lean` needs no new compile."""

    lean: Float[Array, ""] | float = 0.5  # [s]: how much of the wind is steered against

    def act(self, key: PRNGKeyArray, states: EnvState, obs: Float[Array, "n 4"]) -> Float[Array, "n 2"]:
        """Actions in n situations; a policy that draws uses `key`, one that is told more than agents are, `states`."""
        return retract(retract(obs[:, :2]) - self.lean * obs[:, 2:])


def by_hand(obs: np.ndarray) -> np.ndarray:
    """Act as `Leaning` in plain NumPy, (n, 4) -> (n, 2). The package makes returned vectors unit vectors."""
    towards = obs[:, :2] / np.maximum(np.linalg.norm(obs[:, :2], axis=-1, keepdims=True), 1e-6)
    return towards - 0.5 * obs[:, 2:]


def policies(env: Reach) -> dict[str, Policy]:
    """The three; a teacher made of a policy could also be a task's `teacher`."""
    return {
        "a pytree": Leaning(jnp.float32(1.0)),
        "a NumPy function": Opaque(by_hand, on_host=True),
        "a policy as a teacher": Taught(Teaching(Leaning(jnp.float32(1.0)))),
    }


def main(arguments: Sequence[str], steps: int = 8_000) -> dict[str, dict[str, jax.Array]]:
    """Evaluate each on validation episodes, `steps` in all, and films the last in the folder that is named.

    Returns:
        Metrics by policy.
    """
    env = TASK.environment(ReachConfig(), "validation")
    assert isinstance(env, Reach)
    found = {}
    for name, policy in policies(env).items():
        found[name] = evaluate_policy(env, policy, episodes(), num_envs=200, steps=steps)
        told = ", ".join(f"{metric} {float(value):.3f}" for metric, value in found[name].items())
        print(f"{name}: {told}")
    film, still, _ = filming.files(Path(arguments[0] if arguments else "pictures"), "leaning", "gif")
    filming.film(TASK.pictures(), env, policy, 0, 30, film, still)
    print(f"wrote {film} and {still}")
    return found


if __name__ == "__main__":
    main(sys.argv[1:])
