"""Choices: one of several actions, as a one-hot vector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.errors import UserError
from cuelearner_jax.spaces.space import Cue, Space, Vectors

STEPS = "steps"


@dataclass(frozen=True)
class Choices(Space):
    """A space of `count` choices; an action is a vector (count,), 1 at the choice and 0 elsewhere.

    With `order` the choices stand in a row, and `log` counts the steps from one to another. Without `order` there is no
    cue, no answer can ask for "more", and bounds have no effect.
    """

    count: int
    order: Cue | None = None  # the cue of the order, whose unit is "steps"

    name = "choices"
    grain = 1.0
    about = "vectors with a single 1 among zeros"

    def __post_init__(self) -> None:
        """Raise UserError for too few choices, or an order in another unit."""
        if self.count < 2 or (self.order is not None and self.order.unit != STEPS):
            raise UserError(f"{self} makes no sense: give at least two choices, and an order of the unit {STEPS!r}")

    @property
    def size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Number of entries of an action."""
        return self.count

    @property
    def cues(self) -> tuple[Cue, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The order as the only cue, if there is one."""
        return () if self.order is None else (self.order,)

    @property
    def reach(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Number of steps from the first choice to the last; without an order 1."""
        return float(self.count - 1) if self.cues else 1.0

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Float[Array, "*shape action"]:
        """Draw choices uniformly."""
        return jax.nn.one_hot(jax.random.randint(key, shape, 0, self.count), self.count)

    def log(self, action: Vectors, other: Vectors) -> Float[Array, "... cues"]:
        """Return the steps from one choice to the other; no entry where choices have no order."""
        steps = jnp.argmax(jnp.asarray(other), -1) - jnp.argmax(jnp.asarray(action), -1)
        return jnp.repeat(steps[..., None], len(self.cues), -1).astype(jnp.float32)

    def exp(self, action: Vectors, change: Float[Array, "... cues"]) -> Float[Array, "... action"]:
        """Move so many steps, rounded, but no farther than the ends of the row."""
        if not self.cues:
            return jnp.asarray(action)
        place = jnp.round(jnp.argmax(jnp.asarray(action), -1) + jnp.asarray(change)[..., 0])
        return jax.nn.one_hot(jnp.clip(place, 0, self.count - 1).astype(jnp.int32), self.count)

    def retract(self, vector: Vectors) -> Float[Array, "... action"]:
        """Return the choice with the largest entry; NaN where an entry is not finite."""
        one_hot = jax.nn.one_hot(jnp.argmax(jnp.asarray(vector), -1), self.count)
        return jnp.where(jnp.isfinite(vector).all(-1, keepdims=True), one_hot, jnp.nan)

    def spread(self, count: int) -> Float[Array, "count action"]:
        """Return all choices, whatever the number asked for."""
        return jnp.eye(self.count)

    def distance(self, action: Vectors, other: Vectors) -> Float[Array, "..."]:
        """Return the steps between two choices; without an order 0 for the same, 1 for another."""
        if self.cues:
            return super().distance(action, other)
        return (jnp.argmax(jnp.asarray(action), -1) != jnp.argmax(jnp.asarray(other), -1)).astype(jnp.float32)

    def words_of(self, action: Any) -> str:
        """Return the number of the choice."""
        return f"choice {int(np.argmax(action)) + 1} of {self.count}"

    @classmethod
    def of_json(cls, about: dict[str, Any], cues: tuple[Cue, ...]) -> Choices:
        """Return the choices of a file's number and order."""
        return cls(about["count"], *cues)

    def to_json(self) -> dict[str, Any]:
        """Describe the choices with their number."""
        return {**super().to_json(), "count": self.count}
