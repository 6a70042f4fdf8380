"""Errors that the package raises: what happened, with numbers, and what to try."""

from importlib import import_module
from pathlib import Path
from string import Formatter
from typing import Any


def well_formed(text: str) -> str:
    r"""Make text safe to write anywhere: a lone surrogate becomes its escape, such as `\udce9`.

    File names that are not UTF-8 contain them (PEP 383), and YAML permits them.
    """
    return text.encode(errors="backslashreplace").decode()


def counted(number: int, noun: str, form: str = "d") -> str:
    """A number of things with a regular plural: 1 pose, 2 poses."""
    return f"{number:{form}} {noun}{'' if number == 1 else 's'}"


class _Sentences(Formatter):
    def format_field(self, value: Any, spec: str) -> str:
        if spec.startswith("mm"):
            return "-" if value is None else f"{1e3 * value:{spec[2:] or '.3g'}} mm"
        if spec.startswith("# "):
            return counted(value, spec[2:])
        if isinstance(value, list | tuple):
            return ", ".join(map(str, value))
        return str(super().format_field(value, spec))


def worded(template: str, /, **values: Any) -> str:
    """Fill a template of a sentence: the rules of units and plurals.

    `{off:mm}` is a length [m] in millimetres, with three digits or as in `{off:mm.2g}`, a dash for
    None;
    `{count:# pose}` a number of things, see `counted`; `{names}` the items of a list or tuple;
    all else is as in `str.format`.
    """
    return _Sentences().format(template, **values)


class DloError(Exception):
    """Base class of all errors raised on purpose by dlo_casadi.

    Parameters
    ----------
    message : str
        What happened, with numbers and units, and what to try; made `well_formed`.

    Attributes
    ----------
    poses : tuple of PoseInput
        For a failed session: its poses, with everything that was read of them.
    """

    def __init__(self, message: str) -> None:
        super().__init__(well_formed(message))
        self.message = str(self)
        self.poses: tuple[Any, ...] = ()


class ConfigError(DloError):
    """A configuration or parameter file that cannot be used.

    Parameters
    ----------
    message : str
        What is wrong and what to try.
    file : Path, optional
        The YAML file.
    line : int, optional
        Line in that file, counted from 1.

    Attributes
    ----------
    problem : str
        The message without the place.
    """

    def __init__(self, message: str, file: Path | None = None, line: int | None = None) -> None:
        place = (
            "" if file is None else f"{file}" + ("" if line is None else f", line {line}") + ": "
        )
        super().__init__(place + message)
        self.problem = well_formed(message)
        self.file = file
        self.line = line


class MeasurementError(DloError):
    """A photograph or a file that gives no centre-line.

    Parameters
    ----------
    message : str
        What is wrong and what to try.
    pose : str, optional
        File name of the pose.
    """

    def __init__(self, message: str, pose: str | None = None) -> None:
        super().__init__(message if pose is None else f"{pose}: {message}")
        self.pose = pose


class VisionError(MeasurementError):
    """A photograph in which the board or the cable cannot be found."""


class MotionError(DloError):
    """A motion that cannot be computed.

    Parameters
    ----------
    message : str
        What is wrong and what to try.
    t : float [s]
        When.
    """

    def __init__(self, message: str, t: float) -> None:
        super().__init__(message)
        self.t = t


class EquilibriumError(DloError):
    """A pose without a (stable) equilibrium.

    Parameters
    ----------
    message : str
        What is wrong and what to try.
    pose : str, optional
        Name of the pose.
    p_des : tuple of float, optional
        Requested position of the end [m].
    """

    def __init__(
        self,
        message: str,
        pose: str | None = None,
        p_des: tuple[float, ...] | None = None,
    ) -> None:
        super().__init__(message if pose is None else f"{pose}: {message}")
        self.pose = pose
        self.p_des = p_des


class EstimationError(DloError):
    """An estimate that the available poses do not allow."""


class OutputError(DloError):
    """A file or folder that cannot be written.

    Parameters
    ----------
    message : str
        What is wrong and what to try.
    path : Path, optional
        The file or folder.
    """

    def __init__(self, message: str, path: Path | None = None) -> None:
        super().__init__(message)
        self.path = path

    def retold(self, draft: str, place: str) -> None:
        """Replace the name of a draft in the message by that of its final place."""
        self.message = self.message.replace(draft, place)
        self.args = (self.message,)
        self.path = None if self.path is None else Path(str(self.path).replace(draft, place))


def library(name: str, extra: str, user: str) -> Any:
    """Import an optional library; without it a DloError names its `user` and the extra to use."""
    try:
        return import_module(name)
    except ImportError:
        raise DloError(
            f"{user}: {name.partition('.')[0]} is not installed.\n"
            f"  Try: pip install 'dlo-casadi[{extra}]'"
        ) from None
