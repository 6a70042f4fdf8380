"""Photographs to centre-lines: arrays in, arrays out."""

from dlo_casadi.vision.board import Board, locate_board, locate_camera
from dlo_casadi.vision.calibration import Calibration, calibrate_camera
from dlo_casadi.vision.centerline import Centerline, extract_centerline
from dlo_casadi.vision.correspondence import nearest_in_order, places_along
from dlo_casadi.vision.image import read_image
from dlo_casadi.vision.image_curve import ImageCurve, see_cable
from dlo_casadi.vision.outline import Outline, compare_pixels, project_outline
from dlo_casadi.vision.pictures import draw_steps, encoded
from dlo_casadi.vision.search import Workings
from dlo_casadi.vision.space_line import SpaceLine, Views, measure_views
from dlo_casadi.vision.view import Camera, View, Viewpoint, from_reference

__all__ = [
    "Board",
    "Calibration",
    "Camera",
    "Centerline",
    "ImageCurve",
    "Outline",
    "SpaceLine",
    "View",
    "Viewpoint",
    "Views",
    "Workings",
    "calibrate_camera",
    "compare_pixels",
    "draw_steps",
    "encoded",
    "extract_centerline",
    "from_reference",
    "locate_board",
    "locate_camera",
    "measure_views",
    "nearest_in_order",
    "places_along",
    "project_outline",
    "read_image",
    "see_cable",
]
