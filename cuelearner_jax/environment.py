"""The environment protocol, its optional members, and the symmetries of its data.

An environment is a pytree: its parameters are traced, so a changed world needs no new compile. What every environment
has is in `Environment`. It may also have these members; no module asks for the name of a task.

| member                 | meaning                                                                                  |
|------------------------|------------------------------------------------------------------------------------------|
| actions                | the action space, where it is not directions in the plane; ask by `actions_of`           |
| view()                 | the environment without the parts that no policy uses; ask by `view_of`                  |
| heuristic(obs)         | the task's obvious action (action,), without learning                                    |
| symmetries             | number of exact symmetries for data augmentation; ask by `symmetries_of`                 |
| mirror(which, obs, v)  | images of an observation and an action-like vector under symmetry `which`; 0: itself     |
| features(obs, actions) | `Features`: a network's inputs for one observation and each of the actions               |
| privileged             | entries at the end of `remember` and `Step.aftermath` that only critics see, with obs    |
| aims(obs)              | `Aims`: one for each thing that an action may be about, in a fixed order                 |
| plays_once             | True: an evaluation plays one episode in each, since steps are slow; NaN is no action    |
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces import DIRECTIONS, Space
from cuelearner_jax.types import Action, EnvState, Observation, Step

OWN, PROPOSED, EFFECT = "own", "proposed", "effect"
KINDS = ("", OWN, PROPOSED, EFFECT, "beams", "directions")
BASE = "base action"  # the last slice of an observation that holds the action of a policy elsewhere
SYMBOLS = (
    *("m", "cm", "mm", "km", "rad", "deg", "s", "ms", "kg", "g", "N"),
    *("Nm", "A", "V", "W", "Hz", "Pa", "K", "px", "steps", "%"),
)
# 1, or a symbol, perhaps after a number and before more: "m", "5 cm", "rad/s", "m a step", "rad (Euler angles)"
UNIT = re.compile(rf"1|as given|([0-9.]+ )?({'|'.join(SYMBOLS)})([ /²^·*(].*)?")
UNKNOWN_UNIT = "as given"  # of slices that another library names


class Quantity(NamedTuple):
    """One slice of an observation."""

    name: str
    size: int  # number of entries
    unit: str  # unit of an entry, as "m", "rad" or "1" for a pure number
    about: str = ""  # meaning, source and order of the entries, in a few words
    # "beams" at equal angles, counterclockwise, or "directions", unit vectors (x, y): what a sensor turns with; "own":
    # what a robot measures of itself, which no displaced sensor shifts; "proposed": the action of a policy elsewhere;
    # "effect": change of that action by one unit of each of the first entries of the observation (entry, action)
    kind: str = ""
    step_deg: float = 0.0  # angle between neighbouring beams
    # Of a place in metres (x, y, perhaps z): the point about which a sensor that is turned turns the place; None: no
    # sensor turns it, or the point is not known
    origin: tuple[float, float] | None = None
    follows: str = ""  # name of the place from which this difference is taken, and with which it is displaced


def checked_quantities(quantities: Iterable[Quantity]) -> tuple[Quantity, ...]:
    """Return the slices of an observation. Raises UserError for an unknown unit or kind, which would have no effect."""
    slices = tuple(quantities)
    for name, _, unit, _, kind, *_ in slices:
        if not UNIT.fullmatch(unit):
            raise UserError(
                f"the unit of {name!r} is {unit!r}: give a symbol, as m, rad or m/s, or 1 (known: {', '.join(SYMBOLS)})"
            )
        if kind not in KINDS:
            raise UserError(f"the kind of {name!r} is {kind!r}: give {', '.join(KINDS[1:])}, or none")
    return slices


class Features(NamedTuple):
    """An observation as it looks from actions. Networks take the two parts where they take observation and action."""

    own: Float[Array, " own"]  # the part that does not depend on the action: computed once for all actions
    turned: Float[Array, "*n turned"]  # the part that depends on the action


@runtime_checkable
class Environment(Protocol):
    """One task. Inherit `WholeObservations` (or `Described`) for the members that can be derived."""

    @property
    def observation(self) -> tuple[Quantity, ...]:
        """The slices of an observation, in their order."""
        ...

    @property
    def obs_size(self) -> int:
        """Number of entries of an observation: the sum of its slices."""
        ...

    def reset(self, key: PRNGKeyArray) -> tuple[EnvState, Observation]:
        """Start an episode."""
        ...

    def step(self, key: PRNGKeyArray, state: EnvState, action: Action) -> tuple[EnvState, Step]:
        """Execute an action; reset automatically when the episode ends."""
        ...

    def remember(self, state: EnvState, obs: Observation) -> Float[Array, " memory"]:
        """Return what replay stores of an observation: as little as `recall` needs."""
        ...

    def recall(self, memory: Float[Array, " memory"]) -> Observation:
        """Return the observation that was acted on."""
        ...

    def recall_next(
        self, memory: Float[Array, " memory"], action: Action, aftermath: Float[Array, " aftermath"]
    ) -> Observation:
        """Return `Step.final_obs` of the step that `action` led to."""
        ...


class Aims(NamedTuple):
    """Actions that a teacher may mean in a situation (one a ball and a pocket, say), as many in each.

    Their order carries no information: one network with the same weights is applied to each aim.
    """

    actions: Float[Array, "aims action"]
    features: Float[Array, "aims features"]  # features that tell good aims from bad ones, of the order of one
    possible: Bool[Array, " aims"]  # False: not an aim in this situation
    open: Bool[Array, " aims"] | None = None  # False: may be meant, but must not be followed; None: all may be followed


class Described:
    """Mixin that derives members from the environment's `observation`."""

    observation: tuple[Quantity, ...]

    @property
    def obs_size(self) -> int:
        """Number of entries of an observation: the sum of its slices."""
        return sum(quantity.size for quantity in self.observation)


