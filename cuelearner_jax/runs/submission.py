"""Submitting the pieces of a sweep that are not finished, as jobs of a cluster."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax

from cuelearner_jax.errors import UserError
from cuelearner_jax.runs import cluster, failures
from cuelearner_jax.runs.cluster import Job
from cuelearner_jax.runs.order import Plan
from cuelearner_jax.runs.shards import Shard


def check(place: str | None, shards: int | None, job: Job, shard: str | None, overwrite: bool, out: Path) -> None:
    """Raises UserError for options that do not go together. `place`: "slurm", or None for no jobs."""
    if place is None:
        if shards is not None or job != Job():
            raise UserError("--shards and --job belong to --cluster: give --cluster slurm, or --shard i/n alone")
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
    cluster.check(job)


def submit(
    shards: int,
    job: Job,
    out: Path,
    arguments: list[str],
    plan: Callable[[Shard], Plan],
    tell: Callable[[str], None] = print,
) -> None:
    """Every piece of a sweep that is not finished, as a job of Slurm.

    Args:
        shards: number of pieces.
        job: what each job gets.
        out: the sweep's folder.
        arguments: of the command `cuelearner sweep` that submits them.
        plan: what the sweep does for a piece.
        tell: told how it went, and how to go on.

    Raises:
        UserError: what the sweep or the cluster refuses, before anything is written.
        NotFinite: all is done, but some lanes stopped being finite.
    """
    jax.config.update("jax_platforms", "cpu")  # the accelerator's memory is for the jobs
    plans = {shard: plan(shard) for shard in (Shard(index, shards) for index in range(1, shards + 1))}
    pieces = {s: cluster.piece_arguments(arguments, s) for s, planned in plans.items() if not planned.finished}
    if len(pieces) < len(plans):
        tell(f"{len(plans) - len(pieces)} of {len(plans)} pieces were finished before")
    told = f"cuelearner report {out} --out {out}/report"
    if pieces:
        number, logs = cluster.submit_to_slurm(pieces, out, job)
        tell(
            f"submitted {len(pieces)} jobs as {number}; logs in {logs}\n"
            f"how they stand: squeue --job {number}\nwhat there is and what is missing: {told}\n"
            f"stop them: scancel {number}; the same command again goes on with what is not finished"
        )
        return
    orders = [planned.order for planned in plans.values()]
    failures.check(out, [order.out / kind for order in orders for kind in order.grid.guidance])
    tell(f"done: {out} (see it with: {told})")
