"""The agent protocol: pure functions of one lane, made from options (`config.part`), for any space and environment.

The options are a class with a `NAME`, a line `ABOUT` it, and `make`. Add your own to `AGENTS`, or name it as
package.module:NAME. An agent made from equal options for equal spaces is equal, so that a program compiled for one
serves the other. Where the class of options has `SORTS = True`, `update` draws guided and own steps separately, and
replay counts guided steps.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol, runtime_checkable

from jaxtyping import Array, Float, Int, PRNGKeyArray

from cuelearner_jax.agents import ddqn, sac
from cuelearner_jax.agents.replay import Memory
from cuelearner_jax.config import Frame, Scalars, Sizes
from cuelearner_jax.environment import Spaces
from cuelearner_jax.types import Actions, Observations, Params


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

    def init(self, key: PRNGKeyArray) -> tuple[Params, Any]:
        """Return parameters that act, and the rest of the learning state."""
        ...

    def act(self, env: Any, params: Params, obs: Observations, key: PRNGKeyArray) -> Actions:
        """Return actions of the finished agent. `env` gives the features of observations (`Sizes.frame`)."""
        ...

    def explore(self, env: Any, options: Any, params: Params, obs: Observations, key: PRNGKeyArray) -> Actions:
        """Return actions during learning; `options`: see `update`."""
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
        """Make gradient step number `count` (from 1); return parameters, the rest, the loss and the gradient's norm.

        `options` are those that the agent was made from, their floats traced; `scalars` are settings that all parts
        share; `params` and `rest` are as `init` returns them; `env` rebuilds the memory's observations.
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
        """
        ...

    def check(self, sizes: Sizes, bootstraps: bool) -> None:
        """Raise UserError for options that do not work together; each is within its bounds."""
        ...


AGENTS: dict[str, Any] = {kind.NAME: kind for kind in (ddqn.DDQNConfig, sac.SACConfig)}
