"""Calibrations of cameras as ROS, OpenCV and Kalibr write them: the matrix and the lens in them."""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from pydantic import ValidationInfo

from dlo_casadi.config.document import parsed_yaml
from dlo_casadi.config.problems import kind_of, show
from dlo_casadi.errors import ConfigError

# Keys of the same thing: ours first, then those of ROS, OpenCV's samples and Kalibr.
_MATRIX = (
    *("matrix", "camera_matrix", "cameramatrix", "k", "m", "m1", "mtx", "intrinsic_matrix"),
    *("intrinsics", "intrinsic", "cammatrix"),
)
_LENS = (
    *("distortion", "distortion_coefficients", "distortion_coeffs", "distcoeffs", "dist_coeffs"),
    *("dist_coeff", "distcoeff", "dist", "d", "d1", "coeffs"),
)
_FOCAL = (("fx",), ("fy",), ("cx", "ppx"), ("cy", "ppy"))
_TERMS = ("k1", "k2", "p1", "p2", "k3")
_MODELS = ("distortion_model", "camera_model", "lens_model", "distortion_type", "model")
# What these files hold beside it: sizes, names, and transforms between cameras.
_UNUSED = {"image_width", "image_height", "width", "height", "resolution", "camera_name", "header"}
_UNUSED |= {"rectification_matrix", "projection_matrix", "rectification", "projection", "r", "p"}
_UNUSED |= {"rostopic", "cam_overlaps", "t_cam_imu", "t_cn_cnm1", "timeshift_cam_imu", "roi"}
_UNUSED |= {"binning_x", "binning_y", "calibration_time", "flags", "fisheye_model", *_MODELS}

# Models with OpenCV's radial and tangential terms, and those of lenses that have no such terms.
_PINHOLE = {"", "none", "pinhole", "plumb_bob", "radtan", "radial_tangential", "opencv", "brown"}
_PINHOLE |= {"brown_conrady", "rational_polynomial", "rational", "full_opencv", "perspective"}
_PINHOLE |= {"simple_pinhole", "standard", "thin_prism"}
_FISHEYE = {"fisheye", "equidistant", "equi", "kannala_brandt", "kannala_brandt4", "kb4", "fov"}
_FISHEYE |= {"opencv_fisheye", "kannalabrandt4", "omni", "omnidirectional", "ds", "eucm", "mei"}
_RECTIFY = (
    "is of a fisheye lens, which is not supported. Try: rectify the photographs first (OpenCV: "
    "cv2.fisheye.undistortImage), and give the matrix of the rectified ones without a distortion"
)


def camera_of(value: object, info: ValidationInfo) -> object:
    """Matrix and distortion in the keys of a configuration, from those of a calibration.

    `value` is a mapping, or the name of a file of ROS (camera_info), OpenCV (FileStorage, YAML or
    XML) or Kalibr (camchain). Raises ValueError if the camera has another model, or if the file
    holds no camera or several.
    """
    if isinstance(value, Mapping) and {*value} == {"file"}:
        value = value["file"]
    if isinstance(value, str | Path) and str(value) != "FILL_IN":
        path = (info.context or {}).get("folder", Path()) / value
        try:
            return _converted(_read(path), in_file=True)
        except ValueError as error:
            raise ValueError(f"{path.name}: {error}") from None
    return _converted(value, in_file=False) if isinstance(value, Mapping) else value


def _read(path: Path) -> Mapping[str, Any]:
    """Data of a calibration file."""
    try:
        content = path.read_bytes()
    except OSError as error:
        text = f"cannot be read: {error.strerror}. Try: a calibration of ROS, OpenCV or Kalibr"
        raise ValueError(text) from None
    if content.lstrip().startswith(b"<"):
        return _of_xml(content)
    # OpenCV's first line and its tags are no YAML 1.2.
    plain = re.sub(rb"\A%YAML:.*?$", b"", content, flags=re.MULTILINE)
    plain = re.sub(rb"!!opencv-[a-z-]+", b"", plain)
    # A topic of ROS that is printed repeats itself, with --- below each message.
    messages = [x for x in re.split(rb"(?m)^---[ \t\r]*$", plain) if x.strip()]
    plain = messages[0] if messages else plain
    try:
        data = parsed_yaml(plain, path)
    except ConfigError as error:
        raise ValueError(error.problem) from None
    if not isinstance(data, Mapping):
        raise ValueError(f"a mapping with a camera matrix belongs there, found {kind_of(data)}")
    return data


