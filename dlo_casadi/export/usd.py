"""Export to USD: a linear curve with the deformable physics proposed by the AOUSD working group.

No release of USD has this proposal yet: its schemas and attributes are authored by name, and
programs that do not know them see only a curve.
"""

from collections.abc import Sequence

import numpy as np

from dlo_casadi.arrays import FloatArray
from dlo_casadi.export import newton
from dlo_casadi.export.common import Relaxed, rounded
from dlo_casadi.export.rod import Fixture, Rod

# Moduli [Pa] that the proposal assumes for a material without values: E 1 MPa, Poisson's ratio 0.3.
DEFAULT = (1e6, 1e6 / 2.6)
# Distance [link lengths] between the points at which a clamp holds its link, to prevent roll.
_LEVER = 5.0


def write(rod: Rod, head: Sequence[str]) -> str:
    """The rod as USDA: a curve, its material, two grippers, and the curve's attachments to them."""
    doc = "\n".join(head).replace('"', "'")
    rest_nodes, rest_frames = rod.unloaded
    count, stiff = len(rod.nodes), rod.inextensible(newton.STIFF)
    extent = np.array([rod.nodes.min(axis=0) - rod.radius, rod.nodes.max(axis=0) + rod.radius])
    gravity = float(np.linalg.norm(rod.gravity))
    down = rod.gravity / gravity if gravity else np.array([0.0, 0.0, -1.0])
    # A link's normal is its axis z; the last point starts no link.
    normals, rest_normals = (
        np.vstack([z, z[-1:]])
        for z in (f.apply([0.0, 0.0, 1.0]) for f in (rod.frames, rest_frames))
    )
    return f'''#usda 1.0
(
    defaultPrim = "World"
    doc = """{doc}"""
    kilogramsPerUnit = 1
    metersPerUnit = 1
    upAxis = "{rod.node.axes[-1].upper()}"
)

def Xform "World"
{{
    def PhysicsScene "scene"
    {{
        vector3f physics:gravityDirection = {_row(down)}
        float physics:gravityMagnitude = {gravity:.9g}
    }}

    def BasisCurves "cable" (
        prepend apiSchemas = ["PhysicsDeformableBodyAPI", "PhysicsCurvesDeformableSimAPI", \
"PhysicsCollisionAPI", "MaterialBindingAPI"]
    )
    {{
        uniform token type = "linear"
        int[] curveVertexCounts = [{count}]
        point3f[] points = {_rows(rod.nodes)}
        normal3f[] normals = {_rows(normals)} (
            interpolation = "vertex"
        )
        float[] widths = [{2 * rod.radius:.9g}] (
            interpolation = "constant"
        )
        float3[] extent = {_rows(extent)}
        rel material:binding:physics = </World/material>
        point3f[] physics:restShapePoints = {_rows(rest_nodes)}
        normal3f[] physics:restNormals = {_rows(rest_normals)}
        float[] physics:thicknesses = [{2 * rod.radius:.9g}]
        token physics:thicknesses:elementType = "constant"
        float[] physics:masses = {rounded(rod.link_masses)}
        token physics:masses:elementType = "segment"
    }}

    def Material "material" (
        prepend apiSchemas = ["PhysicsMaterialAPI", "PhysicsCurvesDeformableMaterialAPI"]
    )
    {{
        float physics:curvesStretchStiffness = {min(rod.axial, stiff):.9g}
        float physics:curvesShearStiffness = {stiff:.9g}
        float physics:curvesBendStiffness = {rod.mean_bending.mean():.9g}
        float physics:curvesTwistStiffness = {rod.torsion.mean():.9g}
    }}
{_gripper("start", rod.start, 0, rod)}{_gripper("end", rod.end, count - 2, rod)}}}
'''


def _gripper(side: str, fixture: Fixture, link: int, rod: Rod) -> str:
    """A fixture, and the attachment of the cable to it."""
    if not fixture.kind.place:
        return ""
    if fixture.kind.direction:  # coordinates: weight of the first point, normal, binormal
        lever = _LEVER * rod.h
        kind, index = "segment", [link] * 3
        on_link = np.array([[0.5, 0.0, 0.0], [0.5 - _LEVER, 0.0, 0.0], [0.5, lever, 0.0]])
        middle = (rod.nodes[link] + rod.nodes[link + 1]) / 2
        offsets = rod.frames[link].apply([[0.0, 0.0, 0.0], [lever, 0.0, 0.0], [0.0, 0.0, lever]])
        places = middle + offsets
    else:
        node = link + (side == "end")
        kind, index, on_link, places = "point", [node], np.zeros((0, 3)), rod.nodes[node : node + 1]
    x, y, z, w = fixture.frame.as_quat()
    on_fixture = fixture.frame.inv().apply(places - fixture.place)
    coordinates = f"\n        vector3f[] physics:coords0 = {_rows(on_link)}" if len(on_link) else ""
    return f'''
    def Xform "{side}"
    {{
        double3 xformOp:translate = {_row(fixture.place)}
        quatd xformOp:orient = {_row(np.array([w, x, y, z]))}
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]
    }}

    def PhysicsAttachment "hold_{side}"
    {{
        rel physics:src0 = </World/cable>
        token physics:type0 = "{kind}"
        int[] physics:indices0 = {index}{coordinates}
        rel physics:src1 = </World/{side}>
        token physics:type1 = "xform"
        vector3f[] physics:coords1 = {_rows(on_fixture)}
    }}
'''


def _row(values: FloatArray) -> str:
    return f"({', '.join(map(str, rounded(values)))})"


def _rows(values: FloatArray) -> str:
    return f"[{', '.join(map(_row, values))}]"


def settle(text: str, rod: Rod) -> Relaxed:
    """Relax a written curve in Newton by its own importer, where it can be simulated today."""
    with newton.quietly():
        import newton as simulator
        from pxr import Sdf, Usd

        layer = Sdf.Layer.CreateAnonymous(".usda")
        layer.ImportFromString(text)
        builder = simulator.ModelBuilder()
        builder.add_usd(Usd.Stage.Open(layer), apply_up_axis_from_stage=True)
        builder.color()
        model = builder.finalize("cpu")
    return newton.settled(model, rod, "Newton, from USD")
