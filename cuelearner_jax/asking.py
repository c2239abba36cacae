"""The course of a label: question -> answer -> record -> fit, each step a pure function of a lane's guide state.

A simulated teacher's round scans them (`label_round`); a page calls them one by one, with a person's answer in between;
adaptation gives another base policy than uniform actions.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax import user_code
from cuelearner_jax.agents.networks import all_finite
from cuelearner_jax.config import GuideScalars, GuideSizes
from cuelearner_jax.environment import Environment, actions_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.feedback.answers import AnswerForm
from cuelearner_jax.guides.base import Guide
from cuelearner_jax.guides.refining import bound_scalars
from cuelearner_jax.policies import Policy, best_actions, call_policy, policy_name
from cuelearner_jax.types import EnvState, GuidanceModel, Label, Step, Teacher

LaneT = TypeVar("LaneT", bound=Any)
CandidateActions = Float[Array, "*candidates action"]

ONE_BY_ONE = GuideSizes()  # sizes with one candidate a question, as a page asks


class GuideState(struct.PyTreeNode):
    """A lane's guide: the model, the labels so far, and the situation of the next question."""

    model: GuidanceModel
    labels: Label  # leading axis: slots, the largest budget of the sweep in whole rounds
    budget: Int[Array, ""]  # label budget of this lane
    asked: Int[Array, ""]  # questions so far that count within it, answered or not
    env: EnvState  # leading axis: candidates, where each question is chosen among several situations
    obs: Float[Array, "*candidates obs"]
    stored: Float[Array, "slots width"] | None = None  # labelled steps as rows of replay; None: they are not kept


class Stream(IntEnum):
    """Streams of random numbers of one lane, each folded into the lane's key before a counter is."""

    INIT = 0
    ASK = 1
    FIT = 2
    TRAIN = 3
    WALK = 4
    SHUFFLE = 5


class Inquiry(struct.PyTreeNode):
    """The guide, environment, base policy and settings that stay the same for all questions of a lane."""

    guidance: Guide = struct.field(pytree_node=False)
    env: Environment
    scalars: Any  # `GuideScalars`; with a simulated teacher `Scalars`
    base: Policy  # its actions are asked about, after refinement by the guide so far
    # Questions stay within it of what the base policy does, as `log` of the space counts; None: wherever guidance leads
    bound: Float[Array, ""] | None = None
    # rows of replay of steps (n, ...) with the observations and actions before; None: asked actions are executed
    pack: Callable[[Array, Array, Step], Array] | None = struct.field(pytree_node=False, default=None)


class QuestionKeys(NamedTuple):
    """Random keys of one question."""

    base: PRNGKeyArray  # the base policy's
    question: PRNGKeyArray
    answer: PRNGKeyArray  # a simulated teacher's faults
    env: PRNGKeyArray  # the step that follows


def question_keys(lane_key: PRNGKeyArray, position: Int[Array, ""] | int) -> QuestionKeys:
    """Return the keys of a lane's question number `position`."""
    return QuestionKeys(*jax.random.split(jax.random.fold_in(jax.random.fold_in(lane_key, Stream.ASK), position), 4))


