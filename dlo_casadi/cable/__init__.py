"""A fitted cable: its file, its shapes in any pose, and the C that solves for them."""

from dlo_casadi.cable.file import load
from dlo_casadi.cable.fitted_cable import FittedCable, Shape
