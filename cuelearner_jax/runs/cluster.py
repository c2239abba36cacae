"""Run a sweep's shards as jobs of a Slurm cluster; the only module that uses submitit.

A job is submitit's process with `cuelearner sweep ... --shard i/n` as its child, a command that can also be given by
hand. The outer process never waits inside compiled code, so it always receives the scheduler's signals. Near its time
limit it makes the command save and stop, as Ctrl-C does, and then asks to be requeued. The files of submitit lie in
`jobs` below the sweep's folder, one folder per submission.
"""

from __future__ import annotations

import contextlib
import io
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import jax

from cuelearner_jax.errors import UserError
from cuelearner_jax.runs import failures
from cuelearner_jax.runs.order import Plan
from cuelearner_jax.runs.shards import Shard

# The command, whose name in the results is as if it had been typed.
ENTRY = "import sys; sys.argv[0] = 'cuelearner'; from cuelearner_jax.cli import main; sys.exit(main())"
# options of sbatch that this program sets
OURS = ("array", "error", "nodes", "open_mode", "output", "requeue", "signal")
REQUEUE_S = 30  # part of the notice that submitit needs to requeue the job [s]


@dataclass(frozen=True)
class Job:
    """Resources of each job."""

    gpus: int = 0
    """GPUs of each job (0: run on the CPU)."""
    cpus: int = 4
    """CPU cores of each job."""
    memory_gb: float = 0.0
    """Main memory of each job (0: the partition's default) [GB]."""
    minutes: int = 240
    """Time limit of each job [min]. A job that reaches the limit saves its state and is requeued to continue."""
    partition: str | None = None
    """Partition to submit to (default: the cluster's)."""
    account: str | None = None
    """Account to charge (default: yours)."""
    at_once: int = 0
    """Largest number of jobs that run at once (0: all)."""
    restarts: int = 100
    """How often a job is requeued after reaching its time limit."""
    notice_s: int = 180
    """Time before the limit at which a job is told to save [s]. Give more than the time between two evaluations."""
    setup: tuple[str, ...] = ()
    """Shell lines to run before the job, for instance "module load cuda"."""
    slurm: tuple[str, ...] = ()
    """Further options of sbatch as KEY=VALUE, for instance qos=high gres=gpu:h200:1 constraint=ib."""


def check(place: str | None, shards: int | None, job: Job, shard: str | None, overwrite: bool, out: Path) -> None:
    """Raise UserError for options that do not fit together. `place`: "slurm", or None for no jobs."""
    if place is None:
        if shards is not None or job != Job():
            raise UserError("--shards and --job belong to --cluster: give --cluster slurm, or --shard i/n alone")
        return
    if shard:
        raise UserError("--shard runs one shard here and --cluster runs all shards as jobs: give one of the two")
    if shards is None or shards < 1:
        raise UserError(f"--cluster needs --shards of at least 1, the number of jobs; it is {shards}")
    if overwrite:
        raise UserError(
            f"--overwrite with --cluster: a job that starts again would delete its own work; delete {out} by "
            "hand, or give another --out"
        )
    for name, least in (("gpus", 0), ("cpus", 1), ("minutes", 1), ("at_once", 0), ("restarts", 0), ("notice_s", 60)):
        if getattr(job, name) < least:
            raise UserError(f"--job.{name.replace('_', '-')} is {getattr(job, name)}: give at least {least}")
    if not 0 <= job.memory_gb < float("inf"):
        raise UserError(f"--job.memory-gb is {job.memory_gb}: give a positive number, or 0 for the partition's default")
    if job.notice_s >= 60 * job.minutes:
        raise UserError(f"--job.notice-s is {job.notice_s}: give less than the {60 * job.minutes} s of --job.minutes")
    _sbatch_options(job)
    _submitit()


