"""How many answers of people or teachers a policy agrees with: evaluation without a simulator.

A policy agrees with what was said of a cue if it would say the same: that its own action lies at more, at less, or
within eps / 2 of the action asked about. Give answers that it was not corrected by.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cuelearner_jax import user_code
from cuelearner_jax.evaluate import mean_interval
from cuelearner_jax.feedback.answers import relative_feedback
from cuelearner_jax.policies import policy_name
from cuelearner_jax.spaces import Space, is_answered
from cuelearner_jax.types import Label

Share = tuple[float, float, float]  # and the ends of its 95% interval


class Agreement(NamedTuple):
    """Shares of answers, with 95% bootstrap intervals over labels."""

    labels: int
    policy: Share  # that the policy agrees with
    right: Share  # that are "already right"
    base: Share | None = None  # that the policy as it was agrees with; None: it is not known
    difference: Share | None = None  # the policy's less the base's, label by label

    def words(self) -> list[str]:
        """The agreement, a line each."""
        rows = (("the policy", self.policy), ("the policy as it was", self.base), ("always already right", self.right))
        lines = [f"{name}: agrees with {_told(share)}" for name, share in rows if share is not None]
        less = [] if self.difference is None else [f"difference from the policy as it was: {_told(self.difference)}"]
        return [
            *lines,
            *less,
            f"shares of the answers of {self.labels} labels, with 95% bootstrap intervals over labels",
        ]


def _told(share: Share) -> str:
    return "{:.3f} [{:.3f}, {:.3f}]".format(*share)


def agreement(policy: Any, rows: Label, space: Space, eps: float, base: Any = None) -> Agreement:
    """Return how many answers a policy agrees with.

    Args:
        policy: what acts; see `types.Policy`. It gets observations alone.
        rows: relative labels (labels, ...) as arrays.
        space: of the actions.
        eps: strength of an answer, in the space's unit.
        base: the policy before its correction; None: it is not known.

    Raises:
        UserError: a policy gives something else than actions.
    """
    told = (
        np.asarray(is_answered(jnp.asarray(rows.answer))) if len(space.cues) > 1 else np.ones(rows.answer.shape, bool)
    )
    count = np.maximum(told.sum(-1), 1)
    share = lambda agreed: (agreed & told).sum(-1) / count  # noqa: E731
    own = share(_says(policy, rows, space, eps) == rows.answer)
    before = None if base is None else share(_says(base, rows, space, eps) == rows.answer)
    less = None if before is None else _interval(own - before)
    right = _interval(share(np.asarray(rows.answer) == 0))
    return Agreement(len(own), _interval(own), right, None if before is None else _interval(before), less)


def _interval(values: Float[np.ndarray, " labels"]) -> Share:
    estimate, low, high = (float(value) for value in mean_interval(values))
    return estimate, low, high


def _says(policy: Any, rows: Label, space: Space, eps: float) -> Float[np.ndarray, "labels cues"]:
    """What a policy would answer about the actions of labels."""

    @jax.jit
    def answered(policy: Any, obs: Any, action: Any) -> Any:
        own = space.only_actions(policy.act(jax.random.key(0), None, obs))
        strength = space.from_unit(eps)
        return own, jax.vmap(lambda asked, own: relative_feedback(space, asked, own, strength))(action, own)

    own, found = answered(policy, jnp.asarray(rows.obs), jnp.asarray(rows.action))
    user_code.check_actions(own, policy_name(policy))
    return np.asarray(found)
