"""Submitting the pieces of a sweep that are not finished, as jobs of a cluster or of this machine."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from statistics import fmean

import jax

from cuelearner_jax.errors import UserError
from cuelearner_jax.runs import cluster, failures
from cuelearner_jax.runs.cluster import Job
from cuelearner_jax.runs.order import Plan
from cuelearner_jax.runs.shards import Shard
from cuelearner_jax.storage.folders import holder


def check(place: str | None, shards: int | None, job: Job, shard: str | None, overwrite: bool, out: Path) -> None:
    """Raises UserError for options that do not go together. `place`: "slurm", "local", or None for no jobs."""
    if place is None:
        if shards is not None or job != Job():
            raise UserError(
                "--shards and --job belong to --cluster: give --cluster slurm or local, or --shard i/n alone"
            )
        return
    if shard:
        raise UserError("--shard runs one piece here, --cluster all of them as jobs: give one of the two")
    if shards is None or shards < 1:
        raise UserError(f"--cluster needs --shards of at least 1, the number of jobs; it is {shards}")
    if overwrite:
        raise UserError(
            f"--overwrite with --cluster: a job that starts again would delete its own work; delete {out} by "
            "hand, or give another --out"
        )
    cluster.check(place, job)


def submit(
    place: str,
    shards: int,
    job: Job,
    out: Path,
    arguments: list[str],
    plan: Callable[[Shard], Plan],
    tell: Callable[[str], None] = print,
) -> None:
    """Every piece of a sweep that is not finished, as a job.

    Args:
        place: "slurm" submits and returns, "local" runs them on this machine and waits.
        shards: number of pieces.
        job: what each job gets.
        out: the sweep's folder.
        arguments: of the command `cuelearner sweep` that submits them.
        plan: what the sweep does for a piece.
        tell: told how it went, and how to go on.

    Raises:
        UserError: what the sweep or the cluster refuses, before anything is written.
        JobsFailed: some piece did not come to its end (local).
        NotFinite: all is done, but some lanes stopped being finite.
    """
    jax.config.update("jax_platforms", "cpu")  # the accelerator's memory is for the jobs
    plans = {shard: plan(shard) for shard in (Shard(index, shards) for index in range(1, shards + 1))}
    pieces = {s: cluster.piece_arguments(arguments, s) for s, planned in plans.items() if not planned.finished}
    if len(pieces) < len(plans):
        tell(f"{len(plans) - len(pieces)} of {len(plans)} pieces were finished before")
    told = f"cuelearner report {out} --out {out}/report"
    if pieces and place == "slurm":
        number, logs = cluster.submit_to_slurm(pieces, out, job)
        tell(
            f"submitted {len(pieces)} jobs as {number}; logs in {logs}\n"
            f"how they stand: squeue --job {number}\nwhat there is and what is missing: {told}\n"
            f"stop them: scancel {number}; the same command again goes on with what is not finished"
        )
        return
    if pieces:
        _check_free({shard: plans[shard].order.out for shard in pieces})
        cluster.run_locally(pieces, out, job, lambda: fmean(planned.done for planned in plans.values()))
    orders = [planned.order for planned in plans.values()]
    failures.check(out, [order.out / kind for order in orders for kind in order.grid.guidance])
    tell(f"done: {out} (see it with: {told})")


def _check_free(folders: dict[Shard, Path]) -> None:
    """Raises UserError if other processes write some pieces, as they do whose parent was killed."""
    held = {shard: by for shard, folder in folders.items() if (by := holder(folder))}
    if held:
        told = ", ".join(f"{shard.index}/{shard.count} by {by}" for shard, by in held.items())
        raise UserError(
            f"pieces are being written by others: {told}; wait for them, or end them there (kill -INT NUMBER: they "
            "save), then give the same command again"
        )
