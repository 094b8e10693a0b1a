"""What is fuzzed: readers of files and of bytes from the wire, each with valid input."""

from __future__ import annotations

import gzip
import io
import json
import shutil
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

Read = Callable[[bytes], object]
Target = tuple[list[bytes], Read]
TURN = [[0, -1, 0, 0.4], [-1, 0, 0, 0.1], [0, 0, -1, 0.7], [0, 0, 0, 1]]


EASY_HANDEYE = b"""parameters:
  eye_on_hand: false
  robot_base_frame: base_link
  tracking_base_frame: camera_optical
transformation: {qw: 0.0, qx: 1.0, qy: 0.0, qz: 0.0, x: 0.4, y: 0.1, z: 0.7}
"""
EVIDENCE_TABLE = b"""piece,frame,kind,part,x_mm,y_mm,z_mm,std_mm,tip_mm,x_ct_mm,y_ct_mm,z_ct_mm
1,camera,touch,,1.5,2,150,0.8,1.5,,,
2,camera,outline,tumor_1,3,4,140,,,,,
2,camera,outline,tumor_1,5,4,139,,,,,
3,camera,landmark,,20,3,133,,,-41,12.5,88
"""


def scratch() -> Path:
    """A new folder, in memory where that can be."""
    return Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))


def of_file(read: Callable[[Path], object], name: str, *seeds: bytes | str | object) -> Target:
    """A reader of files, with their contents: bytes, text, or what JSON is made of."""
    path = scratch() / name

    def of_bytes(content: bytes) -> object:
        path.write_bytes(content)
        return read(path)

    return [_bytes(seed) for seed in seeds], of_bytes


def _bytes(seed: object) -> bytes:
    if isinstance(seed, bytes):
        return seed
    return (seed if isinstance(seed, str) else json.dumps(seed)).encode()


def of_member(read: Callable[[Path], object], folder: Path, name: str) -> Target:
    """One file of a folder that is read; what an artifact's manifest says of it is made true."""
    from tumortrack.core import store

    copy = scratch() / folder.name
    shutil.copytree(folder, copy)
    content = (copy / name).read_bytes()
    sealed = copy / store.MANIFEST
    manifest = json.loads(sealed.read_text()) if sealed.is_file() and name != sealed.name else None

    def of_bytes(changed: bytes) -> object:
        (copy / name).write_bytes(changed)
        if manifest is not None and name in manifest["files"]:
            manifest["files"][name] = store.sha256_of(copy / name)
            sealed.write_text(json.dumps(manifest))
        return read(copy)

    return [content], of_bytes


def _clouds() -> dict[str, Target]:
    from attack_clouds import npy, npz, pcd, ply
    from tumortrack.sense.files import read_cloud

    points = np.random.default_rng(0).uniform(50, 150, (40, 3)).astype("<f4")
    rows = "\n".join(" ".join(map(str, row)) for row in points[:5])
    text = ply(points[:5]).split(b"end_header")[0].replace(b"binary_little_endian", b"ascii")
    return {
        "ply": of_file(read_cloud, "in.ply", ply(points), text + b"end_header\n" + rows.encode()),
        "pcd": of_file(read_cloud, "in.pcd", pcd(count=40) + points.tobytes()),
        "npz": of_file(read_cloud, "in.npz", npz(points_mm=points)),
        "npy": of_file(read_cloud, "in.npy", npy(points)),
    }


def _images() -> dict[str, Target]:
    from attack_clouds import png_of
    from stereo_objects import endoscope
    from tumortrack.sense.files import read_depth_png, read_intrinsics
    from tumortrack_devices.stereo import read_calibration

    yaml = (
        "%YAML:1.0\n---\nK1: !!opencv-matrix\n   rows: 1\n   cols: 1\n   dt: d\n   data: [ 1. ]\n"
    )
    camera = {"width": 16, "height": 12, "fx": 10.0, "fy": 10.0, "cx": 8, "cy": 6}
    camera["depth_unit_mm"] = 0.1
    intrinsics = scratch() / "intrinsics.json"
    intrinsics.write_text(json.dumps(camera))
    png = png_of(16, 12, 16, zlib.compress(bytes(33 * 12)))
    return {
        "intrinsics": of_file(read_intrinsics, "in.json", camera),
        "stereo calibration": of_file(
            read_calibration, "in.yaml", msgspec.json.encode(endoscope()), yaml
        ),
        "depth image": of_file(lambda path: read_depth_png(path, intrinsics), "in.png", png),
    }


