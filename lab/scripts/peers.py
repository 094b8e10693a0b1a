"""Seconds and errors of every peer on a folder of scenes, as JSON lines.

    python lab/scripts/peers.py CASE SCENES [--only NAME ...] [--bcpd PROGRAM]

The errors are mean distances of a part's vertices to their true places, in mm: scenes must be made
from the case, so that their meshes keep its triangles.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from tumortrack.simulate.scene_folder import list_scenes, read_scene
from tumortrack_lab.peers.base import matched_vertices
from tumortrack_lab.peers.kinds import peer_kinds
from tumortrack_lab.study.methods import peer_method, study_case


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", type=Path)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("--only", nargs="*", default=None)
    parser.add_argument("--bcpd", type=Path, default=None)
    given = parser.parse_args()
    case = study_case("case", given.case, given.scenes)
    rest = case.anatomy_ct
    for name in peer_kinds(given.bcpd):
        if given.only is not None and name not in given.only:
            continue
        peer = peer_method(name, case, given.bcpd).peer
        for folder in list_scenes(given.scenes):
            scene = read_scene(folder)
            fit, errors = peer.fit(scene), {}
            for part, mesh, true in zip(rest.names, rest.parts, scene.reference.parts, strict=True):
                off = fit.carry(mesh.vertices_mm) - matched_vertices(mesh, true)
                errors[part] = float(np.linalg.norm(off, axis=1).mean())
            line = {"peer": peer.name, "scene": folder.name, "error_mm": errors}
            line |= {"seconds": fit.seconds, "prepare_s": peer.prepare_s, "report": fit.report}
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
