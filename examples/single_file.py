"""The whole method in one file: one-ball billiards, from the teacher's first answer to the evaluated agent.

Run in the folder above this one: python -m examples.single_file --seeds 8 --png curves.png

A teacher answers about one action at a time: "more counterclockwise", "more clockwise" or "already right". A network is
fitted to the answers (`fit`) and corrects the actions of an agent that learns (`refine`), which so meets rewards early.
Only the billiards table comes from elsewhere (`cuelearner_envs`). Equations are numbered as in the CueLearner paper.

Parameters are those of the preset `billiards/quickstart`, random numbers are drawn in the order of the package: seeds
can be compared with those recorded in docs/data/quickstart. What this file leaves out, the package has: other action
spaces and kinds of feedback, teachers who err or stay silent, ensembles, other agents, checkpoints, and the pacing of
guided episodes by what they earn. Here an episode is guided with probability 1/2, which stands for every second one.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray
from scipy.stats import trim_mean

from cuelearner_envs.billiards.environment import Billiards
from cuelearner_envs.billiards.table import Table

INIT, ASK, FIT, TRAIN, EPISODES = 0, 1, 2, 3, 1_000_003  # streams of random numbers; the last is of the evaluation


@dataclass(frozen=True)
class Config:
    """Parameters; angles in radians, counterclockwise positive."""

    layers: Sequence[int] = (128, 128)  # hidden layers of both networks
    max_grad_norm: float = 0.5  # gradients of both networks are clipped to this global norm
    eps: float = math.radians(2.0)  # by how much one answer turns an action
    search_directions: int = 1440  # directions that the teacher tries
    aim_error: float = math.radians(0.5)  # standard deviation of the aim for which the teacher values directions
    habit: float = 0.2  # share by which the teacher's values shrink over a full turn: settles near-ties always alike
    labels: int = 100  # of one seed
    labels_per_fit: int = 10  # new labels after which the feedback network is fitted from scratch
    fit_steps: int = 400  # Adam steps of one fit
    fit_batch_size: int = 64
    validate_every: int = 20  # Adam steps between two looks at the held-out labels
    feedback_learning_rate: float = 1e-3
    tau: float = math.radians(0.1)  # refinement stops once a pass turns the action by less
    tau_max: float = math.pi  # refinement never leaves this distance from the first action
    k_max: int = 100  # largest number of passes
    directions: int = 360  # among which the agent chooses, evenly spaced
    discount: float = 0.0  # each shot is a problem of its own: targets do not bootstrap
    learning_rate: float = 0.01
    batch_size: int = 100
    polyak: float = 0.005  # rate at which the target network follows
    target_every: int = 2  # gradient steps between two moves of the target network
    num_envs: int = 10  # environments of one seed that step together; as many gradient steps follow
    total_steps: int = 3_000  # environment steps of one seed
    random_steps: int = 200  # first steps: actions are uniform and the agent does not learn
    guidance_until: int = 1_500  # the cut-off
    eval_every: int = 100
    eval_envs: int = 50
    eval_steps: int = 100  # shared by the evaluation's environments


def direction(angle: Float[Array, "..."]) -> Float[Array, "... 2"]:
    """Return the unit vector that points along an angle: an action."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)


def turned(action: Float[Array, "... 2"], angle: Float[Array, "..."] | float) -> Float[Array, "... 2"]:
    """Return an action turned counterclockwise."""
    x, y, cos, sin = action[..., 0], action[..., 1], jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], -1)


def angle_between(start: Float[Array, "... 2"], end: Float[Array, "... 2"]) -> Float[Array, "..."]:
    """Return the signed angle from one action to another, in (-pi, pi]."""
    return jnp.arctan2(start[..., 0] * end[..., 1] - start[..., 1] * end[..., 0], jnp.sum(start * end, -1))


def best_action(cfg: Config, env: Billiards, state: Any) -> Float[Array, "2"]:
    """Search the teacher's best action: that with the largest expected reward of a player whose aim errs."""
    turn = jnp.arange(cfg.search_directions) * (2 * math.pi / cfg.search_directions)
    rewards = jax.vmap(lambda angle: env.step(jax.random.key(0), state, direction(angle))[1].reward)(turn)
    bell = jax.nn.softmax(-0.5 * jnp.square(jnp.minimum(turn, 2 * math.pi - turn) / cfg.aim_error))
    expected = jnp.fft.irfft(jnp.fft.rfft(rewards) * jnp.fft.rfft(bell), n=cfg.search_directions)
    return direction(turn[jnp.argmax(expected * (1 - cfg.habit * turn / (2 * math.pi)))])


