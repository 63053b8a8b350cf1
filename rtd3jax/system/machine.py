"""The cores and the memory that this process may use, under every limit of the machine."""

import contextlib
import os
from pathlib import Path

_CGROUP = Path("/sys/fs/cgroup")
_OWN_CGROUPS, _OWN_STATUS = Path("/proc/self/cgroup"), Path("/proc/self/statm")


def cores() -> int:
    """Cores that this process may run on; all cores where the system has no CPU affinity."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def memory_limit() -> int:
    """Bytes that this process may use: the least of the machine's memory and the job's limits."""
    limits = [
        _physical(),
        *_cgroup_limits(),
        _address_space(),
        *_slurm_limits(),
    ]
    return min(limit for limit in limits if limit is not None)


def _physical() -> int | None:
    """The machine's memory."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return _physical_on_windows()


def _physical_on_windows() -> int:
    """As `_physical`, for Windows, which has no sysconf."""
    import ctypes

    class Status(ctypes.Structure):
        _fields_ = [("length", ctypes.c_ulong), ("load", ctypes.c_ulong)] + [
            (name, ctypes.c_ulonglong) for name in ("total", "free", "a", "b", "c", "d", "e")
        ]

    status = Status()
    status.length = ctypes.sizeof(status)
    try:
        ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status))  # type: ignore[attr-defined]
        return int(status.total)
    except (AttributeError, OSError):
        return 8 * 2**30  # unknown: a usual size is assumed


def _cgroup_limits() -> list[int]:
    """Limits of containers and batch systems: of this cgroup (v1 or v2) and all its parents."""
    found = []
    with contextlib.suppress(OSError, ValueError):
        for line in _OWN_CGROUPS.read_text(encoding="utf-8").splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers == "":
                root, name = _CGROUP, "memory.max"
            elif "memory" in controllers.split(","):
                root, name = _CGROUP / "memory", "memory.limit_in_bytes"
            else:
                continue
            group = root / path.strip("/")
            # In a container, the path may be the host's, which is not visible; the root is.
            for directory in (group, *group.parents):
                found += _number(directory / name)
                if directory == root:
                    break
    return found


def _number(file: Path) -> list[int]:
    """The number in a file; an empty list for the word "max" or a missing file."""
    with contextlib.suppress(OSError, ValueError):
        return [int(file.read_text(encoding="utf-8"))]
    return []


def _address_space() -> int | None:
    """Bytes that ``ulimit -v`` leaves besides those that this process has already mapped."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return None
    mapped = 0
    with contextlib.suppress(OSError, ValueError):
        pages = int(_OWN_STATUS.read_text(encoding="utf-8").split()[0])
        mapped = pages * resource.getpagesize()
    return max(0, limit - mapped)


def _slurm_limits() -> list[int]:
    """Memory that SLURM gave the job on this machine; SLURM may enforce it without a cgroup."""

    def megabytes(name: str) -> int | None:
        with contextlib.suppress(KeyError, ValueError):
            return int(os.environ[name]) * 2**20 or None
        return None

    found = [megabytes("SLURM_MEM_PER_NODE")]
    each = megabytes("SLURM_MEM_PER_CPU")
    if each is not None:
        with contextlib.suppress(KeyError, ValueError):
            found.append(each * int(os.environ["SLURM_CPUS_ON_NODE"]))
    return [limit for limit in found if limit is not None]