def submit(
    shards: int,
    job: Job,
    out: Path,
    arguments: list[str],
    plan: Callable[[Shard], Plan],
    tell: Callable[[str], None] = print,
) -> None:
    """Submit every unfinished shard of a sweep as a job of Slurm.

    Args:
        shards: number of shards.
        job: resources of each job.
        out: the sweep's folder.
        arguments: arguments of the command `cuelearner sweep` that submits the jobs.
        plan: returns a shard's plan.
        tell: called with the outcome and how to continue.

    Raises:
        UserError: the sweep or the cluster refuses the request, before anything is written.
        NotFinite: everything is finished, but some lanes stopped being finite.
    """
    jax.config.update("jax_platforms", "cpu")  # the accelerator's memory is for the jobs
    plans = {shard: plan(shard) for shard in (Shard(index, shards) for index in range(1, shards + 1))}
    pieces = [piece_arguments(arguments, shard) for shard, planned in plans.items() if not planned.finished]
    if len(pieces) < len(plans):
        tell(f"{len(plans) - len(pieces)} of {len(plans)} shards were finished before")
    told = f"cuelearner report {out} --out {out}/report"
    if pieces:
        number, logs = _submit_to_slurm(pieces, out, job)
        tell(
            f"submitted {len(pieces)} jobs as {number}; logs in {logs}\n"
            f"their state: squeue --job {number}\nresults so far: {told}\n"
            f"to stop them: scancel {number}; repeat the same command to continue unfinished shards"
        )
        return
    orders = [planned.order for planned in plans.values()]
    failures.check(out, [order.out / kind for order in orders for kind in order.grid.guidance])
    tell(f"done: {out} (show it by: {told})")


def _submitit() -> ModuleType:
    """Import submitit without its side effect of closing all logs. Raises UserError if it is not installed."""
    level = os.environ.get("SUBMITIT_LOG_LEVEL")
    os.environ["SUBMITIT_LOG_LEVEL"] = "NOCONFIG"
    try:
        import submitit
    except ImportError:
        raise UserError(
            "--cluster needs submitit: install the extra `cluster`, for instance pip install -e '.[cluster]'"
        ) from None
    finally:  # jobs need submitit's own logging
        del os.environ["SUBMITIT_LOG_LEVEL"]
        if level is not None:
            os.environ["SUBMITIT_LOG_LEVEL"] = level
    return submitit


def _sbatch_options(job: Job) -> dict[str, Any]:
    """Parse `--job.slurm` into sbatch's long options. Raises UserError for invalid or reserved options."""
    found: dict[str, Any] = {}
    for text in job.slurm:
        key, equals, value = text.partition("=")
        key = key.removeprefix("--").replace("-", "_")
        if not key or not equals or not value:
            raise UserError(f"--job.slurm is {text!r}: give KEY=VALUE, for instance qos=high")
        if key in OURS:
            raise UserError(f"--job.slurm cannot set {key.replace('_', '-')!r}, which cuelearner sets: leave it out")
        found[key] = value
    return found


def piece_arguments(arguments: list[str], shard: Shard) -> tuple[str, ...]:
    """Return the arguments of `cuelearner sweep` that run one shard, from those that submit all shards."""
    kept, dropping = [], False
    for argument in arguments:
        if argument.startswith("--"):
            name = argument.partition("=")[0]
            # A shard resumes by itself; --resume would be refused for a shard that has not begun.
            dropping = name in ("--cluster", "--shards", "--resume") or name.startswith("--job.")
        if not dropping:
            kept.append(argument)
    return ("sweep", *kept, "--shard", f"{shard.index}/{shard.count}")


