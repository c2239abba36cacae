"""What an environment is to the method, what it may offer beyond that, and the symmetries of its data.

An environment is a pytree: its parameters are traced, so a changed world needs no new compile. What every environment
has stands in `Environment`, what it may have in `OptionalMembers`; nobody asks by the name of a task.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cuelearner_jax.spaces import DIRECTIONS, Space
from cuelearner_jax.types import EnvState, Step

OWN = "own"


class Quantity(NamedTuple):
    """One slice of an observation."""

    name: str
    size: int  # entries
    unit: str  # of an entry, as "m", "rad" or "1" for a pure number
    about: str = ""  # what it is, where from and in which order, in a few words
    # "beams" at equal angles, counterclockwise, or "directions", unit vectors: what a sensor turns with; "own": what a
    # robot measures of itself, which no displaced sensor shifts
    kind: str = ""
    step_deg: float = 0.0  # of beams: the angle between two neighbours
    # Of a place in metres (x, y, perhaps z): the point about which a sensor that is turned turns the place; None: no
    # sensor turns, or nobody says about which point
    origin: tuple[float, float] | None = None
    follows: str = ""  # name of the place from which this difference is taken, and with which it is displaced


# What `spaces.DIRECTIONS` are, where an environment does not say more by its own `action`.
DIRECTION = Quantity("direction", 2, "1", "unit vector (x, y) in the frame of the observation")


class Features(NamedTuple):
    """An observation as it looks from actions. Networks take the two parts where they take observation and action."""

    own: Float[Array, " own"]  # what looks alike from every action: computed once, however many there are
    turned: Float[Array, "*n turned"]  # what hangs on the action


@runtime_checkable
class View(Protocol):
    """What a policy looks at: the observation, and optional members such as `features`, `aims`, `heuristic`, `mirror`.

    Every environment is one; one whose episodes need more than that (generated worlds, say) offers `view()`.
    """

    @property
    def observation(self) -> tuple[Quantity, ...]:
        """The slices of an observation, in their order."""
        ...

    @property
    def obs_size(self) -> int:
        """Number of entries of an observation: the sum of its slices."""
        ...


@runtime_checkable
class Environment(View, Protocol):
    """One task. Inherit `WholeObservations` (or `Described`) for what can be derived."""

    def reset(self, key: PRNGKeyArray) -> tuple[EnvState, Float[Array, " obs"]]:
        """Starts an episode."""
        ...

    def step(self, key: PRNGKeyArray, state: EnvState, action: Float[Array, " action"]) -> tuple[EnvState, Step]:
        """Executes an action; resets automatically when the episode ends."""
        ...

    def remember(self, state: EnvState, obs: Float[Array, " obs"]) -> Float[Array, " memory"]:
        """What replay keeps of an observation: as little as `recall` needs."""
        ...

    def recall(self, memory: Float[Array, " memory"]) -> Float[Array, " obs"]:
        """The observation that was acted on."""
        ...

    def recall_next(
        self, memory: Float[Array, " memory"], action: Float[Array, " action"], aftermath: Float[Array, " aftermath"]
    ) -> Float[Array, " obs"]:
        """`Step.final_obs` of the step that `action` led to from there."""
        ...


class Aims(NamedTuple):
    """Actions that somebody may have in mind in a situation, as many in each; see `OptionalMembers.aims`."""

    actions: Float[Array, "aims action"]
    features: Float[Array, "aims features"]  # what tells good ones from bad ones, of the order of one
    possible: Bool[Array, " aims"]  # False: none of these, here
    open: Bool[Array, " aims"] | None = None  # False: may be meant, but is not to be done; None: all that are meant may


class OptionalMembers(Protocol):
    """What an environment may have beside; ask by `offers`, `view_of`, `symmetries_of` and `actions_of`."""

    @property
    def actions(self) -> Space:
        """The space of its actions, where these are no directions in the plane."""
        ...

    def view(self) -> View:
        """The environment without the parts that no policy looks at."""
        ...

    def heuristic(self, obs: Float[Array, " obs"]) -> Float[Array, " action"]:
        """The obvious action, which needs no learning."""
        ...

    @property
    def symmetries(self) -> int:
        """Number of exact symmetries that data may be multiplied by (1: only the identity)."""
        ...

    def mirror(
        self, which: Int[Array, ""], obs: Float[Array, " obs"], vector: Float[Array, " action"]
    ) -> tuple[Float[Array, " obs"], Float[Array, " action"]]:
        """Image of an observation and of a vector like an action (an action, a residual) under symmetry `which`.

        0 is the identity.
        """
        ...

    def features(self, obs: Float[Array, " obs"], actions: Float[Array, "*n action"]) -> Features:
        """What a network is to see of one observation and each of the actions."""
        ...

    def aims(self, obs: Float[Array, " obs"]) -> Aims:
        """One aim for each thing that an action may be about (a ball and a pocket, say), in one order of things.

        The order means nothing: one network with the same weights looks at each aim.
        """
        ...

    def rule(self, obs: Float[Array, " obs"]) -> Float[Array, " aims"]:
        """log-weights of the aims by a rule that somebody wrote by hand: what labels about aims must surpass."""
        ...


class Described:
    """Mixed into an environment: what follows from its `observation`."""

    observation: tuple[Quantity, ...]

    @property
    def obs_size(self) -> int:
        """Number of entries of an observation: the sum of its slices."""
        return sum(quantity.size for quantity in self.observation)


class WholeObservations(Described):
    """Mixed into an environment whose observations are small: replay keeps them as they are.

    `Step.aftermath` is then `Step.final_obs`.
    """

    def remember(self, state: EnvState, obs: Float[Array, " obs"]) -> Float[Array, " obs"]:
        """The observation."""
        return obs

    def recall(self, memory: Float[Array, " obs"]) -> Float[Array, " obs"]:
        """The observation."""
        return memory

    def recall_next(
        self, memory: Float[Array, " obs"], action: Float[Array, " action"], aftermath: Float[Array, " obs"]
    ) -> Float[Array, " obs"]:
        """The next observation."""
        return aftermath


def offers(env: Any, name: str) -> bool:
    """Has an environment the optional member `name` (`heuristic`, `mirror`, `features`, `aims`, `rule`)?"""
    return getattr(env, name, None) is not None


def view_of(env: Any) -> Any:
    """The view of an environment: what it offers as one, or the environment."""
    return env.view() if offers(env, "view") else env


def actions_of(env: Any) -> Space:
    """What an environment takes for actions: its `actions`, or directions in the plane."""
    return getattr(env, "actions", DIRECTIONS)


def action_of(env: Any) -> Quantity:
    """What an action is, in words: an environment's own `action`, a direction, or what its space says."""
    space = actions_of(env)
    return getattr(
        env, "action", DIRECTION if space == DIRECTIONS else Quantity("action", space.size, "1", space.about)
    )


