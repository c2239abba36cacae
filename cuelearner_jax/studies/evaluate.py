"""Evaluation: policies on validation episodes, as one request of the command line and Python; and by answers alone.

A policy agrees with an answer about a cue if it would give that answer itself: its own action lies at more, at less,
or within eps / 2 of the action asked about. Use answers that were not used for its correction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cuelearner_jax import user_code
from cuelearner_jax.devices import release_programs
from cuelearner_jax.environment import actions_of, view_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import episodes, ignore_progress, mean_interval, part_of, rollout_lanes
from cuelearner_jax.feedback.answers import relative_feedback
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import Common, lanes_in, policy_name
from cuelearner_jax.runs.policy_sources import POLICIES, Block, PolicySource, check_no_lane
from cuelearner_jax.spaces import Space, is_answered, says_something
from cuelearner_jax.task import Task
from cuelearner_jax.types import Label

Ready = tuple[Any, list[Block]]  # the validation episodes, and the lanes that act in them
Share = tuple[float, float, float]  # estimate, and the ends of its 95% interval


@dataclass(frozen=True, kw_only=True)
class EvaluateRequest:
    """A request to evaluate a policy."""

    task: Any
    policy: str = "agent"
    """Who acts."""
    guidance: tuple[str, ...] = ()
    """Kinds of guidance of the lanes to evaluate (default: all)."""
    labels: tuple[int, ...] = ()
    """Label budgets of the lanes to evaluate (default: all)."""
    seed: tuple[int, ...] = ()
    """Seeds of the lanes to evaluate (default: all)."""
    episodes: int | None = None
    """Number of whole episodes per lane, where the task counts episodes (default: 100)."""
    steps: int | None = None
    """Number of environment steps per lane, instead of episodes (default where the task counts steps: 10,000)."""
    envs: int | None = None
    """Number of environments that share the steps (default: 100)."""
    engine: str | None = None
    """Alternative physics engine of the robot. `mujoco` for anymal is C MuJoCo with a finer step instead of MJX; it
    measures first episodes only."""


class Measured(NamedTuple):
    """A policy's metrics for one guidance and budget."""

    guidance: str
    labels: int
    step: int  # of the policy's training; 0: untrained
    seeds: np.ndarray  # (seeds,)
    metrics: dict[str, np.ndarray]  # each (seeds,)
    each: dict[str, np.ndarray]  # metrics per environment (seeds, envs); NaN where the first episode has not ended
    bound_deg: float | None = None  # bound of a policy folder's lanes, in `unit`
    is_shared: bool = False  # whether all seeds have one policy
    unit: str = "deg"  # of the space of actions

    @property
    def within(self) -> str:
        """The bound with its unit; empty without a bound."""
        return "" if self.bound_deg is None else f"{self.bound_deg:g} {self.unit}"


def amount(task: Task, request: EvaluateRequest) -> tuple[int, int]:
    """Return the number of environments and the number of steps that they share."""
    longest = None if task.longest is None else task.longest(request.task)
    envs = 100 if request.envs is None else request.envs
    if request.episodes is not None:
        if request.steps is not None or request.envs is not None:
            raise UserError("episodes determines environments and steps: leave out steps and envs")
        if longest is None:
            raise UserError(f"{task.name} counts steps, not episodes: give --steps (in Python steps)")
        envs = request.episodes
    if envs < 1:
        raise UserError(f"{'envs' if request.episodes is None else 'episodes'} is {envs}: give at least 1")
    steps = request.steps
    if steps is None:
        steps = 10_000 if longest is None else envs * longest
    if steps < 1 or steps % envs:
        raise UserError(f"steps is {steps}: give a positive multiple of envs ({envs})")
    task.check_whole(request.task, envs, steps, "envs", "steps")
    return envs, steps


def prepare(source: PolicySource, request: EvaluateRequest) -> Ready:
    """Return the validation episodes of the request's world and the lanes that act in it, by guidance and step."""
    release_programs()
    name, entry = request.policy, POLICIES[request.policy]
    env = source.task.environment(request.task, "validation")
    teacher = source.task.make_teacher(request.task, env) if entry.taught else None
    if entry.from_folder:
        kinds = tuple(map(guidances.kind_name, request.guidance))
        return env, source.blocks(name, view_of(env), teacher, kinds, request.labels, request.seed)
    check_no_lane(name, request.guidance, request.labels, request.seed)
    none = np.zeros(1, int)
    return env, [Block("-", none, none, none, 0, Common(source.alone(name, view_of(env), teacher)), none > 0)]