@dataclass(frozen=True)
class PieceJob:
    """One job: a callable that submitit pickles, and loads and calls where the job runs."""

    arguments: tuple[str, ...]
    folder: str
    """Working directory of the command, to which relative paths refer."""
    grace_s: int
    """Time for the command to save and stop before it is killed [s]."""

    def __call__(self) -> None:
        """Run the command to its end; exit with its status unless that is 0."""
        again = signal.getsignal(signal.SIGUSR2)  # submitit's handler: calls `checkpoint`, requeues the job, exits
        signals = (signal.SIGUSR2, signal.SIGTERM)
        for number in signals:  # a scheduler signals every process; the command gets its signal from here only
            signal.signal(number, signal.SIG_IGN)
        # Ignored by a function: the command would inherit SIG_IGN, but has to receive the signal from here.
        signal.signal(signal.SIGINT, lambda number, frame: None)
        command = [sys.executable, "-u", "-c", ENTRY, *self.arguments]
        process = subprocess.Popen(command, cwd=self.folder, start_new_session=True)
        print(f"process {process.pid}: {shlex.join(('cuelearner', *self.arguments))}", flush=True)
        asked: list[int] = []

        def stop(number: int, frame: Any) -> None:
            if not asked:  # a second signal would stop the command at once
                process.send_signal(signal.SIGINT)
            asked.append(number)
            signal.alarm(self.grace_s)

        for number in signals:
            signal.signal(number, stop)
        signal.signal(signal.SIGALRM, lambda number, frame: process.kill())
        status = process.wait()
        signal.alarm(0)
        if status == 0:
            return
        while asked and signal.SIGUSR2 not in asked:
            time.sleep(1)  # after SIGTERM the scheduler decides about requeuing, and ends this process
        if signal.SIGUSR2 in asked and callable(again):
            again(signal.SIGUSR2, None)
        if status < 0 and not asked:
            print(f"error: the process was killed by {signal.Signals(-status).name}", file=sys.stderr, flush=True)
        sys.exit(status if status > 0 else 1)

    def checkpoint(self) -> Any:
        """Return the job for submitit to start after this one was stopped: the same, since a shard resumes."""
        return _submitit().helpers.DelayedSubmission(self)


def _new_folder(out: Path) -> Path:
    """Make a folder for submitit's files of one submission, named after the time."""
    stamp, number = time.strftime("%Y-%m-%dT%H-%M-%S"), 1
    while True:
        folder = out / "jobs" / (stamp if number == 1 else f"{stamp}-{number}")
        try:
            folder.mkdir(parents=True)
            return folder.absolute()
        except FileExistsError:  # two submissions within a second
            number += 1


def _submit_to_slurm(pieces: list[tuple[str, ...]], out: Path, job: Job) -> tuple[str, Path]:
    """Submit one job array with a command per shard; return its number and the folder of its logs.

    Raises UserError without Slurm, or with sbatch's last line if sbatch refused; nothing is left on disk then.
    """
    submitit = _submitit()
    if submitit.SlurmExecutor.affinity() < 0:
        raise UserError("--cluster slurm: Slurm's command srun is not installed here: submit from a login node")
    given = {
        "partition": job.partition,
        "account": job.account,
        "mem": f"{round(1024 * job.memory_gb)}M" if job.memory_gb else None,
        "gpus_per_node": job.gpus or None,
        "setup": list(job.setup) or None,
    }
    folder = _new_folder(out)
    try:
        executor = submitit.SlurmExecutor(folder, max_num_timeout=job.restarts)
        executor.update_parameters(
            job_name=f"cuelearner-{out.name}",
            time=job.minutes,
            cpus_per_task=job.cpus,
            signal_delay_s=job.notice_s,
            array_parallelism=job.at_once or len(pieces),
            additional_parameters={"requeue": True, **_sbatch_options(job)},
            **{name: value for name, value in given.items() if value is not None},
        )
        grace = job.notice_s - REQUEUE_S
        calls = [PieceJob(arguments, os.getcwd(), grace) for arguments in pieces]
        with contextlib.redirect_stderr(io.StringIO()):  # submitit prints the error that it raises afterwards
            jobs = executor.submit_array(calls)
    except (submitit.core.utils.FailedJobError, submitit.core.utils.FailedSubmissionError, FileNotFoundError) as error:
        shutil.rmtree(folder)
        with contextlib.suppress(OSError):  # the folder is not empty
            folder.parent.rmdir()
            folder.parent.parent.rmdir()
        told = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise UserError(f"sbatch refused the jobs ({told[-1] if told else type(error).__name__})") from error
    return jobs[0].job_id.partition("_")[0], folder
