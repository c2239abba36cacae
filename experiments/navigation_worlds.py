"""Three worlds of each style, seen from above: what is trained in, and what an agent can be tried in after that.

python experiments/navigation_worlds.py --out docs/figures/navigation_worlds.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax

from cuelearner_envs.navigation import drawing
from cuelearner_envs.navigation.layouts import STYLES
from cuelearner_envs.navigation.worlds import generate_many

WORLDS = 3


def main() -> int:
    """Draws them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("worlds.png"), help="a name that ends in .png, .svg or .pdf")
    parser.add_argument("--seed", type=int, default=0, help="decides the worlds")
    asked = parser.parse_args()
    worlds, titles = [], []
    for style in STYLES:
        many = generate_many(jax.random.key(asked.seed), WORLDS, style)
        worlds += [jax.tree.map(lambda leaf, number=number: leaf[number], many) for number in range(WORLDS)]
        titles += [style] + [""] * (WORLDS - 1)
    drawing.overview(worlds, asked.out, titles)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
