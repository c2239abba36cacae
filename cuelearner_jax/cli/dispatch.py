"""The command `cuelearner`: calls the file of a command, turns errors into one line and an exit status.

Exit status: 0 done; 2 bad input, nothing changed; 130 stopped by Ctrl-C, 143 by SIGTERM, 129 by SIGHUP, everything
saved; 1 the disk is full or a job failed, everything up to the last checkpoint saved, or what was trained is not
finite, all else saved; 141 nobody reads the output any more (of progress and messages on standard error nobody has to).
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from types import ModuleType

# Before JAX starts: warnings of its start-up are not the user's.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

from cuelearner_jax import __version__, user_code
from cuelearner_jax.cli.parsing import HELP, summary
from cuelearner_jax.errors import NotFinite, UserError, blamed, closest
from cuelearner_jax.runs.cluster import JobsFailed
from cuelearner_jax.tasks import registry
from cuelearner_jax.terminal import Interrupted, abandon, console

# Each is a file beside this one with `run(arguments)` and `OPTIONS`, the options of what it does by its full name.
COMMANDS = (
    *("train", "sweep", "adapt", "evaluate", "report", "render", "label", "labels", "export"),
    "bench",
)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point. Returns the exit status."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        try:
            return user_code.told(_dispatch)(arguments)
        finally:
            sys.stdout.flush()  # here, where it is heard if nobody reads
    except UserError as error:
        console.print(f"error: {error}")
        return 2
    except (Interrupted, JobsFailed, NotFinite) as error:
        console.print(str(error))
        return error.status
    except BrokenPipeError:  # whoever read our output has gone, as `head` does
        abandon(sys.stdout)
        return 141
    except Exception as error:
        told = blamed(error, _resumes(arguments))
        if told is None:
            raise
        console.print(f"error: {told}")
        return 1
    except KeyboardInterrupt:  # of a process that does more than this command: see `signals`
        console.print("stopped at once; what was saved before is safe")
        return 130


def _dispatch(arguments: list[str]) -> int:
    for argument in arguments:
        if not argument.isascii() and argument != argument.encode(errors="replace").decode():
            raise UserError(f"{argument!r} is not encoded as UTF-8: results could not name it")
    if not arguments or arguments[0] in HELP:
        _overview()
        return 0 if arguments else 2
    command = arguments[0]
    if command == "--version":
        print(f"cuelearner {__version__}")
        return 0
    if command not in COMMANDS:
        raise UserError(f"unknown command {command!r}{closest(command, COMMANDS)}; see cuelearner --help")
    _file(command).run(arguments[1:])
    return 0


def _resumes(arguments: list[str]) -> bool:
    """Has the command that was given an option --resume?"""
    options = _file(arguments[0]).OPTIONS if arguments and arguments[0] in COMMANDS else {}
    asked = [kind for name, kind in options.items() if name.split() == arguments[: len(name.split())]]
    return any(hasattr(kind, "resume") for kind in asked)


def _file(command: str) -> ModuleType:
    """The file of a command, loaded when it is called: what one needs, the others need not wait for."""
    return importlib.import_module(f"cuelearner_jax.cli.{command}")


def _overview() -> None:
    print("usage: cuelearner COMMAND ...\n\nLearning from relative feedback with off-policy deep RL.\n\ncommands:")
    told = {name: summary(kind) for command in COMMANDS for name, kind in _file(command).OPTIONS.items()}
    width = max(map(len, told)) + 2
    for name, about in told.items():
        print(f"  {name:<{width}}{about}")
    print(f"\ntasks: {', '.join(registry.names())}; or one of your own, as package.module:NAME")
    print("Each command has --help, for instance: cuelearner sweep billiards --help; cuelearner --version")
