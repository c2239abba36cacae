"""A label's way: question -> answer -> record -> fit, each step a pure function of the guide's part of a lane.

A simulated teacher's round scans them (`label_round`); a page calls them one by one, with a person's answer in between;
adaptation gives another base policy than uniform actions.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax.config import GuideScalars, GuideSizes, Scalars
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.guidance.bundle import Guidance
from cuelearner_jax.policies import Policy
from cuelearner_jax.types import GuideState, Label, Stream, Teacher


class QuestionKeys(NamedTuple):
    """Random numbers of one question."""

    base: PRNGKeyArray  # the base policy's
    question: PRNGKeyArray
    answer: PRNGKeyArray  # a simulated teacher's faults
    env: PRNGKeyArray  # the step that follows


def question_keys(lane_key: PRNGKeyArray, position: Int[Array, ""] | int) -> QuestionKeys:
    """Those of a lane's question number `position`."""
    key = jax.random.fold_in(jax.random.fold_in(lane_key, Stream.ASK), position)
    return QuestionKeys(*jax.random.split(key, 4))


def label_slots(budget: int, sizes: GuideSizes) -> int:
    """Rows that a label set needs: the budget rounded up to whole rounds."""
    return -(-budget // sizes.labels_per_round) * sizes.labels_per_round


def empty_labels(slots: int, obs_size: int, action_size: int, answer_width: int) -> Label:
    """`slots` rows of padding."""
    return Label(
        obs=jnp.zeros((slots, obs_size)),
        action=jnp.zeros((slots, action_size)),
        answer=jnp.zeros((slots, answer_width)),
        valid=jnp.zeros((slots,), bool),
    )


def start(
    guidance: Guidance,
    env: Environment,
    slots: int,
    budget: Int[Array, ""] | int,
    k_model: PRNGKeyArray,
    k_env: PRNGKeyArray,
) -> GuideState:
    """A guide that has asked nothing yet, at the start of an episode."""
    state, obs = env.reset(k_env)
    return GuideState(
        model=guidance.init(k_model),
        labels=empty_labels(slots, env.obs_size, actions_of(env).size, guidance.answer_width),
        budget=jnp.asarray(budget, jnp.int32),
        env=state,
        obs=obs,
    )


def question(
    guidance: Guidance, env: Environment, scalars: GuideScalars, base: Policy, guide: GuideState, keys: QuestionKeys
) -> Float[Array, " action"]:
    """The action to ask about in the guide's situation."""
    states = jax.tree.map(lambda leaf: leaf[None], guide.env)
    proposed = base.act(keys.base, states, guide.obs[None])[0]
    return guidance.question(keys.question, guide.model, env, guide.obs, proposed, scalars)


def record(
    guide: GuideState,
    position: Int[Array, ""] | int,
    action: Float[Array, " action"],
    answer: Float[Array, " answer"],
    answered: Bool[Array, ""] | bool,
) -> GuideState:
    """The guide with an answer in the row `position` of its labels; it counts within the budget alone."""
    label = Label(guide.obs, action, answer, jnp.asarray(answered) & (position < guide.budget))
    put = lambda rows, row: jax.lax.dynamic_update_index_in_dim(rows, row, position, 0)  # noqa: E731
    return guide.replace(labels=jax.tree.map(put, guide.labels, label))


def proceed(env: Environment, guide: GuideState, action: Float[Array, " action"], keys: QuestionKeys) -> GuideState:
    """The guide in the situation that the action leads to."""
    state, step = env.step(keys.env, guide.env, action)
    return guide.replace(env=state, obs=step.obs)


def fit(
    guidance: Guidance,
    env: Environment,
    scalars: GuideScalars,
    guide: GuideState,
    lane_key: PRNGKeyArray,
    times: Int[Array, ""] | None = None,
) -> GuideState:
    """The guide with a model of its labels. `times`: fits before this one, where it is one of several."""
    key = jax.random.fold_in(lane_key, Stream.FIT)
    key = key if times is None else jax.random.fold_in(key, times)
    return guide.replace(model=guidance.fit(key, env, guide.labels, guide.model, scalars))


def ask(
    guidance: Guidance,
    env: Environment,
    teacher: Teacher,
    scalars: Scalars,
    base: Policy,
    guide: GuideState,
    lane_key: PRNGKeyArray,
    position: Int[Array, ""],
) -> GuideState:
    """Question number `position`, answered by a simulated teacher, recorded and acted on."""
    if guidance.form is None:
        raise ValueError(f"guidance {guidance.name!r} asks nothing")
    keys = question_keys(lane_key, position)
    action = question(guidance, env, scalars, base, guide, keys)
    answer, answered = guidance.form.answer(keys.answer, env, teacher, guide.env, guide.obs, action, scalars)
    return proceed(env, record(guide, position, action, answer, answered), action, keys)


def label_round(
    guidance: Guidance,
    sizes: GuideSizes,
    env: Environment,
    teacher: Teacher,
    scalars: Scalars,
    base: Policy,
    guide: GuideState,
    lane_key: PRNGKeyArray,
    number: Int[Array, ""],
) -> GuideState:
    """Round `number`: as many questions as a round has, then a fit. A guide whose budget is spent stays as it is."""
    first = number * sizes.labels_per_round

    def one(guide: GuideState, offset: Int[Array, ""]) -> tuple[GuideState, None]:
        return ask(guidance, env, teacher, scalars, base, guide, lane_key, first + offset), None

    asked, _ = jax.lax.scan(one, guide, jnp.arange(sizes.labels_per_round))
    fitted = fit(guidance, env, scalars, asked, lane_key, number)
    going = first < guide.budget
    return jax.tree.map(lambda new, old: jnp.where(going, new, old), fitted, guide)


def take_labels(
    guidance: Guidance, env: Environment, scalars: GuideScalars, labels: Label, guide: GuideState, lane_key: Any
) -> GuideState:
    """The guide with labels (slots, ...) that were given elsewhere, and a model fitted to them once."""
    return fit(guidance, env, scalars, guide.replace(labels=labels), lane_key)
