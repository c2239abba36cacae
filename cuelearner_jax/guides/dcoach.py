"""Deep COACH: every correction updates a policy network, which is never fitted from scratch.

Source: Perez-Dattari, Celemin, Ruiz-del-Solar, Kober, "Interactive learning with corrective feedback for policies based
on deep neural networks" (ISER 2018), Algorithm 1. A correction h gives the target a + e h; one gradient step is made on
the target, and one on a minibatch of a replay of the newest corrections. (Their code: 200 corrections, minibatches of
50.) Here e is eps, and the sum is `exp` of the space, along the cues that the label names:

    y = exp(a, eps h)
    pi <- pi - Adam(grad of sum over those cues of (d log (pi(s) - y))^2)
    a <- clip(retract(pi(s)), a, tau_max)

Differences and their reasons. Corrections come in rounds, so the corrections of a round are learned one after another
at the round's end (`--sizes.labels-per-round 1` learns each at once). "Already right" is an answer here, which holds
the policy in place; in the paper it is silence. The paper also learns from the replay at every tenth step, of which a
person corrects few; here every step is asked about, and `REPLAY_STEPS` minibatches follow a correction. Adam replaces
their SGD, since the CueLearner paper's appendix gives all auxiliary policies the same optimiser. The members of an
ensemble are corrected separately, and differ by their initial parameters and their draws from the replay.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cached_property, partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int, PRNGKeyArray

from cuelearner_jax.config import GuideScalars
from cuelearner_jax.feedback.answers import RELATIVE
from cuelearner_jax.guides.base import Rows
from cuelearner_jax.guides.demonstration import Demonstration
from cuelearner_jax.guides.fitting import Example, for_each, optimizer, squared_errors, with_moments
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.types import Actions, GuidanceModel, Label, Observations, Params

REPLAY_STEPS = 5  # gradient steps on earlier corrections after each new one
CORRECTION_REPLAY = 50  # newest corrections that the policy keeps learning from


class Coached(struct.PyTreeNode):
    """The policy during training, as the parameters of a model; an ensemble has a leading axis of members."""

    policy: Params
    optimizer: Any  # state
    learned: Int[Array, ""]  # labels that were used already; later ones are new


Correct = Callable[[PRNGKeyArray, Int[Array, ""], Any], Any]  # (key, number of a label, coached) -> coached


class DeepCoach(Demonstration):
    """A guide that acts as a cloned policy does, and is updated by each correction."""

    name, about, title = "dcoach", "a policy moved by each correction", "deep COACH"
    form, colour, holds_out = RELATIVE, "#56B4E9", False
    learners: ClassVar[tuple[str, ...]] = ("policy",)  # the networks of `Coached`

    @cached_property
    def member(self) -> DeepCoach:
        """Return the guide of one member of the ensemble."""
        return dataclasses.replace(self, sizes=dataclasses.replace(self.sizes, ensemble=1))

    def begin(self, key: PRNGKeyArray) -> Coached:
        """Return one member's policy without corrections."""
        params = self.member.network.init(key)
        return Coached(params, optimizer(GuideScalars()).init(params), jnp.zeros((), jnp.int32))

    def init(self, key: PRNGKeyArray) -> GuidanceModel:
        """Return a policy without corrections."""
        return GuidanceModel(for_each(self.sizes.ensemble, self.begin, key), jnp.array(False))

    def target(self, label: Label, scalars: GuideScalars) -> Float[Array, " action"]:
        """Return the action changed by h * eps along each cue."""
        space = self.spaces.actions
        return space.toward(label.action, label.answer, space.from_unit(scalars.eps_deg))

    def fit(
        self, key: PRNGKeyArray, env: Any, labels: Label, former: GuidanceModel, scalars: GuideScalars
    ) -> GuidanceModel:
        """Return the former model, corrected by the new labels in order."""
        rows = self.examples(labels, scalars)
        order, count = jnp.argsort(~rows.valid, stable=True), rows.valid.sum()
        correct, obs = self.correction(env, labels, rows, order, scalars), rows.obs[order]

        def one(key: PRNGKeyArray, number: Int[Array, ""], coached: Coached) -> Coached:
            so_far = jnp.arange(len(order)) <= number
            fresh = {name: with_moments(getattr(coached, name), obs, so_far) for name in self.learners}
            return correct(key, number, coached.replace(**fresh))

        def learn(key: PRNGKeyArray, coached: Coached) -> Coached:
            return jax.lax.fori_loop(coached.learned, count, partial(one, key), coached)

        return GuidanceModel(for_each(self.sizes.ensemble, learn, key, former.params), former.fitted | (count > 0))

    def correction(
        self, env: Any, labels: Label, rows: Example, order: Int[Array, " slots"], scalars: GuideScalars
    ) -> Correct:
        """Return the update by one label, then by a replay of the newest labels; `order`: valid labels first."""

        def loss(params: Params, batch: Example) -> Array:
            return jnp.mean(squared_errors(batch, self.member.predict(env, params, batch.obs, batch.action)))

        def step(coached: Coached, numbers: Int[Array, " batch"], key: PRNGKeyArray) -> Coached:
            batch = self.augmented(key, jax.tree.map(lambda leaf: leaf[order[numbers]], rows))
            gradient = jax.grad(loss)(coached.policy, batch)
            updates, state = optimizer(scalars).update(gradient, coached.optimizer, coached.policy)
            return coached.replace(policy=optax.apply_updates(coached.policy, updates), optimizer=state)

        def correct(key: PRNGKeyArray, number: Int[Array, ""], coached: Coached) -> Coached:
            oldest = jnp.maximum(number + 1 - CORRECTION_REPLAY, 0)

            def replay(coached: Coached, key: PRNGKeyArray) -> tuple[Coached, None]:
                k_draw, k_see = jax.random.split(key)
                numbers = jax.random.randint(k_draw, (self.sizes.fit_batch_size,), oldest, number + 1)
                return step(coached, numbers, k_see), None

            k_new, k_replay = jax.random.split(jax.random.fold_in(key, number))
            coached = step(coached, number[None], k_new)
            coached, _ = jax.lax.scan(replay, coached, jax.random.split(k_replay, REPLAY_STEPS))
            return coached.replace(learned=number + 1)

        return correct

    def act(
        self, model: GuidanceModel, env: Any, obs: Observations, actions: Actions, active: Rows, scalars: GuideScalars
    ) -> Refinement:
        """Return the cloned policy's action in place of a."""
        return super().act(model.replace(params=model.params.policy), env, obs, actions, active, scalars)

    def disagreement(self, model: GuidanceModel, env: Any, obs: Observations, actions: Actions) -> Float[Array, " n"]:
        """Return the variance of the members' vectors, summed over their entries."""
        return super().disagreement(model.replace(params=model.params.policy), env, obs, actions)