def _volumes() -> dict[str, Target]:
    from attack_volumes import ball, nifti_header, nrrd
    from tumortrack.imaging.volume import read_raw

    voxels = ball(12).tobytes("F")
    nifti = bytes(nifti_header((12, 12, 12))) + voxels
    raw = nrrd("12 12 12", "encoding: raw", voxels)
    packed = nrrd("12 12 12", "encoding: gzip", gzip.compress(voxels, mtime=0))
    return {
        "nifti": of_file(read_raw, "in.nii", nifti),
        "nifti.gz": of_file(read_raw, "in.nii.gz", gzip.compress(nifti, mtime=0)),
        "nrrd": of_file(read_raw, "in.nrrd", raw, packed),
    }


def _dicom() -> dict[str, Target]:
    import pydicom
    from pydicom.encaps import encapsulate, get_frame

    from dicom_objects import packed, write_slices
    from tumortrack.core.types import Volume
    from tumortrack.imaging.dicom import read_dicom
    from tumortrack.phantom.dicom import write_dicom_series

    def read(folder: Path) -> object:
        return read_dicom(folder, "1")

    series = scratch() / "ct"
    hu = np.zeros((12, 12, 12), np.float32)
    write_dicom_series(Volume(hu, np.diag([1.0, 1.0, 1.0, 1.0])), series)
    first = min(series.iterdir())
    targets = {"dicom slice": of_member(read, series, first.name)}
    hu = np.random.default_rng(0).integers(0, 100, (24, 24, 2)).cumsum(0).astype("<i2")
    for syntax in ("rle", "jpeg lossless", "jpeg-ls", "jpeg 2000"):
        paths = write_slices(scratch(), hu, 12)
        for path in paths:
            packed(path, syntax)
        slice_ = pydicom.dcmread(paths[0])

        def of_frame(changed: bytes, path: Path = paths[0], slice_: Any = slice_) -> object:
            """The compressed picture in a slice whose tags are as they were."""
            slice_.PixelData = encapsulate([changed.ljust(8, b"\0")])
            slice_.save_as(stream := io.BytesIO())
            path.write_bytes(stream.getvalue())
            return read(path.parent)

        frame = get_frame(slice_.PixelData, 0, number_of_frames=1)
        targets[f"dicom {syntax}"] = [frame], of_frame
    return targets


def _meshes() -> dict[str, Target]:
    from attack_series import sphere
    from tumortrack.core.mesh_files import read_mesh

    small = sphere(30.0)
    return {
        f"mesh {kind}": of_file(read_mesh, f"in.{kind}", small.export(file_type=kind))
        for kind in ("stl", "ply", "obj")
    }


def _tables() -> dict[str, Target]:
    from tumortrack.core.store import read_json
    from tumortrack.tracking.points import read_points

    point = {"id": "1", "label": "a", "position": [1.0, 2.0, 3.0]}
    markups = {"markups": [{"coordinateSystem": "LPS", "controlPoints": [point]}]}
    head = (
        "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n# columns = id,x,y,z\n"
    )
    return {
        "json": of_file(read_json, "in.json", {"a": [1, 2, {"b": "c"}]}),
        "points csv": of_file(read_points, "in.csv", "x,y,z\n1,2,3\n4,5,6\n"),
        "markups": of_file(read_points, "in.mrk.json", markups),
        "fcsv": of_file(read_points, "in.fcsv", f"{head}1,1,2,3,0,0,0,1,1,1,0,a,,\n"),
    }


