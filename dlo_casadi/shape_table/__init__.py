"""Shapes of a fitted cable in very many poses: from a grid or a list to one Parquet file."""

from dlo_casadi.shape_table.poses import Grid, PoseList
from dlo_casadi.shape_table.run import shape_table
from dlo_casadi.shape_table.solve import CHUNK_BYTES, Plan

__all__ = ["CHUNK_BYTES", "Grid", "Plan", "PoseList", "shape_table"]
