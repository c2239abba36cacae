"""Two tiny worlds: directions with aims for the deep Q-network, a box for the soft actor-critic; and a policy."""

import dataclasses

import box_task
import jax.numpy as jnp
import numpy as np
import probes
import recorded_situations
import walk_task

from cuelearner_jax.run_config import RunConfig
from cuelearner_jax.spaces import DIRECTIONS
from cuelearner_jax.task import Body, Preset, Task
from cuelearner_jax.tasks.logs import LogsConfig


class Reach(box_task.Reach):
    """The bandit of a box, with a heuristic that errs."""

    def heuristic(self, obs):
        return self.actions.exp(self.best(obs), jnp.full(3, 0.05))


def tiny(name, config, env, agent, scalars):
    """A task of one environment, whose preset is as small as can be."""
    schedule = dataclasses.replace(probes.SCHEDULE, eval_every=48, checkpoint_every=48)
    sizes = dataclasses.replace(probes.SIZES, feedback_layers=(16,), fit_steps=20, lanes_per_block=1)
    preset = RunConfig(config(), sizes, scalars, schedule, agent)
    return Task(
        name,
        "a bandit",
        config,
        (Body("point", "", lambda config, split: env),),
        teacher=lambda config, env: probes.Expert(env),
        presets={"quickstart": Preset("tiny", preset, guidance=("none",), labels=(20,))},
    )


AGENT = dataclasses.replace(probes.AGENT, q_layers=(16,), replay_capacity=32)
FLAT = tiny("flat", probes.WindowConfig, probes.Aimed(), AGENT, probes.SCALARS)
SOFT = dataclasses.replace(walk_task.SMALL, replay_capacity=32)
BOXED = tiny("boxed", box_task.ArmConfig, Reach(box_task.GRIPPER), SOFT, box_task.SCALARS)


def straight(obs):
    """A policy of code: the observation as the direction, which is 0.6 rad off."""
    return obs


def recorded_labels(folder):
    """Write 40 labels of a recording: the best action is the observation, turned by 0.6 rad. Return the path."""
    angles = np.linspace(0, 6, 40, dtype=np.float32)
    obs, action, best = (np.stack([np.cos(at), np.sin(at)], -1) for at in (angles, angles + 0.2, angles + 0.6))
    answer = np.sign(action[:, :1] * best[:, 1:] - action[:, 1:] * best[:, :1]).astype(np.float32)
    config = LogsConfig(entries=(2,), actions="directions")
    return recorded_situations.write_labels(folder, config, DIRECTIONS, 10.0, (obs, action.astype(np.float32), answer))
