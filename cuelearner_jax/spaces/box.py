"""The box: actions whose entries lie between two bounds, each entry a cue of its own; cues from a person's words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cuelearner_jax.errors import UserError, format_value
from cuelearner_jax.spaces.space import Cue, Space, Vectors

SHARE = "shares"
WORDS = ("more", "less")
# Keys of the first cues where none are given; cues beyond these have buttons alone.
KEYS = ("qa", "ed", "rf", "tg", "yh", "uj", "ik", "ol", "zx", "cv", "bn", "mp", "12", "34", "56", "78", "90")


@dataclass(frozen=True)
class Box(Space):
    """Vectors between `low` and `high`. A change along a cue counts in shares of the cue's range, `high` less `low`."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    cues: tuple[Cue, ...] = ()  # one an entry; none given: "entry 1" and so on, "more" and "less"

    name = "box"
    about = "vectors between the bounds"
    reach = 1.0

    def __post_init__(self) -> None:
        """Raise UserError for bounds or cues that do not fit together."""
        low, high = (tuple(map(float, np.asarray(bound, np.float32))) for bound in (self.low, self.high))
        if len(low) != len(high) or not low or not all(0 < b - a < np.inf for a, b in zip(low, high, strict=True)):
            raise UserError(f"low is {low} and high is {high}: give as many of both, finite, each high above its low")
        cues = tuple(self.cues) or plain_cues([f"entry {number}" for number in range(1, len(low) + 1)])
        if len(cues) != len(low) or any(cue.unit != SHARE for cue in cues):
            raise UserError(f"{len(cues)} cues for {len(low)} entries: give one cue an entry, of the unit {SHARE!r}")
        for name, value in (("low", low), ("high", high), ("cues", cues)):
            object.__setattr__(self, name, value)

    @property
    def size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Number of entries of an action."""
        return len(self.low)

    @property
    def _range(self) -> Float[np.ndarray, " action"]:
        return np.asarray(self.high, np.float32) - np.asarray(self.low, np.float32)

    def sample(self, key: PRNGKeyArray, shape: tuple[int, ...] = ()) -> Float[Array, "*shape action"]:
        """Draw vectors uniformly between the bounds."""
        return self._at(jax.random.uniform(key, (*shape, self.size)))

    def log(self, action: Vectors, other: Vectors) -> Float[Array, "... cues"]:
        """Return the difference in each entry, as a share of its range."""
        action, other = jnp.broadcast_arrays(action, other)
        return (other - action) / _row(self._range, other)

    def exp(self, action: Vectors, change: Float[Array, "... cues"]) -> Float[Array, "... action"]:
        """Add shares of the ranges; the bounds hold."""
        action, change = jnp.broadcast_arrays(action, change)
        return self.retract(action + change * _row(self._range, change))

    def retract(self, vector: Vectors) -> Float[Array, "... action"]:
        """Return the vector between the bounds that is nearest; NaN where an entry is not finite."""
        bounded = jnp.clip(vector, _row(self.low, vector), _row(self.high, vector))
        return jnp.where(jnp.isfinite(vector), bounded, jnp.nan)

    def room(self, action: Vectors) -> tuple[Float[Array, "... cues"], Float[Array, "... cues"]]:
        """Return the shares of the ranges below and above each entry."""
        return self.log(_row(self.low, action), action), self.log(action, _row(self.high, action))

    def even(self, action: Vectors) -> Float[Array, "... action"]:
        """Return the entries from -1 at the lower bound to 1 at the upper."""
        return 2 * self.log(self.middle(), action)

    def half_ranges(self, like: Vectors) -> Float[Array, "... action"]:
        """Return half of each entry's range, in the shape of an array of actions."""
        return _row(self._range / 2, like)

    def outward(self, vector: Vectors, action: Vectors) -> Float[Array, "... action"]:
        """Return a vector given in shares of the ranges as a vector to be added to the action."""
        return jnp.asarray(vector) * _row(self._range, vector)

    def spread(self, count: int) -> Float[Array, "count action"]:
        """Return `count` vectors that fill the box evenly and reach its bounds, the same ones each time.

        An additive recurrence by powers of the generalised golden ratio (Roberts, "The unreasonable effectiveness of
        quasirandom sequences", 2018); of one entry they are evenly spaced.
        """
        if count == 1:
            return self.middle()[None]
        ratio = 2.0
        for _ in range(64):  # the root of x^(size + 1) = x + 1
            ratio = (1 + ratio) ** (1 / (self.size + 1))
        steps = ratio ** -np.arange(1.0, self.size + 1)
        places = np.arange(count)[:, None] * steps % 1.0 if self.size > 1 else np.arange(float(count))[:, None]
        places = (places - places.min(0)) / np.ptp(places, 0)
        return self._at(jnp.asarray(places, jnp.float32))

    def middle(self) -> Float[Array, " action"]:
        """Return the vector halfway between the bounds."""
        return self._at(jnp.full((self.size,), 0.5))

    def _at(self, shares: Float[Array, "... action"]) -> Float[Array, "... action"]:
        return _row(self.low, shares) + _row(self._range, shares) * shares

    def words_of(self, action: Any) -> str:
        """Return each entry by the name of its cue."""
        return ", ".join(f"{cue.name} {value:.3g}" for cue, value in zip(self.cues, np.asarray(action), strict=True))

    @classmethod
    def of_json(cls, about: dict[str, Any], cues: tuple[Cue, ...]) -> Box:
        """Return the box of a file's bounds and cues."""
        return cls(about["low"], about["high"], cues)

    def to_json(self) -> dict[str, Any]:
        """Describe the box with its bounds."""
        return {**super().to_json(), "low": list(self.low), "high": list(self.high)}