def _command_line() -> dict[str, Target]:
    from tumortrack.live.spec import SINKS, SOURCES, TOOLS

    def text(parse: Callable[[str], object], *seeds: bytes) -> Target:
        return [*seeds], lambda data: parse(data.decode("utf-8", "replace"))

    sources = (b"ros2:/camera/depth?mask=/mask", b"virtual:case?fps=20", b"recording:a?rate=2")
    return {
        "source": text(SOURCES.parse, *sources),
        "sink": text(SINKS.parse, b"viewer:8080", b"ur:1.2.3.4?arm=cutter&gain=300"),
        "tool": text(TOOLS.parse, b"file:a.csv?tip=0,0,80&holds=true", b"openigtlink:h:1?name=a"),
    }


def _wire() -> dict[str, Target]:
    from tumortrack_devices.igtl import message as igtl_messages
    from tumortrack_devices.igtl.message import HEADER_SIZE, Message, check_body, pack
    from tumortrack_devices.ros import sensors
    from tumortrack_devices.ros.messages import Messages

    def igtl(data: bytes) -> None:
        check_body(igtl_messages.unpack_header(data[:HEADER_SIZE]), data[HEADER_SIZE:])

    def igtl_body(data: bytes) -> None:
        """The first byte says what it is of."""
        kinds = "transform", "string", "points", "polydata_points"
        header = igtl_messages.Header(2, "X", "x", 0, len(data) - 1, 0)
        content, _ = igtl_messages.unpack_body(header, data[1:])
        getattr(igtl_messages, f"unpack_{kinds[data[0] % 4]}")(content)

    contents = (
        igtl_messages.pack_transform(np.eye(4)),
        b"\0\3\0\1" + b"1",
        igtl_messages.pack_points(np.ones((2, 3)), ["a", "b"], [(1, 2, 3)] * 2),
        igtl_messages.pack_polydata(np.ones((3, 3)), np.array([[0, 1, 2]])),
    )
    bodies = [
        bytes([n]) + pack(Message("X", "x", 1, content, {"k": "v"}))[HEADER_SIZE:]
        for n, content in enumerate(contents)
    ]

    def read_image(message: Any) -> object:
        return sensors._pixels(message, {"16UC1": "u2"}, "a depth image")  # type: ignore[attr-defined]

    def read_info(message: Any) -> object:
        return sensors._intrinsics_of(message, False)  # type: ignore[attr-defined]

    targets: dict[str, Target] = {
        "openigtlink": ([pack(Message("STATUS", "x", 10**18, b"abc", {"k": "v"}))], igtl),
        "openigtlink tool": (bodies, igtl_body),
    }
    points = np.random.default_rng(0).random((20, 3)).astype("<f4").view(np.uint8).reshape(-1)
    camera = np.array([5.0, 0, 4, 0, 5, 3, 0, 0, 1])
    info_type = "sensor_msgs/msg/CameraInfo"
    for distro in ("humble", "noetic"):
        messages = Messages(distro)  # type: ignore[arg-type]

        def target(
            kind: str, read: Callable[[Any], object], messages: Any = messages, **fields: Any
        ) -> Target:
            message = messages.make(kind, header=messages.header(10**18, "camera"), **fields)
            seed = bytes(messages.to_bytes(message))
            return [seed], lambda data: read(messages.from_bytes(data, kind))

        fields = [
            messages.make("sensor_msgs/msg/PointField", name=axis, offset=n, datatype=7, count=1)
            for n, axis in zip((0, 4, 8), "xyz", strict=True)
        ]
        grid = {"height": 1, "width": 20, "point_step": 12, "row_step": 240}
        pixels = {"height": 6, "width": 8, "encoding": "16UC1", "step": 16}
        targets |= {
            f"{distro} cloud": target(
                sensors.CLOUD, sensors.cloud_of, data=points, fields=fields, **grid
            ),
            f"{distro} image": target(
                sensors.IMAGE, read_image, data=np.zeros(96, np.uint8), **pixels
            ),
            f"{distro} camera_info": target(info_type, read_info, height=6, width=8, k=camera),
        }
    return targets


