"""Stories draw photographs as the tests of the camera do."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "vision"))
