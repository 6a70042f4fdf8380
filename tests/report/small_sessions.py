"""Bench sessions on a coarse mesh, without the parts that take time."""

from pathlib import Path

from matplotlib.figure import Figure

from dlo_casadi.config import load_config
from dlo_casadi.report.sections import SECTIONS

BENCH = Path(__file__).parents[1] / "data" / "bench"
# Charts of a page of which only the text is looked at.
BARE = {
    name: Figure((1, 1))
    for name in (
        "errors",
        "pose_errors",
        "residuals",
        "rest_curvature",
        "unexplained",
        "next_pose",
    )
}
CONFIGS = Path(__file__).parents[2] / "configs"


def context(name, outcome):
    """What the template of a section is filled with, beside what all share."""
    (section,) = (one for one in SECTIONS if one.name == name)
    return section.context(outcome)


def small(name):
    """Configuration of a quick run of a bench session."""
    return quick(load_config(BENCH / name / "session.yaml"))


def photographs(names):
    """Configuration of a quick run of a few photographs of configs/cable.yaml."""
    return some("cable", names)


def in_space(names):
    """Configuration of a quick run of a few poses of configs/markers_in_space.yaml."""
    return some("markers_in_space", names, n=10)


def some(session, names, n=20):
    """Configuration of a quick run of a few poses of a session in configs."""
    config = load_config(CONFIGS / f"{session}.yaml")
    poses = tuple(pose for pose in config.experiment.poses if pose.name in names)
    experiment = config.experiment.changed(poses=poses)
    return quick(config.changed(experiment=experiment), n)


def quick(config, n=20):
    """The same session on a coarse mesh, without the parts that take time."""
    return config.changed(
        model=config.model.changed(n=n),
        estimation=config.estimation.changed(algorithm1=False),
        diagnosis=config.diagnosis.changed(enabled=False),
    )
