"""A scene for SOFA with SofaPython3. Never run: SOFA is not on PyPI (the package `sofa` there is
something else). Written after SOFA's documentation and MeshVTKLoader.

    tumortrack export CASE BODY --format vtk --located RUN && cd BODY && runSofa .../sofa_scene.py

Units: mm, kg, s, so that Young's moduli in kPa and stresses in kg / (mm s2) are the same numbers.
"""

from typing import Any

KG_PER_MM3 = 1.05e-6  # body.json: presumed.density_kg_per_m3
GRAVITY_MM_S2 = [0.0, 9810.0, 0.0]  # down in a level camera's picture; yours may differ


def createScene(root: Any) -> None:  # noqa: N802, SOFA's name
    root.gravity = GRAVITY_MM_S2
    root.dt = 0.01
    root.addObject("RequiredPlugin", pluginName="Sofa.Component")
    root.addObject("DefaultAnimationLoop")
    root.addObject("MeshVTKLoader", name="now", filename="body.tets.vtk")
    root.addObject("MeshVTKLoader", name="rest", filename="rest.tets.vtk")
    root.addObject("MeshVTKLoader", name="surface", filename="kidney.vtk")

    organ = root.addChild("organ")
    organ.addObject("EulerImplicitSolver")
    organ.addObject("CGLinearSolver", iterations=100, tolerance=1e-8, threshold=1e-8)
    organ.addObject("TetrahedronSetTopologyContainer", src="@../now")
    organ.addObject("TetrahedronSetGeometryAlgorithms", template="Vec3")
    organ.addObject(
        "MechanicalObject",
        template="Vec3",
        position="@../now.position",  # mode_1_mm, ...: add what you draw, times a standard normal
        rest_position="@../rest.position",
    )
    organ.addObject("MeshMatrixMass", massDensity=KG_PER_MM3)
    organ.addObject(
        "TetrahedronFEMForceField",
        method="large",
        youngModulus="@../now.young_modulus_kpa",  # of each tetrahedron
        poissonRatio=0.45,  # 0.49 locks linear tetrahedra
    )
    organ.addObject("FixedProjectiveConstraint", indices=[0])  # the hilum's nodes: yours to choose

    shown = organ.addChild("surface")
    shown.addObject("OglModel", src="@../../surface", color=[0.73, 0.4, 0.33, 1.0])
    shown.addObject("BarycentricMapping")
