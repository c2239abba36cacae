"""The command `cuelearner`: reads arguments, calls one function, turns errors into one line and an exit status.

Exit status: 0 done; 2 bad input, nothing changed; 130 stopped by Ctrl-C, everything saved;
1 the disk is full or a job failed, everything up to the last checkpoint saved; 141 nobody reads the output any more.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean

# Before JAX starts: warnings of its start-up are not the user's.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

import jax
from rich.console import Console
from rich.table import Table

from cuelearner_jax.bench import known_machines as machines
from cuelearner_jax.bench import measuring as bench
from cuelearner_jax.brax_bridge import walking as locomotion
from cuelearner_jax.cli.arguments import ABOUT, parse, preset_of, subject_of, task_of
from cuelearner_jax.cli.options import (
    Bench,
    BenchTask,
    Common,
    Evaluate,
    LocomotionEvaluate,
    LocomotionTrain,
    Render,
    Report,
    Sweep,
    TeacherTrain,
    Train,
)
from cuelearner_jax.errors import UserError, closest, no_space
from cuelearner_jax.evaluate import episodes
from cuelearner_jax.runs import cluster, sweep
from cuelearner_jax.runs import grid as runs
from cuelearner_jax.runs import trained as play
from cuelearner_jax.runs.order import Order, planned
from cuelearner_jax.runs.shards import Shard
from cuelearner_jax.tasks.registry import TASKS, Task, anymal_walker
from cuelearner_jax.teachers import training as teaching
from cuelearner_jax.terminal import Interrupted

out = Console(highlight=False, soft_wrap=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point. Returns the exit status."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        return _dispatch(arguments)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (Interrupted, cluster.JobsFailed) as error:
        print(str(error), file=sys.stderr)
        return error.status
    except BrokenPipeError:  # whoever read our output has gone, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except Exception as error:
        if not no_space(error):
            raise
        print("error: the disk is full: free some, then go on with the same command and --resume", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("stopped at once; what the last checkpoint holds is safe, go on with --resume", file=sys.stderr)
        return 130


def _dispatch(arguments: list[str]) -> int:
    commands: dict[str, Callable[[list[str]], None]] = {
        "train": _train,
        "sweep": _sweep,
        "evaluate": _evaluate,
        "report": _report,
        "render": _render,
        "teacher": _teacher,
        "bench": _bench,
        "locomotion": _locomotion,
    }
    if not arguments or arguments[0] in ("-h", "--help"):
        _overview()
        return 0 if arguments else 2
    command = arguments[0]
    if command not in commands:
        raise UserError(f"unknown command {command!r}{closest(command, commands)}; see cuelearner --help")
    commands[command](arguments[1:])
    return 0


def _overview() -> None:
    print("usage: cuelearner COMMAND ...\n\nLearning from relative feedback with off-policy deep RL.\n\ncommands:")
    for name, about in ABOUT.items():
        print(f"  {name:<10}{about}")
    print(f"\ntasks: {', '.join(TASKS)}. Each command has --help, for instance: cuelearner sweep billiards --help")


def _train(arguments: list[str]) -> None:
    task, rest = task_of(arguments, "train")
    name, rest = preset_of(task, rest)
    preset = task.presets[name]
    kind = Train[task.config]  # pyright: ignore[reportInvalidTypeArguments]
    default = kind(preset.config, out=Path("runs") / f"{task.name}-{name}", labels=preset.labels[0])
    asked = parse(kind, rest, f"train {task.name}", default)
    grid = runs.Grid((asked.guidance,), (asked.seed,), (asked.labels,))
    _run(task, asked, grid)


def _sweep(arguments: list[str]) -> None:
    task, rest = task_of(arguments, "sweep")
    name, rest = preset_of(task, rest)
    preset = task.presets[name]
    kind = Sweep[task.config]  # pyright: ignore[reportInvalidTypeArguments]
    folder = Path("runs") / f"{task.name}-{name}"
    default = kind(
        preset.config,
        out=folder,
        guidance=preset.guidance,
        labels=preset.labels,
        seeds=preset.seeds,
        first_seed=preset.first_seed,
    )
    asked = parse(kind, rest, f"sweep {task.name}", default)
    seeds = tuple(range(asked.first_seed, asked.first_seed + asked.seeds))
    grid = runs.Grid(asked.guidance, seeds, asked.labels)
    if asked.cluster:
        _submit(task, asked, grid, arguments)
        return
    if asked.shards is not None or asked.job != cluster.Job():
        raise UserError("--shards and --job belong to --cluster: give --cluster slurm or local, or --shard i/n alone")
    shard = Shard.parse(asked.shard) if asked.shard else None
    _run(task, asked, grid, shard)


def _submit(task: Task, asked: Sweep, grid: runs.Grid, arguments: list[str]) -> None:
    """Every piece of a sweep that is not finished, as a job."""
    if asked.shard:
        raise UserError("--shard runs one piece here, --cluster all of them as jobs: give one of the two")
    if asked.shards is None or asked.shards < 1:
        raise UserError(f"--cluster needs --shards of at least 1, the number of jobs; it is {asked.shards}")
    if asked.overwrite:
        raise UserError(
            f"--overwrite with --cluster: a job that starts again would delete its own work; delete {asked.out} by "
            "hand, or give another --out"
        )
    cluster.check(asked.cluster or "", asked.job)
    jax.config.update("jax_platforms", "cpu")  # the accelerator's memory is for the jobs
    shards = [Shard(index, asked.shards) for index in range(1, asked.shards + 1)]
    split = "tuning" if asked.tuning else "validation"
    plans = {
        shard: planned(Order(task, asked.run, grid, asked.out, labels_from=asked.labels_from, shard=shard, split=split))
        for shard in shards
    }
    pieces = {s: cluster.piece_arguments(arguments, s) for s, plan in plans.items() if not plan.finished}
    if len(pieces) < len(plans):
        out.print(f"{len(plans) - len(pieces)} of {len(plans)} pieces were finished before")
    told = f"cuelearner report {asked.out} --out {asked.out}/report"
    if pieces and asked.cluster == "slurm":
        number, logs = cluster.submit_to_slurm(pieces, asked.out, asked.job)
        out.print(
            f"submitted {len(pieces)} jobs as {number}; logs in {logs}\n"
            f"how they stand: squeue --job {number}\nwhat there is and what is missing: {told}\n"
            f"stop them: scancel {number}; the same command again goes on with what is not finished"
        )
        return
    if pieces:
        cluster.run_locally(pieces, asked.out, asked.job, lambda: fmean(plan.done for plan in plans.values()))
    out.print(f"done: {asked.out} (see it with: {told})")


def _run(task: Task, asked: Common, grid: runs.Grid, shard: Shard | None = None) -> None:
    sweep.run(
        Order(
            task,
            asked.run,
            grid,
            asked.out,
            resume=asked.resume,
            overwrite=asked.overwrite,
            labels_from=asked.labels_from,
            shard=shard,
            split="tuning" if asked.tuning else "validation",
        )
    )
    out.print(f"done: {asked.out} (see it with: cuelearner report {asked.out} --out {asked.out}/report)")


def _evaluate(arguments: list[str]) -> None:
    subject, rest = subject_of(arguments, "evaluate")
    kind = Evaluate[subject.task.config]  # pyright: ignore[reportInvalidTypeArguments]
    default = kind(subject.config.task, policy="agent" if subject.grid else "heuristic")
    asked = parse(kind, rest, f"evaluate {subject.folder}", default)
    own, subject = subject, subject.on(asked.robot)
    engine = own.engine(asked.robot, asked.engine)
    subject.check(asked.policy, asked.task)
    if asked.steps < 1 or asked.envs < 1 or asked.steps % asked.envs:
        raise UserError(f"--steps is {asked.steps}: give a positive multiple of --envs ({asked.envs})")
    if asked.out and asked.out.exists():
        raise UserError(f"{asked.out} exists: give another --out")
    measured = play.evaluate(subject, asked.task, asked.policy, asked.guidance, asked.envs, asked.steps, engine)
    body = {name: value for name, value in (("robot", asked.robot), ("engine", asked.engine)) if value}
    out.print(_measurements(measured, ", ".join([asked.policy, *body.values(), f"{asked.steps} steps a lane"])))
    if asked.out:
        play.write(asked.out, subject, asked.task, asked.policy, asked.envs, asked.steps, measured, body)
        out.print(f"wrote {asked.out}")


def _measurements(measured: list[play.Measured], title: str) -> Table:
    """Interquartile means over seeds with their intervals, a row for each guidance and budget."""
    from cuelearner_jax.report.statistics import interval

    table = Table("guidance", "labels", "seeds", "steps", "metric", "mean", "95% interval", title=title)
    for column in table.columns:
        column.no_wrap = True
    for row in measured:
        own = [row.guidance, str(row.labels), str(len(row.seeds)), str(row.step)]
        for name, values in row.metrics.items():
            found = interval(values)
            spread = f"{float(found.lower):.3f} to {float(found.upper):.3f}" if len(values) > 1 else ""
            table.add_row(*own, name, f"{float(found.estimate):.3f}", spread)
            own = [""] * len(own)
        table.add_section()
    return table


def _report(arguments: list[str]) -> None:
    from cuelearner_jax.report.document import report  # it loads what draws, which other commands need not wait for

    asked = parse(Report, arguments, "report")
    command = shlex.join(["cuelearner", "report", *arguments])
    written = report(
        asked.folders,
        asked.out,
        asked.metric,
        split=asked.split,
        lower_is_better=asked.lower_is_better,
        overwrite=asked.overwrite,
        command=command,
    )
    out.print(f"wrote {written}")


def _render(arguments: list[str]) -> None:
    subject, rest = subject_of(arguments, "render")
    kind = Render[subject.task.config]  # pyright: ignore[reportInvalidTypeArguments]
    default = kind(subject.config.task, Path("pictures"), policy="agent" if subject.grid else "heuristic")
    asked = parse(kind, rest, f"render {subject.folder}", default)
    subject = subject.on(asked.robot)
    subject.check(asked.policy, asked.task)
    if asked.film not in ("gif", "mp4"):
        raise UserError(f"--film is {asked.film!r}: choose gif or mp4")
    if asked.steps < 1:
        raise UserError(f"--steps is {asked.steps}: give a positive number")
    name = "-".join([subject.folder.name, *([asked.robot] if asked.robot else []), asked.policy])
    film, still = (asked.out / f"{name}{end}" for end in (f".{asked.film}", ".png"))
    taken = [str(file) for file in (film, still) if file.exists()]
    if taken and not asked.overwrite:
        raise UserError(f"{taken[0]} exists: give --overwrite to replace it, or another --out")
    env = subject.task.environment(asked.task, "validation")
    policy = play.one_policy(subject, env, asked.task, asked.policy, asked.guidance, asked.labels, asked.seed)
    key = jax.random.fold_in(episodes(), asked.episode)
    frames, rewards = subject.task.record(env, policy, key, asked.steps)
    asked.out.mkdir(parents=True, exist_ok=True)
    subject.task.still(env, frames, still)
    subject.task.animate(env, frames, film)
    out.print(f"rewards {' '.join(f'{reward:g}' for reward in rewards)}; wrote {film} and {still}")


def _teacher(arguments: list[str]) -> None:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(f"usage: cuelearner teacher train TASK [OPTIONS]\n\n{ABOUT['teacher']}")
        raise SystemExit(0 if arguments else 2)
    if arguments[0] != "train":
        raise UserError(f"unknown command 'teacher {arguments[0]}': it is cuelearner teacher train TASK")
    task, rest = task_of(arguments[1:], "teacher train")
    kind = TeacherTrain[task.config]  # pyright: ignore[reportInvalidTypeArguments]
    name, rest = preset_of(task, rest)
    default = kind(task.presets[name].config.task, Path("runs") / f"{task.name}-teacher")
    asked = parse(kind, rest, f"teacher train {task.name}", default)
    command = shlex.join(["cuelearner", "teacher", *arguments])
    reward = teaching.train(
        task, asked.task, asked.teacher, asked.out, asked.seed, asked.eval_steps, command, asked.resume
    )
    out.print(f"reward a step over {asked.eval_steps} validation steps: {reward:.4f}; wrote {asked.out}")


def _bench(arguments: list[str]) -> None:
    if arguments and not arguments[0].startswith("-"):
        task, rest = task_of(arguments, "bench")
        name, rest = preset_of(task, rest)
        kind = BenchTask[task.config]  # pyright: ignore[reportInvalidTypeArguments]
        asked = parse(kind, rest, f"bench {task.name}", kind(task.presets[name].config))
        works = [bench.Work(task, name, asked.run)]
    else:
        asked = parse(Bench, arguments, "bench")
        if asked.add:
            machines.add(asked.add)
            out.print(f"{machines.TABLE.name} holds {asked.add} now")
            return
        name = "paper" if asked.full else "quickstart"
        works = [bench.Work(task, name, task.presets[name].config) for task in TASKS.values() if name in task.presets]
    known = machines.read()
    entry = bench.run(works, asked.measuring, shlex.join(["cuelearner", "bench", *_without_out(arguments)]))
    out.print(machines.figures(entry["rows"]), machines.beside(entry, known), sep="\n\n", markup=False)
    if asked.measuring.out:
        out.print(f"wrote {asked.measuring.out}")


def _without_out(arguments: list[str]) -> list[str]:
    """Arguments less --out and its path, which change no figure."""
    given = [
        not (a.startswith("--out=") or "--out" in arguments[max(i - 1, 0) : i + 1]) for i, a in enumerate(arguments)
    ]
    return [argument for argument, keep in zip(arguments, given, strict=True) if keep]


def _locomotion(arguments: list[str]) -> None:
    kinds = {"train": LocomotionTrain, "evaluate": LocomotionEvaluate}
    if not arguments or arguments[0] in ("-h", "--help"):
        print(f"usage: cuelearner locomotion {'|'.join(kinds)} [OPTIONS]\n\n{ABOUT['locomotion']}")
        raise SystemExit(0 if arguments else 2)
    if arguments[0] not in kinds:
        raise UserError(f"unknown command 'locomotion {arguments[0]}'{closest(arguments[0], kinds)}")
    asked = parse(kinds[arguments[0]], arguments[1:], f"locomotion {arguments[0]}")
    command = shlex.join(["cuelearner", "locomotion", *arguments])
    if isinstance(asked, LocomotionTrain):
        locomotion.check(asked.train)
        locomotion.train(anymal_walker(), asked.train, asked.out, asked.seed, command, out.print)
    else:
        locomotion.evaluate(anymal_walker(), asked.policy, asked.robots, asked.seed, command, asked.out, out.print)
    if asked.out:
        out.print(f"wrote {asked.out}")
