"""Shards of a sweep: independent pieces with seeds and a folder of their own, which may be restarted."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cuelearner_jax.errors import UserError, format_numbers
from cuelearner_jax.storage import formats
from cuelearner_jax.storage.folders import CONFIG, differences

OWN = ("grid.seeds", "shard.index")  # entries of config.json that differ between shards of one sweep


class Shard(NamedTuple):
    """Shard `index` (from 1) of `count`."""

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Parse "i/n". Raises UserError for anything else."""
        match = re.fullmatch(r"(\d+)/(\d+)", text)
        shard = cls(*(int(number) for number in match.groups())) if match else cls(0, 0)
        if not 1 <= shard.index <= shard.count:
            raise UserError(f"--shard is {text!r}: give i/n with i from 1 to n, for instance 3/8")
        return shard

    def folder(self, out: Path) -> Path:
        """Return the shard's folder below the sweep's folder."""
        return out / f"shard-{self.index:0{len(str(self.count))}d}-of-{self.count}"

    def check_sweep(self, out: Path, contents: dict[str, Any]) -> None:
        """Check that the shard, with `contents` as its config.json, belongs to the sweep in the folder `out`."""
        if (out / CONFIG).exists():
            raise UserError(f"{out} holds a run that is not cut into shards: give another --out")
        for folder in sorted(out.glob("shard-*-of-*")):
            if not folder.name.endswith(f"-of-{self.count}"):
                advice = "use as many shards as before, or give another --out"
                raise UserError(f"{folder} is a shard of another division, whose seeds would count twice: {advice}")
            if folder == self.folder(out) or not (folder / CONFIG).is_file():
                continue
            if names := differing_options(formats.read("config", folder / CONFIG), contents):
                advice = "give the same options for all shards, or another --out"
                raise UserError(f"{folder} is a shard of a sweep with another {names}: {advice}")

    def seeds(self, seeds: tuple[int, ...]) -> tuple[int, ...]:
        """Return the shard's share of a sweep's seeds; shares differ by at most one seed."""
        if self.count > len(seeds):
            advice = f"give at most {len(seeds)}"
            raise UserError(f"--shard: {len(seeds)} seeds cannot be divided into {self.count} shards: {advice}")
        return tuple(int(seed) for seed in np.array_split(np.array(seeds), self.count)[self.index - 1])


def differing_options(before: dict[str, Any], now: dict[str, Any], own: tuple[str, ...] = OWN) -> str:
    """Return at most four options, but for `own`, in which the sweeps of two descriptions differ."""
    return ", ".join(sorted({*differences(before, now)} - set(own))[:4])


def missing(configurations: list[Path]) -> list[str]:
    """Return one line per sweep some of whose shards have not begun, given the config.json files that can be read."""
    begun: dict[tuple[Path, int], set[int]] = {}
    for path in configurations:
        with contextlib.suppress(UserError):
            if shard := formats.read("config", path).get("shard"):
                begun.setdefault((path.parent.parent, shard["count"]), set()).add(shard["index"])
    return [
        f"{sweep.as_posix()}: shards not begun, of {count}: {format_numbers(absent)}"
        for (sweep, count), there in sorted(begun.items())
        if (absent := set(range(1, count + 1)) - there)
    ]
