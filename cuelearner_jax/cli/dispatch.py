"""The command `cuelearner`: calls the file of a command, turns errors into one line and an exit status.

Exit status: 0 done; 2 bad input, nothing changed; 130 stopped by Ctrl-C, 143 by SIGTERM, 129 by SIGHUP, everything
saved; 1 the disk is full, everything up to the last checkpoint saved, or what was trained is not
finite, all else saved; 141 nobody reads the output any more (of progress and messages on standard error nobody has to).
"""

from __future__ import annotations

import ast
import importlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

# Before JAX starts: warnings of its start-up are not the user's.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

# What loads JAX, and takes seconds, is imported where a command needs it: `--version` and `--help` wait for nothing.
from cuelearner_jax import __version__
from cuelearner_jax.cli import pages
from cuelearner_jax.cli.pages import HELP
from cuelearner_jax.errors import NotFinite, UserError, blamed, closest
from cuelearner_jax.signals import Interrupted

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
            return _dispatch(arguments)
        finally:
            sys.stdout.flush()  # here, where it is heard if nobody reads
    except UserError as error:
        _tell(f"error: {error}")
        return 2
    except (Interrupted, NotFinite) as error:
        _tell(str(error))
        return error.status
    except BrokenPipeError:  # whoever read our output has gone, as `head` does
        from cuelearner_jax.terminal import abandon

        abandon(sys.stdout)
        return 141
    except Exception as error:
        told = blamed(error, _resumes(arguments))
        if told is None:
            raise
        _tell(f"error: {told}")
        return 1
    except KeyboardInterrupt:  # of a process that does more than this command: see `signals`
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
        raise UserError(f"unknown command {command!r}{closest(command, COMMANDS)}; see cuelearner --help")
    from cuelearner_jax import user_code

    user_code.told(_file(command).run)(arguments[1:])
    return 0


def _resumes(arguments: list[str]) -> bool:
    """Has the command that was given an option --resume?"""
    options = _file(arguments[0]).OPTIONS if arguments and arguments[0] in COMMANDS else {}
    asked = [kind for name, kind in options.items() if name.split() == arguments[: len(name.split())]]
    return any(hasattr(kind, "resume") for kind in asked)


def _file(command: str) -> ModuleType:
    """The file of a command, loaded when it is called: what one needs, the others need not wait for."""
    return importlib.import_module(f"cuelearner_jax.cli.{command}")


def summaries(command: str) -> dict[str, str]:
    """One line about each command of a file, by its full name: the start of its options' docstring.

    The file is read, not imported, because importing it loads JAX.
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
