"""Our probes and tasks under brax's wrappers and agents."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from box_task import SMALL, Reach
from brax import envs
from brax.envs.wrappers import training
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo import train as ppo
from brax.training.agents.sac import networks as sac_networks
from brax.training.agents.sac import train as sac
from flax import struct

from cuelearner_envs.navigation import config as navigation
from cuelearner_jax.bridges import brax as brax_adapter
from cuelearner_jax.bridges.brax import to_brax, wrap_for_training
from cuelearner_jax.environment import Quantity, WholeObservations
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import Choices
from cuelearner_jax.types import Step

RAW = jax.random.key_data(jax.random.key(0))
WRAPS = {"brax": training.wrap, "ours": wrap_for_training}


def legacy_keys(count):
    return jax.random.split(jax.random.PRNGKey(3), count)


def run(env, actions, count=2):
    """States of a wrapped batch of `count` environments: the first, then one after each action."""
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    states = [reset(legacy_keys(count))]
    for action in actions:
        states.append(step(states[-1], jnp.tile(jnp.array(action), (count, 1))))
    return states


def column(states, read):
    """One number of the first environment, after each action."""
    return [float(read(state)[0]) for state in states[1:]]


def done(state):
    return state.done


def truncation(state):
    return state.info["truncation"]


def test_a_step_is_ours_with_the_direction_of_the_action():
    window = probes.Window()
    env = to_brax(window)
    assert isinstance(env, envs.Env)
    assert (env.observation_size, env.action_size) == (2, 2)
    assert env.unwrapped is env
    state = env.reset(RAW)
    after = env.step(state, 0.01 * window.best(state.obs))
    assert (after.reward, after.done, after.info["truncation"]) == (1, 1, 0)
    assert after.metrics["hit"] == 1
    np.testing.assert_array_equal(after.obs, state.obs)  # what the shot led to, not the next episode
    assert env.step(state, -0.01 * window.best(state.obs)).reward == 0
    assert jax.tree.structure(state) == jax.tree.structure(after)
    kinds = lambda tree: jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), tree)  # noqa: E731
    assert kinds(state) == kinds(after)


def test_a_box_is_stretched_to_the_cube_of_brax():
    reach = Reach()  # lower bounds -1, 0 and -2, upper bounds 1, 4 and 0
    env = to_brax(reach)
    assert env.action_size == 3
    state = env.reset(RAW)
    in_cube = lambda action: 2 * (action - jnp.array(SMALL.low)) / jnp.array([2.0, 4.0, 2.0]) - 1  # noqa: E731
    best = reach.best(state.obs)
    assert env.step(state, in_cube(best)).reward == 1
    assert env.step(state, in_cube(best).at[1].add(0.3)).reward == 0  # 0.15 of the range away
    corner = Reach(offset=jnp.float32(5.0))  # whose best action is the upper corner
    env = to_brax(corner)
    assert env.step(env.reset(RAW), jnp.full(3, 3.0)).reward == 1  # beyond the bounds is brought back
    assert env.step(env.reset(RAW), jnp.ones(3)).reward == 1
    with pytest.raises(UserError, match="to_brax works for directions and boxes, not for actions that are choices"):
        to_brax(Reach(Choices(3)))


@pytest.mark.parametrize("wrap", WRAPS)
@pytest.mark.parametrize("truncates", [False, True])
def test_ends_and_truncations_reach_the_wrappers(wrap, truncates):
    chain = probes.Chain(jnp.array(truncates))
    states = run(WRAPS[wrap](to_brax(chain), episode_length=50), [(0.0, 2.0), (3.0, 0.0)] * 3)
    assert column(states, done) == [0, 1] * 3
    assert column(states, truncation) == [0, float(truncates)] * 3
    assert column(states, lambda state: state.reward) == [0.5, 1.0] * 3
    assert column(states, lambda state: state.obs[:, 0]) == [0, 1] * 3  # place 1, then the next episode's place 0
    assert column(states, lambda state: state.info["episode_metrics"]["length"]) == [1, 2] * 3
    np.testing.assert_allclose(
        column(states, lambda state: state.info["episode_metrics"]["sum_reward"]), [0.5, 1.5] * 3
    )
    if wrap == "ours":
        assert column(states, lambda state: state.info["steps"]) == [1, 2] * 3


class Countdown(WholeObservations, struct.PyTreeNode):
    """Three steps, cut or not after two; what the last one was drawn tells whether the key moves on."""

    observation = (Quantity("draw", 1, "1"),)

    def reset(self, key):
        return jnp.zeros((), jnp.int32), jax.random.uniform(key, (1,))

    def step(self, key, state, action):
        ended = state == 2
        drawn = jax.random.uniform(key, (1,))
        fresh, fresh_obs = self.reset(key)
        following, obs = jnp.where(ended, fresh, state + 1), jnp.where(ended, fresh_obs, drawn)
        outcome = {"luck": drawn[0] + 1.0}
        return following, Step(obs, drawn, drawn, jnp.ones(()), ended, jnp.array(False), {"draw": drawn[0]}, outcome)


@pytest.mark.parametrize("episode_length", [2, 50])
def test_our_wrapper_begins_new_episodes_and_brax_the_cached_one(episode_length):
    firsts = {}
    for name, wrap in WRAPS.items():
        states = run(wrap(to_brax(Countdown()), episode_length=episode_length), [(1.0, 0.0)] * 12)
        starts = [state.obs[:, 0] for state in states[1:] if state.done[0]]
        assert len(starts) == 12 // min(3, episode_length)
        firsts[name] = np.stack([states[0].obs[:, 0], *starts])
        draws = [float(state.metrics["draw"][0]) for state in states[1:]]
        assert len(set(draws)) == 12  # the cached state never brings old random numbers back
    np.testing.assert_array_equal(firsts["brax"][1:], firsts["brax"][:-1])
    assert len(np.unique(firsts["ours"])) == firsts["ours"].size


def test_the_sum_over_an_episode_is_its_outcome():
    states = run(wrap_for_training(to_brax(Countdown()), episode_length=50), [(1.0, 0.0)] * 6)
    luck = column(states, lambda state: state.metrics["luck"])
    assert [value > 0 for value in luck] == [False, False, True] * 2
    summed = column(states, lambda state: state.info["episode_metrics"]["luck"])
    assert (summed[2], summed[5]) == (luck[2], luck[5])


@pytest.mark.long
@pytest.mark.parametrize("wrap", WRAPS)
def test_brax_may_randomize_our_parameters(wrap):
    offsets = jnp.array([0.0, 1.5])

    def worlds(env):
        return env.replace(offset=offsets), jax.tree.map(lambda _: None, env).replace(offset=0)

    wrapped = WRAPS[wrap](to_brax(probes.Window()), episode_length=50, randomization_fn=worlds)
    state = wrapped.reset(legacy_keys(2))
    right = jax.vmap(lambda offset, obs: probes.Window(offset=offset).best(obs))(offsets, state.obs)
    np.testing.assert_array_equal(wrapped.step(state, right).reward, [1, 1])
    np.testing.assert_array_equal(wrapped.step(state, right[::-1]).reward, [0, 0])


# brax's agents on ours.


def test_device_put_replicated_stacks_a_copy_for_each_device(monkeypatch):
    monkeypatch.delattr(jax, "device_put_replicated", raising=False)
    brax_adapter.supply_device_put_replicated()
    supplied = jax.device_put_replicated  # pyright: ignore[reportAttributeAccessIssue]
    devices = jax.local_devices()[:1]
    copies = supplied({"a": jnp.arange(3.0), "b": 2}, devices)
    np.testing.assert_array_equal(copies["a"], [[0, 1, 2]])
    assert copies["b"].shape == (1,)
    np.testing.assert_array_equal(jax.pmap(lambda a: a + 1, devices=devices)(copies["a"]), [[1, 2, 3]])
    brax_adapter.supply_device_put_replicated()
    assert jax.device_put_replicated is supplied  # pyright: ignore[reportAttributeAccessIssue]


TINY = {"policy_hidden_layer_sizes": (16,), "value_hidden_layer_sizes": (16,)}


def train_ppo(env, wrap=None, **values):
    """A few updates of brax's PPO: parameters before and after, what it reported last, and at which step."""
    seen, reported = [], []
    settings = {"num_timesteps": 256, "episode_length": 20, "num_envs": 8, "batch_size": 8, "num_minibatches": 2}
    settings |= {"unroll_length": 4, "num_updates_per_batch": 2, "max_devices_per_host": 1, "run_evals": False}
    ppo.train(
        env,
        wrap_env_fn=wrap,
        network_factory=functools.partial(ppo_networks.make_ppo_networks, **TINY),
        policy_params_fn=lambda step, make_policy, params: seen.append(jax.tree.map(np.asarray, params[1:])),
        progress_fn=lambda step, metrics: reported.append((step, metrics)),
        **(settings | values),
    )
    return seen[0], seen[-1], *reported[-1]


