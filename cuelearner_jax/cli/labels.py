"""`cuelearner labels inspect`, `merge` and `export`."""

from __future__ import annotations

import csv
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.table import Table

from cuelearner_jax.cli.options import Flag, out, parse
from cuelearner_jax.config import Scalars
from cuelearner_jax.errors import UserError, one_line
from cuelearner_jax.labelling import comparing
from cuelearner_jax.spaces import UNSAID
from cuelearner_jax.storage import label_files
from cuelearner_jax.storage.label_files import UNDONE, UNSURE, LabelFile
from cuelearner_jax.storage.whole import replacing
from cuelearner_jax.task import Task, shape_of
from cuelearner_jax.tasks import registry
from cuelearner_jax.terminal import console

Files = Annotated[tuple[Path, ...], tyro.conf.Positional]


@dataclass(frozen=True)
class Inspect:
    """Summarise label files: counts, pace, agreement."""

    files: Files
    """Label files, or folders of label files. Two files are also compared on the questions that both answered."""
    teacher: Flag[bool] = False
    """Also ask the task's teacher a page's questions (takes a while, since all situations are replayed)."""


@dataclass(frozen=True)
class Merge:
    """Merge the labels of several people or sittings into one file."""

    files: Files
    """Label files of one world, or folders of label files."""
    out: Path | None = None
    """New file, .parquet; an existing file is not replaced."""


@dataclass(frozen=True)
class LabelsExport:
    """Labels as a table: a row a label; in CSV a column a number, in Parquet lists."""

    files: Files
    """One label file, or the folder of one."""
    out: Path | None = None
    """New file, .csv or .parquet; an existing file is not replaced."""


Labels = (
    Annotated[Inspect, tyro.conf.subcommand("inspect")]
    | Annotated[Merge, tyro.conf.subcommand("merge")]
    | Annotated[LabelsExport, tyro.conf.subcommand("export")]
)


def run(arguments: list[str]) -> None:
    """Run one of the commands. Raises UserError for invalid files, or files that do not fit together."""
    options = parse(Labels, arguments, "labels")
    if not options.files:
        raise UserError(f"name a label file: cuelearner labels {arguments[0]} FILE")
    {Inspect: _inspect, Merge: _merge, LabelsExport: _export}[type(options)](options)


# --- inspect ---------------------------------------------------------------------------------------------------------


def _inspect(options: Inspect) -> None:
    files = [comparing.read_checked(path) for path in options.files]
    table = Table("", *(one_line(str(path)) for path in options.files))
    told = [_told(path, file, options.teacher) for path, file in zip(options.files, files, strict=True)]
    for name in dict.fromkeys(name for one in told for name in one):
        table.add_row(name, *(one_line(one.get(name, "")) for one in told))
    if len(files) == 2:
        table.add_row("agree with each other", str(comparing.between(files[0], files[1], _shape(files[0]))))
    out.print(table)


def _told(path: Path, file: LabelFile, teacher: bool) -> dict[str, str]:
    """Return the facts about a label file, by name."""
    world = ", ".join(f"{name} {value}" for name, value in file.task.items() if name not in ("name", "from"))
    strength = "" if file.eps is None else f", by {file.eps:g} {file.space.unit}"
    facts = {"task": f"{file.task.get('name')} ({world})", "answers": f"{file.answers}{strength}"}
    facts["labels"] = f"{len(file.seeds)}" + (
        f" of {len(np.unique(file.seeds))} seeds" if len(np.unique(file.seeds)) > 1 else ""
    )
    form = comparing.form_of(file)
    if form is not None and form.values is not None:
        counts = Counter(np.asarray(file.labels.answer).ravel().tolist())
        names = {UNSAID: "not said"} if form.by_eps else {}
        values = form.values(file.space)
        facts["of each answer"] = ", ".join(f"{names.get(one, f'{one:g}')}: {counts.get(one, 0)}" for one in values)
    if file.said:
        facts["not known"], facts["taken back"] = (str(file.said.get(name, 0)) for name in (UNSURE, UNDONE))
    if file.session:
        base = " ".join(str(file.session[name]) for name in ("base", "base_digest") if file.session.get(name))
        facts |= {
            "actions of": base,
            "fitted meanwhile": str(file.session.get("guidance")),
            "seed": f"{file.session['seed']}",
        }
    if file.people is not None:
        facts |= _pace(file.people)
    if teacher:
        facts["agrees with the teacher"] = str(_with_teacher(path, file))
    return facts


