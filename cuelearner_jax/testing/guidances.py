"""Check the laws of a kind of guidance (`cuelearner_jax.guides.base.Guide`) in one environment."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from cuelearner_jax.agents.networks import all_finite
from cuelearner_jax.config import GuideScalars, GuideSizes, Scalars
from cuelearner_jax.environment import Environment, actions_of, offers, spaces_of
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.testing.laws import Laws, shapes_of
from cuelearner_jax.types import GuidanceModel, Label

SMALL = GuideSizes(feedback_layers=(8, 8), labels_per_round=4, fit_steps=8, fit_batch_size=4, validate_every=4)
ROWS = 6  # situations, of which every second is guided; as many labels
SCALARS = GuideScalars()


def check_guidance(kind: type[Guide], env: Environment, sizes: GuideSizes = SMALL) -> None:
    """Check that a kind of guidance keeps its laws in an environment that it can be had in, with a small model.

    Raises AssertionError for the first law that is broken.
    """
    laws = Laws(f"guidance {kind.name}")
    for need in kind.needs:
        laws.hold(offers(env, need), f"it needs a {need}, which {type(env).__name__} lacks: check it in another one")
    guide = kind(sizes, spaces_of(env))
    model = guide.init(key := jax.random.key(0))
    states, obs = jax.vmap(env.reset)(jax.random.split(key, ROWS))
    actions = actions_of(env).sample(key, (ROWS,))
    fitted = _fitted(laws, guide, env, model, _labels(laws, guide, env, states, obs, actions)) if guide.form else model
    _check_act(laws, guide, env, model, fitted, obs, actions)
    action = jax.jit(guide.question)(jax.random.key(3), fitted, env, obs[0], actions[0], SCALARS)
    laws.actions(actions_of(env), action, "what `question` asks about")


def _labels(laws: Laws, guide: Guide, env: Any, states: Any, obs: Array, actions: Array) -> Label:
    space, form = actions_of(env), guide.form
    assert form is not None
    teacher: Any = SimpleNamespace(best_action=lambda state, obs: space.spread(8)[3])
    answer = jax.vmap(lambda key, *situation: form.answer(key, env, teacher, *situation, Scalars()))
    answers, answered = jax.jit(answer)(jax.random.split(jax.random.key(1), ROWS), states, obs, actions)
    shape = (ROWS, form.width(space))
    laws.hold(answers.shape == shape, f"{ROWS} answers have shape {answers.shape}: their form says {shape}")
    labels = Label(obs, actions, answers, answered, base=actions if guide.sees_base else None)
    targets = jax.vmap(lambda label: guide.target(label, SCALARS))(labels)
    sound = targets.ndim == 2 and np.isfinite(targets).all()
    laws.hold(sound, f"`target` of one label has shape {targets.shape[1:]} or is not finite: return one finite vector")
    return labels


def _fitted(laws: Laws, guide: Guide, env: Any, model: GuidanceModel, labels: Label) -> GuidanceModel:
    """Return the model of labels, fitted beside a lane without labels."""
    lanes, former = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), (labels, model))
    lanes = lanes.replace(valid=lanes.valid.at[1].set(False))
    fit = jax.jit(jax.vmap(guide.fit, (0, None, 0, 0, None)))
    fits = fit(jax.random.split(jax.random.key(2), 2), env, lanes, former, SCALARS)
    laws.hold(shapes_of(fits) == shapes_of(former), "`fit` returns a model of other fields or shapes than `init`")
    laws.hold(fits.fitted[0], "`fit` of valid labels returns an unfitted model: set `fitted`")
    laws.hold(not fits.fitted[1], "`fit` without a valid label returns a fitted model: `fitted` must be False there")
    one = jax.tree.map(lambda leaf: leaf[0], fits)
    laws.hold(all_finite(one), "`fit` returns parameters that are not finite")
    return one


def _check_act(
    laws: Laws, guide: Guide, env: Any, unfitted: GuidanceModel, fitted: GuidanceModel, obs: Array, actions: Array
) -> None:
    active, act = jnp.arange(ROWS) % 2 == 0, jax.jit(guide.act)
    refined, passes = act(fitted, env, obs, actions, active, SCALARS)
    alone = act(unfitted, env, obs, actions, jnp.ones(ROWS, bool), SCALARS).actions
    laws.actions(actions_of(env), refined, "an action that `act` returns")
    counts = passes.shape == (ROWS,) and jnp.issubdtype(passes.dtype, jnp.integer)
    laws.hold(counts, "`act` returns passes that are no count for each row: how often was each moved?")
    same = np.array_equal(refined[~active], actions[~active])
    laws.hold(same, "`act` changes rows that are not active: keep them by jnp.where(active[:, None], ...)")
    same = not guide.asks or np.array_equal(alone, actions)
    laws.hold(same, "`act` of an unfitted model changes actions: guide only active & model.fitted")
