"""Records and tables of numbers are laid out as the structures of the header."""

import shutil
import subprocess

import numpy as np
import pytest

from dlo_casadi.codegen import generate
from dlo_casadi.codegen.shapes import pose_size, records_of
from dlo_casadi.effects import CableData
from dlo_casadi.model.cable_model import CableModel

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")


@pytest.mark.parametrize("gravity", [(0.0, -9.81), (0.0, 0.0, -9.81)], ids=["plane", "space"])
def test_every_field_is_where_the_compiler_puts_it(tmp_path, gravity):
    cable = CableData(
        0.6, 0.03, 0.004, 0.015, torsional_stiffness=0.011 if len(gravity) == 3 else None
    )
    model = CableModel(cable, 5, "arc", "clamped", "clamped", gravity)
    generate(model, model.nominal, np.zeros(model.chain.n_rests)).write(tmp_path)
    records = records_of(model)._asdict()
    del records["columns"]
    lines = ['printf("%zu\\n", sizeof(dlo_pose) / sizeof(double));']
    expected = [pose_size(model)]
    for name, record in records.items():
        lines.append(f'printf("%zu\\n", sizeof(dlo_{name}));')
        expected.append(record.itemsize)
        for field in record.names:
            own, offset = record.fields[field][:2]
            lines.append(f'printf("%zu\\n", offsetof(dlo_{name}, {field}));')
            lines.append(f'printf("%zu\\n", sizeof(((dlo_{name} *)0)->{field}));')
            expected += [offset, own.itemsize]
    text = '#include "dlo_solver.h"\n#include <stdio.h>\nint main(void)\n{\n%s\nreturn 0;\n}\n'
    (tmp_path / "told.c").write_text(text % "\n".join(lines))
    subprocess.run(["cc", "told.c", "-o", "told"], cwd=tmp_path, check=True)
    told = subprocess.run(["./told"], cwd=tmp_path, check=True, capture_output=True, text=True)
    assert list(map(int, told.stdout.split())) == expected
