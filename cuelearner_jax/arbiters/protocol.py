"""What an arbiter is: pure functions of one lane that decide in which environments the guide's action is executed.

An arbiter is made from options (`config.parts`), a class with a `NAME`, a line `ABOUT` it, and `make`; `registry` finds
them by name.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.config import Scalars


class Outcome(NamedTuple):
    """What one step led to in each environment."""

    reward: Float[Array, " num_envs"]
    done: Bool[Array, " num_envs"]  # did the episode end with it?
    counts: Bool[Array, ""]  # is this the time of guidance?


@runtime_checkable
class Arbiter(Protocol):
    """An arbiter's functions; hashable, without arrays of its own."""

    def init(self, num_envs: int) -> Any:
        """Its state in environments at the start of their first episodes."""
        ...

    def guided(self, state: Any) -> Bool[Array, " num_envs"]:
        """In which environments the guide's action is executed next, in the time of guidance."""
        ...

    def follow(self, state: Any, options: Any, scalars: Scalars, outcome: Outcome, key: PRNGKeyArray) -> Any:
        """The state after one step in every environment.

        Args:
            state: before it.
            options: those that the arbiter was made from, their floats traced.
            scalars: what all parts share, such as the discount factor.
            outcome: of the step.
            key: of this step.
        """
        ...


@runtime_checkable
class ArbiterOptions(Protocol):
    """A class of options (`config.part`) that makes an arbiter."""

    NAME: ClassVar[str]
    ABOUT: ClassVar[str]

    def make(self, bootstraps: bool) -> Arbiter:
        """The arbiter; floats of the options may be None. `bootstraps`: is the discount factor above 0?"""
        ...
