"""The pendulum as an environment of brax, and brax's wrappers with a random start of every episode."""

from typing import Any

import jax
import jax.numpy as jnp
from brax import envs
from brax.envs.wrappers import training
from pendulum import STEPS, STRONGEST, Pendulum, seen

ENDLESS = Pendulum(2**30)  # brax's wrapper ends the episodes


class BraxPendulum(envs.Env):  # with actions from -1 to 1
    observation_size, action_size, backend = 3, 1, "generalized"  # pyright: ignore[reportAssignmentType]

    def reset(self, rng: Any) -> Any:
        swing, obs = ENDLESS.reset(rng)
        return envs.State(swing, obs, jnp.zeros(()), jnp.zeros(()), info={"rng": rng})  # pyright: ignore

    def step(self, state: Any, action: jax.Array) -> Any:
        swing, step = ENDLESS.step(jax.random.key(0), state.pipeline_state, STRONGEST * action)
        return state.replace(pipeline_state=swing, obs=step.final_obs, reward=step.reward)


class FreshEpisodes(envs.Wrapper):  # brax's `AutoResetWrapper` begins every episode at the same cached state
    def step(self, state: Any, action: jax.Array) -> Any:
        info = {**state.info, "steps": jnp.where(state.done > 0, 0.0, state.info["steps"])}
        after: Any = self.env.step(state.replace(done=jnp.zeros_like(state.done), info=info), action)
        rngs = jax.vmap(lambda rng: jax.random.fold_in(rng, 1))(after.info["rng"])
        choose = lambda new, old: jnp.where(after.done > 0, new, old)  # noqa: E731
        swing = jax.tree.map(choose, jax.vmap(ENDLESS.reset)(rngs)[0], after.pipeline_state)
        return after.replace(pipeline_state=swing, obs=jax.vmap(seen)(swing), info={**after.info, "rng": rngs})


def wrap(env: envs.Env, episode_length: int = STEPS, action_repeat: int = 1, randomization_fn: Any = None) -> Any:
    return FreshEpisodes(training.EpisodeWrapper(training.VmapWrapper(env), episode_length, action_repeat))
