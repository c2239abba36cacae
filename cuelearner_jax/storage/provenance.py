"""Provenance: program, machine and command, as recorded with every result."""

from __future__ import annotations

import shlex
import subprocess
import sys
import warnings
from contextlib import suppress
from importlib import metadata
from pathlib import Path


def provenance() -> dict[str, str]:
    """Return the columns `commit`, `versions`, `hardware` and `command` of this process.

    `commit` is empty where the package does not come from a git checkout.
    """
    import jax

    from cuelearner_jax.devices import numerics

    versions = [f"python {sys.version.split()[0]}"]
    for name in ("cuelearner-jax", "jax", "jaxlib", "flax", "optax", "numpy"):
        with suppress(metadata.PackageNotFoundError):
            versions.append(f"{name} {metadata.version(name)}")
    kinds = [device.device_kind for device in jax.devices()]
    return {
        "commit": _commit(),
        "versions": ", ".join([*versions, numerics()]),
        "hardware": ", ".join(f"{kinds.count(kind)} x {kind}" for kind in dict.fromkeys(kinds)),
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
    }


def _commit() -> str:
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():  # an installed package may lie inside an unrelated repository
        return ""
    git = ["git", "-C", str(root), "--no-optional-locks"]  # writes nothing to the repository
    describe = [*git, "describe", "--always", "--exclude=*", "--abbrev=12", "--dirty"]
    try:
        with warnings.catch_warnings():
            # JAX warns of any fork; this one executes git at once.
            warnings.filterwarnings("ignore", message=r"os\.fork", category=RuntimeWarning)
            return subprocess.run(describe, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
