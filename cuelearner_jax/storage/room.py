"""Free memory of a device, a machine or a container, checked before large files are read."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import jax

from cuelearner_jax.errors import UserError

GROWTH = 16  # memory per byte of JSON [bytes]


def check_size(path: Path) -> None:
    """Check that memory holds a parsed JSON file.

    Raises:
        UserError: the file needs more memory than is free.
        OSError: the file's size cannot be read.
    """
    size = path.stat().st_size
    check_room(f"{path} has {size:,} bytes", GROWTH * size, "it is damaged, or no file of this program")


def check_room(declared: str, needed: int, remedy: str) -> None:
    """Raise UserError if more than the free memory is needed, before any of it is allocated.

    Args:
        declared: the message's beginning: what declares how much of what.
        needed: memory needed [bytes].
        remedy: the message's end.
    """
    free = _least([_host_bytes(), group_bytes()])
    if free is not None and needed > free:
        raise UserError(
            f"{declared}, which needs {needed / 1e9:,.1f} GB of memory, {free / 1e9:.1f} GB are free: {remedy}"
        )


def free_bytes() -> int | None:
    """Return the free memory of the training device [bytes]; for a CPU at most what control groups grant."""
    device = jax.devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        return stats["bytes_limit"] - stats.get("bytes_in_use", 0) if "bytes_limit" in stats else None
    return _least([_host_bytes(), group_bytes()])


def _host_bytes() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)


def group_bytes(groups: Path = Path("/proc/self/cgroup"), root: Path = Path("/sys/fs/cgroup")) -> int | None:
    """Return the memory that the process's control groups (container, batch job) still grant [bytes]; None: no limit.

    Source: Linux, Documentation/admin-guide/cgroup-v2.rst.

    Args:
        groups: the file that names the process's own group, in the line that begins with "0::".
        root: the folder of the groups' files; a group is limited by those above it too.
    """
    try:
        own = next((line[3:] for line in groups.read_text().splitlines() if line.startswith("0::")), "/")
    except OSError:
        return None
    folder = root / own.lstrip("/")
    above = len(folder.relative_to(root).parts)
    return _least(_granted(group) for group in [folder, *folder.parents][: above + 1])


def _granted(group: Path) -> int | None:
    """Return what one group grants [bytes]; file caches, which the kernel would release, count as free."""
    try:
        limit = (group / "memory.max").read_text().strip()
        used = int((group / "memory.current").read_text())
        kinds = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
    except OSError:
        return None
    return None if limit == "max" else max(0, int(limit) - used + int(kinds.get("inactive_file", 0)))


def _least(found: Iterable[int | None]) -> int | None:
    return min((number for number in found if number is not None), default=None)