class Spaces(NamedTuple):
    """What networks have to know of an environment."""

    obs_size: int
    actions: Space
    features: tuple[int, int] | None = None  # entries of `Features.own` and `Features.turned`, if it offers any
    aims: int | None = None  # entries of one row of `Aims.features`, if it offers any


def spaces_of(env: Any) -> Spaces:
    """An environment's; shapes in place of its arrays will do."""
    spaces = Spaces(env.obs_size, actions_of(env))
    obs, action = jnp.zeros(spaces.obs_size), jnp.zeros(spaces.actions.size)
    if offers(env, "features"):
        seen = jax.eval_shape(_features, env, obs, action)
        spaces = spaces._replace(features=(seen.own.shape[-1], seen.turned.shape[-1]))
    if offers(env, "aims"):
        spaces = spaces._replace(aims=jax.eval_shape(_aims, env, obs).features.shape[-1])
    return spaces


# By names of their own, by which JAX remembers what it has traced.
def _features(env: Any, obs: Float[Array, " obs"], action: Float[Array, " action"]) -> Features:
    return env.features(obs, action)


def _aims(env: Any, obs: Float[Array, " obs"]) -> Aims:
    return env.aims(obs)


def symmetries_of(env: Any) -> int:
    """Number of symmetries that an environment offers (1: only the identity)."""
    return int(getattr(env, "symmetries", 1)) if offers(env, "mirror") else 1


Image = Callable[[Array, Array], tuple[Array, Array]]  # observations (n, obs), vectors (n, action) -> their images


def random_symmetries(key: PRNGKeyArray, env: Any, count: int) -> Image:
    """One random symmetry of the environment for each of `count` rows, as the function that maps rows under it.

    Where an environment has none, rows stay as they are.
    """
    symmetries = symmetries_of(env)
    if symmetries == 1:
        return lambda obs, vectors: (obs, vectors)
    which = jax.random.randint(key, (count,), 0, symmetries)
    return lambda obs, vectors: jax.vmap(env.mirror)(which, obs, jnp.asarray(vectors))
