"""Submit a sweep to Slurm, one job a piece; near its time limit a piece saves and goes back into the queue.

    python examples/slurm_sweep.py --pieces 16 --minutes 240 --gpus 1 --partition gpu \\
        billiards --preset paper --seeds 64 --labels 500 --out runs/paper

What follows the options is `cuelearner sweep`'s. Needs submitit (`pip install submitit`).
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
from pathlib import Path
from typing import Any


class Piece:
    """A piece of a sweep: a command that goes on from where it was stopped."""

    def __init__(self, sweep: list[str], index: int, pieces: int) -> None:
        # Slurm signals all processes of a job; the command shall hear SIGTERM alone, on which it saves and ends.
        hearing = ["env", "--ignore-signal=USR2"]
        self.command = [*hearing, "cuelearner", "sweep", *sweep, "--shard", f"{index}/{pieces}"]

    def __call__(self) -> None:
        """Run the command to its end."""
        process = subprocess.Popen(self.command)
        self.number = process.pid
        if status := process.wait():
            raise subprocess.CalledProcessError(status, self.command)

    def checkpoint(self) -> Any:
        """Let the command save and end; return the job that submitit starts in its place: the same again."""
        import submitit

        with contextlib.suppress(ChildProcessError, ProcessLookupError):  # it has ended by itself
            os.kill(self.number, signal.SIGTERM)
            os.waitid(os.P_PID, self.number, os.WEXITED | os.WNOWAIT)
        return submitit.helpers.DelayedSubmission(self)


def main() -> None:
    """Submit every piece as a job of one array."""
    import submitit

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for option, default in (("pieces", 8), ("minutes", 240), ("gpus", 0), ("cpus", 4)):
        parser.add_argument(f"--{option}", type=int, default=default)
    parser.add_argument("--partition")
    asked, sweep = parser.parse_known_args()
    executor = submitit.SlurmExecutor(Path(sweep[sweep.index("--out") + 1]) / "jobs", max_num_timeout=100)
    more = {"gpus_per_node": asked.gpus or None, "partition": asked.partition}
    executor.update_parameters(
        time=asked.minutes,
        cpus_per_task=asked.cpus,
        signal_delay_s=180,  # the time to save: longer than between two evaluations
        array_parallelism=asked.pieces,
        additional_parameters={"requeue": True},
        **{name: value for name, value in more.items() if value},
    )
    jobs = executor.submit_array([Piece(sweep, index + 1, asked.pieces) for index in range(asked.pieces)])
    print(f"submitted {len(jobs)} jobs: {jobs[0].job_id}, ...")


if __name__ == "__main__":
    main()