def answer(cfg: Config, action: Float[Array, "2"], best: Float[Array, "2"]) -> Float[Array, ""]:
    """Return the teacher's answer h: +1 counterclockwise, -1 clockwise, 0 already right, which is within eps / 2."""
    error = angle_between(action, best)
    return jnp.where(jnp.abs(error) <= cfg.eps / 2, 0.0, jnp.sign(error))


class Labels(NamedTuple):
    """The teacher's answers."""

    obs: Float[Array, "labels obs"]
    action: Float[Array, "labels 2"]  # the action asked about
    h: Float[Array, " labels"]  # the answer


class MLP(nn.Module):
    """ReLU layers on observation and action; Xavier-uniform weights, zero biases."""

    layers: Sequence[int]
    outputs: int

    @nn.compact
    def __call__(self, obs: Float[Array, "... obs"], action: Float[Array, "... 2"]) -> Float[Array, "... outputs"]:
        """Return the outputs; one observation may come with many actions."""
        x = jnp.concatenate([jnp.broadcast_to(obs, (*action.shape[:-1], obs.shape[-1])), action], -1)
        for width in self.layers:
            x = nn.relu(nn.Dense(width, kernel_init=nn.initializers.xavier_uniform())(x))
        return nn.Dense(self.outputs, kernel_init=nn.initializers.xavier_uniform())(x)


def feedback_targets(cfg: Config, labels: Labels) -> Float[Array, "labels 2"]:
    """Return what the feedback network is to predict, in units of eps: the action turned by eps h, less the action."""
    return (turned(labels.action, cfg.eps * labels.h) - labels.action) / cfg.eps


