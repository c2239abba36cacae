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

import ast
import importlib
import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

# Set before JAX starts: its start-up warnings are of no use to the user.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

# JAX takes seconds to load, so a command imports it only when needed, never for `--version` and `--help`.
from cuelearner_jax import __version__
from cuelearner_jax.cli import pages
from cuelearner_jax.cli.pages import HELP
from cuelearner_jax.errors import NotFinite, UserCodeError, UserError, machine_message, suggestion
from cuelearner_jax.signals import Interrupted

# Each is a file beside this one with `run(arguments)` and `OPTIONS`, its option classes by command name.
COMMANDS = ("train", "sweep", "adapt", "evaluate", "report", "render", "label", "labels", "export")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line. Returns the exit status."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        try:
            return _dispatch(arguments)
        finally:
            sys.stdout.flush()  # flush here, where a missing reader is handled
    except UserError as error:
        _tell(f"error: {error}")
        if isinstance(error, UserCodeError) and (cause := error.__cause__) is not None:
            from cuelearner_jax.user_code import user_traceback

            traceback.print_exception(cause.with_traceback(user_traceback(cause) or cause.__traceback__))
        return 2
    except (Interrupted, NotFinite) as error:
        _tell(str(error))
        return error.status
    except BrokenPipeError:  # the reader of the output has gone, as `head` does
        from cuelearner_jax.terminal import abandon

        abandon(sys.stdout)
        return 141
    except Exception as error:
        told = machine_message(error, _resumes(arguments))
        if told is None:
            raise
        _tell(f"error: {told}")
        return 1
    except KeyboardInterrupt:  # in a process that does more than this command: see `signals`
        _tell("stopped at once; what was saved before is safe")
        return 130


def _tell(line: str) -> None:
    from cuelearner_jax.terminal import console

    console.print(line)


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
        raise UserError(f"unknown command {command!r}{suggestion(command, COMMANDS)}; see cuelearner --help")
    from cuelearner_jax import devices, user_code

    devices.fix_numerics()
    user_code.report_user_errors(_file(command).run)(arguments[1:])
    return 0


def _resumes(arguments: list[str]) -> bool:
    """Whether the given command has an option --resume."""
    options = _file(arguments[0]).OPTIONS if arguments and arguments[0] in COMMANDS else {}
    asked = [kind for name, kind in options.items() if name.split() == arguments[: len(name.split())]]
    return any(hasattr(kind, "resume") for kind in asked)


def _file(command: str) -> ModuleType:
    """Import the file of a command; other commands' dependencies are not loaded."""
    return importlib.import_module(f"cuelearner_jax.cli.{command}")


def summaries(command: str) -> dict[str, str]:
    """Return one line about each command of a file, by its full name: the start of its options' docstring.

    The file is read, not imported, since importing it loads JAX.
    """
    module = ast.parse(Path(__file__).with_name(f"{command}.py").read_text(encoding="utf-8"))
    abouts = {node.name: ast.get_docstring(node) or "" for node in module.body if isinstance(node, ast.ClassDef)}
    assigned = [node for node in module.body if isinstance(node, ast.Assign)]
    (options,) = [node.value for node in assigned if ast.unparse(node.targets[0]) == "OPTIONS"]
    assert isinstance(options, ast.Dict)
    named = zip(options.keys, options.values, strict=True)
    abouts = {ast.literal_eval(name): abouts[ast.unparse(kind)] for name, kind in named if name}
    return {name: " ".join(about.split("\n\n")[0].split()) for name, about in abouts.items()}


def _overview() -> None:
    from cuelearner_jax.tasks import registry

    print("usage: cuelearner COMMAND ...\n\nLearning from relative feedback with off-policy deep RL.\n\ncommands:")
    told = {name: about for command in COMMANDS for name, about in summaries(command).items()}
    width = max(map(len, told)) + 2
    for name, about in told.items():
        print(f"  {name:<{width}}{about}")
    print("\nexamples:")
    for command in ("sweep", "evaluate", "label"):
        print(*pages.lines_of(pages.examples_of(command)[:1]), sep="\n")
    print(f"\ntasks: {', '.join(registry.names())};\n  or one of your own: package.module:NAME")
    print("Each command has --help, for instance: cuelearner sweep billiards --help; cuelearner --version")
