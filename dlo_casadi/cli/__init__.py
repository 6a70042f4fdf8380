"""The command `dlo`: a function per subcommand; the only package that prints or exits.

Exit codes: 0 done, 1 a bug, 2 bad input, 130 interrupted.
"""

import errno
import io
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from importlib import import_module
from keyword import iskeyword
from types import FrameType

from dlo_casadi.errors import DloError

# Subcommand -> its module, imported only when the command is called, and its summary.
COMMANDS = {
    "new": ("new", "write a commented configuration to start from"),
    "import": ("recordings", "make a session of motion capture, ROS bags or point clouds"),
    "check": ("check", "check a configuration and its photographs in seconds, without fitting"),
    "calibrate": ("check", "find the camera of a session from its own photographs of the board"),
    "fit": ("fit", "fit a cable to its photographs or centre-lines and report what was found"),
    "fit-many": ("fit", "fit many sessions, on many cores or machines, into one table"),
    "diagnose": ("fit", "fit, and print the search for missing effects in full"),
    "predict": ("fitted", "predict the shape of a fitted cable from where its ends are held"),
    "limits": ("fitted", "check whether a fitted cable keeps its limits in a list of poses"),
    "shape-table": ("fitted", "predict the shapes of a fitted cable in very many poses"),
    "watch": ("watching", "track a fitted cable through poses that arrive"),
    "modes": ("moving", "frequencies and damping of small motions of a fitted cable"),
    "simulate": ("moving", "simulate a fitted cable under moving fixtures"),
    "move": ("moving", "plan a motion after which a fitted cable is at rest"),
    "export": ("export", "write a fitted cable for a simulator, such as MuJoCo"),
    "generate-solver": ("fitted", "write the C solver of a fitted cable for planners to embed"),
    "schema": ("new", "print the JSON schema of a configuration, for editors"),
    "reproduce": ("new", "compare with the paper's results (needs a checkout)"),
    "benchmark": ("new", "time the C solver beside other solvers (needs a checkout)"),
}

EXIT_CODES = "exit codes: 0 done, 1 a bug, 2 bad input, 130 interrupted"
EXAMPLES = """\
examples:
  dlo new rope.yaml --photographs photographs/     start a configuration
  dlo check rope.yaml                              is everything as declared?
  dlo fit rope.yaml                                results/rope/
  dlo predict results/rope --end 0.3 -0.1          where will it hang?

`dlo SUBCOMMAND --help` tells more."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run `dlo SUBCOMMAND ...`.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments after `dlo`; by default those of the command line.

    Returns
    -------
    int
        Exit code: 0 done, 1 a bug, 2 bad input, 130 interrupted.

    Raises
    ------
    SystemExit
        With 2 for unknown arguments, with 0 after `--help`.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    return guarded(lambda: _run(arguments))


def _run(arguments: list[str]) -> int:
    if arguments and arguments[0] in COMMANDS:
        for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
            os.environ.setdefault(variable, "1")  # the matrices are small: threads would only cost
        module = import_module(f"dlo_casadi.cli.{COMMANDS[arguments[0]][0]}")
        name = arguments[0].replace("-", "_")
        return getattr(module, f"{name}_" if iskeyword(name) else name)(arguments[1:])
    if arguments[:1] in (["-h"], ["--help"]):
        print(_overview())
        return OK
    if arguments[:1] == ["--version"]:
        from dlo_casadi import __version__

        print(f"dlo {__version__}")
        return OK
    if arguments:
        near = get_close_matches(arguments[0], COMMANDS, 1)
        text = f"no subcommand is called {arguments[0]!r}"
        if near:
            print(f"{text}; did you mean {near[0]!r}? `dlo --help` lists them all", file=sys.stderr)
            return BAD_INPUT
        print(f"{text}\n", file=sys.stderr)
    print(_overview(), file=sys.stderr)
    return BAD_INPUT


def _overview() -> str:
    width = max(map(len, COMMANDS))
    listed = "\n".join(f"  {name:{width}}  {text}" for name, (_, text) in COMMANDS.items())
    return (
        "usage: dlo SUBCOMMAND ...\n\n"
        "Elastic models of cables in the plane and in space: fit, diagnose, predict, embed.\n\n"
        f"subcommands:\n{listed}\n\n{EXAMPLES}\n\n{EXIT_CODES}"
    )


OK, BUG, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


# Errors of the output stream; errors of files have already become an OutputError.
_LOST = (errno.EPIPE, errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class _Signals:
    """Record received signals: a library may swallow the exceptions that they raise."""

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

    @contextmanager
    def unprinted(self) -> Iterator[None]:
        """Print no traceback of an interrupt that Python swallows, as in a weak reference."""
        before = sys.unraisablehook

        def told(error: "sys.UnraisableHookArgs") -> None:
            if not issubclass(error.exc_type, KeyboardInterrupt):
                before(error)

        sys.unraisablehook = told
        try:
            yield
        finally:
            sys.unraisablehook = before


signals = _Signals()


def guarded(work: Callable[[], int]) -> int:
    """Run a command, including its imports, and return its exit code."""
    # Also for SIGINT: a shell may have started the command with SIGINT ignored.
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signals.received = False
    try:
        for number in before:
            signal.signal(number, signals.interrupt)
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")  # same as stderr
        with signals.unprinted():
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
        if signals.received:  # an interrupted import may end with any error
            return _interrupted()
        if isinstance(error, OSError) and error.errno in _LOST:
            sys.stdout = None  # otherwise Python retries the unwritten rest at exit
            if error.errno == errno.EPIPE:
                return OK  # the reader has closed the pipe, as `head` does
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
