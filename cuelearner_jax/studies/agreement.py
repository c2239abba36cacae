"""Agreement of a policy with the answers of people or teachers: evaluation without a simulator.

A policy agrees with an answer about a cue if it would give that answer itself: its own action lies at more, at less,
or within eps / 2 of the action asked about. Use answers that were not used for its correction.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cuelearner_jax import user_code
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import mean_interval
from cuelearner_jax.feedback.answers import relative_feedback
from cuelearner_jax.policies import policy_name
from cuelearner_jax.spaces import Space, is_answered, says_something
from cuelearner_jax.types import Label

Share = tuple[float, float, float]  # estimate, and the ends of its 95% interval


class Agreement(NamedTuple):
    """Shares of answers, with 95% bootstrap intervals over labels."""

    labels: int
    policy: Share  # answers that the policy agrees with
    right: Share  # answers that are "already right"
    base: Share | None = None  # answers that the uncorrected policy agrees with; None: unknown
    difference: Share | None = None  # the policy's share less the base's, paired by label

    def words(self) -> list[str]:
        """Return the agreement in words, line by line."""
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
    """Return the share of answers that a policy agrees with. Labels that say nothing of any cue do not count.

    Args:
        policy: the acting policy, see `types.Policy`, called with observations only.
        rows: relative labels (labels, ...) as arrays.
        space: the actions' space.
        eps: strength of an answer, in the space's unit.
        base: the policy before its correction; None: unknown.

    Raises:
        UserError: a policy returns something other than actions, or no label says anything.
    """
    rows = jax.tree.map(lambda leaf: np.asarray(leaf)[np.asarray(says_something(rows.answer))], rows)
    if not len(rows.obs):
        raise UserError("labels say nothing of any cue: give labels with answers")
    told = np.asarray(is_answered(rows.answer)) if len(space.cues) > 1 else np.ones(rows.answer.shape, bool)
    share = lambda agreed: (agreed & told).sum(-1) / told.sum(-1)  # noqa: E731
    own = share(_says(policy, rows, space, eps) == rows.answer)
    before = None if base is None else share(_says(base, rows, space, eps) == rows.answer)
    less = None if before is None else _interval(own - before)
    right = _interval(share(np.asarray(rows.answer) == 0))
    return Agreement(len(own), _interval(own), right, None if before is None else _interval(before), less)


def _interval(values: Float[np.ndarray, " labels"]) -> Share:
    estimate, low, high = (float(value) for value in mean_interval(values))
    return estimate, low, high


def _says(policy: Any, rows: Label, space: Space, eps: float) -> Float[np.ndarray, "labels cues"]:
    """Return the answers (labels, cues) that a policy would give about the labels' actions."""

    @jax.jit
    def answered(policy: Any, obs: Any, action: Any) -> Any:
        own = space.only_actions(policy.act(jax.random.key(0), None, obs))
        strength = space.from_unit(eps)
        return own, jax.vmap(lambda asked, own: relative_feedback(space, asked, own, strength))(action, own)

    own, found = answered(policy, jnp.asarray(rows.obs), jnp.asarray(rows.action))
    user_code.check_actions(own, policy_name(policy))
    return np.asarray(found)
