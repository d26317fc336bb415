"""How many cores this process may use."""

import os


def num_cores() -> int:
    """Cores that the system lets this process run on, which may be fewer than the machine has."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1
