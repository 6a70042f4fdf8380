"""The package without what only POSIX has."""

import subprocess
import sys

ELSEWHERE = """
import importlib, pkgutil, signal, sys, warnings

warnings.simplefilter("ignore")
for name in ("fcntl", "grp", "pwd", "resource", "termios"):
    sys.modules[name] = None  # an import of it fails
for name in ("pthread_sigmask", "SIGKILL", "SIGHUP", "SIGALRM"):
    delattr(signal, name)

import dlo_casadi

names = [item.name for item in pkgutil.walk_packages(dlo_casadi.__path__, "dlo_casadi.")]
for name in names:
    importlib.import_module(name)

from pathlib import Path
from dlo_casadi.io.files import only_run
from dlo_casadi.errors import OutputError
from dlo_casadi.runtime.executors import begin_worker, starting_processes

with starting_processes():
    pass
begin_worker(None)
with only_run(Path(sys.argv[1])):
    try:
        with only_run(Path(sys.argv[1])):
            print("not held")
    except OutputError as error:
        print(error)
with only_run(Path(sys.argv[1])):
    pass
print(len(names), "modules")
"""


def test_every_module_can_be_imported_and_one_run_holds_its_folder(tmp_path):
    """As on a system without file locks of its own and without masks of signals."""
    done = subprocess.run(
        [sys.executable, "-c", ELSEWHERE, str(tmp_path)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    said, count = done.stdout.splitlines()
    assert said == f"another run is writing to {tmp_path}; wait for its end"
    assert int(count.split()[0]) > 100
