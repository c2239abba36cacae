"""Messages: text of the user's is no markup, and nobody has to read them."""

import io
import sys
import time

from rich.table import Table

from cuelearner_jax import terminal
from cuelearner_jax.cli.options import out
from cuelearner_jax.terminal import TimedProgress, console, progress_bars

TEXT = "runs/br[/x]/[red]r:smile:"


def test_what_looks_like_markup_is_printed_as_it_is(capsys, monkeypatch):
    monkeypatch.setattr(terminal, "FIRST", 0.0)
    console.print(f"wrote {TEXT}")
    out.print(f"wrote {TEXT}")
    told = capsys.readouterr()
    assert told.out == told.err == f"wrote {TEXT}\n"
    table = Table(*[TEXT] * 6, title=TEXT)
    table.add_row(*[TEXT] * 6)
    out.print_table(table)
    assert [line.count(TEXT) for line in capsys.readouterr().out.splitlines()] == [1, 6, 6]  # a row a line
    with progress_bars() as bars:
        bars.update(work := bars.add_task(TEXT, total=1, note="[/bold]"), completed=1)
        bars.update(work, completed=1)  # no step since
    told = capsys.readouterr().err
    assert told.startswith(f"{TEXT}, 1 of 1, [/bold]; after 0 s")


def test_work_goes_on_where_nobody_reads_its_messages(monkeypatch):
    class Gone(io.StringIO):
        def write(self, text):
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stderr", Gone())
    console.print("told to nobody")
    with progress_bars() as bars:
        bars.add_task("work", total=1, note="")


def test_progress_that_is_piped_is_lines_few_and_without_carriage_returns(capsys, monkeypatch):
    monkeypatch.setattr(terminal, "FIRST", 0.02)
    monkeypatch.setattr(terminal, "EVERY", 0.2)
    started = time.monotonic()
    with progress_bars() as bars:
        work = bars.add_task("work", total=1000, note="")
        while time.monotonic() - started < 0.5:
            bars.update(work, advance=1, note=f"reward {bars.tasks[0].completed:g}")
    told = capsys.readouterr().err
    lines = told.splitlines()
    assert 2 <= len(lines) <= 4  # of hundreds of updates
    assert "\r" not in told
    assert all(line.startswith("work, ") and " of 1,000, reward " in line for line in lines)
    with progress_bars(visible=False) as bars:
        bars.add_task("work", total=1, note="")
    assert capsys.readouterr().err == ""


def test_the_time_left_is_told_from_the_second_stretch_on_and_counts_the_kinds_to_come():
    clock, left, bars = [0], [], TimedProgress(disable=True)
    bars.get_time = lambda: clock[0]
    work = bars.add_task("relative", total=100, ahead=2)
    for clock[0], steps in ((3600, 10), (4600, 20)):
        bars.update(work, completed=steps)
        left.append(bars.tasks[0].fields.get("left"))
    assert left == [None, "about 2 h left, 8 h with the kinds to come"]
