"""Valid input of every reader, of files and of bytes from the wire, damaged at random: it is read,
or refused by a TumortrackError, within 5 s and 1 GB. `make attack` tries more of it."""

from __future__ import annotations

import gzip
import io
import json
import resource
import shutil
import struct
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dvrk_files import dvrk, open_cv
from raw_files import ball, nifti_header, npy, npz, nrrd, pcd, ply, png, sphere
from stereo_objects import endoscope
from tumortrack.case.meshes import read_meshes
from tumortrack.core import store
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import TumortrackError
from tumortrack.core.evidence import FreeSpace, Outline, Touch
from tumortrack.core.frames import FrameGraph
from tumortrack.core.types import Volume
from tumortrack.io.evidence_files import evidence_json

EXAMPLES, EXAMPLES_A_TIME = 40, 500  # of each reader; and with --attack TIMES
SECONDS, MEGABYTES = 5, 1024
TURN = [[0, -1, 0, 0.4], [-1, 0, 0, 0.1], [0, 0, -1, 0.7], [0, 0, 0, 1]]
WORDS = [b"nan", b"inf", b"-1", b"1e308", b"99999999999999999999", b"\n", b" ", b"\0", b"{", b'"']
NUMBERS = [0, 1, 127, 255, 256, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1]
REALS = [np.nan, np.inf, -np.inf, 1e30, -1e-30, 0.0]
PUT = st.one_of(
    st.binary(min_size=1, max_size=8),
    st.sampled_from(WORDS),
    st.builds(struct.pack, st.sampled_from(["<I", ">I", "<Q"]), st.sampled_from(NUMBERS)),
    st.builds(struct.pack, st.sampled_from(["<f", ">f", "<d"]), st.sampled_from(REALS)),
)


KINDS = ["put", "put", "insert", "delete", "repeat", "cut"]
# Every second change is among the first 400 bytes: headers are where readers decide.
CHANGE = st.tuples(
    st.sampled_from(KINDS), st.booleans(), st.integers(0, 2**31), st.integers(1, 64), PUT
)


def damaged(seed: bytes, changes: list[tuple[str, bool, int, int, bytes]]) -> bytes:
    data = bytearray(seed)
    for kind, early, place, size, new in changes:
        at = place % ((min(len(data), 400) if early else len(data)) + 1)
        if kind == "put":
            data[at : at + len(new)] = new
        elif kind == "insert":
            data[at:at] = new
        elif kind == "delete":
            del data[at : at + size]
        elif kind == "repeat":
            data[at:at] = data[at : at + size]
        else:
            del data[at:]
    return bytes(data)


def check(read: Callable[[bytes], object], seeds: list[bytes], times: int) -> None:
    """All that is read, or refused as it must be."""

    @settings(
        max_examples=EXAMPLES_A_TIME * times or EXAMPLES,
        deadline=1000 * SECONDS,
        derandomize=not times,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.sampled_from(range(len(seeds))), st.lists(CHANGE, min_size=1, max_size=8))
    def tried(n: int, changes: list[Any]) -> None:
        with suppress(TumortrackError):
            read(damaged(seeds[n], changes))

    read(seeds[0])  # it is valid
    before_mb = _peak_mb()
    tried()
    assert _peak_mb() - before_mb < MEGABYTES


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _bytes(seed: object) -> bytes:
    if isinstance(seed, bytes):
        return seed
    return (seed if isinstance(seed, str) else json.dumps(seed)).encode()


@pytest.fixture
def times(request, unchecked) -> int:
    return request.config.getoption("--attack")


