"""Interrupts that come while something must not be left half way."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

# Signals by which a command is interrupted.
INTERRUPTS = (signal.SIGINT, signal.SIGTERM)
# Whether signals can be blocked, in processes that are started meanwhile, too: a matter of POSIX.
BLOCKABLE = hasattr(signal, "pthread_sigmask")


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Hold interrupts back until the end of the block; they are raised there."""
    if threading.current_thread() is not threading.main_thread():
        yield  # interrupts are the main thread's
        return
    received: list[int] = []
    handlers = {number: signal.getsignal(number) for number in INTERRUPTS}
    for number in INTERRUPTS:
        signal.signal(number, lambda number, _: received.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for one in received:
            signal.raise_signal(one)
