"""A script that presses keys on the labelling page and sees only the page."""

from __future__ import annotations

import random
import re
from typing import Any, NamedTuple

import numpy as np
from _photos import ENTRIES, HIGH, best
from _way import Scene

from cuelearner_jax.spaces import UNSAID

KEYS = {"ArrowLeft": 1.0, "ArrowUp": 0.0, "ArrowRight": -1.0, "ArrowDown": None}  # of a page about directions
UNSURE, MISTAKES = 0.1, 0.1  # shares of a script's keys, and of its answers
RIGHT_DEG = 10.0  # half of navigation's eps: an arrow this near the way is left as it is
RIGHT_SHARE = 0.05  # of a range: an entry this near is left as it is
DRAWN = "document.querySelector('svg.scene').outerHTML"
SEEN = "() => [document.querySelector('.side').innerText, [...document.querySelectorAll('.note')].at(-1).innerText]"


class Presses(NamedTuple):
    """Keys, the last of which moves on, and what they say: (cues,), or None for "don't know"."""

    keys: tuple[str, ...]
    answer: tuple[float, ...] | None


def chosen(page: Any, task: str, rng: random.Random, seen: np.ndarray | None = None) -> Presses:
    """Return the script's key; `seen` (situations, 4): contents of a folder's pictures."""
    named = page.evaluate("cue.keys")
    cues = sorted({int(name.split("-")[1]) for name in named.values() if name.startswith(("pick-", "only-"))})
    if not cues:
        key = _turned(page, task, rng)
        return Presses((key,), None if (said := KEYS[key]) is None else (said,))
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


def _turned(page: Any, task: str, rng: random.Random) -> str:
    """A key of a page about directions."""
    if rng.random() < UNSURE:
        return "ArrowDown"
    if task != "navigation":
        return rng.choice(["ArrowLeft", "ArrowUp", "ArrowRight"])
    scene = Scene(page.evaluate(DRAWN))
    apart = (scene.to_goal() - scene.asked + 180) % 360 - 180
    right = "ArrowUp" if abs(apart) <= RIGHT_DEG else "ArrowLeft" if apart > 0 else "ArrowRight"
    wrong = [key for key, said in KEYS.items() if said is not None and key != right]
    return rng.choice(wrong) if rng.random() < MISTAKES else right


def _wanted(page: Any, seen: np.ndarray) -> list[float]:
    """Return the direction in which each entry of the page's action should change, by its picture."""
    side, note = page.evaluate(SEEN)
    row = int(re.search(r"situation (\d+)", side)[1])  # pyright: ignore[reportOptionalSubscript]
    action = [float(re.search(rf"{name} (-?[\d.e-]*\d)", note)[1]) for name in ENTRIES]  # pyright: ignore[reportOptionalSubscript]
    apart = (best(seen[row : row + 1])[0] - action) / (2 * HIGH)
    return [float(np.sign(share)) if abs(share) > RIGHT_SHARE else 0.0 for share in apart]
