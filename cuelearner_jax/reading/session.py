"""What answers about one policy say so far: questions are chosen, answers are read, and a verdict is given.

    reading = Reading(policy, env, eps_deg=2.0, labels=100)
    reading.learn(obs, actions, answers)    # as often as there are new ones
    reading.policy(), reading.result()

Before a batch of answers is read, the correction so far and "nothing changed" predict it; r is the ratio of the two.
The product of (1 + r) / 2 is a test martingale: half of its capital is staked on each batch, so that one batch
predicted badly halves it at most. Where nothing changed it exceeds 20 with probability 1/20 at most, however often one
looks (Ville's inequality). From 20 on the correction is used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax import user_code
from cuelearner_jax.environment import PROPOSED, Quantity
from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import innermost, policy_name, policy_of
from cuelearner_jax.reading import fitting, linear
from cuelearner_jax.reading.families import Family
from cuelearner_jax.reading.fitting import Fit, Reader
from cuelearner_jax.reading.linear import RelativeLabels, steps_of
from cuelearner_jax.reading.policy import ReadingPolicy, unread
from cuelearner_jax.reading.result import Result, describe_fit
from cuelearner_jax.spaces import UNSAID, Space

BATCHES = 5  # in which a budget of labels is asked or read
LEAST_BATCH = 10
LEAST_EVIDENCE = math.log(20)  # log of the test martingale from which a correction is used
MOST_WRONG = 0.4  # share of answers about something else from which none is believed
MOST_SITUATIONS = 200  # situations met that are kept
FIRST = 3.0  # spread of the first questions about the policy's actions, in eps


class Reading:
    """The answers about a policy, and what they say.

    Args:
        policy: a policy, or any function of a batch of observations.
        family: distortions that may have changed; empty: any entry of the observation may have shifted.
        space: space of the actions, with cues.
        eps_deg: strength of an answer, in the space's unit.
        labels: expected number of labels, for which programs are compiled.
        observation: slices of the observation, for words. Where one is an action proposed elsewhere, there is no
            process, since what the proposal depends on, such as pictures, is not seen.
        bound_deg: largest distance from the policy's own action, in use and in questions, in the space's unit.
    """

    def __init__(
        self,
        policy: Any,
        family: Family,
        space: Space,
        eps_deg: float,
        labels: int,
        observation: Sequence[Quantity] = (),
        bound_deg: float = np.inf,
    ) -> None:
        if not space.cues:
            raise UserError(f"actions of {space.name} have no order, so no answer says more or less: give them cues")
        self.base, self.family, self.space = policy_of(policy, space), family, space
        self.eps, self.observation = float(space.from_unit(eps_deg)), tuple(observation)
        self.bound = jnp.float32(space.from_unit(bound_deg))
        self.slots = labels
        self.rows: RelativeLabels | None = None  # all answers so far
        self.fits: Fit | None = None  # all hypotheses
        self.fit: Fit | None = None  # the best of them
        self.evidence = 0.0  # log of the test martingale [nats]
        self.situations = np.zeros((0, 0), np.float32)  # situations that the policy met last
        self._acts = acts_of(self.base)
        self._reader: Reader | None = None

    @property
    def count(self) -> int:
        """Number of answers so far."""
        return 0 if self.rows is None else len(self.rows.obs)

    def questions(
        self, obs: Float[np.ndarray, "n obs"], count: int, key: PRNGKeyArray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Choose situations and actions to ask about, as wide around the right action as it is unknown.

        `obs`: situations that the policy meets. Returns the numbers of the chosen ones (count,) and the actions
        (count, action).
        """
        k_where, k_action = jax.random.split(key)
        self.situations = np.concatenate([self.situations.reshape(-1, obs.shape[1]), obs])[-MOST_SITUATIONS:]
        index = np.asarray(jax.random.choice(k_where, len(obs), (count,), replace=len(obs) < count))
        rows = jnp.asarray(np.asarray(obs)[index], jnp.float32)
        base, spread = self.act(rows), jnp.full((count, len(self.space.cues)), FIRST * self.eps)
        if self.fit is not None and self._reader is not None:
            spread = self._reader.spread(self.fit, rows)
        asks = jnp.array([cue.is_asked for cue in self.space.cues])
        action = _near(self.space, k_action, base, asks[None] * jnp.maximum(spread, self.eps / 2))
        if np.isfinite(self.bound):
            action = self.space.clip(action, self._acts(rows), self.bound)
        return index, np.asarray(action)

    def learn(
        self,
        obs: Float[np.ndarray, "n obs"],
        action: Float[np.ndarray, "n action"],
        answer: Float[np.ndarray, "n cues"],
    ) -> None:
        """Read answers -1, 0, 1 or `UNSAID`, after those before were read."""
        new = [np.asarray(part, np.float32) for part in (obs, action, answer)]
        if not len(new[0]):
            return
        batch = _padded(new, max(len(new[0]), -(-self.slots // BATCHES)))  # as others are: few programs are compiled
        self._acts(batch.obs)  # refuses a policy that has no action there
        if self._reader is None:
            acts = acts_of(self.base, everywhere=False)
            step = steps_of(self.space, self.family, acts, jnp.asarray(new[0]), self.eps) if self.family else None
            process = all(part.kind != PROPOSED for part in self.observation)
            self._reader = Reader(self.space, self.family, acts, jnp.float32(self.eps), step, process=process)
        if self.fits is not None:
            self.evidence += float(self._reader.ratio(self.fits, batch))
        if self.rows is not None:
            new = [np.concatenate(both) for both in zip(self.rows[:3], new, strict=True)]
        self.rows = RelativeLabels(new[0], new[1], new[2], np.ones(len(new[0]), bool))  # pyright: ignore[reportArgumentType]
        self.slots = max(self.slots, -(-len(new[0]) // self.slots) * self.slots)
        former, size = self.fits, new[0].shape[1]
        start = fitting.unfitted(self.space, self.family, size) if former is None else fitting.again(former)
        self.fits = self._reader.read(_padded(new, self.slots), *start)
        self.fit = fitting.pick(self.fits, int(fitting.best_of(self.fits)))

    def read_in_batches(self, obs: np.ndarray, action: np.ndarray, answer: np.ndarray) -> None:
        """Read given answers in batches, so that each is predicted before it is read."""
        size = max(LEAST_BATCH, -(-len(obs) // BATCHES))
        for start in range(0, len(obs), size):
            part = slice(start, start + size)
            self.learn(obs[part], action[part], answer[part])

    def policy(self) -> Any:
        """Return the policy as corrected so far."""
        size = sum(part.size for part in self.observation) or self.situations.shape[1]
        if self.fit is None:
            return unread(self.base, self.space, self.family, size) if size else self.base
        return ReadingPolicy(self.base, fitting.correction(self.fit, self.eps), self.bound, self.space, self.family)

    def result(self) -> Result:
        """Return the verdict."""
        if self.fits is None or self.fit is None:
            return Result(False, False, 0.0, (), 0.0, 0.0, None, 0.0, self.policy())
        number = int(fitting.best_of(self.fits))
        inputs = situations = jnp.asarray(self.situations)
        if len(situations):
            inputs = linear.inputs(self.space, self.fit.frame, situations, self._acts(situations))
        described = describe_fit(self.fit, self.space, self.family, self.eps, self.observation, np.asarray(inputs))
        in_use = number > 0 and self.evidence >= LEAST_EVIDENCE and described[-1] < MOST_WRONG
        return Result(in_use, number > 0, self.evidence, *described, self.policy(), self._open_ended())

    def _open_ended(self) -> tuple[str, ...]:
        """Return words about each cue of which all answers, `LEAST_BATCH` or more, name the same way."""
        assert self.rows is not None
        lines = []
        for cue, answers in zip(self.space.cues, np.asarray(self.rows.answer).T, strict=True):
            ways = answers[answers != UNSAID]
            if len(ways) >= LEAST_BATCH and abs(ways.sum()) == len(ways):
                lines.append(f"all {len(ways)} answers about {cue.name} say {cue.words[int(ways[0] < 0)]}")
        return tuple(lines)

    def act(self, obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        """Return actions of the policy as corrected so far."""
        return self._acts(obs) if self.fit is None or self._reader is None else self._reader.act(self.fit, obs)


def acts_of(policy: Any, everywhere: bool = True) -> linear.Acts:
    """Return a policy's actions as a function. Plain Python is not compiled in.

    `everywhere`: refuse a policy without an action somewhere; False: actions are NaN there, where no world may lead.
    """
    name, run = policy_name(policy), run_of(policy)

    def acts(obs: Float[Array, "n obs"]) -> Float[Array, "n action"]:
        actions = jnp.asarray(run(jax.random.key(0), None, jnp.asarray(obs)))
        user_code.check_actions(not everywhere or np.isfinite(np.asarray(actions)).all(), name)
        return actions

    return acts


def run_of(policy: Any) -> Any:
    """Return a policy's `act`, compiled unless plain Python acts: that may call JAX itself, and would deadlock."""
    return policy.act if getattr(innermost(policy), "on_host", False) else partial(_act, policy)


@partial(jax.jit, static_argnums=0)
def _near(space: Space, key: Any, actions: Array, spread: Array) -> Array:
    """Return actions at random around others; `spread` is along each cue."""
    return space.exp(actions, spread * jax.random.normal(key, spread.shape))


_act = jax.jit(lambda policy, key, states, obs: policy.act(key, states, obs))


def _padded(rows: Sequence[np.ndarray], slots: int) -> RelativeLabels:
    """Return rows in `slots` slots, those beyond the last repeating the first row and not valid."""
    count = len(rows[0])
    obs, action, answer = (jnp.asarray(np.concatenate([row, np.repeat(row[:1], slots - count, 0)])) for row in rows)
    return RelativeLabels(obs, action, answer, jnp.arange(slots) < count)
