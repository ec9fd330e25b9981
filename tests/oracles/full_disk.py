"""A disk that is full, for tests of what writes."""

from __future__ import annotations

import resource
from contextlib import contextmanager


@contextmanager
def no_file_larger_than(size):
    """Let the operating system take no more bytes than these of any file of this process, and of
    those that it starts."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
