"""`cuelearner labels inspect` and `merge`."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

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
    task: str | None = None
    """Task of your own whose teacher is asked, as package.module:NAME."""

    def run(self) -> None:
        """Print a table with a column a file."""
        files = [comparing.read_checked(path) for path in self.files]
        table = Table("", *(one_line(str(path)) for path in self.files))
        columns = [_facts(file) for file in files]
        if self.teacher:
            for path, file, facts in zip(self.files, files, columns, strict=True):
                facts["agrees with the teacher"] = _with_teacher(path, file, self.task)
        for name in dict.fromkeys(name for facts in columns for name in facts):
            table.add_row(name, *(one_line(facts.get(name, "")) for facts in columns))
        if len(files) == 2:
            try:
                table.add_row("agree with each other", str(comparing.between(*files)))
            except UserError as error:
                table.add_row("agree with each other", f"not compared: {error}")
        out.print_table(table)


@dataclass(frozen=True)
class Merge:
    """Merge the labels of several people or sittings into one file."""

    files: Files
    """Label files of one world, or folders of label files."""
    out: Path | None = None
    """New file, .parquet; an existing file is not replaced."""

    def run(self) -> None:
        """Write the file. Raises UserError for files that do not fit together."""
        if self.out is None or self.out.suffix != ".parquet":
            raise UserError("merge needs --out: give it a name that ends in .parquet")
        files = [comparing.read_checked(path) for path in self.files]
        name = str(files[0].task.get("name"))
        file, left_out = comparing.merge(files, registry.find(name).labels_hold if name in registry.names() else ())
        sources = [f"{path.name} {label_files.digest(path)}" for path in self.files]
        label_files.write_file(self.out, file, merged_from=sources)
        twice = f"; {left_out} duplicates of an earlier file's labels were left out" if left_out else ""
        if file.people is None and any(one.people for one in files):
            twice += "; without names and times, which not all files have"
        out.print(f"wrote {len(file.seeds)} labels of {len(self.files)} files to {self.out}{twice}")


Labels = Annotated[Inspect, tyro.conf.subcommand("inspect")] | Annotated[Merge, tyro.conf.subcommand("merge")]


def run(arguments: list[str]) -> None:
    """Run one of the commands. Raises UserError for invalid files, or files that do not fit together."""
    options = parse(Labels, arguments, "labels")
    if not options.files:
        raise UserError(f"name a label file: cuelearner labels {arguments[0]} FILE")
    options.run()


def _facts(file: LabelFile) -> dict[str, str]:
    own = {name: value for name, value in file.task.items() if name not in ("name", "from")}
    world = ", ".join(f"{name} {value}" for name, value in own.items() if not isinstance(value, dict | list))
    strength = "" if file.eps is None else f", by {file.eps:g} {file.space.unit}"
    facts = {"task": f"{file.task.get('name')} ({world})", "answers": f"{file.answers}{strength}"}
    several = f" of {seeds} seeds" if (seeds := len(np.unique(file.seeds))) > 1 else ""
    facts["labels"] = f"{len(file.seeds)}{several}"
    form = comparing.form_of(file)
    if form is not None and form.values is not None:
        counts = Counter(form.choice(np.asarray(file.labels.answer)).ravel().tolist())
        names = {UNSAID: "not said"} if form.by_eps else {}
        values = form.values(file.space)
        facts["of each answer"] = ", ".join(f"{names.get(one, f'{one:g}')}: {counts.get(one, 0)}" for one in values)
    if file.counts and file.session:  # a merged file holds what stands alone
        facts |= {"not known": str(file.counts.get(UNSURE, 0)), "taken back": str(file.counts.get(UNDONE, 0))}
    if file.session:
        of = file.session.get
        facts |= {"actions of": f"{of('base') or ''} {of('base_digest') or ''}".strip()}
        facts |= {"fitted meanwhile": str(of("guidance")), "seed": str(of("seed"))}
    if file.people is not None:
        seconds = np.asarray(file.people.seconds, float)
        pace = f"{60 * len(seconds) / file.seconds:.1f}" if file.session and file.seconds > 0 else ""
        facts |= {
            "by": ", ".join(f"{who} ({count})" for who, count in Counter(file.people.who.tolist()).items()),
            "given": f"{min(file.people.when)} to {max(file.people.when)}",
            "seconds a label": f"{np.median(seconds):.2f} median, {np.quantile(seconds, 0.9):.2f} for nine of ten",
            "labels a minute": pace,
        }
    return facts


def _with_teacher(path: Path, file: LabelFile, own: str | None) -> str:
    """Return how often the answers are those of the task's teacher. Raises UserError where no page asked them."""
    task = registry.resolve(own) if own else registry.find(str(file.task.get("name")))  # no file's code is loaded
    place = label_files.found_in(path)
    assert place is not None  # the file was read before
    scalars = next((preset.config.scalars for preset in task.presets.values()), Scalars())
    rows = label_files.history(place)
    return str(comparing.with_teacher(task, file, rows, scalars, lambda words: console.print(f"{words} ...")))