def _pace(people: label_files.People) -> dict[str, str]:
    seconds = np.asarray(people.seconds, float)
    total = seconds.sum()
    counts = Counter(people.who.tolist())
    return {
        "by": ", ".join(f"{who} ({count})" for who, count in counts.items()),
        "given": f"{min(people.when)} to {max(people.when)}",
        "seconds a label": f"{np.median(seconds):.2f} median, {np.quantile(seconds, 0.9):.2f} for nine of ten",
        "labels a minute": f"{60 * len(seconds) / total:.1f}" if total > 0 else "",
    }


def _task(file: LabelFile) -> Task:
    return registry.find(str(file.task.get("name")))


def _shape(file: LabelFile) -> Any:
    task = _task(file)
    return shape_of(task, comparing.world_of(task, file))


def _with_teacher(path: Path, file: LabelFile) -> comparing.Agreement:
    task = _task(file)
    found = label_files.found_in(path)
    assert found is not None  # the file was read above
    presets = [preset.config.scalars for preset in task.presets.values()]
    scalars, rows = presets[0] if presets else Scalars(), label_files.history(found)
    return comparing.with_teacher(task, file, rows, scalars, lambda words: console.print(f"{words} ..."))


# --- merge and export ------------------------------------------------------------------------------------------------


def _merge(options: Merge) -> None:
    if options.out is None or options.out.suffix != ".parquet":
        raise UserError("merge needs --out: give it a name that ends in .parquet")
    file, left_out = comparing.merge([comparing.read_checked(path) for path in options.files])
    sources = [f"{path.name} {label_files.digest(path)}" for path in options.files]
    label_files.write_file(options.out, file, merged_from=sources)
    twice = f"; {left_out} duplicates of an earlier file's labels were left out" if left_out else ""
    out.print(f"wrote {len(file.seeds)} labels of {len(options.files)} files to {options.out}{twice}")


def _export(options: LabelsExport) -> None:
    if len(options.files) != 1:
        raise UserError("export takes one label file: first join several by `cuelearner labels merge`")
    place = options.out
    if place is None or place.suffix not in (".csv", ".parquet"):
        raise UserError("export needs --out: give it a name that ends in .csv or .parquet")
    file = comparing.read_checked(options.files[0])
    if place.suffix == ".parquet":
        label_files.write_file(place, file)
    else:
        rows = _flat(file)
        with replacing(place, fresh=True) as target:
            writer = csv.writer(target)
            writer.writerow(rows)
            writer.writerows(zip(*rows.values(), strict=True))
    out.print(f"wrote {len(file.seeds)} labels to {place}")


def _flat(file: LabelFile) -> dict[str, list[Any]]:
    """Return the labels as columns of plain numbers and words."""
    columns: dict[str, list[Any]] = {"seed": file.seeds.tolist()}
    if file.people is not None:
        columns |= {name: getattr(file.people, name).tolist() for name in file.people._fields}
    columns["eps"] = [file.eps] * len(file.seeds)
    layout = (file.session or {}).get("observation") or []
    names = [f"{part['name']}[{i}]" for part in layout for i in range(part["size"])]
    width = file.labels.obs.shape[1]
    named = {"action": None, "answer": None, "obs": names if len(names) == width else None}
    for kind, given in named.items():
        values = np.asarray(getattr(file.labels, kind))
        for place in range(values.shape[1]):
            columns[f"obs: {given[place]}" if given else f"{kind}[{place}]"] = values[:, place].tolist()
    return columns