def _row(values: Any, like: Vectors) -> Float[Array, "... action"]:
    """Return one number for every entry, broadcast over an array of actions."""
    return jnp.broadcast_to(jnp.asarray(values, jnp.float32), jnp.shape(like))


def plain_cues(names: Sequence[str]) -> tuple[Cue, ...]:
    """Return a cue for each entry of an action: its name, "more" and "less", and two keys while there are any."""
    pairs = zip_longest(names, KEYS[: len(names)], fillvalue="")
    return tuple(Cue(name, WORDS, tuple(keys), SHARE) for name, keys in pairs)


LONGEST = 40  # characters of a word
UNASKED = ("", "")  # words of an entry that people are not asked about
ARROWS = {"left": "ArrowLeft", "right": "ArrowRight", "up": "ArrowUp", "down": "ArrowDown"}
HELD = {"left": "a", "right": "d"}  # letter keys that stand for these arrows too


def cues_from(words: Any, names: Sequence[str] = (), unit: str = SHARE) -> tuple[Cue, ...]:
    """Return cues by their words, each with its own keys. Raises UserError for words that are no such pairs.

    Keys are arrows for left, right, up and down, or else a letter of the word that is free. A cue for which no keys
    are left has none.

    Args:
        words: "left,right;up,down", or pairs of words; the first of a pair asks for more of an entry, the second for
            less. With "NAME=open,close", people are asked about the named entries alone.
        names: names of the cues (default: "left or right" and so on).
        unit: unit of a change.
    """
    try:
        parts = words.split(";") if isinstance(words, str) else words
        pairs = [part.split(",") if isinstance(part, str) else part for part in parts]
        pairs = [tuple(" ".join(word.split()) for word in pair) for pair in pairs]
        pairs = _by_name(pairs, names) if pairs and "=" in pairs[0][0] else pairs
    except (TypeError, AttributeError):
        pairs = []
    if not any(map(any, pairs)) or not all(map(_is_pair, pairs)):
        raise UserError(f'cues is {format_value(words)}: give two words an entry of an action, as "left,right;up,down"')
    in_words = [pair for pair in pairs if pair != UNASKED]
    if not names and len({*in_words}) < len(in_words):
        raise UserError(f"cues is {format_value(words)}, the same words twice: give each entry its own")
    if names and len(names) != len(pairs):
        advice = "give one an entry"
        raise UserError(f"cues are {len(pairs)} pairs of words for {len(names)} entries of an action: {advice}")
    keys_in_use = {HELD[word] for pair in pairs for word in pair if word in HELD}
    cues = []
    for number, pair in enumerate(pairs):
        keys = []
        for word, spare in zip(pair, KEYS[number % len(KEYS)], strict=True) if any(pair) else ():
            key = ARROWS.get(word.lower())
            if key is None or key in keys_in_use:
                letters = (letter for letter in word.lower() if letter.isascii() and letter.isalpha())
                key = next((one for one in (*letters, spare, *"".join(KEYS), *"ws") if one not in keys_in_use), "")
            keys_in_use.add(key)
            keys.append(key)
        name = names[number] if names else " or ".join(pair)
        cues.append(Cue(name, (pair[0], pair[1]), tuple(keys) if all(keys) else (), unit))
    return tuple(cues)


def _is_pair(words: tuple[str, ...]) -> bool:
    """Return whether words are two different ones, or those of an entry that people are not asked about."""
    return words == UNASKED or (len({*words}) == len(words) == 2 and all(0 < len(word) <= LONGEST for word in words))


def _by_name(pairs: list[tuple[str, ...]], names: Sequence[str]) -> list[tuple[str, ...]]:
    """Return a pair of words for each of `names`; `pairs` start with "NAME=". Raises UserError for unknown names."""
    parts = [(first.partition("="), *rest) for first, *rest in pairs]
    by_name = {name.strip(): (word.strip(), *rest) for (name, _, word), *rest in parts}
    if not by_name.keys() <= {*names} or len(by_name) < len(pairs):
        there = ", ".join(names) or "no names"
        raise UserError(f"cues name {', '.join(by_name)}, but the entries of an action are {there}: name each once")
    return [by_name.get(name, UNASKED) for name in names]
