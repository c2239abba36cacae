"""Forms of answers, as label files and teachers know them, independent of any guide."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cuelearner_jax.config import Scalars
from cuelearner_jax.spaces import Space
from cuelearner_jax.types import EnvState, Teacher


@runtime_checkable
class AnswerFunction(Protocol):
    """A simulated teacher's answer, with the faults of `scalars`, about an action in a situation."""

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
        """Return (answer, answered)."""
        ...


class AnswerForm(NamedTuple):
    """A form of answer. Label files hold its name; every guide with the same form can use them."""

    name: str
    width: Callable[[Space], int]  # entries of an answer
    meaning: Callable[[Space], str]  # meaning of its entries, in a few words
    answer: AnswerFunction
    values: Callable[[Space], tuple[float, ...]] | None = None  # allowed values of an entry; None: any finite number
    is_action: bool = False  # True if an answer is itself an action
    by_eps: bool = False  # True if an answer means a change by eps, which label files then record
    # (space, action, answer, eps) -> the action that the answer asks for; None: an answer names none
    correct: Callable[[Space, Array, Array, Array], Array] | None = None