def assert_learned(before, after, metrics, losses):
    for old, new in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        assert np.isfinite(new).all()
        assert (old != new).any()
    for name in losses:
        assert np.isfinite(metrics[name]), name


@pytest.mark.long
def test_ppo_of_brax_learns_on_navigation():
    env = to_brax(navigation.make_environment(navigation.NavigationConfig(style="clutter", worlds=8)))
    before, after, step, metrics = train_ppo(env, wrap_for_training, num_timesteps=128)
    assert step == 128
    assert_learned(before, after, metrics, ["training/policy_loss", "training/v_loss", "training/entropy_loss"])


@pytest.mark.long
def test_sac_of_brax_learns_and_its_evaluator_counts_a_truncated_episode():
    reported = {}
    _, params, _ = sac.train(
        to_brax(probes.Chain(jnp.array(True))),
        num_timesteps=96,
        episode_length=20,
        wrap_env_fn=wrap_for_training,
        num_envs=4,
        num_eval_envs=4,
        batch_size=8,
        min_replay_size=16,
        max_devices_per_host=1,
        network_factory=functools.partial(sac_networks.make_sac_networks, hidden_layer_sizes=(16,)),
        progress_fn=lambda step, metrics: reported.update({step: metrics}),
    )
    (metrics,) = reported.values()
    assert list(reported) == [96]
    biases = [leaf for leaf in jax.tree.leaves(params[1]) if leaf.ndim == 1]
    assert all(np.any(bias) for bias in biases)  # they start at zero
    assert len(biases) == 2
    for name in ("training/critic_loss", "training/actor_loss", "training/alpha_loss"):
        assert np.isfinite(metrics[name]), name
    assert metrics["eval/avg_episode_length"] == 2
    assert metrics["eval/std_episode_length"] == 0
    assert metrics["training/alpha"] != 1  # the temperature has been learned