def _of_xml(content: bytes) -> dict[str, Any]:
    """Data of OpenCV's XML; matrices as in its YAML."""
    try:
        root = ElementTree.fromstring(content)
    except ElementTree.ParseError as error:
        line = error.position[0]
        raise ValueError(f"not valid XML (line {line}). Try: the file as it was written") from None
    return {
        item.tag: [float(x) for x in item.findtext("data", "").split()]
        if item.get("type_id") == "opencv-matrix"
        else (item.text or "").strip()
        for item in root
    }


def _converted(given: Mapping[Any, Any], in_file: bool) -> dict[Any, Any]:
    """The keys of a configuration; others stay, where they were not written by a program."""
    given = _only_camera(given)
    called = {str(key).lower(): key for key in given}
    _check_model({name: given[key] for name, key in called.items()})
    matrix, lens = _first(called, _MATRIX), _first(called, _LENS)
    used = {key for key in (matrix, lens) if key is not None}
    found: dict[Any, Any] = {}
    numbers = [_first(called, names) for names in _FOCAL]
    if matrix is not None:
        found["matrix"] = _matrix(given[matrix])
    elif all(key is not None for key in numbers):
        found["matrix"] = _matrix([given[key] for key in numbers])
        used |= {*numbers}
    elif in_file:
        known = ", ".join(map(str, given)) or "nothing"
        raise ValueError(
            f"holds no camera matrix; its keys are {known}. Try: camera_matrix of ROS or OpenCV, "
            "intrinsics of Kalibr"
        )
    terms = [called[name] for name in _TERMS if name in called]
    if lens is not None:
        found["distortion"] = _flat(given[lens])
    elif len(terms) >= 4:
        found["distortion"] = [given[key] for key in terms]
        used |= {*terms}
    foreign = in_file or bool(found and "matrix" not in called)
    if foreign and "distortion" not in found:
        raise ValueError(
            f"holds no distortion; its keys are {', '.join(map(str, given))}. Try: `distortion: "
            "[]` in it if the photographs are rectified"
        )
    if foreign:
        return found
    return found | {
        key: value
        for key, value in given.items()
        if key not in used and str(key).lower() not in _UNUSED
    }


def _only_camera(given: Mapping[Any, Any]) -> Mapping[Any, Any]:
    """The mapping of the only camera in a file of one or several."""
    cameras = [key for key in given if re.fullmatch(r"cam(?:era)?_?\d+", str(key), re.IGNORECASE)]
    if not cameras and "M2" in given:
        cameras = ["M1", "M2"]
    if len(cameras) > 1:
        raise ValueError(
            f"holds {len(cameras)} cameras ({', '.join(map(str, cameras))}). Try: a file with the "
            "one that took the photographs"
        )
    inner = given[cameras[0]] if cameras else given
    return inner if isinstance(inner, Mapping) else given


def _check_model(given: Mapping[str, Any]) -> None:
    """Raise ValueError if the camera is no pinhole with OpenCV's terms of distortion."""
    for key in _MODELS:
        name = re.sub(r"[\s-]+", "_", str(given.get(key) or "").strip().lower())
        if name in _FISHEYE:
            raise ValueError(f"{key} {show(given[key])} {_RECTIFY}")
        if name not in _PINHOLE:
            raise ValueError(
                f"{key} {show(given[key])} is not known. Try: plumb_bob or rational_polynomial "
                "(ROS, OpenCV), radtan (Kalibr), or `dlo calibrate` with the session's photographs"
            )
    if given.get("fisheye_model") not in (None, 0, "0", False):
        raise ValueError(f"fisheye_model {given['fisheye_model']} {_RECTIFY}")


def _first(called: Mapping[str, Any], names: Sequence[str]) -> Any:
    return next((called[name] for name in names if name in called), None)


def _matrix(value: Any) -> Any:
    """Rows of a camera matrix, from nine numbers or from fx, fy, cx, cy; anything else as it is."""
    if isinstance(value, Mapping) and "data" not in value:
        called = {str(key).lower(): key for key in value}
        keys = [_first(called, names) for names in _FOCAL]
        value = value if None in keys else [value[key] for key in keys]
    numbers = _flat(value)
    if isinstance(numbers, list) and len(numbers) == 4:
        fx, fy, cx, cy = numbers
        return [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    if isinstance(numbers, list) and len(numbers) == 9:
        return [numbers[:3], numbers[3:6], numbers[6:]]
    return value


def _flat(value: Any) -> Any:
    """Numbers of {rows, cols, data} or of nested lists as one list; anything else as it is."""
    if isinstance(value, Mapping) and "data" in value:
        value = value["data"]
    return [*_items(value)] if isinstance(value, list | tuple) else value


def _items(value: Sequence[Any]) -> Iterator[Any]:
    for item in value:
        if isinstance(item, list | tuple):
            yield from _items(item)
        else:
            yield item
