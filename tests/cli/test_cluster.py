"""Sweeps as jobs of a Slurm whose commands write down what they are asked."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from small_runs import SMALL, rows

from cuelearner_jax.cli import main
from cuelearner_jax.runs import cluster
from cuelearner_jax.runs.shards import Shard

ENTRY = [str(Path(sys.executable).with_name("cuelearner"))]
SWEEP = ["sweep", "billiards", "--preset", "quickstart", *SMALL, "--schedule.total-steps", "800", "--guidance", "none"]
SWEEP += ["--seeds", "2", "--first-seed", "7"]
SLURM = [*SWEEP, "--cluster", "slurm", "--shards", "2"]

SBATCH = """#!/bin/sh
cp "$1" "$FAKE_SLURM/script.sh"
echo "Submitted batch job 77"
"""
REFUSING = """#!/bin/sh
echo "sbatch: error: invalid partition specified: gpus" >&2
exit 1
"""
SRUN = """#!/bin/sh
echo $$ > "$FAKE_SLURM/pid"
while true; do case "$1" in --output|--error) shift 2;; --*) shift;; *) break;; esac; done
exec "$@"
"""
SCONTROL = """#!/bin/sh
echo "$@" >> "$FAKE_SLURM/asked"
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "run"
    assert main([*SWEEP, "--out", str(folder)]) == 0
    return rows(folder)


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """Stand-ins for Slurm's commands; `sbatch` and `scontrol` leave what they are given in this folder."""
    folder = tmp_path / "slurm"
    folder.mkdir()
    for name, script in (("sbatch", SBATCH), ("srun", SRUN), ("scontrol", SCONTROL)):
        (folder / name).write_text(script)
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_SLURM", str(folder))
    return folder


def until(found, process=None):
    for _ in range(3600):  # three minutes, for machines that are busy with something else
        if found():
            return
        assert process is None or process.poll() is None, process.communicate()
        time.sleep(0.05)
    raise AssertionError("waited for nothing")


def begun(out, shard, step=200):
    file = out / f"shard-{shard}-of-2" / "none" / "results.jsonl"
    return file.exists() and f'"step": {step}' in file.read_text()


@pytest.mark.long
def test_slurm_gets_an_array_and_a_job_told_to_end_goes_on_when_started_again(whole, slurm, tmp_path, capsys):
    out = tmp_path / "run"
    options = "--job.partition gpus --job.account lab --job.gpus 1 --job.cpus 8 --job.memory-gb 1.5 --job.minutes 90"
    options += " --job.at-once 1 --job.slurm qos=high gres=disk:1 --job.notice-s 240"
    assert main([*SLURM, *options.split(), "--job.setup", "module load cuda", "--out", str(out)]) == 0
    told = capsys.readouterr().out
    assert "submitted 2 jobs as 77" in told
    assert f"cuelearner report {out}" in told
    script = (slurm / "script.sh").read_text()
    for line in ("array=0-1%1", "partition=gpus", "account=lab", "gpus-per-node=1", "cpus-per-task=8", "mem=1536M"):
        assert f"#SBATCH --{line}\n" in script
    for line in ("time=90", "qos=high", "gres=disk:1", "signal=USR2@240", "requeue", "job-name=cuelearner-run"):
        assert f"#SBATCH --{line}\n" in script
    assert script.index("\nmodule load cuda\n") < script.index("\nsrun ")
    assert f"-m submitit.core._submit {out}/jobs/" in script

    own = {"SLURM_JOB_ID": "77", "SLURM_ARRAY_JOB_ID": "77", "SLURM_ARRAY_TASK_ID": "1", "SLURM_PROCID": "0"}
    start = ["bash", "-c", "module() { :; }; . " + str(slurm / "script.sh")]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    job = subprocess.Popen(start, env={**os.environ, **own}, **streams)
    until(lambda: begun(out, 2), job)
    waiting = int((slurm / "pid").read_text())
    os.kill(waiting, signal.SIGTERM)  # as in preemption: it saves, and leaves what follows to Slurm
    time.sleep(1.5)
    assert job.poll() is None
    os.kill(waiting, signal.SIGUSR2)
    told = job.communicate(timeout=60)[0]
    assert "stopped at step" in told
    assert (slurm / "asked").read_text() == "requeue 77_1\n"
    assert not (out / "shard-2-of-2" / "none" / "results.parquet").exists()
    done = subprocess.run(start, env={**os.environ, **own}, **streams, check=False)
    assert done.returncode == 0, done.stdout
    assert rows(out) == [row for row in whole if row["seed"] == 8]