def _configurations() -> dict[str, Target]:
    from tumortrack.core.config import from_builtins, to_builtins
    from tumortrack.core.evidence import Outline, Touch, evidence_json, read_evidence
    from tumortrack.core.store import read_json
    from tumortrack.live.calibration_file import read_frames
    from tumortrack.sense.files import read_poses
    from tumortrack.tracking.presets import PRESETS
    from tumortrack_resection.arms.config import CellConfig
    from tumortrack_resection.values import ResectionConfig
    from warp_objects import ANATOMY

    def written(value: object) -> Target:
        def read(path: Path) -> object:
            return from_builtins(read_json(path), type(value), str(path))

        return of_file(read, "in.json", to_builtins(value))

    frame = {"frame_id": "base_link", "unit": "m"}
    hand_eye = {**frame, "robot_from_camera": TURN}
    marker = {**frame, "camera_from_marker": TURN, "robot_from_marker": TURN}
    poses = {"fixed_from_camera": [TURN, TURN], "unit": "m", "frame_id": "base_link"}
    touch = Touch(place_mm=(1.0, 2.0, 150.0))
    outline = Outline(places_mm=((1.0, 2.0, 150.0), (3.0, 4.0, 151.0)), part="tumor_1")
    return {
        "poses": of_file(lambda path: read_poses(path, 2), "in.json", poses),
        "evidence": of_file(read_evidence, "in.json", evidence_json((touch, outline))),
        "evidence table": of_file(read_evidence, "in.csv", EVIDENCE_TABLE),
        "calibration": of_file(read_frames, "in.json", hand_eye, marker),
        "easy_handeye": of_file(read_frames, "in.yaml", EASY_HANDEYE),
        "cell": written(CellConfig()),
        "resection": written(ResectionConfig()),
        "registration": written(PRESETS["clinic"](ANATOMY)),
        "training": written(PRESETS["quick"](ANATOMY)),
    }


def _recordings() -> dict[str, Target]:
    from recording_objects import frame_number, record, update_number, write_bag
    from tumortrack.core.errors import InputError
    from tumortrack.core.evidence import Free
    from tumortrack.live.values import SourceEnded
    from tumortrack_devices.sources.recording import RecordingSourceConfig

    def play(path: Path) -> None:
        source = RecordingSourceConfig(path=path, rate=0).open()
        try:
            while True:
                try:
                    source.read(0.0)
                except InputError:  # of one frame: the next is read
                    continue
        except SourceEnded:
            pass
        finally:
            source.close()

    folder, free = scratch(), Free(places_mm=((0.0, 0.0, 90.0),))
    frames = [frame_number(n) for n in range(2)]
    topics = {"/depth": ("depth/image_rect", frames), "/camera_info": ("depth/camera_info", frames)}
    updates = [replace(update_number(n), evidence=(free,)) for n in range(2)]
    ours = record(folder / "ours", updates) / "ours.mcap"
    packed = write_bag(folder / "packed", topics, "packed mcap")
    bag = write_bag(folder / "a.bag", topics, "bag")
    (file,) = write_bag(folder / "sqlite", topics, "sqlite3").glob("*.db3")
    return {
        "mcap": of_file(play, "in.mcap", ours.read_bytes()),
        "bag": of_file(play, "in.bag", bag.read_bytes()),
        "db3": of_file(play, "in.db3", file.read_bytes()),
        "rosbag2 folder": of_member(play, packed, "metadata.yaml"),
        "packed mcap": of_member(play, packed, "packed.mcap"),
    }


