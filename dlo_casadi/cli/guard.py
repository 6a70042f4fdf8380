"""Errors and interrupts become a message and an exit code."""

import errno
import io
import signal
import sys
import traceback
from collections.abc import Callable
from types import FrameType

from dlo_casadi.errors import DloError

OK, BUG, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


# Errors of writing to the output stream; errors of files have become an OutputError before.
_LOST = (errno.EPIPE, errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class _Signals:
    """Record of received signals: a library may swallow the exceptions that they raise."""

    def __init__(self) -> None:
        self.received = False

    def interrupt(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal."""
        self.received = True
        raise KeyboardInterrupt

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal was swallowed."""
        if self.received:
            raise KeyboardInterrupt


signals = _Signals()


def guarded(work: Callable[[], int]) -> int:
    """Run a command, its imports included, and return its exit code."""
    # Also for SIGINT: a shell may have started the command with SIGINT ignored.
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signals.received = False
    try:
        for number in before:
            signal.signal(number, signals.interrupt)
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")  # as stderr is
        code = work()
        print(end="", flush=True)
        return code
    except KeyboardInterrupt:
        return _interrupted()
    except DloError as error:
        notes = getattr(error, "__notes__", [])
        print("\n".join([f"{type(error).__name__}: {error}", *notes]), file=sys.stderr)
        return BAD_INPUT
    except Exception as error:
        if signals.received:  # an import that was interrupted may end as any error
            return _interrupted()
        if isinstance(error, OSError) and error.errno in _LOST:
            sys.stdout = None  # its unwritten rest would be tried again at exit
            if error.errno == errno.EPIPE:
                return OK  # the reader has gone, as `head` does; nothing is left to be said
            print(f"OutputError: the output cannot be written: {error.strerror}", file=sys.stderr)
            return BAD_INPUT
        traceback.print_exc()
        print(
            "This is a bug. Please report it with the lines above and your configuration.",
            file=sys.stderr,
        )
        return BUG
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _interrupted() -> int:
    print("interrupted; earlier results are as they were", file=sys.stderr)
    return INTERRUPTED
