"""The agent protocol: pure functions of one lane, made from options (`config.part`), for any space and environment.

The options are a class with a `NAME`, a line `ABOUT` it, and `make`; `registry` finds them by name. An agent made from
equal options for equal spaces is equal, so that a program compiled for one serves the other.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol, runtime_checkable

from jaxtyping import Array, Float, Int, PRNGKeyArray

from cuelearner_jax.agents.replay import Memory
from cuelearner_jax.config import Frame, Scalars, Sizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.types import Params


@runtime_checkable
class AgentFunctions(Protocol):
    """An agent's functions; hashable, without arrays of its own."""

    @property
    def options(self) -> Any:
        """The options that the agent was made from."""
        ...

    @property
    def frame(self) -> Frame:
        """The frame of the networks' inputs."""
        ...

    @property
    def described(self) -> dict[str, Any]:
        """Facts for an export's contract, as JSON values."""
        ...

    def init(self, key: PRNGKeyArray) -> tuple[Params, Any]:
        """Return parameters that act, and the rest of the learning state."""
        ...

    def act(self, env: Any, params: Params, obs: Float[Array, "n obs"], key: PRNGKeyArray) -> Float[Array, "n action"]:
        """Return actions of the finished agent. `env` gives the features of observations (`Sizes.frame`)."""
        ...

    def explore(
        self, env: Any, options: Any, params: Params, obs: Float[Array, "n obs"], key: PRNGKeyArray
    ) -> Float[Array, "n action"]:
        """Return actions during learning; `options`: see `update`."""
        ...

    def value(
        self, env: Any, params: Params, obs: Float[Array, "*n obs"], actions: Float[Array, "*m action"]
    ) -> Float[Array, "*m"]:
        """Return the expected value of each action; `obs` is one situation for all actions, or one for each."""
        ...

    def update(
        self,
        env: Any,
        options: Any,
        scalars: Scalars,
        count: Int[Array, ""],
        params: Params,
        rest: Any,
        memory: Memory,
        key: PRNGKeyArray,
    ) -> tuple[Params, Any, Float[Array, ""], Float[Array, ""]]:
        """Make one gradient step.

        Args:
            env: as for `act`; its `recall` rebuilds the memory's observations.
            options: those that the agent was made from, their floats traced.
            scalars: settings that all parts share, such as the discount factor.
            count: gradient steps, this one included.
            params, rest: as `init` returns them.
            memory: the steps to learn from.
            key: random key of this step.

        Returns:
            Parameters; the rest; the loss; the norm of the gradient.
        """
        ...


@runtime_checkable
class AgentOptions(Protocol):
    """A class of options (`config.part`) that makes an agent."""

    NAME: ClassVar[str]
    ABOUT: ClassVar[str]

    @property
    def replay_capacity(self) -> int:
        """Number of transitions in replay, a multiple of `Sizes.num_envs`."""
        ...

    def make(self, frame: Frame, spaces: Spaces, bootstraps: bool = False) -> AgentFunctions:
        """Return the agent for an environment's spaces; floats of the options may be None.

        `bootstraps`: whether the discount is above 0.

        Raises UserError for a frame in which the environment cannot be seen.
        """
        ...

    def check(self, sizes: Sizes, bootstraps: bool) -> None:
        """Raise UserError for options that do not work together; each is within its bounds."""
        ...


class OptionalFacts(Protocol):
    """Optional members of a class of options, beside `AgentOptions`; read them by the functions below."""

    SORTS: ClassVar[bool]  # True if `update` draws guided and own steps separately; replay then counts guided steps


def draws_sorts(options: Any) -> bool:
    """Return whether agents of these options draw guided and own steps separately (`guided_share`)."""
    return getattr(options, "SORTS", False)
