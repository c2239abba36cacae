"""The command `cuelearner`: calls the file of a command, turns errors into one line and an exit status.

Exit status: 0 done; 2 bad input, nothing changed; 130 stopped by Ctrl-C, everything saved;
1 the disk is full or a job failed, everything up to the last checkpoint saved, or what was trained is not finite, all
else saved; 141 nobody reads the output any more.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from types import ModuleType

# Before JAX starts: warnings of its start-up are not the user's.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

from cuelearner_jax import __version__
from cuelearner_jax.cli.parsing import HELP, summary
from cuelearner_jax.errors import NotFinite, UserError, closest, no_space
from cuelearner_jax.runs.cluster import JobsFailed
from cuelearner_jax.tasks import registry
from cuelearner_jax.terminal import Interrupted

# Each is a file beside this one with `run(arguments)` and `OPTIONS`, the options of what it does by its full name.
COMMANDS = ("train", "sweep", "evaluate", "report", "render", "teacher", "bench", "locomotion")


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point. Returns the exit status."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        return _dispatch(arguments)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (Interrupted, JobsFailed, NotFinite) as error:
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
