"""Corrections alone: the worlds in which they are given, the kinds that learn from them, and how success is measured.

A world says in which environment questions are asked, whose actions they are about at first, who answers and how
success is measured. Questions come in rounds; after each budget the guide's own policy plays episodes. No step is
rewarded, and nothing decides whether a model is used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import _coach
import _energy
import _residual
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

import cuelearner_jax as cl
from cuelearner_jax.adaptation.by_model import plain_scalars
from cuelearner_jax.adaptation.lanes import Adaptation, LaneState, ask_round, begin, product
from cuelearner_jax.config import GuideSizes, Scalars
from cuelearner_jax.devices import release_programs
from cuelearner_jax.environment import Quantity, WholeObservations, actions_of, spaces_of
from cuelearner_jax.evaluate import episodes, rollout_lanes
from cuelearner_jax.guides import registry
from cuelearner_jax.guides.base import Kind
from cuelearner_jax.policies import Common, Heuristic, Middle
from cuelearner_jax.spaces import Box, Cue
from cuelearner_jax.types import Step

A_ROUND = 25  # labels
SIZES = GuideSizes(
    feedback_layers=(64, 64), labels_per_round=A_ROUND, fit_steps=300, fit_batch_size=32, question_every=5
)
CORRECTIONS: Mapping[str, Kind] = {  # what a kind is where a finished policy is corrected
    "demonstration": _residual.KIND,
    "dcoach": _coach.KIND,
    "bdcoach": _coach.BATCH,
    "clic": _energy.KIND,
}
FIRST_SEED = {"validation": 0, "tuning": 100}  # of labels
ARM_EPS, ARM_BOUND = 0.05, 0.5  # shares of a cue's range: strength of an answer, largest correction of a script
Settings = Mapping[str, Any]  # "sizes.…", "scalars.…", and options of a kind by their own names
Row = dict[str, Any]


class Condition(NamedTuple):
    """A teacher's way of answering."""

    name: str
    scalars: Settings
    of_cues: bool = False  # does it mean anything in spaces of several cues alone?
    of_relative: bool = False  # is it measured for relative answers alone?


CONDITIONS = (
    Condition("plain", {}),
    Condition("wrong", {"mistake_probability": 0.2}),
    Condition("one", {"says": "one"}, of_cues=True, of_relative=True),
    Condition("shuffled", {"answer": "shuffled"}, of_relative=True),  # a control: labels have each other's answers
)


class World(NamedTuple):
    """A world in which corrections are given."""

    name: str
    about: str
    opened: Callable[[str], Opened]  # of a split of episodes
    adapts: bool = False  # is a finished policy corrected? Otherwise a policy is learned from nothing
    tuned_in: str = ""  # the world whose chosen settings hold here too; none: its own


class Opened(NamedTuple):
    """A world that is ready."""

    env: Any  # where is asked
    base: Any  # the policy whose actions are asked about at first
    teacher: Any
    bound: float  # how far a guide may lead from that policy's actions, in the space's unit
    scalars: Scalars
    # (policies of all lanes, episodes of each) -> success (lanes, episodes)
    play: Callable[[Any, int], Float[np.ndarray, "lanes episodes"]]


# Worlds.


def halls(split: str) -> Opened:
    """Return cluttered halls with a policy that walks straight for its goal."""
    from cuelearner_envs.navigation.config import NavigationConfig, make_environment
    from cuelearner_jax.tasks.navigation import NAVIGATION_SCALARS, make_teacher

    config = NavigationConfig(worlds=64)
    env, shown = make_environment(config, "training"), make_environment(config, split)
    scalars = replace(NAVIGATION_SCALARS, tau_deg=1.0)

    def play(policies: Any, count: int) -> np.ndarray:
        rolled = rollout_lanes(shown, policies, episodes(split), count, count * config.max_steps)
        return np.asarray(rolled.each["success"])

    return Opened(env, Heuristic(env), make_teacher(config, env), 180.0, scalars, play)


