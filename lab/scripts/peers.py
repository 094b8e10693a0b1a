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

from tumortrack.imaging.case import Case, load_case
from tumortrack.simulate.scene_folder import Scene, list_scenes, read_scene
from tumortrack_lab.peers.base import Peer
from tumortrack_lab.peers.kinds import peer_kinds
from tumortrack_lab.peers.rigid import matched_vertices


def line(peer: Peer, case: Case, scene: Scene, name: str) -> dict:
    fit = peer.fit(scene)
    errors = {
        part: float(np.linalg.norm(fit.carry(mesh.vertices_mm) - true, axis=1).mean())
        for part, mesh, true in (
            (part, mesh, matched_vertices(mesh, reference))
            for part, mesh, reference in zip(
                case.anatomy.names, case.anatomy.parts, scene.reference.parts, strict=True
            )
        )
    }
    return {
        "peer": peer.name,
        "scene": name,
        "error_mm": errors,
        "seconds": fit.seconds,
        "prepare_s": peer.prepare_s,
        "report": fit.report,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", type=Path)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("--only", nargs="*", default=None)
    parser.add_argument("--bcpd", type=Path, default=None)
    given = parser.parse_args()
    case = load_case(given.case)
    for name, kind in peer_kinds(given.bcpd).items():
        if given.only is None or name in given.only:
            peer = kind.made_for(case.anatomy, case.up_lps)
            for folder in list_scenes(given.scenes):
                print(json.dumps(line(peer, case, read_scene(folder), folder.name)), flush=True)


if __name__ == "__main__":
    main()
