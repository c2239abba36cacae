"""Messages: text of the user's is no markup, and nobody has to read them."""

import io
import sys

from rich.table import Table

from cuelearner_jax.cli.parsing import out
from cuelearner_jax.terminal import console, progress_bars

TEXT = "runs/br[/x]/[red]r:smile:"


def test_what_looks_like_markup_is_printed_as_it_is(capsys):
    console.print(f"wrote {TEXT}")
    out.print(f"wrote {TEXT}")
    told = capsys.readouterr()
    assert told.out == told.err == f"wrote {TEXT}\n"
    table = Table(TEXT, title=TEXT)
    table.add_row(TEXT)
    out.print(table)
    assert capsys.readouterr().out.count(TEXT) == 3
    with progress_bars() as bars:
        bars.add_task(TEXT, total=1, note="[/bold]")
    told = capsys.readouterr().err
    assert TEXT in told
    assert "[/bold]" in told


def test_work_goes_on_where_nobody_reads_its_messages(monkeypatch):
    class Gone(io.StringIO):
        def write(self, text):
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stderr", Gone())
    console.print("told to nobody")
    with progress_bars() as bars:
        bars.add_task("work", total=1, note="")
