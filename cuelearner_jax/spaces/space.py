"""The base class of action spaces: their cues, and the distance of two actions along each cue.

A space brings `sample`, `log`, `exp`, `retract` and `spread`; distances, bounds and steps follow here, for all spaces.
`log` of two actions is how far to go, and `exp` goes: exp(a, log(a, b)) = b, as on any smooth space of actions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

Vectors = Float[Array, "... action"] | Float[np.ndarray, "... action"]  # accepted arrays; results are JAX's arrays
Amount = Float[Array, "..."] | Float[np.ndarray, "..."] | float
Answers = Float[Array, "... cues"] | Float[np.ndarray, "... cues"]
UNSAID = 2.0  # entry of a relative answer for a cue that the answer does not name


@dataclass(frozen=True)
class Cue:
    """One way in which an action may change, in the words of a person who asks for the change."""

    name: str
    words: tuple[str, str]  # words for more and less: ("counterclockwise", "clockwise"), ("open", "close")
    # for these words on the labelling page, as browsers call them (`KeyboardEvent.key`); (): buttons alone
    keys: tuple[str, ...]
    unit: str  # unit of a change in options and files: "degrees", "shares" (of the cue's range), "steps"

    @property
    def is_asked(self) -> bool:
        """Whether people are asked about the cue: it has words."""
        return bool(self.words[0])


SPACES: dict[str, type[Space]] = {}  # registered spaces by their names in files


class Space:
    """A space of actions: frozen, hashable, compared by value, so that pytrees may hold one as a static field.

    Every method works on any leading axes. An action has `size` entries on the last axis, a change `len(cues)`.
    """

    name: str  # name in files
    about: str  # description of its actions, in a few words
    size: int  # entries of an action
    cues: tuple[Cue, ...]  # empty: no relative answer is possible
    reach: float  # the largest meaningful change along a cue, in `unit`
    grain: float = 0.0  # the smallest change along a cue, in `unit`; 0: there is no smallest

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "name" in vars(cls):
            SPACES[cls.name] = cls

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Float[Array, "*shape action"]:
        """Draw actions uniformly."""
        raise NotImplementedError

    def log(self, action: Vectors, other: Vectors) -> Float[Array, "... cues"]:
        """Return the change from `action` to `other` along each cue."""
        raise NotImplementedError

    def exp(self, action: Vectors, change: Float[Array, "... cues"]) -> Float[Array, "... action"]:
        """Change an action along its cues."""
        raise NotImplementedError

    def retract(self, vector: Vectors) -> Float[Array, "... action"]:
        """Return the action nearest to a vector; NaN for one that is not finite."""
        raise NotImplementedError

    def spread(self, count: int) -> Float[Array, "count action"]:
        """Return `count` actions, spread evenly."""
        raise NotImplementedError

    def middle(self) -> Float[Array, " action"] | None:
        """Return the action in the middle of every cue's range; None: there is none."""
        return None

    def room(self, action: Vectors) -> tuple[Float[Array, "... cues"], Float[Array, "... cues"]]:
        """Return how far an action can be changed to less and to more along each cue; here: without an end."""
        ends = jnp.full((*jnp.shape(action)[:-1], len(self.cues)), jnp.inf)
        return ends, ends

    def even(self, action: Vectors) -> Float[Array, "... action"]:
        """Return an action with entries of the order of one."""
        return jnp.asarray(action)

    def half_ranges(self, like: Vectors) -> Float[Array, "... action"]:
        """Return half of each entry's range, in the shape of an array of actions; 1 where entries have no bounds."""
        return jnp.ones_like(like)

    def to_json(self) -> dict[str, Any]:
        """Describe the space for a file; see `spaces.from_json`."""
        return {
            "name": self.name,
            "cues": [{"name": c.name, "words": list(c.words), "keys": list(c.keys), "unit": c.unit} for c in self.cues],
        }

    @classmethod
    def of_json(cls, about: dict[str, Any], cues: tuple[Cue, ...]) -> Space:
        """Return the space that `to_json` described; a space with parameters of its own reads them from `about`."""
        return cls()

    def words_of(self, action: Any) -> str:
        """Return an action in words for people; here: its entries."""
        return ", ".join(f"{value:.3g}" for value in np.asarray(action))

    @property
    def unit(self) -> str:
        """Unit of eps, bounds and errors in options and files."""
        return self.cues[0].unit if self.cues else "1"

    def from_unit(self, amount: Any) -> Float[Array, "..."]:
        """Convert an amount in `unit` to what `log` gives."""
        return jnp.asarray(amount, jnp.float32)

    def to_unit(self, change: Any, xp: Any = jnp) -> Any:
        """Convert what `log` gives to `unit`; `xp`: NumPy or JAX's NumPy."""
        return xp.asarray(change)

    def usable(self, vector: Any, xp: Any = jnp) -> Any:
        """Return which vectors (..., action) `retract` can make actions of, (...); `xp`: NumPy or JAX's NumPy."""
        return xp.isfinite(vector).all(-1)

    def only_actions(self, vector: Vectors) -> Float[Array, "... action"]:
        """Return vectors as they are, NaN in place of each that is unusable.

        Actions of user code pass through here, so that a fault of that code is reported and not executed.
        """
        return jnp.where(self.usable(vector)[..., None], vector, jnp.nan)

    def outward(self, vector: Vectors, action: Vectors) -> Float[Array, "... action"]:
        """Return a vector given in the frame of an action in the frame of the space."""
        return jnp.asarray(vector)

    def distance(self, action: Vectors, other: Vectors) -> Float[Array, "..."]:
        """Return the distance of two actions along the cue in which they differ most."""
        apart = jnp.abs(self.log(action, other))
        return apart[..., 0] if len(self.cues) == 1 else jnp.max(apart, -1, initial=0.0)

    def toward(self, action: Vectors, h: Float[Array, "... cues"], step: Amount) -> Float[Array, "... action"]:
        """Change an action by h steps along each cue; a cue of which nothing was said (`UNSAID`) stays."""
        h = h if len(self.cues) == 1 else jnp.where(h == UNSAID, 0.0, h)  # with one cue, an unsaid cue is no answer
        return self.exp(action, h * _for_cues(step))

    def approach(self, action: Vectors, goal: Vectors, most: Amount) -> Float[Array, "... action"]:
        """Change an action toward `goal`, along each cue by `most` at most."""
        most = _for_cues(most)
        return self.exp(action, jnp.clip(self.log(action, goal), -most, most))

    def clip(self, action: Vectors, base: Vectors, radius: Amount) -> Float[Array, "... action"]:
        """Return the action within `radius` of `base` along each cue that lies nearest to `action` (paper, Eq. 5)."""
        radius, change = _for_cues(radius), self.log(base, action)
        inside = jnp.abs(change) <= radius
        inside = inside if len(self.cues) == 1 else inside.all(-1, keepdims=True)
        return jnp.where(inside, action, self.exp(base, jnp.clip(change, -radius, radius)))

    def along(self, action: Float[Array, " action"], vector: Float[Array, " action"]) -> Float[Array, " cues"]:
        """Return what a small vector added to an action changes along each cue: the derivative of `log`."""
        return jax.jvp(lambda other: self.log(action, other), (action,), (vector,))[1]


def _for_cues(amount: Amount) -> Array:
    """Return an amount for each action, broadcast over the action's cues."""
    amount = jnp.asarray(amount)
    return amount[..., None] if amount.ndim else amount


def is_answered(answer: Answers) -> Bool[Array, "... cues"]:
    """Return which cues a relative answer names: (..., cues) bool.

    "Not said" is a finite number (`UNSAID`): NaN means that a teacher failed, JSON knows no NaN, and answers that hold
    a NaN do not equal themselves.
    """
    return jnp.asarray(answer) != UNSAID


def says_something(answer: Answers) -> Bool[Array, "..."]:
    """Return which relative answers name a cue. With one cue, all do: silence is not an answer there."""
    return is_answered(answer).any(-1) | (answer.shape[-1] == 1)
