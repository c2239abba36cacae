"""A sweep in pieces that know nothing of each other: each with its own seeds and folder, free to be started anew."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cuelearner_jax.errors import UserError
from cuelearner_jax.evaluate import SPLITS
from cuelearner_jax.storage import formats
from cuelearner_jax.storage.folders import CONFIG, differences

MOST_PIECES = min(SPLITS.values())  # one for each seed that there can be
OWN = ("grid.seeds", "shard.index")  # of what config.json says, that which differs between pieces of one sweep


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

    def check_sweep(self, out: Path, described: dict[str, Any], defaults: dict[str, Any]) -> None:
        """Whether its piece, whose config.json is to hold `described`, belongs to the sweep in the folder `out`.

        `defaults`: as `differences` has them. Raises UserError if the folder holds a whole run, pieces of another
        count, or of a sweep with other settings.
        """
        if out.exists() and not out.is_dir():
            raise UserError(f"{out} is no folder: give another --out")
        if (out / CONFIG).exists():
            raise UserError(f"{out} holds a run that is not cut into pieces: give another --out")
        for folder in sorted(out.glob("shard-*-of-*")):
            if not folder.name.endswith(f"-of-{self.count}"):
                raise UserError(
                    f"{folder} is a piece of another cut, whose seeds would count twice: "
                    f"cut into as many pieces as before, or give another --out"
                )
            if folder == self.folder(out) or not (folder / CONFIG).is_file():
                continue
            if found := apart(formats.read("config", folder / CONFIG), described, defaults):
                raise UserError(
                    f"{folder} is a piece of a sweep with another {found}: give the same options for all pieces, or "
                    "another --out"
                )

    def described(self, seeds: tuple[int, ...]) -> dict[str, Any]:
        """What its config.json says of it: its number, and the seeds of all pieces."""
        return {**self._asdict(), "seeds": list(seeds)}

    @classmethod
    def of(cls, described: dict[str, Any]) -> Shard:
        """From what config.json says. Raises ValueError, TypeError or KeyError if that makes no sense."""
        shard, seeds = cls(described["index"], described["count"]), described["seeds"]
        if not isinstance(seeds, list) or not all(type(number) is int for number in (*shard, *seeds)):
            raise TypeError("a piece is made of whole numbers")
        if not 1 <= shard.index <= shard.count <= min(MOST_PIECES, len(seeds)):
            raise ValueError(f"{shard} is no piece of {len(seeds)} seeds")
        return shard

    def seeds(self, seeds: tuple[int, ...]) -> tuple[int, ...]:
        """Its share of a sweep's seeds: as many as the other pieces have, or one less.

        Raises UserError if some piece would have none.
        """
        if self.count > len(seeds):
            raise UserError(f"--shard: {len(seeds)} seeds do not make {self.count} pieces, at most {len(seeds)}")
        return tuple(int(seed) for seed in np.array_split(np.array(seeds), self.count)[self.index - 1])


def apart(before: dict[str, Any], now: dict[str, Any], defaults: dict[str, Any]) -> str:
    """The options in which two descriptions are of different sweeps, four at most; see `folders.differences`."""
    return ", ".join(sorted({*differences(before, now, defaults)} - set(OWN))[:4])


def missing(configurations: list[Path]) -> list[str]:
    """One line for each sweep of whose pieces some have not begun, given the config.json files that there are.

    A file that cannot be read is passed over: it says nothing of a piece. One whose piece makes no sense is named.
    """
    begun: dict[tuple[Path, int], set[int]] = {}
    lines = []
    for path in configurations:
        try:
            described = formats.read("config", path)
            if "shard" not in described:
                continue
            shard = Shard.of(described["shard"])
        except UserError:
            continue
        except (ValueError, KeyError, TypeError):
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