def variants(env: Any, block: Block, of_lanes: Sequence[dict[str, np.ndarray]] = ({}, {})) -> list[Measured]:
    """Return a block's lanes by bound and budget, with their metrics and environments' values (each by lane)."""
    unit, is_shared, rows = actions_of(env).unit.replace("degrees", "deg"), lanes_in(block.policy) is None, []
    for bound, budget in sorted(set(zip(block.bounds.tolist(), block.budgets.tolist(), strict=True))):
        own = (block.budgets == budget) & (block.bounds == bound)
        means, each = ({metric: values[own] for metric, values in of.items()} for of in of_lanes)
        variant = block.guidance, budget, block.step, block.seeds[own]
        rows.append(Measured(*variant, means, each, bound or None, is_shared, unit))
    return rows


def run(
    source: PolicySource, request: EvaluateRequest, watch: Any = lambda _: ignore_progress, ready: Ready | None = None
) -> list[Measured]:
    """Return metrics of a policy on validation episodes of the request's world, for each guidance and budget.

    `watch`: given a kind of guidance, returns a `Tell` of its lanes. `ready`: the result of `prepare`.
    """
    num_envs, steps = amount(source.task, request)
    engine, key = source.task.engine(request.engine), episodes()
    env, blocks = ready or prepare(source, request)
    rows = []
    for block in blocks:
        count, place = len(block.seeds), np.arange(len(block.seeds))
        tell = watch(request.policy if block.guidance == "-" else block.guidance)
        if engine:
            tells = [part_of(tell, lane, count) for lane in range(count)]
            lanes = [engine(block.policy.lane(lane), env, key, num_envs, steps, tells[lane]) for lane in range(count)]
            each = {metric: np.stack([np.asarray(lane[metric], float) for lane in lanes]) for metric in lanes[0]}
            means = {metric: values.mean(-1) for metric, values in each.items()}
        else:
            means, each, _ = rollout_lanes(env, block.policy, key, num_envs, steps, tell)
            place = place * 0 if lanes_in(block.policy) is None else place  # lanes that share a policy share a row
        rows += variants(env, block, [{name: np.asarray(of[name])[place] for name in of} for of in (means, each)])
    return rows


class Agreement(NamedTuple):
    """Shares of answers, with 95% intervals over labels, see `mean_interval`."""

    labels: int
    policy: Share  # answers that the policy agrees with
    right: Share  # answers that are "already right"
    base: Share | None = None  # answers that the uncorrected policy agrees with; None: unknown
    difference: Share | None = None  # the policy's share less the base's, paired by label

    def rows(self) -> list[tuple[str, Share]]:
        """Return each share with its name."""
        names = "the policy", "the policy as it was", "always already right", "difference from the policy as it was"
        shares = self.policy, self.base, self.right, self.difference
        return [(name, share) for name, share in zip(names, shares, strict=True) if share is not None]

    def words(self) -> list[str]:
        """Return the agreement in words, line by line."""
        lines = ["{}: {:.3f} [{:.3f}, {:.3f}]".format(name, *share) for name, share in self.rows()]
        return [*lines, f"shares of the answers of {self.labels} labels, with 95% intervals over labels"]


def agreement(policy: Any, rows: Label, space: Space, eps: float, base: Any = None) -> Agreement:
    """Return the share of relative answers that a policy agrees with, called with observations only.

    Labels that say nothing of any cue do not count. `eps`: strength of an answer, in the space's unit. `base`: the
    policy before its correction; None: unknown.
    """
    rows = jax.tree.map(lambda leaf: np.asarray(leaf)[np.asarray(says_something(rows.answer))], rows)
    if not len(answers := np.asarray(rows.answer)):
        raise UserError("labels say nothing of any cue: give labels with answers")
    counts = np.asarray(is_answered(answers)) if len(space.cues) > 1 else np.ones(answers.shape, bool)

    def agreed(policy: Any) -> Float[np.ndarray, " labels"]:
        own = 0 if policy is None else _answers_of(policy, rows, space, eps)
        return ((own == answers) & counts).sum(-1) / counts.sum(-1)

    def interval(values: Float[np.ndarray, " labels"], is_share: bool = True) -> Share:
        estimate, low, high = (float(value) for value in mean_interval(values, is_share))
        return estimate, low, high

    own, right = agreed(policy), agreed(None)
    if base is None:
        return Agreement(len(own), interval(own), interval(right))
    before = agreed(base)
    change = interval(own - before, is_share=False)
    return Agreement(len(own), interval(own), interval(right), interval(before), change)


def _answers_of(policy: Any, rows: Label, space: Space, eps: float) -> Float[np.ndarray, "labels cues"]:
    @jax.jit
    def answered(policy: Any, obs: Any, action: Any) -> Any:
        own = space.only_actions(policy.act(jax.random.key(0), None, obs))
        return own, jax.vmap(partial(relative_feedback, space), (0, 0, None))(action, own, space.from_unit(eps))

    own, result = answered(policy, jnp.asarray(rows.obs), jnp.asarray(rows.action))
    user_code.check_actions(own, policy_name(policy))
    return np.asarray(result)
