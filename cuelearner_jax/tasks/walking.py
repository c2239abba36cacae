"""Robots that learn to walk, for `cuelearner locomotion`."""

from __future__ import annotations

from cuelearner_jax.bridges.walking import LocomotionTask


def anymal() -> LocomotionTask:
    """The quadruped."""
    from cuelearner_envs.anymal import policy, tracking  # MuJoCo's loading is not for every command
    from cuelearner_envs.anymal.locomotion import Locomotion

    return LocomotionTask(
        environment=Locomotion(),
        policy=policy.from_brax,
        measure=tracking.measure_training,
        examine=tracking.examine,
        save=policy.save,
        load=policy.load,
    )
