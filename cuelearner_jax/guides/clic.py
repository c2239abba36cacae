"""CLIC: an energy over actions, low in the sets of actions that corrections leave possible.

Source: Li, Perez-Dattari, Babuska, Della Santina, Kober, "From action labels to sets: rethinking action supervision for
imitation learning from corrective feedback" (arXiv 2502.07645), with the numbers of its public code. With
x = log(a, b) / eps along the cues of which a label (s, a, h) speaks, zero along the others:

    pi(b | s) = exp(-E(s, b)) / Z,  over sampled actions b
    A = {b : |x - gamma h| < |x|}                        (half-space: nearer to the better action than to a)
      and {b : |x - h| < |x - g_i|},  g_i = gamma h + (1 - gamma) u_i, u_i as long as h and `ANGLE` away from it
      and {b : |x_c| < |x_c - 1|, |x_c| < |x_c + 1|}     (of a cue c that is already right)
    log p(b in A) = SHARPNESS * mean over these pairs of log sigmoid(difference of the two distances / SOFTNESS)
    E = argmin over labels of -log sum over b of pi(b | s) p(b in A)
    a <- argmin over b within tau_max of a of E(s, b)

A demonstration a+ of what to do in place of a (`clic_shown`, absolute corrections) has one set in place of these,
A = {b : |log(a+, b)| < RADIUS |log(a+, a)|}, of the same form and half that softness.

What differs, and why. The paper's loss is KL(target || pi) with target ~ pi p held fixed; the one above has the same
gradient, is a likelihood of labels, and so can choose parameters by held-out labels. As for every kind here these are
fitted from scratch in each round; there one network goes on. There b are drawn by Langevin dynamics; here half are
uniform and half lie around a, so that a fit takes seconds on a CPU, and no penalty on the energy's gradient is needed.
There one b is drawn to act; here the least energy is searched, first over `space.spread`, then around the best so far
in ever smaller boxes: no random number, no gradient, and a graph that can be exported. "Already right" is an answer
here where silence is meant there. A cue of which nothing was said is no part of any distance; one that no label names
stays where it is.
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax.agents.choice import each_in_portions
from cuelearner_jax.config import GuideScalars
from cuelearner_jax.feedback.answers import DEMONSTRATION, RELATIVE
from cuelearner_jax.guides.base import Guide, Rows, replaced
from cuelearner_jax.guides.fitting import silent_cues
from cuelearner_jax.guides.refining import Refinement
from cuelearner_jax.spaces import Box, is_answered, says_something
from cuelearner_jax.types import Action, Actions, GuidanceModel, Label, Observation, Observations, Params

SHARPNESS = 10.0  # weight of the observation model against the policy
SOFTNESS = 0.5  # softness of a set's edge, in units of eps: 0.1 in actions from -1 to 1, where eps is 0.2
NEAR = 2.0  # standard deviation of the actions sampled around the one asked about, in units of eps
FIRST_PAIRS = 0.3  # weight of the half-space beside all implicit pairs together
PASSES = 6  # passes of the search around the best action so far, each in a box of half the size
AROUND = 4  # actions of such a pass, for each cue
SAMPLED = 32  # actions between which the energy is compared in a step of a fit, for each label
SEARCHED = 256  # actions among which the search for the least energy begins
PAIRS = 8  # implicit pairs that narrow a half-space, drawn again in each step of a fit
ANGLE = 30.0  # how far the worse actions of these pairs lie from the answer's direction [deg]
GAMMA = 0.1  # how far along the answer the better action of the half-space lies, in units of eps
RADIUS = 0.5  # of the set around a demonstration, as a share of the way there from the action asked about


class Contrast(struct.PyTreeNode):
    """One label as the energy learns from it."""

    obs: Observation
    action: Action
    answer: Float[Array, " answer"]
    valid: Bool[Array, ""]
    draw: Int[Array, ""]  # number of its random stream for sampling
    base: Action  # the finished policy's action, where labels keep it; else the action asked about
    never: Bool[Array, " answer"]  # cues that no label names: they stay


def log_nearer(apart: Float[Array, "..."], closer: Float[Array, "..."], softness: float) -> Float[Array, "..."]:
    """Return log sigmoid((apart - closer) / softness): how surely the second distance is the smaller one."""
    return jax.nn.log_sigmoid((apart - closer) / softness)


def log_desired(
    x: Float[Array, " cues"], h: Float[Array, " cues"], implicit: Float[Array, "pairs cues"], gamma: Array | float
) -> Float[Array, ""]:
    """Return the mean over pairs of the log-probabilities that an action lies on the desired side, see the module.

    `x` is the action as seen from the one asked about, along the cues, in units of eps; `h` the answer, with `UNSAID`;
    `implicit` are directions u_i, as long as h.
    """
    spoken = is_answered(h)
    x, h = jnp.where(spoken, x, 0.0), jnp.where(spoken, h, 0.0)
    half = log_nearer(_size(x), _size(x - gamma * h), SOFTNESS)
    if len(h) > 1:
        worse = jax.vmap(lambda u: _size(x - gamma * h - (1 - gamma) * u))(implicit)
        both = (log_nearer(worse, _size(x - h), SOFTNESS).mean() + FIRST_PAIRS * half) / (1 + FIRST_PAIRS)
        half = jnp.where(spoken.sum() > 1, both, half)  # along one cue alone there are no other directions
    still, moving = spoken & (h == 0), (h != 0).sum()
    return (moving * half + jnp.sum(log_still(x), where=still)) / jnp.maximum(moving + still.sum(), 1)


def log_still(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the mean log-probability that x is nearer to 0 than to 1 and to -1."""
    right = [log_nearer(jnp.abs(x - side), jnp.abs(x), SOFTNESS) for side in (1.0, -1.0)]
    return (right[0] + right[1]) / 2