POINTS = np.random.default_rng(0).uniform(50, 150, (40, 3)).astype("<f4")
ASCII_PLY = ply(POINTS[:1]).split(b"end_header")[0].replace(b"binary_little_endian", b"ascii")
VOXELS = ball(12).tobytes("F")
NIFTI = bytes(nifti_header((12, 12, 12))) + VOXELS
CAMERA = {"width": 16, "height": 12, "fx": 10.0, "fy": 10.0, "cx": 8, "cy": 6}
OPENCV = "%YAML:1.0\n---\nK1: !!opencv-matrix\n   rows: 1\n   cols: 1\n   dt: d\n   data: [ 1. ]\n"
GREY = np.arange(192, dtype=np.uint8).reshape(12, 16)
MARKUPS = {
    "markups": [
        {
            "coordinateSystem": "LPS",
            "controlPoints": [{"id": "1", "label": "a", "position": [1.0, 2.0, 3.0]}],
        }
    ]
}
FCSV = "# CoordinateSystem = LPS\n# columns = id,x,y,z\n1,1,2,3,0,0,0,1,1,1,0,a,,\n"
FRAME = {"frame_id": "base_link", "unit": "m"}
EASY_HANDEYE = """parameters:
  eye_on_hand: false
  robot_base_frame: base_link
  tracking_base_frame: camera_optical
transformation: {qw: 0.0, qx: 1.0, qy: 0.0, qz: 0.0, x: 0.4, y: 0.1, z: 0.7}
"""
EVIDENCE_TABLE = """piece,frame,kind,part,x_mm,y_mm,z_mm,std_mm,tip_mm,x_ct_mm,y_ct_mm,z_ct_mm
1,camera,touch,,1.5,2,150,0.8,1.5,,,
2,camera,outline,tumor_1,3,4,140,,,,,
2,camera,outline,tumor_1,5,4,139,,,,,
3,camera,landmark,,20,3,133,,,-41,12.5,88
"""
EVIDENCE = (
    Touch(place_mm=(1.0, 2.0, 150.0)),
    Outline(places_mm=((1.0, 2.0, 150.0), (3.0, 4.0, 151.0)), part="tumor_1"),
)
TOOL_TABLE = """stamp_ns,frame_id,x_mm,y_mm,z_mm,qw,qx,qy,qz
1700000000000000000,base_link,412.5,-30.0,510.25,0.0,1.0,0.0,0.0
1700000000100000000,base_link,412.5,-31.0,510.25,0.0,1.0,0.0,0.0
"""
TOUCHED_TABLE = "a_x,a_y,a_z,b_x,b_y,b_z\n0,0,1,9,9,9\n80,0,0,89,9,8\n0,70,0,9,79,8\n"
PLUS = """<?xml version="1.0"?><PlusConfiguration><CoordinateDefinitions>
<Transform From="Image" To="Probe" Matrix="0.1 0 0 5 0 0.1 0 6 0 0 0.1 7 0 0 0 1" Error="0.5"/>
</CoordinateDefinitions></PlusConfiguration>"""
IDENTITY = np.eye(4).tolist()
KIT = {
    "case_sha256": "0",
    "bead_diameter_mm": 6,
    "beads": [{"name": str(n), "center_mm": [n, n * n, 3.0]} for n in range(4)],
    "base_from_ct": IDENTITY,
    "organ_ml": 100,
    "tumors_ml": [3],
    "states": ["rest"],
    "parts": [
        {"name": "b", "file": "a.stl", "purpose": "", "volume_ml": 1, "base_from_part": IDENTITY}
    ],
}


# Three frames of a tracked probe: labels of 16 x 12 pixels.
SCAN_KEYS = {
    "ImageToProbeTransform": "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1",
    "UltrasoundImageOrientation": "UF",
    **{
        f"Seq_Frame000{n}_{name}": value
        for n in range(3)
        for name, value in {
            "ProbeToTrackerTransform": f"1 0 0 {n} 0 1 0 0 0 0 1 90 0 0 0 1",
            "ProbeToTrackerTransformStatus": "OK",
            "Timestamp": f"10.{n}",
        }.items()
    },
}
SCAN_LABELS = np.zeros((3, 12, 16), np.uint8)
SCAN_LABELS[:, 3:9, 4:12] = 1
PIXELS = SCAN_LABELS.tobytes()
SCAN_NRRD = (
    "NRRD0005\ntype: uint8\ndimension: 3\nsizes: 16 12 3\nkinds: domain domain list\n"
    "encoding: gzip\n" + "".join(f"{key}:={value}\n" for key, value in SCAN_KEYS.items()) + "\n"
).encode() + gzip.compress(PIXELS, mtime=0)


def scan(compressed: bool) -> bytes:
    fields = {
        "ObjectType": "Image",
        "DimSize": "16 12 3",
        "CompressedData": str(compressed),
        **SCAN_KEYS,
        "ElementType": "MET_UCHAR",
        "ElementDataFile": "LOCAL",
    }
    head = "".join(f"{key} = {value}\n" for key, value in fields.items()).encode()
    return head + (zlib.compress(PIXELS) if compressed else PIXELS)


def read_beside(path: Path) -> object:
    """As an organ's mesh: repaired where it can be."""
    return read_meshes([path])


