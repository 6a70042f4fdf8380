"""Models of electrical cables from photographs: fit, diagnose, predict, embed."""

__version__ = "0.1.0"