def direction_at(key: PRNGKeyArray, h: Float[Array, " cues"], angle: Array | float) -> Float[Array, " cues"]:
    """Return a random direction as long as h, at `angle` [rad] from h, along the cues that h names.

    Along one such cue alone there is no other direction: h itself.
    """
    spoken = is_answered(h)
    h = jnp.where(spoken, h, 0.0)
    noise = jnp.where(spoken, jax.random.normal(key, h.shape), 0.0)
    across = noise - jnp.sum(noise * h) / jnp.maximum(jnp.sum(h * h), 1.0) * h
    size = _size(across)
    return jnp.where(size > 1e-3, jnp.cos(angle) * h + jnp.sin(angle) * _size(h) / size * across, h)


def _size(vector: Float[Array, " cues"]) -> Float[Array, ""]:
    return jnp.sqrt(jnp.sum(jnp.square(vector)) + 1e-12)


class Clic(Guide):
    """A guide that executes the action of least energy."""

    name, title = "clic", "CLIC"
    about = "an energy over actions, low in the sets that corrections leave possible"
    form: ClassVar[Any] = RELATIVE
    colour, outputs, compares = "#117733", 1, True  # minus the energy of an action

    def energy(
        self, env: Any, params: Params, obs: Observation, actions: Actions, base: Action | None, scalars: GuideScalars
    ) -> Float[Array, " n"]:
        """Return E of actions in one situation; `base`, the policy's own action, is ignored."""
        return -self.network.predict(env, params, obs, actions)[:, 0]

    def membership(
        self, key: PRNGKeyArray, row: Contrast, actions: Actions, scalars: GuideScalars
    ) -> Float[Array, " n"]:
        """Return log p(b in A) of actions b, where A is the desired set of one label."""
        space = self.spaces.actions
        x = space.log(jnp.broadcast_to(row.action, actions.shape), actions) / space.from_unit(scalars.eps_deg)
        angle, keys = jnp.deg2rad(ANGLE), jax.random.split(key, PAIRS)
        implicit = jax.vmap(lambda key: direction_at(key, row.answer, angle))(keys)
        beside = jnp.sum(log_still(x), -1, where=row.never[None])
        return SHARPNESS * (jax.vmap(lambda x: log_desired(x, row.answer, implicit, GAMMA))(x) + beside)

    def sample_actions(self, key: PRNGKeyArray, row: Contrast, scalars: GuideScalars) -> Actions:
        """Return the sampled actions of one label: two known ones, uniform ones, and ones near a."""
        space, count, eps = self.spaces.actions, SAMPLED - 2, self.spaces.actions.from_unit(scalars.eps_deg)
        k_any, k_near = jax.random.split(key)
        change = NEAR * eps * jax.random.normal(k_near, (count // 2, len(space.cues)))
        from_label = jnp.stack([row.action, self.form.correct(space, row.action, row.answer, eps)])
        near = space.exp(jnp.broadcast_to(row.action, (count // 2, space.size)), change)
        return jnp.concatenate([from_label, space.sample(k_any, (count - count // 2,)), near])

    def losses(self, env: Any, scalars: GuideScalars, params: Params, rows: Contrast) -> Float[Array, " n"]:
        """Return for each row -log of the probability that the policy's action lies in the desired set."""

        def one(row: Contrast) -> Array:
            k_pairs, k_sample = jax.random.split(jax.random.fold_in(jax.random.key(0), row.draw))
            actions = self.sample_actions(k_sample, row, scalars)
            log_pi = jax.nn.log_softmax(-self.energy(env, params, row.obs, actions, row.base, scalars))
            return -jax.nn.logsumexp(log_pi + self.membership(k_pairs, row, actions, scalars))

        return jax.vmap(one)(rows)

    def examples(self, labels: Label, scalars: GuideScalars) -> Contrast:
        """Return labels (slots, ...) as contrasts; a label that names no cue is not valid."""
        numbers, valid = jnp.arange(len(labels.valid)), says_something(labels.answer) | self.form.is_action
        base, valid = labels.action if labels.base is None else labels.base, labels.valid & valid
        never = silent_cues(labels.answer, valid, self.holds_out) & self.form.by_eps
        never = jnp.broadcast_to(never, labels.answer.shape)
        return Contrast(labels.obs, labels.action, labels.answer, valid, numbers, base, never)

    def augmented(self, key: PRNGKeyArray, batch: Contrast) -> Contrast:
        """Return the batch with new random streams for sampling."""
        return batch.replace(draw=jax.random.randint(key, batch.draw.shape, 0, 2**30))

    def minimise_energy(
        self, env: Any, params: Params, obs: Observation, base: Action, scalars: GuideScalars
    ) -> Action:
        """Return the action of least energy within tau_max of `base`, by a deterministic search."""
        space, cues = self.spaces.actions, len(self.spaces.actions.cues)
        bound = jnp.minimum(space.from_unit(scalars.tau_max_deg), space.from_unit(space.reach))

        def best(actions: Actions) -> Action:
            actions = space.clip(actions, jnp.broadcast_to(base, actions.shape), bound)
            return actions[jnp.argmin(self.energy(env, params, obs, actions, base, scalars))]

        def box(center: Array, half: Array, count: int) -> Float[Array, "count action"]:
            """Return actions spread evenly around one, up to `half` away along each cue."""
            offsets = Box((-1.0,) * cues, (1.0,) * cues).spread(count)
            return space.exp(jnp.broadcast_to(center, (count, space.size)), half * offsets)

        lowest = best(jnp.concatenate([base[None], space.spread(SEARCHED // 2), box(base, bound, SEARCHED // 2)]))
        half = 2.0 * bound * SEARCHED ** (-1.0 / cues)
        for number in range(PASSES):
            lowest = best(jnp.concatenate([lowest[None], box(lowest, 0.5**number * half, AROUND * cues)]))
        return lowest

    def act(
        self, model: GuidanceModel, env: Any, obs: Observations, actions: Actions, active: Rows, scalars: GuideScalars
    ) -> Refinement:
        """Return the action of least energy within tau_max of a, in active rows of a fitted model."""

        def choose(where: Array) -> Array:
            own_obs, base = jnp.split(where, [obs.shape[1]])
            return self.minimise_energy(env, model.params, own_obs, base, scalars)

        best = each_in_portions(choose, jnp.concatenate([obs, actions], -1), SEARCHED)
        return replaced(self.in_question(actions, best), actions, active & model.fitted)


class ClicShown(Clic):
    """A guide that learns from demonstrated actions, by a set around each demonstration."""

    name, title = "clic_shown", "CLIC, demonstrations"
    about = "an energy over actions, low around what the teacher shows"
    form, colour, by_cues = DEMONSTRATION, "#44AA99", True

    def membership(
        self, key: PRNGKeyArray, row: Contrast, actions: Actions, scalars: GuideScalars
    ) -> Float[Array, " n"]:
        """Return log p(b in A) of actions b, where A is the ball around the demonstration."""
        space = self.spaces.actions
        eps = space.from_unit(scalars.eps_deg)
        away = jax.vmap(lambda action: _size(space.log(row.answer, action) / eps))(actions)
        return SHARPNESS * log_nearer(RADIUS * _size(space.log(row.answer, row.action) / eps), away, SOFTNESS / 2)