def read_known(path: Path) -> object:
    """As what `frames` reads, to its end."""
    from tumortrack.live.frame_files import KnownFrames
    from tumortrack.report.frames import chain_lines, open_line

    (known := KnownFrames()).add(str(path))
    known.link_tables()
    links = [*known.links, *known.fits]
    graph = FrameGraph([*links, *links], "camera")
    return [*chain_lines(graph), *map(open_line, graph.open_cycles())]


# What reads it, by the file's name, and valid contents.
FILES: dict[str, tuple[Any, tuple[object, ...]]] = {
    "in.ply": (
        "tumortrack.io.depth_files:read_cloud",
        (ply(POINTS), ASCII_PLY + b"end_header\n1.5 2 150\n"),
    ),
    "in.pcd": ("tumortrack.io.depth_files:read_cloud", (pcd(count=40) + POINTS.tobytes(),)),
    "in.npz": ("tumortrack.io.depth_files:read_cloud", (npz(points_mm=POINTS),)),
    "in.npy": ("tumortrack.io.depth_files:read_cloud", (npy(POINTS),)),
    "intrinsics.json": ("tumortrack.io.depth_files:read_intrinsics", (CAMERA,)),
    "stereo.yaml": ("tumortrack_devices.stereo:read_calibration", ()),
    "in.nii": ("tumortrack.io.volume:read_volume", (NIFTI,)),
    "in.nii.gz": ("tumortrack.io.volume:read_labels", (gzip.compress(NIFTI, mtime=0),)),
    "in.nrrd": (
        "tumortrack.io.volume:read_raw",
        (
            nrrd("12 12 12", "encoding: raw", VOXELS),
            nrrd("12 12 12", "encoding: gzip", gzip.compress(VOXELS, mtime=0)),
        ),
    ),
    **{
        f"kidney.{kind}": (
            read_beside,
            (sphere(30).export(file_type=kind),),
        )
        for kind in ("stl", "ply", "obj")
    },
    "points.csv": ("tumortrack.io.points:read_points", ("x,y,z\n1,2,3\n4,5,6\n",)),
    "points.mrk.json": ("tumortrack.io.points:read_points", (MARKUPS,)),
    "points.fcsv": ("tumortrack.io.points:read_points", (FCSV,)),
    "evidence.json": ("tumortrack.io.evidence_files:read_evidence", ()),
    "evidence.csv": ("tumortrack.io.evidence_files:read_evidence", (EVIDENCE_TABLE,)),
    "calibration.json": (
        "tumortrack.live.calibration_file:read_frames",
        (
            {**FRAME, "robot_from_camera": TURN},
            {**FRAME, "camera_from_marker": TURN, "robot_from_marker": TURN},
        ),
    ),
    "calibration.yaml": ("tumortrack.live.calibration_file:read_frames", (EASY_HANDEYE,)),
    "scan.mha": ("tumortrack.api:read_ultrasound", (scan(True), scan(False))),
    "scan.nrrd": ("tumortrack.api:read_ultrasound", (SCAN_NRRD,)),
    "PSM1-registration-open-cv.json": (
        "tumortrack.live.calibration_file:read_frames",
        (open_cv(),),
    ),
    "PSM1-registration-dVRK.json": ("tumortrack.live.calibration_file:read_frames", (dvrk(),)),
    "poses.csv": ("tumortrack.live.poses:FilePoses", (TOOL_TABLE,)),
    "frames.json": (read_known, ({**FRAME, "robot_from_camera": TURN, "error_mm": 1},)),
    "frames.csv": (read_known, (TOUCHED_TABLE, TOOL_TABLE)),
    "plus.xml": (read_known, (PLUS,)),
    "kit.json": ("tumortrack_experiment.kit_file:read_kit", (KIT,)),
    "lens.json": (
        "tumortrack_experiment.calibrate.lens:read_lens",
        ({**CAMERA, "distortion": [0.0] * 5},),
    ),
}
FILES["stereo.yaml"] = FILES["stereo.yaml"][0], (msgspec.json.encode(endoscope()), OPENCV)
FILES["evidence.json"] = FILES["evidence.json"][0], (evidence_json(EVIDENCE),)


def of_file(path: Path, read: Callable[[Path], object], content: bytes) -> object:
    path.write_bytes(content)
    return read(path)


@pytest.mark.parametrize("name", FILES)
def test_files(name, tmp_path, times):
    reader, seeds = FILES[name]
    read = reader if callable(reader) else resolve_name(reader)
    read = partial(of_file, tmp_path / name, read)
    check(read, list(map(_bytes, seeds)), times)