GRIP = Box(
    (-1.0, -1.0, 0.0),
    (1.0, 1.0, 1.0),
    (
        Cue("sideways", ("left", "right"), ("ArrowLeft", "ArrowRight"), "shares"),
        Cue("height", ("up", "down"), ("r", "f"), "shares"),
        Cue("fingers", ("open", "close"), ("o", "c"), "shares"),
    ),
)
GRASPED_WITHIN = 0.1  # of each cue's range


class Grasp(WholeObservations, struct.PyTreeNode):
    """One grasp per episode of an object seen by a bent mirror; success within a tenth of every cue's range."""

    actions: Box = struct.field(pytree_node=False, default=GRIP)

    observation = (Quantity("object", 2, "1", "where it seems to be"), Quantity("width", 1, "1"))
    action = Quantity("grasp", 3, "1", "sideways, height, opening")

    def best(self, obs: Float[Array, "3"]) -> Float[Array, "3"]:
        """The grasp that holds the object."""
        x, y, width = obs
        return jnp.stack([0.8 * jnp.sin(1.5 * x) * jnp.cos(y), 0.6 * y - 0.3 * x * x, 0.15 + 0.7 * width * width])

    def heuristic(self, obs: Float[Array, "3"]) -> Float[Array, "3"]:
        """The middle of the box, whatever is seen."""
        return self.actions.middle()

    def best_action(self, state: Array, obs: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the teacher's intended action."""
        return self.best(obs)

    def reset(self, key: Array) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """An object somewhere."""
        obs = jax.random.uniform(key, (3,), minval=jnp.array([-1.0, -1.0, 0.0]), maxval=1.0)
        return obs, obs

    def step(self, key: Array, state: Array, action: Float[Array, "3"]) -> tuple[Array, Step]:
        """Grasp; the next object follows."""
        held = (self.actions.distance(action, self.best(state)) <= GRASPED_WITHIN).astype(jnp.float32)
        following, obs = self.reset(key)
        ended, not_late = jnp.array(True), jnp.array(False)
        return following, Step(obs, state, state, held, ended, not_late, {}, {"success": held})


def grasp(split: str) -> Opened:
    """Return the world of one grasp, in a box of three cues."""
    env = Grasp()
    scalars = replace(plain_scalars(GRIP), eps_deg=0.1, tau_deg=0.005, scalar_within_deg=0.15)
    scalars = replace(scalars, max_grad_norm=10.0)

    def play(policies: Any, count: int) -> np.ndarray:
        several = 10 * count  # an episode is one step
        return np.asarray(rollout_lanes(env, policies, episodes(split), several, several).each["success"])

    return Opened(env, Heuristic(env), env, 1.0, scalars, play)


def arm(skill: str, scenario: str = "", episodes_each: int = 4, **changes: Any) -> Callable[[str], Opened]:
    """Return how to open the arm: nothing learned yet, or in a scenario a script whose camera is displaced.

    `changes`: fields of the arm's configuration. `episodes_each`: episodes for each one that is asked for.
    """

    def opened(split: str) -> Opened:
        from cuelearner_envs.arm.environment import ACTIONS
        from cuelearner_jax.tasks.arm import ARM

        config = replace(ARM.config(), skill=skill, **changes)
        config = ARM.scenario(scenario).apply(config) if scenario else config
        env, shown = ARM.environment(config, "training"), ARM.environment(config, split)
        scalars = replace(plain_scalars(ACTIONS), eps_deg=ARM_EPS, tau_deg=ARM_EPS / 20, max_grad_norm=10.0)
        scalars = replace(scalars, scalar_within_deg=2 * ARM_EPS)

        def play(policies: Any, count: int) -> np.ndarray:
            several = count * episodes_each
            rolled = rollout_lanes(shown, policies, episodes(split), several, several * config.max_steps)
            return np.asarray(rolled.each["success"])

        base, bound = (Heuristic(env), ARM_BOUND) if scenario else (Middle(ACTIONS), ACTIONS.reach)
        return Opened(env, base, ARM.make_teacher(config, env), bound, scalars, play)

    return opened


# Learning.


def kind_of(world: World, name: str) -> Kind:
    """The kind of a name as it learns in a world."""
    return CORRECTIONS.get(name, registry.find(name)) if world.adapts else registry.find(name)


def configured(kind: Kind, settings: Settings, scalars: Scalars, condition: Condition) -> tuple[Any, ...]:
    """Sizes, scalars and options of a kind under settings and a condition."""
    own = lambda group: {n.partition(".")[2]: v for n, v in settings.items() if n.startswith(f"{group}.")}  # noqa: E731
    bare = {name: value for name, value in settings.items() if "." not in name}
    options = replace(kind.config(), **bare) if kind.config else None
    sizes = replace(SIZES, **own("sizes"))
    return sizes, replace(scalars, **{**own("scalars"), **condition.scalars}), options


def learned(
    world: World, opened: Opened, name: str, settings: Settings, condition: Condition, seeds: Sequence[int], most: int
) -> Iterator[tuple[int, Any]]:
    """The policies of all seeds after each round of questions, up to `most` labels: (labels so far, policies).

    Whoever needs fewer labels stops before: the program is the same.
    """
    release_programs()
    kind = kind_of(world, name)
    sizes, scalars, options = configured(kind, settings, opened.scalars, condition)
    guide = kind.make(sizes, spaces_of(opened.env), options)
    of = Adaptation(guide, sizes, scalars, opened.env, Common(opened.base))
    block: LaneState = begin(of, product(1, seeds, (most,), (opened.bound,)))
    for asked in range(A_ROUND, most + 1, A_ROUND):
        block = ask_round(of, opened.teacher, block)
        if np.asarray(block.failed).any():
            raise FloatingPointError(f"{world.name}, {name}, {condition.name}: a model is not finite")
        yield asked, of.policy(block)


def means(cues: int, condition: Condition, kind: Kind) -> bool:
    """Return whether a condition means anything for a kind in a space of so many cues."""
    relative = kind.form is not None and kind.form.by_eps
    return (relative or not condition.of_relative) and (cues > 1 or not condition.of_cues)


def measure(
    world: World,
    opened: Opened,
    name: str,
    settings: Settings,
    conditions: Sequence[Condition],
    seeds: Sequence[int],
    budgets: Sequence[int],
    count: int,
    most: int,
) -> Iterator[list[Row]]:
    """The rows of a kind: success of each seed after each budget, a list as soon as all of one run are there.

    `most`: labels for which there is room, as in `learned`.
    """
    cues = len(actions_of(opened.env).cues)
    for condition in conditions:
        if not means(cues, condition, kind_of(world, name)):
            continue
        rows = []
        at = {max(budgets)} if condition.name == "shuffled" else set(budgets)
        for asked, policies in learned(world, opened, name, settings, condition, seeds, most):
            if asked in at:
                rows += rows_of({"condition": condition.name, "labels": asked}, seeds, opened.play(policies, count))
            if asked == max(budgets):
                break
        yield rows


def rows_of(about: Row, seeds: Sequence[int], success: Float[np.ndarray, "lanes episodes"]) -> list[Row]:
    """Return a row for each label seed with its mean success."""
    told = zip(seeds, success.mean(-1), strict=True)
    return [{**about, "seed": seed, "success": round(float(each), 4)} for seed, each in told]


def read(opened: Opened, condition: Condition, seeds: Sequence[int], budgets: Sequence[int], count: int) -> list[Row]:
    """Return the rows of a reading about the base; its own evidence decides on a change."""
    scalars = replace(Scalars(), **{"eps_deg": opened.scalars.eps_deg, **condition.scalars})
    rows: list[Row] = []
    for labels in budgets:
        how: dict[str, Any] = {"guidance": "reading", "judge_by": "labels", "labels": labels, "scalars": scalars}
        found = [cl.adapt(opened.base, opened.env, opened.teacher, seed=seed, **how).policy for seed in seeds]
        success = np.concatenate([opened.play(Common(policy), count) for policy in found])
        rows += rows_of({"condition": condition.name, "labels": labels}, seeds, success)
    return rows


def without_labels(opened: Opened, seeds: Sequence[int], count: int) -> list[Row]:
    """Return the rows of the base policy, before any label."""
    success = opened.play(Common(opened.base), count)
    return rows_of({"condition": "plain", "labels": 0}, seeds, np.broadcast_to(success, (len(seeds), success.shape[1])))
