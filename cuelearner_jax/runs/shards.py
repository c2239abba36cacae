"""A sweep in pieces that know nothing of each other: each with its own seeds and folder, free to be started anew."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cuelearner_jax.errors import UserError
from cuelearner_jax.records import formats


class Shard(NamedTuple):
    """Piece `index` (from 1) of `count`."""

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """From "i/n". Raises UserError for anything else."""
        found = re.fullmatch(r"(\d+)/(\d+)", text)
        shard = cls(*(int(number) for number in found.groups())) if found else cls(0, 0)
        if not 1 <= shard.index <= shard.count:
            raise UserError(f"--shard is {text!r}: give i/n with i from 1 to n, for instance 3/8")
        return shard

    def folder(self, out: Path) -> Path:
        """Where the piece writes below the sweep's folder."""
        return out / f"shard-{self.index:0{len(str(self.count))}d}-of-{self.count}"

    def check_sweep(self, out: Path) -> None:
        """Raises UserError if the sweep's folder holds something else than pieces of this count."""
        if out.exists() and not out.is_dir():
            raise UserError(f"{out} is no folder: give another --out")
        if (out / "config.json").exists():
            raise UserError(f"{out} holds a run that is not cut into pieces: give another --out")
        for folder in sorted(out.glob("shard-*-of-*")):
            if not folder.name.endswith(f"-of-{self.count}"):
                raise UserError(
                    f"{folder} is a piece of another cut, whose seeds would count twice: "
                    f"cut into as many pieces as before, or give another --out"
                )

    def seeds(self, seeds: tuple[int, ...]) -> tuple[int, ...]:
        """Its share of a sweep's seeds: as many as the other pieces have, or one less.

        Raises UserError if some piece would have none.
        """
        if self.count > len(seeds):
            raise UserError(f"--shard: {len(seeds)} seeds do not make {self.count} pieces, at most {len(seeds)}")
        return tuple(int(seed) for seed in np.array_split(np.array(seeds), self.count)[self.index - 1])


def missing(configurations: list[Path]) -> list[str]:
    """One line for each sweep of whose pieces some have not begun, given the config.json files that there are.

    A file that cannot be read is passed over: it says nothing of a piece. One whose piece makes no sense is named.
    """
    begun: dict[tuple[Path, int], set[int]] = {}
    lines = []
    for path in configurations:
        try:
            values = formats.read("config", path).get("shard")
        except UserError:
            continue
        if values is None:
            continue
        if not (isinstance(values, list) and [type(value) for value in values] == [int, int]):
            lines.append(str(formats.damaged("config", path)))
            continue
        shard = Shard(*values)
        if not 1 <= shard.index <= shard.count:
            lines.append(str(formats.damaged("config", path)))
            continue
        begun.setdefault((path.parent.parent, shard.count), set()).add(shard.index)
    for (sweep, count), there in sorted(begun.items()):
        absent = _between(sorted(there), count)
        if absent:
            lines.append(f"{sweep.as_posix()}: shards not begun, of {count}: {', '.join(absent)}")
    return lines


def _between(there: list[int], count: int) -> list[str]:
    """The stretches of 1 to `count` that are not there: as many as there are pieces, however many are absent."""
    edges = [0, *there, count + 1]
    stretches = [(low + 1, high - 1) for low, high in itertools.pairwise(edges) if high - low > 1]
    return [str(first) if first == last else f"{first} to {last}" for first, last in stretches]