class WholeObservations(Described):
    """Mixin for environments with small observations: replay stores them whole.

    `Step.aftermath` is then `Step.final_obs`.
    """

    def remember(self, state: EnvState, obs: Observation) -> Observation:
        """Return the observation."""
        return obs

    def recall(self, memory: Observation) -> Observation:
        """Return the observation."""
        return memory

    def recall_next(self, memory: Observation, action: Action, aftermath: Observation) -> Observation:
        """Return the next observation."""
        return aftermath

    def step_to(
        self: Any,
        key: PRNGKeyArray,
        after: EnvState,
        reward: Float[Array, ""],
        terminated: Bool[Array, ""],
        truncated: Bool[Array, ""],
        metrics: Mapping[str, Float[Array, ""]],
        outcome: Mapping[str, Float[Array, ""]],
    ) -> tuple[EnvState, Step]:
        """Return state and result of a step to the state `after`; where that is an end, a new episode begins."""
        ended, final_obs, (start, first_obs) = terminated | truncated, self.observe(after), self.reset(key)
        obs = jnp.where(ended, first_obs, final_obs)
        step = Step(obs, final_obs, final_obs, reward, terminated, truncated, metrics, outcome)
        return jax.tree.map(lambda new, old: jnp.where(ended, new, old), start, after), step


def offers(env: Any, name: str) -> bool:
    """Return whether an environment has the optional member `name`, for instance `heuristic`, `mirror` or `aims`."""
    return getattr(env, name, None) is not None


def view_of(env: Any) -> Any:
    """Return the environment's `view()` if it has one, else the environment."""
    return env.view() if offers(env, "view") else env


def actions_of(env: Any) -> Space:
    """Return an environment's action space: its `actions`, or directions in the plane."""
    return getattr(env, "actions", DIRECTIONS)


def action_of(env: Any) -> Quantity:
    """Return the description of an action: an environment's own `action`, a direction, or what its space says."""
    if (space := actions_of(env)) == DIRECTIONS:
        words = Quantity("direction", 2, "1", "unit vector (x, y) in the frame of the observation")
    else:
        words = Quantity("action", space.size, "1", space.about)
    return getattr(env, "action", words)


def action_words(space: Any) -> str:
    """Return a space of actions, of ours or of Gymnasium, in words; empty for one of Gymnasium's that ours has not."""
    if count := getattr(space, "count", getattr(space, "n", None)):
        return f"that are one of {count} choices"
    if not hasattr(space, "low"):
        return getattr(space, "about", "")
    bounds = np.array([space.low, space.high]).reshape(2, -1).tolist()
    low, high = (", ".join(f"{value:g}" for value in bound) for bound in bounds)
    return f"between ({low}) and ({high})"


