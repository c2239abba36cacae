"""BD-COACH: a model of the teacher corrects the policy in every situation of the buffer.

Source: Lopez Bosque, "Towards corrective deep imitation learning in data intensive environments" (MSc thesis, TU Delft,
2021), Batch Deep COACH, with the numbers that the public code of CLIC has for this method. Deep COACH replays old
corrections as they were given, of a policy that has changed since. BD-COACH replays situations instead: a human model H
learns what the teacher says of any action, and is asked about what the policy does there now. Of the buffer of all
labels (s, a, h), h_c in {-1, 0, 1} or not said of each cue c:

    H <- H - Adam(grad of sum over said cues of (H(s, a) - h)_c^2)
    y = clip(exp(pi(s), eps H(s, pi(s))), pi(s), eps),  fixed while the policy is moved
    pi <- pi - Adam(grad of sum over cues of (d log (pi(s) - y))_c^2)
    a <- clip(retract(pi(s)), a, tau_max)

A new label is in a minibatch of H, then in one of the policy, with its own target exp(a, eps h). `BATCH_STEPS` times
`HUMAN_STEPS` minibatches of H and one of the policy follow (3 to 1, as in that code). Where a bound of actions cuts
exp(a, eps h) short, h is as much smaller for H.

What differs, and why: that code takes 500 such turns at the end of an episode, of which it may have many corrections or
one; here each label has its turns, since rounds of questions are no episodes. "Already right" is an answer here, on
which H is trained towards 0; there it is silence, and the label is left out. H gives vectors in units of eps, in the
frame in which networks of this package see, as the model of `relative` does; and no step is longer than eps along any
cue, as no answer is. A cue of which nothing was said teaches H nothing, and H then says what the policy learns of it;
one that no label names counts as "already right".
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Int, PRNGKeyArray

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.guides.dcoach import Coached, Correct, DeepCoach
from cuelearner_jax.guides.fitting import Example, optimizer, squared_errors
from cuelearner_jax.types import Label, Params

BATCH_STEPS = 5  # gradient steps of the policy on the whole buffer after each new label
HUMAN_STEPS = 3  # gradient steps of the human model before each of these


class BatchCoached(Coached):
    """The policy and its human model during training, as the parameters of a model."""

    human: Params
    human_optimizer: Any  # state


class BatchCoach(DeepCoach):
    """A guide that acts as a cloned policy does, and learns from a model of its teacher."""

    name, about, title = "bdcoach", "a policy moved by a model of its teacher", "BD-COACH"
    colour, learners = "#CC6677", ("policy", "human")

    def begin(self, key: PRNGKeyArray) -> BatchCoached:
        """Return one member's policy without corrections, and its untrained human model."""
        policy, human = (self.member.network.init(one) for one in jax.random.split(key))
        states = (optimizer(GuideScalars()).init(params) for params in (policy, human))
        return BatchCoached(policy, next(states), jnp.zeros((), jnp.int32), human, next(states))

    def human_loss(self, env: Any, human: Params, rows: Example, scalars: GuideScalars) -> Array:
        """Return the loss of the human model: its predictions about the asked actions against the answers."""
        answers = rows.replace(target=(rows.target - rows.action) / self.spaces.actions.from_unit(scalars.eps_deg))
        return jnp.mean(squared_errors(answers, self.member.network.predict(env, human, rows.obs, rows.action)))

    def policy_targets(self, env: Any, human: Params, rows: Example, acted: Array, scalars: GuideScalars) -> Example:
        """Return rows whose targets are the human model's corrections of the policy's own actions, in all cues."""
        space = self.spaces.actions
        eps, own = space.from_unit(scalars.eps_deg), space.retract(acted)
        toward = space.retract(own + eps * self.member.network.predict(env, human, rows.obs, own))
        target = jax.lax.stop_gradient(space.clip(toward, own, eps))
        return rows.replace(target=target, cues=None if rows.cues is None else jnp.ones_like(rows.cues))

    def correction(
        self, env: Any, labels: Label, rows: Example, order: Int[Array, " slots"], scalars: GuideScalars
    ) -> Correct:
        """Return the update of both models by one label, then by minibatches of all labels up to it."""
        answers, adam = Guide.examples(self, labels, scalars), optimizer(scalars)

        def batch_of(key: PRNGKeyArray, number: Int[Array, ""]) -> tuple[Example, Example]:
            """Return minibatches of the first labels up to `number`, which comes first: for policy and human model."""
            numbers = jax.random.randint(key, (self.sizes.fit_batch_size,), 0, number + 1).at[0].set(number)
            return jax.tree.map(lambda leaf: leaf[order[numbers]], (rows, answers))

        def teach_human(coached: BatchCoached, batch: Example) -> BatchCoached:
            gradient = jax.grad(lambda human: self.human_loss(env, human, batch, scalars))(coached.human)
            updates, state = adam.update(gradient, coached.human_optimizer, coached.human)
            return coached.replace(human=optax.apply_updates(coached.human, updates), human_optimizer=state)

        def move(key: PRNGKeyArray, coached: BatchCoached, batch: Example, own: Array) -> BatchCoached:
            """Return the policy after one step; `own`: rows that keep their label's target."""
            sample = self.augmented(key, batch)

            def loss(policy: Params) -> Array:
                acted = self.member.predict(env, policy, sample.obs, sample.action)
                targets = self.policy_targets(env, coached.human, sample, acted, scalars)
                pick = lambda one, other: jnp.where(own[:, None], one, other)  # noqa: E731
                cues = None if sample.cues is None else pick(sample.cues, targets.cues)
                both = sample.replace(target=pick(sample.target, targets.target), cues=cues)
                return jnp.mean(squared_errors(both, acted))

            updates, state = adam.update(jax.grad(loss)(coached.policy), coached.optimizer, coached.policy)
            return coached.replace(policy=optax.apply_updates(coached.policy, updates), optimizer=state)

        def correct(key: PRNGKeyArray, number: Int[Array, ""], coached: BatchCoached) -> BatchCoached:
            keys = jax.random.split(jax.random.fold_in(key, number), 3)
            batch, answered = batch_of(keys[0], number)
            first = jnp.arange(self.sizes.fit_batch_size) == 0
            coached = move(keys[1], teach_human(coached, answered), batch, first)

            def turn(coached: BatchCoached, key: PRNGKeyArray) -> tuple[BatchCoached, None]:
                k_human, k_batch, k_see = jax.random.split(key, 3)

                def one(coached: BatchCoached, key: PRNGKeyArray) -> tuple[BatchCoached, None]:
                    return teach_human(coached, batch_of(key, number)[1]), None

                coached, _ = jax.lax.scan(one, coached, jax.random.split(k_human, HUMAN_STEPS))
                return move(k_see, coached, batch_of(k_batch, number)[0], jnp.zeros_like(first)), None

            coached, _ = jax.lax.scan(turn, coached, jax.random.split(keys[2], BATCH_STEPS))
            return coached.replace(learned=number + 1)

        return correct
