"""Declared noise that contradicts the cable or the readings, most often given in another unit."""

from collections.abc import Iterator

import numpy as np
from scipy.special import chdtr

from dlo_casadi.config.problems import ConfigProblem
from dlo_casadi.config.sections import Experiment
from dlo_casadi.config.values import Range
from dlo_casadi.rod.quantities import QUANTITIES, quantity_of

# Lower limit of the noise of a point: a fifth of green light's wavelength, beyond any camera.
_FINEST_STD = 1.0e-7
# Largest std of a point, as a share of the cable's length. Twelve poses of 60 points with 0.0004
# lengths of noise tell EI to 0.28 % (scripts/check_readings.py, clean); with 0.05 lengths to 35 %,
# a 95 % interval of a factor of four, and nobody measures a cable so badly.
_COARSEST_STD = 0.05
# Probability of readings so small that their declared noise is refused.
_BY_CHANCE = 1.0e-6


def impossible_noise(experiment: Experiment, length: float) -> Iterator[ConfigProblem]:
    """Find noise that is impossible for a cable of that length [m], or for its readings."""
    at = ("experiment", "measurement")
    std = experiment.measurement.std
    if std is not None and std not in (possible := Range(_FINEST_STD, _COARSEST_STD * length, "m")):
        text = f"std: {possible.complaint(std)} for a cable of {length:g} m"
        if (meant := std / 1e3) in possible and meant < std:
            text += f": units are SI, did you mean {meant:g}?"
        yield ConfigProblem((*at, "std"), f"{text}; without it, it is estimated from the data")
    for quantity in QUANTITIES:
        kind, unit, key = quantity.name, quantity.unit, quantity.std_key
        std = getattr(experiment.measurement, key)
        # A zero may stand for what a pin cannot have; it was not measured.
        read = [
            x
            for pose in experiment.poses
            for name, values in pose.readings.items()
            if quantity_of(name) is quantity
            for x in np.atleast_1d(values)
            if x
        ]
        if std is None or not read:
            continue
        # Noise adds to every reading: the sum of squares over its variance is chi-square or more.
        if chdtr(len(read), np.sum(np.square(read)) / std**2) < _BY_CHANCE:
            rms = float(np.sqrt(np.mean(np.square(read))))
            text = (
                f"{key}: {std:g} {unit}, but the readings of a {kind} are {rms:.2g} {unit} RMS"
                " in all, and noise alone would make them as large as its standard deviation"
            )
            if std / 1e3 < rms:
                text += f": units are SI, did you mean {std / 1e3:g}?"
            yield ConfigProblem((*at, key), f"{text}; without it, it is estimated")
