"""A script that presses keys on the labelling page and sees only the page."""

from __future__ import annotations

import random
import re
from typing import Any, NamedTuple

import numpy as np
from _photos import ENTRIES, HIGH, best

from cuelearner_jax.spaces import UNSAID

TURNS = {"ArrowLeft": 1.0, "ArrowUp": 0.0, "ArrowRight": -1.0}  # of a page about directions
UNSURE = 0.1  # share of a script's keys
RIGHT_SHARE = 0.05  # of a range: the script does not correct an entry this near
SEEN = "() => [document.querySelector('.side').innerText, [...document.querySelectorAll('.note')].at(-1).innerText]"


class Presses(NamedTuple):
    """Keys, the last of which moves on, and what they say: (cues,), or None for "don't know"."""

    keys: tuple[str, ...]
    answer: tuple[float, ...] | None


def presses_of(page: Any, rng: random.Random, seen: np.ndarray | None = None) -> Presses:
    """Return the script's keys; `seen` (situations, 4): contents of a folder's pictures; otherwise at random."""
    named = page.evaluate("cue.keys")
    cues = sorted({int(name.split("-")[1]) for name in named.values() if name.startswith(("pick-", "only-"))})
    if not cues:
        key = "ArrowDown" if rng.random() < UNSURE else rng.choice([*TURNS])
        return Presses((key,), (TURNS[key],) if key in TURNS else None)
    keys = {}
    for key, name in named.items():
        keys.setdefault(name, key)
    if rng.random() < UNSURE:
        return Presses((keys["unsure"],), None)
    said = _wanted(page, seen) if seen is not None else [rng.choice((1.0, 0.0, -1.0)) for _ in cues]
    if f"only-{cues[0]}-more" in keys:
        wrong = [cue for cue in cues if said[cue]]
        if not wrong:
            return Presses((keys["rest"],), (0.0,) * len(cues))
        cue = rng.choice(wrong)
        alone = tuple(said[cue] if number == cue else UNSAID for number in cues)
        return Presses((keys[f"only-{cue}-{'more' if said[cue] > 0 else 'less'}"],), alone)
    picks = [keys[f"pick-{cue}-{'more' if said[cue] > 0 else 'less'}"] for cue in cues if said[cue]]
    return Presses((*picks, keys["rest"]), tuple(said))


def _wanted(page: Any, seen: np.ndarray) -> list[float]:
    """Return the direction in which each entry of the page's action should change, by its picture."""
    side, note = page.evaluate(SEEN)
    row = int(re.search(r"situation (\d+)", side)[1])  # pyright: ignore[reportOptionalSubscript]
    action = [float(re.search(rf"{name} (-?[\d.e-]*\d)", note)[1]) for name in ENTRIES]  # pyright: ignore[reportOptionalSubscript]
    apart = (best(seen[row : row + 1])[0] - action) / (2 * HIGH)
    return [float(np.sign(share)) if abs(share) > RIGHT_SHARE else 0.0 for share in apart]
