"""Keeps freed memory in the process, where the C library allows it.

XLA on a CPU takes the room for a program's intermediate results anew in every call. glibc fetches blocks of that size
from the system each time, which clears them page by page: 110,000 page faults a second and a quarter of all
processor time in a training of configs/small.yaml, 7.4 clouds/s instead of 10.0.
"""

import ctypes
import platform

# Numbers of mallopt's parameters in glibc's malloc.h.
_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX, _ARENA_MAX = -1, -2, -4, -8


def reuse_memory() -> bool:
    """To be called before JAX is loaded; True where it had an effect (Linux with glibc)."""
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    settings = {_ARENA_MAX: 1, _MMAP_MAX: 0, _TRIM_THRESHOLD: -1, _TOP_PAD: 256 << 20}
    return all([mallopt(name, value) == 1 for name, value in settings.items()])
