"""A person as the judge: both policies play the same starts, and films without names are compared."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from cuelearner_jax.environment import Environment
from cuelearner_jax.errors import UserError, format_value
from cuelearner_jax.policies import Policy
from cuelearner_jax.task import Pictures

# films of the same start -> -1: the left one is better, 0: neither, 1: the right one
Prefer = Callable[[Path, Path], int]


class Person(NamedTuple):
    """Who compares films, and how these are drawn."""

    prefer: Prefer
    pictures: Pictures


def preferences(
    person: Person, env: Environment, policies: tuple[Policy, Policy], key: PRNGKeyArray, steps: int
) -> Generator[int, None, None]:
    """Yield, for one start after another, 1 where the second policy is preferred, -1 where the first is, else 0.

    Films change sides by chance. `steps`: of an episode, at most. Raises UserError for another answer.
    """
    with tempfile.TemporaryDirectory() as folder:
        number = 0
        while True:
            start = jax.random.fold_in(key, number)
            films = [Path(folder, f"{number}{name}.gif") for name in "ab"]
            for policy, file in zip(policies, films, strict=True):
                frames, _ = person.pictures.record(env, policy, start, int(_length(env, policy, start, steps)))
                person.pictures.animate(env, frames, file)
            swapped = bool(jax.random.bernoulli(jax.random.fold_in(start, 1)))
            answer = person.prefer(*(films[::-1] if swapped else films))
            if answer not in (-1, 0, 1):
                raise UserError(f"judge_by gave {format_value(answer)}: give -1 (left), 0 (no difference) or 1 (right)")
            yield -answer if swapped else answer
            for file in films:
                file.unlink()
            number += 1


@jax.jit
def _length(env: Environment, policy: Policy, key: PRNGKeyArray, steps: Int[Array, ""] | int) -> Int[Array, ""]:
    """Return the steps of an episode that begins by a key, with the random numbers of `Pictures.record`."""
    k_reset, k_play = jax.random.split(key)

    def unfinished(carry: tuple[Any, ...]) -> Array:
        number, *_, ended = carry
        return (number < steps) & ~ended

    def advance(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        number, state, obs, _ = carry
        k_act, k_step = jax.random.split(jax.random.fold_in(k_play, number))
        action = policy.act(k_act, jax.tree.map(lambda leaf: leaf[None], state), obs[None])[0]
        following, step = env.step(k_step, state, action)
        return number + 1, following, step.obs, step.terminated | step.truncated

    first = (jnp.zeros((), jnp.int32), *env.reset(k_reset), jnp.array(False))
    return jax.lax.while_loop(unfinished, advance, first)[0]
