"""A commented configuration to start from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from dlo_casadi.config.document import dump_yaml
from dlo_casadi.config.problems import PLACEHOLDER

_TOP = """\
# yaml-language-server: $schema=schema.json
# Replace every FILL_IN; `dlo check` tells what is left and what does not fit together.
# SI units: m, kg, s, N, rad. Frame: {frame}.
cable:
  name: {name}
  length: FILL_IN            # m, along the cable between its two fixtures
  mass: FILL_IN              # kg, of that length
  diameter: FILL_IN          # m
  bending_stiffness: FILL_IN # N m^2, a first guess: three decades off is good enough
  # youngs_modulus: 1.0e+8   # Pa, instead of bending_stiffness; as crude
{torsion}  # rest_shape: straight     # if the cable is straight without load; default: curved
experiment:
{experiment}"""

_IN_PLANE = {
    "frame": "x to the right, y up, origin where you like, such as the start",
    "torsion": "",
    "experiment": """\
  gravity: [0.0, -9.81]      # m/s^2
  boundary: {start: pinned, end: pinned}   # pinned (free to turn) | clamped | free (end only)
  # tolerances: {length: 5.0e-4, end: 2.0e-4, heading: 1.0e-2, scale: 3.0e-4}   # m, m, rad, -
""",
}

_IN_SPACE = {
    "frame": "right-handed, one for grippers and points",
    "torsion": """\
  # torsional_stiffness: 0.1 # N m^2, as crude; bending_stiffness / 1.3 when absent
""",
    "experiment": """\
  gravity: [0.0, 0.0, -9.81] # m/s^2; three numbers put the cable in space
  boundary: {start: clamped, end: clamped}   # pinned (ball joint) | clamped | free (end only)
  # tolerances: {length: 5.0e-4, end: 2.0e-4, rotation: 5.0e-3, roll: 1.0}        # m, m, rad, rad
""",
}

_IMAGES = """\
  measurement:
    kind: images             # photographs; or kind: centerlines for CSV files
    board:                   # ArUco markers on the board behind the cable
      dictionary: DICT_4X4_50
      marker_size: FILL_IN   # m, side of the black square
      standoff: 0.0          # m, cable axis in front of the board; other than 0 needs a camera
      marker_centers:        # m, centre [x, y] of each marker by its number
        0: FILL_IN
        1: FILL_IN
        2: FILL_IN
        3: FILL_IN
    # camera:                # makes up for the lens and the standoff; from a calibration
    #   matrix: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]     # pixels
    #   distortion: [k1, k2, p1, p2, k3]
    # reference:             # instead of a board: two points known in all photographs
    #   pixels: [[u, v], [u, v]]                          # u to the right, v down
    #   points: [[x, y], [x, y]]                          # m
"""

_CENTERLINES = """\
  measurement: {kind: centerlines}   # CSV files, x_m,y_m or s_m,x_m,y_m; or kind: images
"""

_LINES_IN_SPACE = """\
  measurement: {kind: centerlines}   # CSV files, x_m,y_m,z_m or s_m,x_m,y_m,z_m of markers
"""

_POSES = """\
  # In the order in which the poses were taken (below: the order of the names). role: held_out
  # keeps a pose out of the fit, to check the prediction. A clamped side takes a heading [rad],
  # start_heading or end_heading, counter-clockwise from +x; a free end has no end.
  poses:
"""

_POSES_IN_SPACE = """\
  # In the order in which the poses were taken (below: the order of the names). role: held_out
  # keeps a pose out of the fit, to check the prediction. A clamped side takes an orientation, the
  # gripper's frame as a unit quaternion [qx, qy, qz, qw], w last, whose x axis points along the
  # cable from start to end, at both ends; a free end has no end.
  poses:
"""
_POSE_IN_PLANE = "    - {{file: {file}, start: [0.0, 0.0], end: {fill}, role: fit}}\n"
_POSE_IN_SPACE = """\
    - {{file: {file}, role: fit,
       start: {fill}, start_orientation: {fill},
       end: {fill}, end_orientation: {fill}}}
"""


def template(
    name: str,
    files: Sequence[str] = (),
    kind: Literal["images", "centerlines"] = "images",
    in_space: bool = False,
) -> str:
    """Text of a configuration with placeholders for what only its user knows.

    Parameters
    ----------
    name : str
        What to call the cable.
    files : sequence of str
        One pose each, relative to the configuration; one placeholder if there are none.
    kind : "images" or "centerlines"
        What the files are, in a plane; in space centre-lines.
    in_space : bool
        Whether the cable may leave the plane.

    Returns
    -------
    str
        Valid YAML. `load_config` names each placeholder that is left.
    """
    measurement = _IMAGES if kind == "images" else _CENTERLINES
    parts = (_IN_PLANE, measurement, _POSES, _POSE_IN_PLANE)
    if in_space:
        parts = (_IN_SPACE, _LINES_IN_SPACE, _POSES_IN_SPACE, _POSE_IN_SPACE)
    top, measurement, remark, pose = parts
    listed = [pose.format(file=_quoted(file), fill=PLACEHOLDER) for file in files or [PLACEHOLDER]]
    return _TOP.format(name=_quoted(name), **top) + measurement + remark + "".join(listed)


def _quoted(text: str) -> str:
    """Text as YAML writes it inside a list: in quotes where it needs them."""
    return dump_yaml([text]).strip()[1:-1]