def fit(cfg: Config, key: PRNGKeyArray, labels: Labels, count: Int[Array, ""] | int) -> Any:
    """Fit a feedback network from scratch to `count` labels by least squares (Eq. 3), every fifth label held out."""
    network, targets, row = MLP(cfg.layers, 2), feedback_targets(cfg, labels), jnp.arange(cfg.labels)
    adam = optax.chain(optax.clip_by_global_norm(cfg.max_grad_norm), optax.adam(cfg.feedback_learning_rate))

    def errors(params, rows):
        predicted = jnp.asarray(network.apply(params, labels.obs[rows], labels.action[rows]))
        return jnp.sum(jnp.square(predicted - targets[rows]), -1)

    def step(carry, key):
        params, state = carry
        drawn = jax.random.randint(jax.random.split(key)[0], (cfg.fit_batch_size,), 0, count - count // 5)
        rows = drawn + drawn // 4  # 0 to 3, 5 to 8 and so on: not held out
        change, state = adam.update(jax.grad(lambda p: errors(p, rows).mean())(params), state, params)
        return (optax.apply_updates(params, change), state), None

    def stretch(carry, keys):
        running, best, least = carry
        running, _ = jax.lax.scan(step, running, keys)
        error = jnp.sum(errors(running[0], row), where=(row % 5 == 4) & (row < count))
        best = jax.tree.map(lambda new, old: jnp.where(error < least, new, old), running[0], best)
        return (running, best, jnp.minimum(error, least)), None

    k_init, k_steps = jax.random.split(key)
    params = network.init(k_init, labels.obs[0], labels.action[0])
    keys = jax.random.split(k_steps, (cfg.fit_steps // cfg.validate_every, cfg.validate_every))
    return jax.lax.scan(stretch, ((params, adam.init(params)), params, jnp.inf), keys)[0][1]


def refine(cfg: Config, params: Any, obs: Array, first: Array, active: Array) -> Float[Array, "n 2"]:
    """Correct actions (n, 2) where active (n,) until they settle, within tau_max of the first (Eqs. 4 and 5)."""

    def one_pass(carry):
        action, is_done, number = carry
        target = action + cfg.eps * jnp.asarray(MLP(cfg.layers, 2).apply(params, obs, action))
        moved = turned(first, jnp.clip(angle_between(first, target), -cfg.tau_max, cfg.tau_max))
        has_settled = jnp.abs(angle_between(action, moved)) < cfg.tau
        return jnp.where(is_done[:, None], action, moved), is_done | has_settled, number + 1

    return jax.lax.while_loop(lambda carry: (carry[2] < cfg.k_max) & ~carry[1].all(), one_pass, (first, ~active, 0))[0]


def gather_labels(cfg: Config, env: Billiards, key: PRNGKeyArray) -> tuple[Labels, Any]:
    """Return labels and the network fitted to them: rounds of questions, each followed by a fit (DAgger)."""
    state, obs = env.reset(jax.random.split(jax.random.fold_in(key, INIT), 4)[2])
    labels = Labels(jnp.zeros((cfg.labels, obs.size)), jnp.zeros((cfg.labels, 2)), jnp.zeros(cfg.labels))
    params = MLP(cfg.layers, 2).init(key, obs, jnp.zeros(2))

    def ask(carry, number):
        state, obs, labels, params = carry
        keys = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, ASK), number), 4)
        action = direction(jax.random.uniform(keys[0], (1,), minval=-math.pi, maxval=math.pi))
        action = refine(cfg, params, obs[None], action, jnp.full(1, number >= cfg.labels_per_fit))[0]  # once fitted
        given = Labels(obs, action, answer(cfg, action, best_action(cfg, env, state)))
        labels = jax.tree.map(lambda rows, row: rows.at[number].set(row), labels, given)
        state, step = env.step(keys[3], state, action)
        return (state, step.obs, labels, params), None

    def label_round(carry, number):
        asked = number * cfg.labels_per_fit
        (state, obs, labels, _), _ = jax.lax.scan(ask, carry, asked + jnp.arange(cfg.labels_per_fit))
        k_fit = jax.random.fold_in(jax.random.fold_in(key, FIT), number)
        return (state, obs, labels, fit(cfg, k_fit, labels, asked + cfg.labels_per_fit)), None

    rounds = jnp.arange(cfg.labels // cfg.labels_per_fit)
    (*_, labels, params), _ = jax.lax.scan(label_round, (state, obs, labels, params), rounds)
    return labels, params


class Transition(NamedTuple):
    """A step of an environment."""

    obs: Float[Array, "n obs"]
    action: Float[Array, "n 2"]  # as executed, corrected or not
    reward: Float[Array, " n"]
    next_obs: Float[Array, "n obs"]
    goes_on: Float[Array, " n"]  # 0 where the task ended, else 1


class Agent(NamedTuple):
    """What double DQN learns."""

    params: Any
    target_params: Any
    updates: Int[Array, ""]  # gradient steps so far


def value(cfg: Config, params: Any, obs: Float[Array, "... obs"], action: Float[Array, "... 2"]) -> Float[Array, "..."]:
    """Return Q(s, a)."""
    return jnp.asarray(MLP(cfg.layers, 1).apply(params, obs, action))[..., 0]


def greedy(cfg: Config, params: Any, obs: Float[Array, "n obs"]) -> Float[Array, "n 2"]:
    """Return the direction with the largest value."""
    options = direction(jnp.arange(cfg.directions) * (2 * math.pi / cfg.directions))
    return options[jax.vmap(lambda one: jnp.argmax(value(cfg, params, one, options)))(obs)]


def value_targets(cfg: Config, agent: Agent, batch: Transition) -> Float[Array, " n"]:
    """Return r + discount * Q'(s', argmax Q(s', .)): the online network chooses, the target network values."""
    if cfg.discount == 0:
        return batch.reward
    choice = greedy(cfg, agent.params, batch.next_obs)
    return batch.reward + cfg.discount * batch.goes_on * value(cfg, agent.target_params, batch.next_obs, choice)


def update(cfg: Config, agent: Agent, batch: Transition) -> tuple[Agent, Float[Array, ""]]:
    """Take one gradient step; return the agent and the loss before the step."""
    targets = value_targets(cfg, agent, batch)
    loss_of = lambda params: jnp.mean(jnp.square(value(cfg, params, batch.obs, batch.action) - targets))  # noqa: E731
    loss, gradient = jax.value_and_grad(loss_of)(agent.params)
    sgd = optax.chain(optax.clip_by_global_norm(cfg.max_grad_norm), optax.sgd(cfg.learning_rate))
    params, count = optax.apply_updates(agent.params, sgd.update(gradient, sgd.init(gradient))[0]), agent.updates + 1
    rate = jnp.where(count % cfg.target_every == 0, cfg.polyak, 0.0)
    return Agent(params, optax.incremental_update(params, agent.target_params, rate), count), loss


def evaluate(cfg: Config, env: Billiards, params: Any) -> Float[Array, ""]:
    """Return the greedy agent's reward a step, on the same episodes for every seed."""
    k_reset, k_run = jax.random.split(jax.random.fold_in(jax.random.key(0), EPISODES))

    def one_step(carry, number):
        keys = jax.random.split(jax.random.split(jax.random.fold_in(k_run, number))[1], cfg.eval_envs)
        state, step = jax.vmap(env.step)(keys, carry[0], greedy(cfg, params, carry[1]))
        return (state, step.obs), step.reward.mean()

    start = jax.vmap(env.reset)(jax.random.split(k_reset, cfg.eval_envs))
    return jax.lax.scan(one_step, start, jnp.arange(cfg.eval_steps // cfg.eval_envs))[1].mean()


def train(cfg: Config, env: Billiards, key: PRNGKeyArray, feedback: Any = None) -> Float[Array, " evaluations"]:
    """Train one agent; return its evaluations. `feedback`: the feedback network; None: no episode is guided."""
    k_agent, _, _, k_env = jax.random.split(jax.random.fold_in(key, INIT), 4)
    envs, obs = jax.vmap(env.reset)(jax.random.split(k_env, cfg.num_envs))
    params = MLP(cfg.layers, 1).init(k_agent, obs[0], jnp.zeros(2))
    empty = [jnp.zeros((cfg.total_steps, *width)) for width in (obs.shape[1:], (2,), (), obs.shape[1:], ())]

    def iteration(carry, step):  # one step in each environment, then as many gradient steps
        agent, replay, envs, obs, is_guided = carry
        k_act, k_envs, k_guide, k_learn = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, TRAIN), step), 4)
        angle = jax.random.uniform(k_act, (cfg.num_envs,), minval=-math.pi, maxval=math.pi)
        action = jax.lax.cond(step < cfg.random_steps, lambda: direction(angle), lambda: greedy(cfg, agent.params, obs))
        if feedback is not None:
            may_guide = (step >= cfg.random_steps) & (step < cfg.guidance_until)
            action = jax.lax.cond(may_guide, lambda: refine(cfg, feedback, obs, action, is_guided), lambda: action)
        envs, after = jax.vmap(env.step)(jax.random.split(k_envs, cfg.num_envs), envs, action)
        new = Transition(obs, action, after.reward, after.final_obs, 1.0 - after.terminated)
        replay = jax.tree.map(lambda old, rows: jax.lax.dynamic_update_slice_in_dim(old, rows, step, 0), replay, new)

        def learn(agent, number):
            k_draw = jax.random.split(jax.random.fold_in(k_learn, number))[0]
            drawn = jax.random.randint(k_draw, (cfg.batch_size,), 0, step + cfg.num_envs)
            return update(cfg, agent, jax.tree.map(lambda rows: rows[drawn], replay))

        learned = lambda: jax.lax.scan(learn, agent, jnp.arange(cfg.num_envs))[0]  # noqa: E731
        agent = jax.lax.cond(step + cfg.num_envs >= cfg.random_steps, learned, lambda: agent)
        is_next = jax.random.bernoulli(k_guide, 0.5, (cfg.num_envs,))  # every second episode is guided, by chance
        return (agent, replay, envs, after.obs, jnp.where(after.terminated | after.truncated, is_next, is_guided)), None

    def stretch(carry, start):
        carry, _ = jax.lax.scan(iteration, carry, start + jnp.arange(0, cfg.eval_every, cfg.num_envs))
        return carry, evaluate(cfg, env, carry[0].params)

    start = (Agent(params, params, jnp.array(0)), Transition(*empty), envs, obs, jnp.zeros(cfg.num_envs, bool))
    _, rewards = jax.lax.scan(stretch, start, jnp.arange(0, cfg.total_steps, cfg.eval_every))
    return jnp.concatenate([evaluate(cfg, env, params)[None], rewards])


