"""The refinement loop (paper, Eqs. 3-5): a <- a + phi(s, a) until a settles, within a ball around the first action.

Batch-native: a mask says which rows are done, so one `lax.while_loop` serves any number of actions, compiles with
everything round it and exports. No randomness. An accelerator waits for the host at each look whether all rows are
done, so it makes several passes between two looks (`devices.Portions.passes`); rows that are done stay as they are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.devices import portions
from cuelearner_jax.spaces import Space

GuideScalarsT = TypeVar("GuideScalarsT", bound=GuideScalars)


class Refinement(NamedTuple):
    """The result of a refinement."""

    actions: Float[Array, "n action"]
    passes: Int[Array, " n"]  # number of passes that moved each row


def no_refinement(actions: Float[Array, "n action"]) -> Refinement:
    """Return the result for actions that are not refined."""
    return Refinement(actions, jnp.zeros(actions.shape[0], jnp.int32))


def bound_scalars(space: Space, scalars: GuideScalarsT, bound: Float[Array, ""]) -> GuideScalarsT:
    """Return scalars that bound refinement to `bound` of the first action, or less where they did before."""
    return dataclasses.replace(scalars, tau_max_deg=jnp.minimum(scalars.tau_max_deg, space.to_unit(bound)))


def refine(
    residual: Callable[[Float[Array, "n action"]], Float[Array, "n action"]],
    first: Float[Array, "n action"],
    active: Bool[Array, " n"],
    *,
    space: Space,
    tau: Float[Array, ""] | float,
    tau_max: Float[Array, ""] | float,
    k_max: Int[Array, ""] | int,
) -> Refinement:
    """Refine a batch of actions from `first`, a_0, by at most `k_max` passes; rows that are not active do not change.

    `residual` is phi(s, .) of the rows' own observations. A row stops once a pass moves it by less than `tau` along
    every cue, in the unit of `space.log`; every iterate is clipped to within `tau_max` of `first` along each cue.
    """

    def unfinished(carry: tuple[Array, ...]) -> Array:
        _, done, _, k = carry
        return (k < k_max) & ~jnp.all(done)

    def one_pass(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        current, done, passes, k = carry
        done = done | (k >= k_max)  # reached between two looks
        proposal = space.clip(space.retract(current + residual(current)), first, tau_max)
        settled = space.distance(current, proposal) < tau
        return jnp.where(done[:, None], current, proposal), done | settled, passes + ~done, k + 1

    at_once = portions().passes
    body = (
        one_pass if at_once == 1 else lambda carry: jax.lax.fori_loop(0, at_once, lambda _, one: one_pass(one), carry)
    )
    start = (first, ~active, jnp.zeros(first.shape[0], jnp.int32), jnp.zeros((), jnp.int32))
    refined, _, passes, _ = jax.lax.while_loop(unfinished, body, start)
    return Refinement(refined, passes)
