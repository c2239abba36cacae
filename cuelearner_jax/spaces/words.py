"""Make cues from a person's words: "left,right;up,down;open,close"."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cuelearner_jax.errors import UserError, format_value
from cuelearner_jax.spaces.box import KEYS, SHARE
from cuelearner_jax.spaces.space import Cue

LONGEST = 40  # characters of a word
ARROWS = {"left": "ArrowLeft", "right": "ArrowRight", "up": "ArrowUp", "down": "ArrowDown"}
HELD = {"left": "a", "right": "d"}  # letter keys that stand for these arrows too


def cues_from(words: Any, names: Sequence[str] = (), unit: str = SHARE) -> tuple[Cue, ...]:
    """Return cues by their words, each with its own keys.

    Keys are arrows for left, right, up and down, or else a letter of the word that is free. A cue for which no keys
    are left has none.

    Args:
        words: "left,right;up,down", or pairs of words; the first of a pair asks for more of an entry, the second for
            less.
        names: names of the cues (default: "left or right" and so on).
        unit: unit of a change.

    Raises:
        UserError: the words are no pairs, or not as many as there are names.
    """
    given = words.split(";") if isinstance(words, str) else words
    try:
        pairs = [tuple(part.split(",")) if isinstance(part, str) else tuple(part) for part in given]
        pairs = [tuple(" ".join(word.split()) for word in pair) for pair in pairs]
    except (TypeError, AttributeError):
        pairs = []
    sound = (len({*pair}) == len(pair) == 2 and all(0 < len(word) <= LONGEST for word in pair) for pair in pairs)
    if not pairs or not all(sound):
        raise UserError(
            f'cues is {format_value(words)}: give two words for each entry of an action, as "left,right;up,down"'
        )
    if names and len(names) != len(pairs):
        raise UserError(
            f"cues are {len(pairs)} pairs of words for {len(names)} entries of an action: give one an entry"
        )
    taken = {HELD[word] for pair in pairs for word in pair if word in HELD}
    cues = []
    for number, pair in enumerate(pairs):
        keys = []
        for word, spare in zip(pair, KEYS[number % len(KEYS)], strict=True):
            key = ARROWS.get(word.lower())
            if key is None or key in taken:
                letters = (letter for letter in word.lower() if letter.isascii() and letter.isalpha())
                key = next((one for one in (*letters, spare, *"".join(KEYS), *"ws") if one not in taken), "")
            taken.add(key)
            keys.append(key)
        name = names[number] if names else " or ".join(pair)
        cues.append(Cue(name, (pair[0], pair[1]), tuple(keys) if all(keys) else (), unit))
    return tuple(cues)