def test_depth_images(tmp_path, times):
    from tumortrack.io.depth_files import read_depth_png

    camera = tmp_path / "intrinsics.json"
    camera.write_text(json.dumps(CAMERA))
    read = partial(of_file, tmp_path / "in.png", lambda path: read_depth_png(path, camera))
    check(read, [png(16, 12, 16, bytes(33 * 12))], times)


def test_poses_of_views(tmp_path, times):
    from tumortrack.io.depth_files import read_poses

    poses = {"fixed_from_camera": [TURN, TURN], "unit": "m", "frame_id": "base_link"}
    read = partial(of_file, tmp_path / "in.json", lambda path: read_poses(path, 2))
    check(read, [_bytes(poses)], times)


def test_pictures_of_a_board(tmp_path, times):
    from tumortrack_experiment.calibrate.pictures import read_shots

    seeds = [cv2.imencode(kind, GREY)[1].tobytes() for kind in (".png", ".jpg")]
    check(partial(of_file, tmp_path / "a.png", lambda path: read_shots(path.parent)), seeds, times)


def test_configurations(tmp_path, times):
    from tumortrack_resection.arms.config import CellConfig

    def read(path: Path) -> object:
        return from_builtins(store.read_json(path), CellConfig, str(path))

    check(partial(of_file, tmp_path / "in.json", read), [_bytes(to_builtins(CellConfig()))], times)


@pytest.mark.parametrize("syntax", ["", "rle", "jpeg lossless", "jpeg-ls", "jpeg 2000"])
def test_dicom_slices(syntax, tmp_path, times):
    """A slice; of compressed ones the picture, in a slice whose tags are as they were."""
    import pydicom
    from pydicom.encaps import encapsulate, get_frame

    from dicom_objects import packed, write_slices
    from tumortrack.io.dicom import read_dicom
    from tumortrack.simulation.phantom.dicom import write_dicom_series

    def read(path: Path) -> object:
        return read_dicom(path.parent, "1")

    if not syntax:
        write_dicom_series(Volume(np.zeros((12,) * 3, np.float32), np.eye(4)), tmp_path / "ct")
        path = min((tmp_path / "ct").iterdir())
        check(partial(of_file, path, read), [path.read_bytes()], times)
        return
    hu = np.random.default_rng(0).integers(0, 100, (24, 24, 2)).cumsum(0).astype("<i2")
    paths = write_slices(tmp_path, hu, 12)
    for path in paths:
        packed(path, syntax)
    dataset = pydicom.dcmread(paths[0])

    def of_frame(changed: bytes) -> object:
        dataset.PixelData = encapsulate([changed.ljust(8, b"\0")])
        dataset.save_as(stream := io.BytesIO())
        return of_file(paths[0], read, stream.getvalue())

    check(of_frame, [get_frame(dataset.PixelData, 0, number_of_frames=1)], times)


@pytest.mark.parametrize(
    ("registry", "seeds"),
    [
        ("SOURCES", [b"ros2:/camera/depth?mask=/mask", b"virtual:case?fps=20"]),
        ("SINKS", [b"viewer:8080", b"ur:1.2.3.4?arm=cutter&gain=300"]),
        ("TOOLS", [b"file:a.csv?tip=0,0,80&holds=true", b"openigtlink:h:1?name=a"]),
    ],
)
def test_words_of_the_command_line(registry, seeds, times):
    from tumortrack.live import spec

    parse = getattr(spec, registry).parse
    check(lambda data: parse(data.decode("utf-8", "replace")), seeds, times)


def test_openigtlink(times):
    from tumortrack_devices.igtl import message as igtl

    def read_message(data: bytes) -> None:
        header = igtl.unpack_header(data[: igtl.HEADER_SIZE])
        igtl.check_body(header, data[igtl.HEADER_SIZE :])

    def read_body(data: bytes) -> None:
        """The first byte says what it is of."""
        unpack = (
            *(igtl.unpack_transform, igtl.unpack_string),
            *(igtl.unpack_points, igtl.unpack_polydata_points, igtl.unpack_labels),
        )[data[0] % 5 if data else 0]
        content, _ = igtl.unpack_body(igtl.Header(2, "X", "x", 0, len(data) - 1, 0), data[1:])
        unpack(content)

    contents = (
        igtl.pack_transform(np.eye(4)),
        b"\0\3\0\1" + b"1",
        igtl.pack_points(np.ones((2, 3)), ["a", "b"], [(1, 2, 3)] * 2),
        igtl.pack_polydata(np.ones((3, 3)), np.array([[0, 1, 2]])),
        struct.pack("> H 4B 3H 12f 6H", 1, 1, 3, 2, 1, 3, 2, 1, *range(12), 0, 0, 0, 3, 2, 1)
        + bytes([0, 1, 2] * 2),
    )
    bodies = [
        bytes([n]) + igtl.pack(igtl.Message("X", "x", 1, content, {"k": "v"}))[igtl.HEADER_SIZE :]
        for n, content in enumerate(contents)
    ]
    status = igtl.pack(igtl.Message("STATUS", "x", 10**18, b"abc", {"k": "v"}))
    check(read_message, [status], times)
    check(read_body, bodies, times)


