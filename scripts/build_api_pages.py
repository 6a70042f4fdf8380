"""Write the pages of the Python API: python scripts/build_api_pages.py (results/api/index.html)."""

import sys
from pathlib import Path

import dlo_casadi

try:
    import pdoc
except ModuleNotFoundError:
    sys.exit("error: the pages need pdoc.\n  Try: pip install -e '.[docs]'")

MODULES = ("dlo_casadi", "dlo_casadi.effects", "dlo_casadi.vision", "dlo_casadi.runtime.parallel")
FOLDER = Path(__file__).parents[1] / "results/api"


def main() -> None:
    """Write one page for each module."""
    for name in dlo_casadi.__all__:  # they are imported on demand, and pdoc does not ask
        setattr(dlo_casadi, name, getattr(dlo_casadi, name))
    pdoc.render.configure(docformat="numpy", footer_text=f"dlo_casadi {dlo_casadi.__version__}")
    pdoc.pdoc(*MODULES, output_directory=FOLDER)
    print(FOLDER / "index.html")


if __name__ == "__main__":
    main()
