"""What a form of answers is, before anyone says what its answers mean to a guide."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.config import Scalars
from cuelearner_jax.spaces import Space
from cuelearner_jax.types import EnvState, Teacher


@runtime_checkable
class AnswerFunction(Protocol):
    """What a simulated teacher with the faults of `scalars` says about an action in a situation."""

    def __call__(
        self,
        key: PRNGKeyArray,
        env: Any,
        teacher: Teacher,
        state: EnvState,
        obs: Float[Array, " obs"],
        action: Float[Array, " action"],
        scalars: Scalars,
    ) -> tuple[Float[Array, " answer"], Bool[Array, ""]]:
        """(answer, answered)."""
        ...


class AnswerForm(NamedTuple):
    """A form of answer. Label files are marked with its name; every guidance of the same form can use them."""

    name: str
    width: Callable[[Space], int]  # entries of an answer
    meaning: Callable[[Space], str]  # of its entries, in a few words
    answer: AnswerFunction
    values: Callable[[Space], tuple[float, ...]] | None = None  # that an entry may have; None: any finite number
    is_action: bool = False  # is an answer an action itself?
    by_eps: bool = False  # does it mean a change by eps? Label files then say how much that was