def label_slots(budget: int, sizes: GuideSizes) -> int:
    """Return the rows that a label set needs: the budget rounded up to whole rounds."""
    return -(-budget // sizes.labels_per_round) * sizes.labels_per_round


def start(
    guidance: Guide,
    env: Environment,
    slots: int,
    budget: Int[Array, ""] | int,
    k_model: PRNGKeyArray,
    k_env: PRNGKeyArray,
    sizes: GuideSizes = ONE_BY_ONE,
) -> GuideState:
    """Return a guide without questions at the start of an episode; with several candidates, of as many episodes."""
    candidates, size = sizes.candidates, actions_of(env).size
    state, obs = env.reset(k_env) if candidates == 1 else jax.vmap(env.reset)(jax.random.split(k_env, candidates))
    return GuideState(
        model=guidance.init(k_model),
        labels=Label(  # padding
            obs=jnp.zeros((slots, env.obs_size)),
            action=jnp.zeros((slots, size)),
            answer=jnp.zeros((slots, guidance.form.width(actions_of(env)) if guidance.form else 0)),
            valid=jnp.zeros((slots,), bool),
            base=jnp.zeros((slots, size)) if guidance.sees_base else None,
        ),
        budget=jnp.asarray(budget, jnp.int32),
        asked=jnp.zeros((), jnp.int32),
        env=state,
        obs=obs,
    )


def question(of: Inquiry, guide: GuideState, keys: QuestionKeys) -> tuple[CandidateActions, CandidateActions]:
    """Return the action to ask about in the guide's situation, or in each candidate, and the base policy's action."""
    space, scalars, several = actions_of(of.env), of.scalars, guide.obs.ndim > 1
    first = call_policy(of.base, keys.base, *_situations(guide), space)
    first = first if several else first[0]
    if of.bound is not None:
        scalars = bound_scalars(space, scalars, of.bound)

    def one(key: PRNGKeyArray, obs: Array, first: Array) -> Array:
        action = of.guidance.question(key, guide.model, of.env, obs, first, scalars)
        return action if of.bound is None else space.clip(action, first, of.bound)

    if several:
        return jax.vmap(one)(jax.random.split(keys.question, len(guide.obs)), guide.obs, first), first
    return one(keys.question, guide.obs, first), first


def _situations(guide: GuideState) -> tuple[EnvState, Float[Array, "candidates obs"]]:
    """Return states and observations of the candidates, or of the guide's one situation as the only candidate."""
    one = (guide.env, guide.obs)
    return one if guide.obs.ndim > 1 else jax.tree.map(lambda leaf: leaf[None], one)


def record(
    guide: GuideState,
    position: Int[Array, ""] | int,
    obs: Float[Array, "n obs"],
    action: Float[Array, "n action"],
    answer: Float[Array, "n answer"],
    answered: Bool[Array, " n"],
    base: Float[Array, "n action"] | None,
) -> GuideState:
    """Return the guide with answers in its labels from row `position` on; `base`: uncorrected actions, if kept."""
    rows = Label(obs, action, answer, answered & (position + jnp.arange(len(obs)) < guide.budget), base)
    put = lambda rows_before, new: jax.lax.dynamic_update_slice_in_dim(rows_before, new, position, 0)  # noqa: E731
    count = jnp.minimum(position + len(obs), guide.budget)
    return guide.replace(labels=jax.tree.map(put, guide.labels, rows), asked=count)


def proceed(env: Environment, guide: GuideState, action: CandidateActions, keys: QuestionKeys) -> GuideState:
    """Return the guide after the step that the action leads to, in each candidate by its own action."""
    if guide.obs.ndim > 1:
        state, step = jax.vmap(env.step)(jax.random.split(keys.env, len(guide.obs)), guide.env, action)
    else:
        state, step = env.step(keys.env, guide.env, action)
    return guide.replace(env=state, obs=step.obs)


def fit(
    guidance: Guide,
    env: Environment,
    scalars: GuideScalars,
    guide: GuideState,
    lane_key: PRNGKeyArray,
    times: Int[Array, ""] | None = None,
) -> GuideState:
    """Return the guide with a model of its labels. `times`: number of fits before this one."""
    key = jax.random.fold_in(lane_key, Stream.FIT)
    key = key if times is None else jax.random.fold_in(key, times)
    labels = fitted_labels(key, guide.labels, scalars, guidance.form)
    return guide.replace(model=guidance.fit(key, env, labels, guide.model, scalars))


def fitted_labels(key: PRNGKeyArray, labels: Label, scalars: GuideScalars, form: AnswerForm | None = None) -> Label:
    """Return the labels (slots, ...) to fit, or, where `scalars.answer` is shuffled, the control.

    In the control each valid label has the answer of another one. Situations, actions and answers keep their
    frequencies, but no answer is about its action. Of a pair (`form`) the choices alone are exchanged. `key`: of the
    fit.
    """
    if getattr(scalars, "answer", "best") != "shuffled":
        return labels
    order_keys = jax.random.uniform(jax.random.fold_in(key, Stream.SHUFFLE), labels.valid.shape)
    order = jnp.argsort(jnp.where(labels.valid, order_keys, jnp.inf))  # valid labels first
    place, count = jnp.arange(len(order)), labels.valid.sum()
    after = jnp.where(place < count, (place + 1) % jnp.maximum(count, 1), place)
    answer = labels.answer if form is None else form.choice(labels.answer)
    return labels.replace(answer=labels.answer.at[order, : answer.shape[-1]].set(answer[order[after]]))


def ask(
    of: Inquiry,
    teacher: Teacher,
    guide: GuideState,
    lane_key: PRNGKeyArray,
    position: Int[Array, ""],
    every: bool = False,
) -> GuideState:
    """Ask a simulated teacher question number `position` (from 0), record the answer, and step on.

    `lane_key`: random key of all questions. `every`: ask about every candidate, as many questions at once, the first of
    them number `position`.
    """
    form, keys = of.guidance.form, question_keys(lane_key, position)
    assert form is not None  # a kind that asks
    actions, proposals = question(of, guide, keys)

    def answer(key: PRNGKeyArray, state: EnvState, obs: Array, action: Array) -> tuple[Array, Array]:
        return form.answer(key, of.env, teacher, state, obs, action, of.scalars)

    if every:
        obs, about, first = guide.obs, actions, proposals
        answers, answered = jax.vmap(answer)(jax.random.split(keys.answer, len(obs)), guide.env, obs, about)
    else:
        state, *there = _choose(of, guide, actions, proposals)
        one = answer(keys.answer, state, there[0], there[1])
        obs, about, first, answers, answered = (row[None] for row in (*there, *one))
    recorded = record(guide, position, obs, about, answers, answered, first if of.guidance.sees_base else None)
    if of.pack is None:
        return proceed(of.env, recorded, actions, keys)
    assert form.correct is not None  # see `RunConfig.guide_in`
    assert guide.stored is not None
    space = actions_of(of.env)
    corrected = form.correct(space, about[0], answers[0], space.from_unit(of.scalars.eps_deg))
    action = jnp.where(answered[0], corrected, about[0])
    before = of.env.remember(guide.env, guide.obs)
    state, step = of.env.step(keys.env, guide.env, action)
    rows = of.pack(before[None], action[None], jax.tree.map(lambda leaf: leaf[None], step))
    stored = jax.lax.dynamic_update_slice_in_dim(guide.stored, rows, position, 0)
    return recorded.replace(env=state, obs=step.obs, stored=stored)


def _choose(
    of: Inquiry, guide: GuideState, actions: CandidateActions, first: CandidateActions
) -> tuple[EnvState, Float[Array, " obs"], Float[Array, " action"], Float[Array, " action"]]:
    """Return the situation to ask in (state, observation), the action to ask about, and the base policy's action.

    Of several candidates the one is chosen on which the members of the guide's model disagree most (query by committee:
    Seung, Opper, Sompolinsky, 1992); before the first fit the first one.
    """
    candidates = guide.env, guide.obs, actions, first
    if guide.obs.ndim == 1 or of.guidance.sizes.ensemble == 1:
        return candidates
    apart = of.guidance.disagreement(guide.model, of.env, guide.obs, actions)
    index = jnp.where(guide.model.fitted, jnp.argmax(apart), 0)
    return jax.tree.map(lambda leaf: leaf[index], candidates)


def check_observations(obs: Any) -> None:
    """Raise UserError unless all of an environment's observations are finite."""
    if not np.isfinite(np.asarray(obs)).all():
        raise UserError("this world gave an observation that is not finite: give a number in place of inf and NaN")


def blame(
    env: Environment,
    teacher: Teacher | None,
    guide: GuideState,
    base: Policy | None = None,
    key: PRNGKeyArray | None = None,
) -> None:
    """Raise UserError if the guide's situation, or a teacher's or a base policy's action in it, is invalid.

    Call this for a lane that failed while asking: its situation is the one before the failure, and its labels do not
    show the fault.
    """
    (states, obs), space = _situations(guide), actions_of(env)
    check_observations(obs)
    if base is not None:
        assert key is not None
        user_code.check_actions(space.only_actions(base.act(key, states, obs)), policy_name(base))
    if teacher is not None:
        actions = space.only_actions(best_actions(teacher, states, obs))
        user_code.check_actions(actions, f"teacher {type(teacher).__name__}")


def label_round(
    of: Inquiry, sizes: GuideSizes, teacher: Teacher, guide: GuideState, lane_key: PRNGKeyArray
) -> GuideState:
    """Ask one round of questions, then fit to all labels so far. A guide whose budget is used up does not change."""
    first = guide.asked
    at_once = sizes.candidates if sizes.ask_all else 1

    def walk(guide: GuideState, key: PRNGKeyArray) -> tuple[GuideState, None]:
        """Make a step with the guide's own action, without a question."""
        own = QuestionKeys(*jax.random.split(key, 4))
        return proceed(of.env, guide, question(of, guide, own)[0], own), None

    def one(guide: GuideState, offset: Int[Array, ""]) -> tuple[GuideState, None]:
        after = ask(of, teacher, guide, lane_key, first + offset, sizes.ask_all)
        if sizes.question_every == 1:
            return after, None
        key = jax.random.fold_in(jax.random.fold_in(lane_key, Stream.WALK), first + offset)
        return jax.lax.scan(walk, after, jax.random.split(key, sizes.question_every - 1))[0], None

    after, _ = jax.lax.scan(one, guide, jnp.arange(0, sizes.labels_per_round, at_once))
    fitted = fit(of.guidance, of.env, of.scalars, after, lane_key, first // sizes.labels_per_round)
    return jax.tree.map(lambda new, old: jnp.where(first < guide.budget, new, old), fitted, guide)


def with_guide(lane: LaneT, guide: GuideState) -> LaneT:
    """Return the lane with a new guide. If that is not finite, the lane fails and keeps its former guide.

    `lane`: a record with `guide` and `failed`.
    """
    failed = lane.failed | ~all_finite((guide.model, guide.labels))
    guide = jax.tree.map(lambda new, old: jnp.where(failed, old, new), guide, lane.guide)
    return lane.replace(guide=guide, failed=failed)
