"""Turn photographs into centre-lines: arrays in, arrays out."""

from dlo_casadi.vision.board import Board, locate_board, locate_camera
from dlo_casadi.vision.calibration import Calibration, calibrate_camera
from dlo_casadi.vision.camera import (
    Camera,
    CameraPose,
    Picture,
    View,
    compare_pixels,
    from_reference,
)
from dlo_casadi.vision.centerline import ExtractedCenterline, extract_centerline
from dlo_casadi.vision.chain import Workings
from dlo_casadi.vision.cloud import line_in_cloud, of_color
from dlo_casadi.vision.image import draw_steps, encoded, read_image
from dlo_casadi.vision.image_curve import ImageCurve, nearest_in_order, see_cable
from dlo_casadi.vision.space_line import SpaceLine, Views, measure_views
from dlo_casadi.vision.video import VIDEO_ENDINGS, count_of, frames_of, rate_of
from dlo_casadi.vision.workplane import KnownCable