def check_layout(whose: str, observation: Sequence[Quantity], actions: Space, env: Any) -> None:
    """Raise UserError where a world has another layout of observations or actions than a policy was made for.

    Names and units of slices are compared where both sides come from the same sort of source: either both give units,
    or neither. `whose`: the policy in the message, for instance "the run". `env`: what `task.shape_of` gives will do.
    """
    advice = "give the world that it was made for, or options that keep its observations and actions"
    before, now = _entries(observation), _entries(env.observation)
    if len(before) != len(now):
        raise UserError(f"{whose} observes {len(before)} entries, this world has {len(now)}: {advice}")
    for number, (own, other) in enumerate(zip(before, now, strict=True), 1):
        if own and other and own != other and (own[1] == UNKNOWN_UNIT) == (other[1] == UNKNOWN_UNIT):
            here, there = (f"{name!r} ({unit})" for name, unit in (own, other))
            raise UserError(f"{whose} observes {here} as entry {number}, this world has {there}: {advice}")
    if (own := action_words(actions)) != (other := action_words(actions_of(env))):
        raise UserError(f"{whose} gives actions {own}, this world takes actions {other}: {advice}")


def _entries(observation: Sequence[Quantity]) -> list[tuple[str, str] | None]:
    """Return the name and unit of the slice of each entry; None where the whole is one slice without a name."""
    unnamed = [one.name for one in observation] == ["observation"]
    return [None if unnamed else (one.name, one.unit) for one in observation for _ in range(one.size)]


class Spaces(NamedTuple):
    """The sizes and spaces of an environment, as networks need them."""

    obs_size: int
    actions: Space
    features: tuple[int, int] | None = None  # entries of `Features.own` and `Features.turned`, if it offers any
    aims: int | None = None  # entries of one row of `Aims.features`, if it offers any
    privileged: int = 0  # entries that critics see beside an observation


def spaces_of(env: Any) -> Spaces:
    """Return an environment's spaces; shapes in place of its arrays will do."""
    spaces = Spaces(env.obs_size, actions_of(env), privileged=getattr(env, "privileged", 0))
    obs, action = jnp.zeros(spaces.obs_size), jnp.zeros(spaces.actions.size)
    features, aims = _traced(_classes(jax.tree.structure(env)))
    if offers(env, "features"):
        shapes = jax.eval_shape(features, env, obs, action)
        spaces = spaces._replace(features=(shapes.own.shape[-1], shapes.turned.shape[-1]))
    if offers(env, "aims"):
        spaces = spaces._replace(aims=jax.eval_shape(aims, env, obs).features.shape[-1])
    return spaces


def _classes(structure: Any) -> tuple[Any, ...]:
    data = structure.node_data()
    return () if data is None else (data[0], *(kind for child in structure.children() for kind in _classes(child)))


@lru_cache(maxsize=64)
def _traced(classes: tuple[Any, ...]) -> tuple[Callable[..., Features], Callable[..., Aims]]:
    """Return the functions that JAX traces for the shapes of `features` and of `aims`.

    JAX keeps traces by function and tree. There are functions for each tuple of classes, since JAX 0.10 and 0.12 take
    dataclasses of different classes with equal fields for the same tree, and now and then give one class the trace of
    another.
    """
    return lambda env, obs, action: env.features(obs, action), lambda env, obs: env.aims(obs)


def symmetries_of(env: Any) -> int:
    """Return the number of symmetries of an environment (1: only the identity)."""
    return int(getattr(env, "symmetries", 1)) if offers(env, "mirror") else 1


def plays_once(env: Any) -> bool:
    """Return whether an evaluation plays one episode in each environment, and no step after it."""
    return bool(getattr(env, "plays_once", False))


Image = Callable[[Array, Array], tuple[Array, Array]]  # observations (n, obs), vectors (n, action) -> their images


def random_symmetries(key: PRNGKeyArray, env: Any, count: int) -> Image:
    """Draw a symmetry of the environment for each of `count` rows; return the function that maps rows by them.

    Where an environment has none, rows stay as they are.
    """
    symmetries = symmetries_of(env)
    if symmetries == 1:
        return lambda obs, vectors: (obs, vectors)
    which = jax.random.randint(key, (count,), 0, symmetries)
    return lambda obs, vectors: jax.vmap(env.mirror)(which, obs, jnp.asarray(vectors))
