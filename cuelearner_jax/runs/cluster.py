"""A sweep's pieces as jobs of a Slurm cluster or of this machine: the only file that knows submitit.

A job is submitit's process with `cuelearner sweep ... --shard i/n` below it, the command that anyone may give by hand.
The outer process never waits inside compiled code, so it always hears the scheduler: told that its time is up, it has
the command save and stop as Ctrl-C does, then asks to be started again. What submitit writes lies in `jobs` below the
sweep's folder, one folder a submission.
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
from dataclasses import dataclass, fields
from pathlib import Path
from types import ModuleType
from typing import Any

from cuelearner_jax import signals
from cuelearner_jax.errors import JobsFailed, UserError
from cuelearner_jax.runs.shards import Shard
from cuelearner_jax.terminal import console, progress_bars

# The command, named in the results as if it had been typed.
ENTRY = "import sys; sys.argv[0] = 'cuelearner'; from cuelearner_jax.cli import main; sys.exit(main())"
ON_THIS_MACHINE = ("gpus", "at_once")  # the job options that mean something without a scheduler
OURS = ("array", "error", "nodes", "open_mode", "output", "requeue", "signal")  # of sbatch's options
REQUEUE_S = 30  # of the notice, for submitit to put the job back
FOREVER_MIN = 10 * 365 * 24 * 60  # jobs of this machine have no time limit
POLL_S = 0.5


@dataclass(frozen=True)
class Job:
    """What each job gets."""

    gpus: int = 0
    """GPUs of each job. local: jobs that run at once get different ones (0: they run on the CPU)."""
    cpus: int = 4
    """CPU cores of each job (slurm)."""
    memory_gb: float = 0.0
    """Main memory of each job (slurm; 0: the partition's default) [GB]."""
    minutes: int = 240
    """Time limit of each job (slurm); one that runs into it saves, and starts again where it stood [min]."""
    partition: str | None = None
    """Partition to submit to (slurm; default: the cluster's)."""
    account: str | None = None
    """Account to charge (slurm; default: yours)."""
    at_once: int = 0
    """Jobs that run at once (0: all of them; local with GPUs: as many as there are GPUs for). local: jobs share the
    machine's cores and memory."""
    restarts: int = 100
    """How often a job that ran into its time limit starts again (slurm)."""
    notice_s: int = 180
    """Time before its limit at which a job is told to save (slurm): more than it trains between two evaluations [s]."""
    setup: tuple[str, ...] = ()
    """Shell lines before the job (slurm), for instance "module load cuda"."""
    slurm: tuple[str, ...] = ()
    """Any other options of sbatch as KEY=VALUE (slurm), for instance qos=high gres=gpu:h200:1 constraint=ib."""


def check(cluster: str, job: Job) -> None:
    """Raises UserError for what cannot be submitted, before anything is written."""
    for name, least in (("gpus", 0), ("cpus", 1), ("minutes", 1), ("at_once", 0), ("restarts", 0), ("notice_s", 60)):
        if getattr(job, name) < least:
            raise UserError(f"--job.{_typed(name)} is {getattr(job, name)}: give at least {least}")
    if not 0 <= job.memory_gb < float("inf"):
        raise UserError(f"--job.memory-gb is {job.memory_gb}: give a positive number, or 0 for the partition's default")
    if cluster == "local":
        given = [field.name for field in fields(job) if getattr(job, field.name) != field.default]
        for name in given:
            if name not in ON_THIS_MACHINE:
                raise UserError(f"--job.{_typed(name)} is for --cluster slurm: leave it out")
        if job.at_once * job.gpus > len(_visible_gpus()):
            raise UserError(
                f"{job.at_once} jobs at once with {job.gpus} GPUs each need {job.at_once * job.gpus}, there are "
                f"{len(_visible_gpus())}: give a smaller --job.at-once or --job.gpus"
            )
        if job.gpus > len(_visible_gpus()):
            raise UserError(f"--job.gpus is {job.gpus}, there are {len(_visible_gpus())}: give no more")
    if job.notice_s >= 60 * job.minutes:
        raise UserError(f"--job.notice-s is {job.notice_s}: give less than the {60 * job.minutes} s of --job.minutes")
    _sbatch_options(job)
    _submitit()


def _typed(name: str) -> str:
    return name.replace("_", "-")


def _submitit() -> ModuleType:
    """submitit, which otherwise would close every log of the program that imports it. Raises UserError without it."""
    level = os.environ.get("SUBMITIT_LOG_LEVEL")
    os.environ["SUBMITIT_LOG_LEVEL"] = "NOCONFIG"
    try:
        import submitit
    except ImportError:
        raise UserError(
            "--cluster needs submitit: install the extra `cluster`, for instance pip install -e '.[cluster]'"
        ) from None
    finally:  # jobs log as submitit does
        del os.environ["SUBMITIT_LOG_LEVEL"]
        if level is not None:
            os.environ["SUBMITIT_LOG_LEVEL"] = level
    return submitit


def _sbatch_options(job: Job) -> dict[str, Any]:
    """`--job.slurm` as sbatch's long options. Raises UserError for what is none, or is set here."""
    found: dict[str, Any] = {}
    for text in job.slurm:
        key, equals, value = text.partition("=")
        key = key.removeprefix("--").replace("-", "_")
        if not key or not equals or not value:
            raise UserError(f"--job.slurm is {text!r}: give KEY=VALUE, for instance qos=high")
        if key in OURS:
            raise UserError(f"--job.slurm cannot set {_typed(key)!r}, which cuelearner sets: leave it out")
        found[key] = value
    return found


def _visible_gpus() -> list[int]:
    """Numbers of the NVIDIA GPUs that this process may use, found without touching them."""
    allowed = os.environ.get("CUDA_VISIBLE_DEVICES")
    if allowed is not None and all(part.strip().isdigit() for part in allowed.split(",")):
        return [int(part) for part in allowed.split(",")]
    there = [path.name.removeprefix("nvidia") for path in Path("/dev").glob("nvidia[0-9]*")]
    return [] if allowed is not None else sorted(int(number) for number in there if number.isdigit())


def piece_arguments(arguments: list[str], shard: Shard) -> tuple[str, ...]:
    """The arguments of `cuelearner sweep` that run one piece, from those that submit all of them."""
    kept, dropping = [], False
    for argument in arguments:
        if argument.startswith("--"):
            name = argument.partition("=")[0]
            # A piece goes on by itself; were --resume asked of one that has not begun, it would be refused.
            dropping = name in ("--cluster", "--shards", "--resume") or name.startswith("--job.")
        if not dropping:
            kept.append(argument)
    return ("sweep", *kept, "--shard", f"{shard.index}/{shard.count}")


@dataclass(frozen=True)
class Piece:
    """One job: a callable that submitit pickles, loads where the job runs, and calls."""

    arguments: tuple[str, ...]
    folder: str
    """Where the command was given; relative paths begin there."""
    grace_s: int
    """How long the command may take to save and stop before it is killed [s]."""
    scheduled: bool
    """Is there a scheduler, which kills by itself what it has asked to end?"""

    def __call__(self) -> None:
        """Runs the command to its end; leaves the process with its status where it is not 0."""
        again = signal.getsignal(
            signal.SIGUSR2
        )  # submitit's: it calls `checkpoint`, asks to be started again, and exits
        signals = (signal.SIGUSR2, signal.SIGTERM)
        for number in signals:  # a scheduler sends them to every process; the command is to hear of them from here
            signal.signal(number, signal.SIG_IGN)
        # Ignored by a function, not by SIG_IGN, which the command would inherit: it is to hear of this from here too.
        signal.signal(signal.SIGINT, lambda number, frame: None)
        command = [sys.executable, "-u", "-c", ENTRY, *self.arguments]
        process = subprocess.Popen(command, cwd=self.folder, start_new_session=True)
        print(f"process {process.pid}: {shlex.join(('cuelearner', *self.arguments))}", flush=True)
        asked: list[int] = []

        def stop(number: int, frame: Any) -> None:
            if not (asked and self.scheduled):  # twice would be: at once
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
        while asked and self.scheduled and signal.SIGUSR2 not in asked:
            time.sleep(1)  # SIGTERM alone: to be started again or not is the scheduler's, which ends this process
        if signal.SIGUSR2 in asked and callable(again):
            again(signal.SIGUSR2, None)
        if status < 0 and not asked:
            print(f"error: the process was killed by {signal.Signals(-status).name}", file=sys.stderr, flush=True)
        sys.exit(status if status > 0 else 1)

    def checkpoint(self) -> Any:
        """What submitit starts in place of a job that was stopped: the same, for a piece goes on where it stands."""
        return _submitit().helpers.DelayedSubmission(self)


def _new_folder(out: Path) -> Path:
    """A folder below the sweep's for what submitit writes of one submission, named by the time."""
    stamp, number = time.strftime("%Y-%m-%dT%H-%M-%S"), 1
    while True:
        folder = out / "jobs" / (stamp if number == 1 else f"{stamp}-{number}")
        try:
            folder.mkdir(parents=True)
            return folder.absolute()
        except FileExistsError:  # submitted twice within a second
            number += 1


def _withdraw(folder: Path) -> None:
    """Takes a submission's folder away again, and those above it that are empty then."""
    shutil.rmtree(folder)
    with contextlib.suppress(OSError):  # not empty
        folder.parent.rmdir()
        folder.parent.parent.rmdir()


def submit_to_slurm(pieces: dict[Shard, tuple[str, ...]], out: Path, job: Job) -> tuple[str, Path]:
    """Submits the pieces as one job array.

    Args:
        pieces: the arguments of each piece's command.
        out: the sweep's folder.
        job: what each job gets.

    Returns:
        The number of the array, and the folder of its logs.

    Raises:
        UserError: no Slurm here, or sbatch refused the jobs, with its last line; nothing has been left on disk then.
    """
    submitit = _submitit()
    if submitit.SlurmExecutor.affinity() < 0:
        raise UserError("--cluster slurm: no srun here; submit where Slurm's commands are")
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
        calls = [Piece(arguments, os.getcwd(), grace, scheduled=True) for arguments in pieces.values()]
        with contextlib.redirect_stderr(io.StringIO()):  # submitit prints what it then raises
            jobs = executor.submit_array(calls)
    except (submitit.core.utils.FailedJobError, submitit.core.utils.FailedSubmissionError, FileNotFoundError) as error:
        _withdraw(folder)
        told = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise UserError(f"sbatch refused the jobs ({told[-1] if told else type(error).__name__})") from error
    return jobs[0].job_id.partition("_")[0], folder


class LocalJobs:
    """The pieces as jobs of this machine, some at once, until all have ended or the user stops them."""

    def __init__(self, pieces: dict[Shard, tuple[str, ...]], folder: Path, job: Job) -> None:
        visible = _visible_gpus()
        most = len(visible) // job.gpus if job.gpus else len(pieces)
        places = min(job.at_once or most, most, len(pieces))
        self._free = [visible[place * job.gpus : (place + 1) * job.gpus] for place in range(places)]
        self._waiting = list(pieces.items())
        self._running: dict[Shard, tuple[Any, list[int]]] = {}
        self.succeeded: list[Shard] = []
        self.failed: dict[Shard, str] = {}  # with the last line of its log
        self.stopping: int | None = None  # the signal that they were stopped by
        self._executor = _submitit().LocalExecutor(folder)

    @property
    def ended(self) -> bool:
        """Is there nothing more to wait for?"""
        return not self._running and (self.stopping is not None or not self._waiting)

    @property
    def note(self) -> str:
        """How many stand where."""
        counts = {"running": self._running, "waiting": self._waiting, "done": self.succeeded, "failed": self.failed}
        return ", ".join(f"{len(shards)} {name}" for name, shards in counts.items() if shards)

    def poll(self) -> None:
        """Starts what there is room for and takes note of what has ended."""
        for shard, (job, gpus) in list(self._running.items()):
            if job.done():
                del self._running[shard]
                self._free.append(gpus)
                if job.paths.result_pickle.exists():
                    self.succeeded.append(shard)
                else:
                    self.failed[shard] = _last_line(job.paths.stderr)
        while self._free and self._waiting and self.stopping is None:
            (shard, arguments), gpus = self._waiting.pop(0), self._free.pop(0)
            self._executor.update_parameters(timeout_min=FOREVER_MIN, gpus_per_node=len(gpus), visible_gpus=gpus)
            piece = Piece(arguments, os.getcwd(), grace_s=FOREVER_MIN, scheduled=False)
            before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C of the terminal is for this process alone
            try:
                self._running[shard] = self._executor.submit(piece), gpus
            finally:
                signal.signal(signal.SIGINT, before)

    def stop(self, number: int, frame: Any) -> None:
        """Tells all that run to save and stop; at a second Ctrl-C they stop at once. A handler of signals."""
        if self.stopping is None:
            self.stopping = number
            console.print("stopping: each piece saves after its stretch of steps (Ctrl-C again: at once)")
        elif number != signal.SIGINT:
            return
        for job, _ in self._running.values():
            job._process.send_signal(signal.SIGTERM)  # submitit's controller passes it on to the job


def run_locally(pieces: dict[Shard, tuple[str, ...]], out: Path, job: Job, progress: Callable[[], float]) -> None:
    """Runs the pieces as jobs of this machine and waits for them, with a progress bar on standard error.

    Args:
        pieces: the arguments of each piece's command.
        out: the sweep's folder.
        job: what each job gets.
        progress: how much of the whole sweep is done, from 0 to 1.

    Raises:
        JobsFailed: with the last line of each piece that failed, or was stopped.
    """
    folder = _new_folder(out)
    jobs = LocalJobs(pieces, folder, job)
    before = {number: signal.signal(number, jobs.stop) for number in signals.NUMBERS}
    try:
        with progress_bars(counted=False) as bars:
            bar = bars.add_task(f"{len(pieces)} pieces", total=1.0, note="")
            while True:
                jobs.poll()
                bars.update(bar, completed=progress(), note=jobs.note)
                if jobs.ended:
                    break
                time.sleep(POLL_S)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if jobs.failed or jobs.stopping is not None:
        lines = [f"piece {shard.index}/{shard.count}: {line}" for shard, line in sorted(jobs.failed.items())]
        ended = "stopped" if jobs.stopping is not None else f"error: {len(jobs.failed)} of {len(pieces)} pieces failed"
        told = "\n".join([*lines, f"{ended}; logs in {folder}; go on with the same command"])
        raise JobsFailed(told, 1 if jobs.stopping is None else 128 + jobs.stopping)


def _last_line(log: Path) -> str:
    """What a job told last."""
    lines = log.read_text(errors="replace").splitlines() if log.exists() else []
    told = [line.strip() for line in lines if line.strip()]
    return told[-1] if told else f"ended without a word; see {log}"
