"""Dispatch of `cuelearner`: call a command's file, and turn errors into one line and an exit status.

Exit status:

    0     done
    1     the disk is full, everything up to the last checkpoint saved; or a training is not finite, all else saved
    2     bad input, nothing changed
    129   stopped by SIGHUP, everything saved
    130   stopped by Ctrl-C, everything saved
    141   the reader of standard output has gone (standard error needs no reader)
    143   stopped by SIGTERM, everything saved
"""

from __future__ import annotations

import importlib
import os
import sys
import traceback
from collections.abc import Sequence

# Set before JAX starts: its start-up warnings are of no use to the user.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

# JAX takes seconds to load, so a command imports it only when needed, never for `--version` and `--help`.
from cuelearner_jax import __version__, signals
from cuelearner_jax.errors import NotFinite, UserCodeError, UserError, machine_message, suggestion

COMMANDS = {  # each a file beside this one with `run(arguments)`
    "train": "Train one seed under one kind of guidance.",
    "sweep": "Train seeds x label budgets x kinds of guidance in one process.",
    "adapt": "Correct a finished policy by labels about what the policy does in a changed world.",
    "evaluate": "Measure a policy on validation episodes, or compare two; in any changed world.",
    "suite": "Run the benchmark: tasks x kinds of guidance x label budgets x teachers.",
    "report": "Write curves and tables with intervals from recorded results.",
    "render": "Draw a still and a film of a policy at work, or the picture of a question.",
    "label": "Label actions in a browser: uniform ones, a policy's, or recorded ones.",
    "labels": "Inspect or merge label files.",
    "export": "Write a policy as a file for a robot, with a contract; --check FOLDER replays one.",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line (default: this process's own). Returns the exit status."""
    if argv is None:
        signals.listen()  # before anything that takes seconds to load
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        try:
            return _dispatch(arguments)
        finally:
            sys.stdout.flush()  # flush here, where a missing reader is handled
    except BrokenPipeError:  # the reader of the output has gone, as `head` does
        from cuelearner_jax.terminal import abandon

        abandon(sys.stdout)
        return 141
    except Exception as error:
        from cuelearner_jax.terminal import console

        if isinstance(error, UserError):
            line, status = f"error: {error}", 2
        elif isinstance(error, signals.Interrupted | NotFinite):
            line, status = str(error), error.status
        elif (message := machine_message(error, resumes=arguments[0] in ("train", "sweep"))) is not None:
            line, status = f"error: {message}", 1
        else:
            raise
        console.print(line)
        if isinstance(error, UserCodeError):
            traceback.print_exception(error.__cause__)
        return status


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print("usage: cuelearner COMMAND ...\n\nLearning from relative feedback with off-policy deep RL.\n")
        print("commands:", *(f"  {name:<10}{about}" for name, about in COMMANDS.items()), sep="\n")
        print("\nEach command has --help, for instance: cuelearner sweep billiards --help; cuelearner --version")
        return 0 if arguments else 2
    command = arguments[0]
    if command == "--version":
        print(f"cuelearner {__version__}")
        return 0
    if command not in COMMANDS:
        raise UserError(f"unknown command {command!r}{suggestion(command, COMMANDS)}; see cuelearner --help")
    from cuelearner_jax import devices, user_code

    devices.fix_numerics()
    user_code.report_user_errors(importlib.import_module(f"cuelearner_jax.cli.{command}").run)(arguments[1:])
    return 0