REFUSED = [
    ([*SLURM, "--shard", "1/2"], "give one of the two"),
    ([*SLURM, "--overwrite"], "would delete its own work"),
    ([*SWEEP, "--cluster", "slurm"], "--shards of at least 1"),
    ([*SWEEP, "--cluster", "slurm", "--shards", "0"], "it is 0"),
    ([*SWEEP, "--cluster", "slurm", "--shards", "3"], "2 seeds cannot be divided into 3 shards"),
    ([*SWEEP, "--cluster", "lsf", "--shards", "2"], "'slurm'"),
    ([*SWEEP, "--shards", "2"], "belong to --cluster"),
    ([*SWEEP, "--job.gpus", "2"], "belong to --cluster"),
    ([*SLURM, "--job.at-once", "-1"], "--job.at-once is -1"),
    ([*SLURM, "--scalars.eps-deg", "0"], "scalars.eps_deg is 0"),
    ([*SLURM, "--job.slurm", "qos"], "give KEY=VALUE"),
    ([*SLURM, "--job.slurm", "array=0-9"], "cannot set 'array'"),
    ([*SLURM, "--job.minutes", "2"], "give less than the 120 s"),
    (SLURM, "srun is not installed here"),
]


@pytest.mark.parametrize(("command", "says"), REFUSED, ids=[" ".join(c[-3:]) for c, _ in REFUSED])
def test_what_cannot_be_submitted_is_refused(refused, tmp_path, monkeypatch, command, says):
    monkeypatch.setenv("PATH", str(tmp_path))  # no Slurm
    refused([*command, "--out", tmp_path / "run"], says, tmp_path)
    assert not (tmp_path / "run").exists()


def test_without_submitit_the_extra_is_named(refused, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "submitit", None)
    refused([*SLURM, "--out", tmp_path / "run"], "install the extra `cluster`", tmp_path)
    assert not (tmp_path / "run").exists()


def test_what_slurm_refuses_leaves_nothing_behind(refused, slurm, tmp_path):
    (slurm / "sbatch").write_text(REFUSING)
    refused([*SLURM, "--out", tmp_path / "run"], "invalid partition specified: gpus", tmp_path)
    assert not (tmp_path / "run").exists()


def test_a_folder_of_another_cut_is_refused(refused, tmp_path):
    (tmp_path / "run" / "shard-1-of-3").mkdir(parents=True)
    refused([*SLURM, "--out", tmp_path / "run"], "shard-1-of-3 is a shard of another division", tmp_path)
    (tmp_path / "whole").mkdir()
    (tmp_path / "whole" / "config.json").write_text("{}")
    refused([*SLURM, "--out", tmp_path / "whole"], "not cut into shards", tmp_path)


def test_a_piece_gets_the_sweeps_options_alone():
    given = ["billiards", "--cluster=slurm", "--seeds", "4", "--job.slurm", "qos=a", "b=c", "--shards", "2", "--resume"]
    given += ["--labels", "10", "20", "--job.at-once=1", "--out", "runs/a"]
    kept = ("sweep", "billiards", "--seeds", "4", "--labels", "10", "20", "--out", "runs/a", "--shard", "2/2")
    assert cluster.piece_arguments(given, Shard(2, 2)) == kept