def curves(cfg: Config, seeds: Sequence[int]) -> dict[str, Float[np.ndarray, "seeds evaluations"]]:
    """Train all seeds side by side, unguided and guided; return their evaluations, the first before the first step."""
    env = Billiards(Table.one_ball(), max_shots=1)
    keys = jax.vmap(lambda seed: jax.random.fold_in(jax.random.key(0), seed))(jnp.asarray(seeds))
    unguided = jax.jit(jax.vmap(lambda key: train(cfg, env, key)))(keys)
    guided = jax.jit(jax.vmap(lambda key: train(cfg, env, key, gather_labels(cfg, env, key)[1])))(keys)
    return {"none": np.asarray(unguided), "relative": np.asarray(guided)}


def main() -> None:
    """Print a table of the curves, and draw them if asked to."""
    parser = argparse.ArgumentParser(description="Billiards' quickstart in one file: guided and unguided agents.")
    parser.add_argument("--seeds", type=int, default=8, help="agents of each kind (default: %(default)s)")
    parser.add_argument("--png", help="draw the curves into this file")
    asked, cfg = parser.parse_args(), Config()
    found = curves(cfg, range(2000, 2000 + asked.seeds))  # the settings were chosen on seeds below
    print(f"balls pocketed a shot: interquartile mean and [lowest, highest] of {asked.seeds} seeds")
    print(f"{'step':>5}", *(f"{name:>19}" for name in found))
    for step in range(0, cfg.total_steps + 1, 3 * cfg.eval_every):
        each = [values[:, step // cfg.eval_every] for values in found.values()]
        print(f"{step:>5}", *(f"{trim_mean(v, 0.25):6.2f} [{v.min():.2f}, {v.max():.2f}]" for v in each))
    if asked.png:
        for name, values in found.items():
            plt.plot(np.arange(values.shape[1]) * cfg.eval_every, trim_mean(values, 0.25), label=name)
        plt.gca().set(xlabel="environment steps", ylabel="balls pocketed a shot")
        plt.legend()
        plt.savefig(asked.png, dpi=120)


if __name__ == "__main__":
    main()
