"""Check the laws of a kind of guidance (`cuelearner_jax.guides.base.Kind`) in one environment."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from cuelearner_jax.config import GuideScalars, GuideSizes, Scalars
from cuelearner_jax.environment import Environment, actions_of, offers, spaces_of
from cuelearner_jax.feedback.forms import AnswerForm
from cuelearner_jax.guides.base import Guide, Kind
from cuelearner_jax.testing.laws import Laws, OnceTraced, change_floats, same_shapes
from cuelearner_jax.types import EnvState, GuidanceModel, Label

SMALL = GuideSizes(feedback_layers=(8, 8), labels_per_round=4, fit_steps=8, fit_batch_size=4, validate_every=4)
ROWS = 6  # situations, of which every second is guided; as many labels


class Steady(struct.PyTreeNode):
    """A teacher whose best action is always the same."""

    action: Float[Array, " action"]

    def best_action(self, state: EnvState, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        """Return that action."""
        return self.action


def check_guidance(kind: Kind, env: Environment, sizes: GuideSizes = SMALL, tolerance: float = 1e-5) -> None:
    """Check that a kind of guidance keeps its laws. Raises AssertionError for the first law that is broken.

    Args:
        kind: the kind.
        env: an environment that it can be had in.
        sizes: small sizes of its model.
        tolerance: relative and absolute, of actions.
    """
    laws = Laws(f"guidance {kind.name}", tolerance)
    for need in kind.needs:
        laws.hold(offers(env, need), f"it needs a {need}, which {type(env).__name__} lacks: check it in another one")
    with laws.attempted("`make`", "its class inherits Guide, and its `config` has defaults"):
        guide = kind.make(sizes, spaces_of(env))
        model = guide.init(key := jax.random.key(0))
    states, obs = jax.vmap(env.reset)(jax.random.split(key, ROWS))
    actions = actions_of(env).sample(key, (ROWS,))
    fitted = model
    if guide.form is not None:
        fitted = _fitted(laws, guide, env, model, _answered(laws, guide, guide.form, env, states, obs, actions))
    _check_act(laws, guide, env, model, fitted, obs, actions)
    with laws.attempted("`question` under jit", "it gets one situation and the base policy's action there"):
        asked = jax.jit(guide.question)(jax.random.key(3), fitted, env, obs[0], actions[0], GuideScalars())
    laws.hold(asked.shape == actions[0].shape, f"`question` returns shape {asked.shape}: ask about one action")
    laws.actions(actions_of(env), asked, "what `question` asks about")
    if guide.form is not None:
        _check_disagreement(laws, kind, env, sizes, obs, actions)


def _answered(laws: Laws, guide: Guide, form: AnswerForm, env: Any, states: Any, obs: Array, actions: Array) -> Label:
    """Return labels (rows, ...) of a simulated teacher."""
    space = actions_of(env)
    named, width = re.fullmatch(r"[a-z][a-z0-9_-]*", form.name) and form.meaning(space), form.width(space)
    laws.hold(named, f"its form {form.name!r} lacks a name in lower case or a meaning: label files tell both")
    teacher = Steady(space.spread(8)[3])

    def each(key: Array, state: Any, obs: Array, action: Array) -> tuple[Array, Array]:
        return form.answer(key, env, teacher, state, obs, action, Scalars())

    with laws.attempted("its form's `answer`", "it returns (answer, answered), in jax.numpy"):
        answers, answered = jax.jit(jax.vmap(each))(jax.random.split(jax.random.key(1), ROWS), states, obs, actions)
    laws.hold(answers.shape == (ROWS, width), f"an answer has shape {answers.shape[1:]}: its form says ({width},)")
    laws.hold(answered.shape == (ROWS,) and answered.dtype == bool, "`answered` is no bool: say whether it answered")
    labels = Label(obs, actions, answers, answered, base=actions if guide.kind.sees_base else None)
    with laws.attempted("`target` under vmap", "it gets one Label and GuideScalars, and returns a vector"):
        targets = jax.vmap(lambda label: guide.target(label, GuideScalars()))(labels)
    sound = targets.ndim == 2 and np.isfinite(targets).all()
    laws.hold(sound, f"`target` of one label has shape {targets.shape[1:]} or is not finite: return one finite vector")
    return labels


def _fitted(laws: Laws, guide: Guide, env: Any, model: GuidanceModel, labels: Label) -> GuidanceModel:
    """Return the model of labels, fitted beside a lane without labels."""
    lanes, former = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), (labels, model))
    lanes = lanes.replace(valid=lanes.valid.at[1].set(False))
    keys = jax.random.split(jax.random.key(2), 2)

    def fit(key: Array, labels: Label, former: GuidanceModel, env: Any, scalars: GuideScalars) -> GuidanceModel:
        return guide.fit(key, env, labels, former, scalars)

    with laws.attempted("`fit` under jit and vmap", "it is one lane's: no Python branch may look at a value"):
        fits = jax.jit(jax.vmap(fit, (0, 0, 0, None, None)))(keys, lanes, former, env, GuideScalars())
    laws.hold(same_shapes(fits, former), "`fit` returns a model of other fields or shapes than `init`")
    laws.hold(fits.fitted[0], "`fit` of valid labels returns an unfitted model: set `fitted`")
    laws.hold(not fits.fitted[1], "`fit` without a valid label returns a fitted model: `fitted` must be False there")
    one = jax.tree.map(lambda leaf: leaf[0], fits)
    finite = all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(one.params))
    laws.hold(finite, "`fit` returns parameters that are not finite")
    return one


def _check_act(
    laws: Laws, guide: Guide, env: Any, unfitted: GuidanceModel, fitted: GuidanceModel, obs: Array, actions: Array
) -> None:
    """Check the changes to a batch of actions."""
    active, act, exact = jnp.arange(ROWS) % 2 == 0, OnceTraced(guide.act), Laws("", 0.0)
    scalars = GuideScalars()
    with laws.attempted("`act` under jit", "it gets a batch of rows and returns Refined(actions, passes)"):
        refined = act(fitted, env, obs, actions, active, scalars)
        act(fitted, env, obs, actions, active, change_floats(scalars))
        alone = act(unfitted, env, obs, actions, jnp.ones(ROWS, bool), scalars).actions
        passes = refined.passes
    laws.hold(act.traces == 1, "`act` is traced anew for other scalars: no Python branch may look at them")
    laws.hold(refined.actions.shape == actions.shape, f"`act` returns actions of shape {refined.actions.shape}")
    laws.actions(actions_of(env), refined.actions, "an action that `act` returns")
    counts = passes.shape == (ROWS,) and jnp.issubdtype(passes.dtype, jnp.integer)
    laws.hold(counts, "`act` returns passes that are no count for each row: how often was each moved?")
    kept = exact.same(refined.actions[~active], actions[~active])
    laws.hold(kept, "`act` changes rows that are not active: keep them by jnp.where(active[:, None], ...)")
    kept = not guide.asks or exact.same(alone, actions)
    laws.hold(kept, "`act` of an unfitted model changes actions: guide only active & model.fitted")


def _check_disagreement(laws: Laws, kind: Kind, env: Any, sizes: GuideSizes, obs: Array, actions: Array) -> None:
    """Check the disagreement of an ensemble's members."""
    guide = kind.make(dataclasses.replace(sizes, ensemble=2), spaces_of(env))
    model = guide.init(jax.random.key(4))
    model = model.replace(params=jax.tree.map(_moved, model.params))  # members may start out alike
    with laws.attempted("`disagreement` under jit", "it gets a model and a batch of situations and actions"):
        apart = jax.jit(guide.disagreement)(model, env, obs, actions)
    laws.hold(apart.shape == (ROWS,), f"`disagreement` of {ROWS} rows has shape {apart.shape}: give one number a row")
    laws.hold(np.isfinite(apart).all() and (apart >= 0).all(), "`disagreement` is negative or not finite")
    laws.hold(jnp.ptp(apart) > 0, "`disagreement` is the same of all situations: it can choose none of them")


def _moved(leaf: Array) -> Array:
    """Return parameters that differ from the start's, as after a fit."""
    if not jnp.issubdtype(leaf.dtype, jnp.floating):
        return leaf
    return leaf + 0.1 * jax.random.normal(jax.random.key(leaf.size), leaf.shape)