@pytest.mark.parametrize("distro", ["humble", "noetic"])
def test_ros_clouds(distro, times):
    from tumortrack_devices.ros import sensors
    from tumortrack_devices.ros.messages import Messages

    messages = Messages(distro)
    fields = [
        messages.make("sensor_msgs/msg/PointField", name=axis, offset=n, datatype=7, count=1)
        for n, axis in zip((0, 4, 8), "xyz", strict=True)
    ]
    message = messages.make(
        sensors.CLOUD,
        header=messages.header(10**18, "camera"),
        data=(POINTS[:20] / 1000).view(np.uint8).reshape(-1),
        fields=fields,
        **{"height": 1, "width": 20, "point_step": 12, "row_step": 240},
    )

    def read(data: bytes) -> object:
        return sensors.cloud_of(messages.from_bytes(data, sensors.CLOUD))

    check(read, [bytes(messages.to_bytes(message))], times)


@pytest.mark.parametrize("kind", ["ours", "bag", "sqlite3", "packed mcap"])
def test_recordings(kind, tmp_path, times):
    from recording_objects import frame_number, play, record, update_number, write_bag

    folder = tmp_path
    if kind == "ours":
        free = FreeSpace(places_mm=((0.0, 0.0, 90.0),))
        updates = [replace(update_number(n), evidence=(free,)) for n in range(2)]
        file = record(folder / "ours", updates) / "ours.mcap"
    else:
        frames = [frame_number(n) for n in range(2)]
        topics = {
            "/depth": ("depth/image_rect", frames),
            "/camera_info": ("depth/camera_info", frames),
        }
        made = write_bag(folder / "a.bag", topics, kind)
        file = made if kind == "bag" else next(p for p in made.iterdir() if p.suffix != ".yaml")
    seed = file.read_bytes()
    whole = kind == "packed mcap"  # with its metadata

    def read(content: bytes) -> None:
        file.write_bytes(content)
        play(file.parent if whole else file)

    check(read, [seed], times)


MEMBERS = [
    (reader, folder, name)
    for reader, folder, names in (
        ("tumortrack.io.case:load_case", "case", ("manifest.json", "tumor_1.ply")),
        (
            "tumortrack.io.scene_folder:read_scene",
            "scenes/0000",
            ("meta.json", "targets.csv"),
        ),
        ("tumortrack_resection.located:read_run", "run", ("manifest.json", "report.json")),
        ("tumortrack_resection.files:read_plan", "plan", ("plan.json", "motions.safetensors")),
        ("tumortrack.tracking.model_files:load_model", "model", ("manifest.json",)),
        ("tumortrack.tracking.model_files:load_model", "model", ("shape.safetensors",)),
        ("tumortrack.tracking.model_files:load_model", "network", ("weights.safetensors",)),
    )
    for name in names
]


@pytest.mark.attack
@pytest.mark.parametrize(("reader", "folder", "name"), MEMBERS)
def test_folders(reader, folder, name, tmp_path, times, attack_base):
    """One file of a folder; what its manifest says of it is made true."""
    copy, read = tmp_path / "copy", resolve_name(reader)
    shutil.copytree(attack_base / folder, copy)
    sealed = copy / store.MANIFEST
    manifest = json.loads(sealed.read_text()) if sealed.is_file() else {"files": {}}

    def of_bytes(content: bytes) -> object:
        (copy / name).write_bytes(content)
        if name in manifest["files"]:
            manifest["files"][name] = store.sha256_of(copy / name)
            sealed.write_text(json.dumps(manifest))
        return read(copy)

    check(of_bytes, [(copy / name).read_bytes()], min(times, 2))
