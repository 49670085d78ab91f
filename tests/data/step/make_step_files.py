"""Writes the STEP files of this folder; needs cadquery-ocp-novtk, which the project does not install.

python3.11 -m venv /tmp/ocp && /tmp/ocp/bin/pip install cadquery-ocp-novtk && /tmp/ocp/bin/python make_step_files.py
"""

from math import cos, pi, sin
from pathlib import Path

from OCP.BRep import BRep_Builder
from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut, BRepAlgoAPI_Fuse
from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox, BRepPrimAPI_MakeCylinder
from OCP.gp import gp_Ax2, gp_Dir, gp_Pnt
from OCP.Interface import Interface_Static
from OCP.STEPControl import STEPControl_AsIs, STEPControl_Writer
from OCP.TopoDS import TopoDS_Compound

HERE = Path(__file__).parent


def cylinder(radius, height, x=0.0, y=0.0, z=0.0):
    """Along z, millimetres."""
    return BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(x, y, z), gp_Dir(0, 0, 1)), radius, height).Shape()


def bushing(holes=3):
    """A flange of 50 x 6 mm with bolt holes of 5 mm on a circle of 38 mm, a neck of 28 x 24 mm, a bore of 20 mm."""
    shape = BRepAlgoAPI_Fuse(cylinder(25, 6), cylinder(14, 30)).Shape()
    shape = BRepAlgoAPI_Cut(shape, cylinder(10, 30)).Shape()
    for k in range(holes):
        angle = 2 * pi * k / holes
        shape = BRepAlgoAPI_Cut(shape, cylinder(2.5, 6, 19 * cos(angle), 19 * sin(angle))).Shape()
    return shape


def block():
    """60 x 20 x 10 mm, 40 mm away from the bushing's flange along x."""
    return BRepPrimAPI_MakeBox(gp_Pnt(65, -10, 0), 60, 20, 10).Shape()


def write(name, unit, *shapes):
    """One file of one solid, or of one compound."""
    Interface_Static.SetCVal_s("write.step.unit", unit)
    Interface_Static.SetCVal_s("write.surfacecurve.mode", "0")
    writer = STEPControl_Writer()
    if len(shapes) == 1:
        shape = shapes[0]
    else:
        shape, builder = TopoDS_Compound(), BRep_Builder()
        builder.MakeCompound(shape)
        for each in shapes:
            builder.Add(shape, each)
    writer.Transfer(shape, STEPControl_AsIs)
    writer.Write(str(HERE / name))


write("bushing_mm.step", "MM", bushing())
write("bushing_inch.stp", "INCH", bushing())
write("assembly_mm.step", "MM", bushing(), block())
