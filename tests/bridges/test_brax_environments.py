"""brax's environments as ours, and in our loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax import envs
from brax.envs.wrappers import training

from cuelearner_jax.bridges.brax import from_brax
from cuelearner_jax.environment import Environment, spaces_of, symmetries_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import Box, Cue


class Field(envs.Env):
    """A walk in the plane: half the action is added to the place; pays x; ends past a length of 1."""

    def __init__(self, size=2):
        self.size = size

    observation_size = 2
    backend = "none"

    @property
    def action_size(self):
        return self.size

    def reset(self, rng):
        place = 0.1 * jax.random.uniform(rng, (2,))
        return envs.State(None, place, jnp.zeros(()), jnp.zeros(()), {"length": jnp.zeros(())})

    def step(self, state, action):
        place = state.obs + 0.5 * jnp.zeros(2).at[: self.size].set(action[:2])
        length = jnp.linalg.norm(place)
        state.metrics.update(length=length)
        return state.replace(obs=place, reward=place[0], done=(length > 1).astype(jnp.float32))


def walk(env, actions):
    """Steps of one of our environments, as NumPy."""
    state, obs = env.reset(jax.random.key(1))
    steps = []
    for index, action in enumerate(actions):
        before, (state, step) = state, env.step(jax.random.key(index), state, jnp.array(action))
        assert index > 0 or before.state.metrics["length"] == 0  # a step leaves the state that it was given
        steps.append(jax.tree.map(np.asarray, step))
    return np.asarray(obs), steps


def test_a_step_is_that_of_brax():
    env: Environment = from_brax(Field())
    assert (env.obs_size, symmetries_of(env)) == (2, 1)
    start, steps = walk(env, [(1.0, 0.0)] * 4)
    assert [bool(step.terminated) for step in steps] == [False, True, False, True]
    assert not any(step.truncated for step in steps)
    np.testing.assert_allclose(steps[0].obs, start + np.array([0.5, 0]))
    np.testing.assert_array_equal(steps[0].obs, steps[0].final_obs)
    np.testing.assert_allclose(steps[1].final_obs, start + np.array([1.0, 0]))
    fresh = env.reset(jax.random.key(1))[1]  # the step's own key
    np.testing.assert_array_equal(steps[1].obs, fresh)
    np.testing.assert_allclose(steps[2].final_obs, fresh + np.array([0.5, 0]))
    rewards = [step.final_obs[0] for step in steps]
    returns = [rewards[0], rewards[0] + rewards[1], rewards[2], rewards[2] + rewards[3]]
    for step, reward, total in zip(steps, rewards, returns, strict=True):
        assert (step.reward, step.reward.dtype, step.outcome) == (reward, np.float32, {"return": total})
        np.testing.assert_allclose(step.metrics["length"], np.linalg.norm(step.final_obs))
        np.testing.assert_array_equal(step.aftermath, step.final_obs)


def test_time_runs_out_by_ours_only_where_nothing_ended_or_by_brax():
    _, steps = walk(from_brax(Field(), max_steps=2), [(1.0, 0.0), (1.0, 0.0), (1.0, 0.0), (-1.0, 0.0)])
    assert [bool(step.terminated) for step in steps] == [False, True, False, False]
    assert [bool(step.truncated) for step in steps] == [False, False, False, True]
    assert np.abs(steps[3].obs - steps[3].final_obs).max() > 0
    _, steps = walk(from_brax(training.EpisodeWrapper(Field(), 1, 1)), [(1.0, 0.0)] * 2)
    assert [bool(step.truncated) for step in steps] == [True, True]
    assert not any(step.terminated for step in steps)


def test_actions_are_the_whole_box_with_names_of_the_model_or_cues_of_the_caller():
    box = from_brax(Field(3)).actions
    assert (box.low, box.high) == ((-1.0,) * 3, (1.0,) * 3)
    assert [cue.name for cue in box.cues] == ["entry 1", "entry 2", "entry 3"]
    assert {cue.words for cue in box.cues} == {("more", "less")}
    own = (Cue("east", ("right", "left"), ("d", "a"), "shares"), Cue("north", ("up", "down"), ("w", "s"), "shares"))
    assert from_brax(Field(), cues=own).actions == Box((-1.0, -1.0), (1.0, 1.0), own)
    named = from_brax(envs.get_environment("halfcheetah")).actions  # by its model
    assert [cue.name for cue in named.cues] == ["bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"]


def test_observations_in_a_dictionary_are_one_vector_with_named_slices_and_those_for_critics_apart():
    class Parts(Field):
        def reset(self, rng):
            state = super().reset(rng)
            return state.replace(obs={"place": state.obs, "angle": state.obs[0], "privileged_state": state.obs})

        def step(self, state, action):
            after = super().step(state.replace(obs=state.obs["place"]), action)
            return after.replace(obs={"place": after.obs, "angle": after.obs[0], "privileged_state": after.obs})

    env = from_brax(Parts())
    assert [(part.name, part.size) for part in env.observation] == [("angle", 1), ("place", 2)]
    (whole, steps), (start, expected) = walk(env, [(0.6, 0.8)] * 3), walk(from_brax(Field()), [(0.6, 0.8)] * 3)
    np.testing.assert_array_equal(whole, start[[0, 0, 1]])
    for one, other in zip(steps, expected, strict=True):
        np.testing.assert_array_equal(one.obs, other.obs[[0, 0, 1]])
        np.testing.assert_array_equal(one.aftermath, other.aftermath[[0, 0, 1, 0, 1]])
        memory = jnp.asarray(one.aftermath)
        np.testing.assert_array_equal(env.recall_next(memory, jnp.zeros(2), memory), one.final_obs)
    assert spaces_of(env).privileged == 2
    state, obs = env.reset(jax.random.key(1))
    np.testing.assert_array_equal(env.remember(state, obs), start[[0, 0, 1, 0, 1]])
    np.testing.assert_array_equal(env.recall(env.remember(state, obs)), obs)


@pytest.mark.parametrize(
    ("env", "words"),
    [
        (envs.get_environment("fast", obs_mode="dict_pixels"), r"Fast: .* 'pixels/view_0' is an image \(4, 4, 3\)"),
        (training.VmapWrapper(Field(), 2), r"Field: it is a batch of shape \(2,\): give a single"),
        (training.AutoResetWrapper(Field()), "Field: AutoResetWrapper hides"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(env, words):
    with pytest.raises(UserError, match=words):
        from_brax(env)