def _margins() -> dict[str, Target]:
    from tumortrack.tracking import bound_factor
    from tumortrack_lab.margins.factor import found_factor
    from tumortrack_lab.margins.table import Row, head_of, open_table

    valid = found_factor([Row("s", "", ratio=1.0)] * 59, "", "", 0)
    bound_factor.write_factor(path := scratch() / bound_factor.NAME, valid)
    row = {"scene": "s", "sha256": "", "ratio": 1.0}
    table = "\n".join(map(json.dumps, (head_of("", 0), row)))

    def rows(path: Path) -> object:
        with open_table(path, head_of("", 0)) as (known, _):
            return known

    return {
        "bound factor": of_file(bound_factor.read_sealed, "in.json", path.read_bytes()),
        "margins table": of_file(rows, "in.jsonl", table),
    }


def _experiment() -> dict[str, Target]:
    """Kits, lenses, robots' poses, and pictures of boards."""
    import cv2

    from tumortrack_experiment.calibrate.lens import read_lens
    from tumortrack_experiment.calibrate.pictures import Shot, read_shots, with_poses
    from tumortrack_experiment.kit_file import read_kit

    rows = np.eye(4).tolist()
    beads = [{"name": str(n), "center_mm": [n, n * n, 3.0]} for n in range(4)]
    parts = [
        {"name": "base", "file": "a.stl", "purpose": "", "volume_ml": 1, "base_from_part": rows}
    ]
    kit = {"case_sha256": "0", "bead_diameter_mm": 6, "beads": beads, "base_from_ct": rows}
    kit |= {"organ_ml": 100, "tumors_ml": [3], "states": ["rest"], "parts": parts}
    lens = {"width": 16, "height": 12, "fx": 10, "fy": 10, "cx": 8, "cy": 6}
    lens["distortion"] = [0.0] * 5
    poses = {"base_from_tool": [rows, rows], "unit": "mm", "frame_id": "base"}
    shots = [Shot(str(n), np.zeros((2, 2), np.uint8)) for n in range(2)]
    grey = np.arange(192, dtype=np.uint8).reshape(12, 16)
    pictures = [cv2.imencode(kind, grey)[1].tobytes() for kind in (".png", ".jpg")]
    return {
        "kit": of_file(read_kit, "in.json", kit),
        "lens": of_file(read_lens, "in.json", lens),
        "robot poses": of_file(lambda path: with_poses(shots, path), "in.json", poses),
        "picture": of_file(lambda path: read_shots(path.parent), "a.png", *pictures),
    }


def _artifacts(base: Path) -> dict[str, Target]:
    """Case, scene, both kinds of model, run and plan, as ``harness.base_in`` makes them."""
    from tumortrack.imaging.case import load_case
    from tumortrack.simulate.scene_folder import read_scene
    from tumortrack.tracking.model_files import load_model
    from tumortrack_resection.files import read_plan
    from tumortrack_resection.located import read_run

    def read_model(folder: Path) -> object:
        return load_model(folder, "cpu")

    model = ("manifest.json", "weights.safetensors", "shape.safetensors")
    members: list[tuple[str, Callable[[Path], object], tuple[str, ...]]] = [
        ("case", load_case, ("manifest.json", "tumor_1.ply")),
        ("scenes/0000", read_scene, ("meta.json", "targets.csv", "tumor_1.ply")),
        ("run", read_run, ("manifest.json", "report.json", "occupancy.ply")),
        ("plan", read_plan, ("plan.json", "motions.safetensors", "piece.ply")),
        ("model", read_model, model),
        ("network", read_model, model),
    ]
    return {
        f"{folder.split('/')[0]} {name}": of_member(read, base / folder, name)
        for folder, read, names in members
        for name in names
        if (base / folder / name).is_file()
    }


def targets(base: Path | None = None) -> dict[str, Target]:
    """All of them; those that need a model only with a ``base``."""
    found: dict[str, Target] = {}
    for make in (
        *(_clouds, _images, _volumes, _dicom, _meshes, _tables, _command_line, _wire),
        *(_configurations, _recordings, _margins, _experiment),
    ):
        found |= make()
    return found | (_artifacts(base) if base is not None else {})
