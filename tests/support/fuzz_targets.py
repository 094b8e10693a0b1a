"""What is fuzzed: readers of files and of bytes from the wire, each with valid input."""

from __future__ import annotations

import io
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np

Read = Callable[[bytes], object]
Target = tuple[list[bytes], Read]


def scratch() -> Path:
    """A new folder, in memory where that can be."""
    return Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))


def of_file(suffix: str, read: Callable[[Path], object]) -> Read:
    """A reader of files as one of bytes."""
    path = scratch() / f"in{suffix}"

    def of_bytes(content: bytes) -> object:
        path.write_bytes(content)
        return read(path)

    return of_bytes


def _cloud_files() -> dict[str, Target]:
    from attack_clouds import npz, pcd, ply
    from tumortrack.sense.files import read_cloud

    points = np.random.default_rng(0).uniform(50, 150, (40, 3)).astype("<f4")
    rows = "\n".join(" ".join(map(str, row)) for row in points[:5])
    text = ply(points[:5]).split(b"end_header")[0].replace(b"binary_little_endian", b"ascii")
    return {
        "ply": (
            [ply(points), text + b"end_header\n" + rows.encode()],
            of_file(".ply", read_cloud),
        ),
        "pcd": ([pcd(count=40) + points.tobytes()], of_file(".pcd", read_cloud)),
        "npz": ([npz(points_mm=points)], of_file(".npz", read_cloud)),
    }


def _images() -> dict[str, Target]:
    import zlib

    from attack_clouds import png_of
    from stereo_objects import endoscope
    from tumortrack.sense.files import read_depth_png, read_intrinsics
    from tumortrack.sense.stereo import read_calibration

    stereo = msgspec.json.encode(endoscope())
    yaml = (
        b"%YAML:1.0\n---\nK1: !!opencv-matrix\n   rows: 1\n   cols: 1\n   dt: d\n   data: [ 1. ]\n"
    )
    camera = {"width": 16, "height": 12, "fx": 10.0, "fy": 10.0, "cx": 8, "cy": 6}
    text = json.dumps({**camera, "depth_unit_mm": 0.1}).encode()
    intrinsics = scratch() / "intrinsics.json"
    intrinsics.write_bytes(text)
    png = png_of(16, 12, 16, zlib.compress(bytes(33 * 12)))
    return {
        "intrinsics": ([text], of_file(".json", read_intrinsics)),
        "stereo calibration": ([stereo, yaml], of_file(".yaml", read_calibration)),
        "depth image": ([png], of_file(".png", lambda path: read_depth_png(path, intrinsics))),
    }


def _volumes() -> dict[str, Target]:
    import gzip

    from attack_volumes import ball, nifti_header
    from tumortrack.imaging.volume import read_raw

    nifti = bytes(nifti_header((12, 12, 12))) + ball(12).tobytes("F")
    head = (
        "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 12 12 12\nspace: left-posterior-superior\n"
        "space directions: (1,0,0) (0,1,0) (0,0,1)\nspace origin: (0,0,0)\nencoding: "
    )
    raw = f"{head}raw\n\n".encode() + ball(12).tobytes("F")
    packed = f"{head}gzip\n\n".encode() + gzip.compress(ball(12).tobytes("F"), mtime=0)
    return {
        "nifti": ([nifti], of_file(".nii", read_raw)),
        "nifti.gz": ([gzip.compress(nifti, mtime=0)], of_file(".nii.gz", read_raw)),
        "nrrd": ([raw, packed], of_file(".nrrd", read_raw)),
    }


def _dicom() -> dict[str, Target]:
    import pydicom
    from pydicom.encaps import encapsulate, get_frame

    from dicom_objects import packed, write_slices
    from tumortrack.core.types import Volume
    from tumortrack.imaging.dicom import read_dicom
    from tumortrack.phantom.dicom import write_dicom_series

    series = scratch() / "ct"
    hu = np.zeros((12, 12, 12), np.float32)
    write_dicom_series(Volume(hu, np.diag([1.0, 1.0, 1.0, 1.0])), series)
    first = sorted(series.iterdir())[0]
    content = first.read_bytes()

    def of_slice(path: Path) -> Read:
        def read(changed: bytes) -> object:
            path.write_bytes(changed)
            return read_dicom(path.parent, "1")

        return read

    def of_frame(slice_: pydicom.Dataset, read: Read) -> Read:
        """Of the compressed picture in a slice whose tags are as they were."""

        def read_frame(changed: bytes) -> object:
            slice_.PixelData = encapsulate([changed.ljust(8, b"\0")])
            slice_.save_as(stream := io.BytesIO())
            return read(stream.getvalue())

        return read_frame

    targets: dict[str, Target] = {"dicom slice": ([content], of_slice(first))}
    hu = np.random.default_rng(0).integers(0, 100, (24, 24, 2)).cumsum(0).astype("<i2")
    for syntax in ("rle", "jpeg lossless", "jpeg-ls", "jpeg 2000"):
        paths = write_slices(scratch(), hu, 12)
        for path in paths:
            packed(path, syntax)
        slice_ = pydicom.dcmread(paths[0])
        frame = get_frame(slice_.PixelData, 0, number_of_frames=1)
        targets[f"dicom {syntax}"] = ([frame], of_frame(slice_, of_slice(paths[0])))
    return targets


def _meshes() -> dict[str, Target]:
    from attack_series import sphere
    from tumortrack.core.mesh_files import read_mesh

    small = sphere(30.0)
    return {
        f"mesh {kind}": (
            [(made if isinstance(made, bytes) else made.encode())],
            of_file(f".{kind}", read_mesh),
        )
        for kind in ("stl", "ply", "obj")
        for made in [small.export(file_type=kind)]
    }


def _artifacts() -> dict[str, Target]:
    from tumortrack.core.store import read_json
    from tumortrack.tracking.points import read_points

    point = {"id": "1", "label": "a", "position": [1.0, 2.0, 3.0]}
    markups = {"markups": [{"coordinateSystem": "LPS", "controlPoints": [point]}]}
    head = (
        "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n# columns = id,x,y,z\n"
    )
    fcsv = f"{head}1,1,2,3,0,0,0,1,1,1,0,a,,\n".encode()
    return {
        "json": ([json.dumps({"a": [1, 2, {"b": "c"}]}).encode()], of_file(".json", read_json)),
        "points csv": ([b"x,y,z\n1,2,3\n4,5,6\n"], of_file(".csv", read_points)),
        "markups": ([json.dumps(markups).encode()], of_file(".mrk.json", read_points)),
        "fcsv": ([fcsv], of_file(".fcsv", read_points)),
    }


def _texts() -> dict[str, Target]:
    from tumortrack.live.spec import SINKS, SOURCES

    def text(parse: Callable[[str], object]) -> Read:
        return lambda data: parse(data.decode("utf-8", "replace"))

    return {
        "source": (
            [b"ros2:/camera/depth?mask=/mask", b"virtual:case?fps=20", b"recording:a?rate=2"],
            text(SOURCES.parse),
        ),
        "sink": ([b"viewer:8080", b"ur:1.2.3.4?arm=cutter&gain=300"], text(SINKS.parse)),
    }


def _wire() -> dict[str, Target]:
    from tumortrack.live.igtl.message import (
        HEADER_SIZE,
        Message,
        check_body,
        pack,
        unpack_header,
    )
    from tumortrack.live.ros.messages import Messages
    from tumortrack.live.ros.sensors import CLOUD, IMAGE, cloud_of

    def igtl(data: bytes) -> None:
        check_body(unpack_header(data[:HEADER_SIZE]), data[HEADER_SIZE:])

    made: dict[str, Target] = {
        "openigtlink": ([pack(Message("STATUS", "x", 10**18, b"abc", {"k": "v"}))], igtl)
    }
    for distro in ("humble", "noetic"):
        messages = Messages(distro)  # type: ignore[arg-type]
        points = np.random.default_rng(0).random((20, 3)).astype("<f4")
        field = "sensor_msgs/msg/PointField"
        cloud = messages.make(
            CLOUD,
            header=messages.header(10**18, "camera"),
            height=1,
            width=20,
            point_step=12,
            row_step=240,
            data=points.view(np.uint8).reshape(-1),
            fields=[
                messages.make(field, name=name, offset=4 * n, datatype=7, count=1)
                for n, name in enumerate("xyz")
            ],
        )

        def of_cloud(data: bytes, messages: Messages = messages) -> object:
            return cloud_of(messages.from_bytes(data, CLOUD))

        def of_image(data: bytes, messages: Messages = messages) -> object:
            from tumortrack.live.ros import sensors

            return sensors._pixels(  # type: ignore[attr-defined]
                messages.from_bytes(data, IMAGE), {"16UC1": "u2"}, "a depth image"
            )

        def of_info(data: bytes, messages: Messages = messages) -> object:
            from tumortrack.live.ros import sensors

            info = messages.from_bytes(data, "sensor_msgs/msg/CameraInfo")
            return sensors._intrinsics_of(info, False)  # type: ignore[attr-defined]

        image = messages.make(
            IMAGE,
            header=messages.header(10**18, "camera"),
            height=6,
            width=8,
            encoding="16UC1",
            step=16,
            data=np.zeros(96, np.uint8),
        )
        info = messages.make(
            "sensor_msgs/msg/CameraInfo",
            header=messages.header(10**18, "camera"),
            height=6,
            width=8,
            k=np.array([5.0, 0, 4, 0, 5, 3, 0, 0, 1]),
        )
        made[f"{distro} cloud"] = [bytes(messages.to_bytes(cloud))], of_cloud
        made[f"{distro} image"] = [bytes(messages.to_bytes(image))], of_image
        made[f"{distro} camera_info"] = [bytes(messages.to_bytes(info))], of_info
    return made


def _configurations() -> dict[str, Target]:
    from tumortrack.core.config import from_builtins, to_builtins
    from tumortrack.core.store import read_json
    from tumortrack.live.calibration_file import read_frames
    from tumortrack.sense.files import read_poses
    from tumortrack.tracking.presets import PRESETS
    from tumortrack_resection.arms.config import CellConfig
    from tumortrack_resection.values import ResectionConfig
    from warp_objects import ANATOMY

    def written(kind: type, value: object) -> Target:
        def read(path: Path) -> object:
            return from_builtins(read_json(path), kind, str(path))

        return [json.dumps(to_builtins(value)).encode()], of_file(".json", read)

    turn = [[0, -1, 0, 0.4], [-1, 0, 0, 0.1], [0, 0, -1, 0.7], [0, 0, 0, 1]]
    frame = {"frame_id": "base_link", "unit": "m", "robot_from_camera": turn}
    marker = {**frame, "camera_from_marker": turn, "robot_from_marker": turn}
    del marker["robot_from_camera"]
    clinic, quick = (PRESETS[name](ANATOMY) for name in ("clinic", "quick"))
    poses = {"fixed_from_camera": [turn, turn], "unit": "m", "frame_id": "base_link"}
    return {
        "poses": ([json.dumps(poses).encode()], of_file(".json", lambda path: read_poses(path, 2))),
        "calibration": (
            [json.dumps(frame).encode(), json.dumps(marker).encode()],
            of_file(".json", read_frames),
        ),
        "cell": written(CellConfig, CellConfig()),
        "resection": written(ResectionConfig, ResectionConfig()),
        "registration": written(type(clinic), clinic),
        "training": written(type(quick), quick),
    }


def _recordings() -> dict[str, Target]:
    from recording_objects import frame_number, record, update_number, write_bag
    from tumortrack.core.errors import InputError
    from tumortrack.live.sources.recording import RecordingSourceConfig
    from tumortrack.live.values import SourceEnded

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

    folder = scratch()
    frames = [frame_number(n) for n in range(2)]
    topics = {"/depth": ("depth/image_rect", frames), "/camera_info": ("depth/camera_info", frames)}
    ours = record(folder / "ours", [update_number(n) for n in range(2)]) / "ours.mcap"
    packed = write_bag(folder / "packed", topics, "packed mcap")
    bag = write_bag(folder / "a.bag", topics, "bag")
    sqlite = write_bag(folder / "sqlite", topics, "sqlite3")
    (file,) = [path for path in sqlite.iterdir() if path.suffix == ".db3"]
    return {
        "mcap": ([ours.read_bytes()], of_file(".mcap", play)),
        "bag": ([bag.read_bytes()], of_file(".bag", play)),
        "db3": ([file.read_bytes()], of_file(".db3", play)),
        "rosbag2 folder": of_member(packed, "metadata.yaml", play),
        "packed mcap": of_member(packed, "packed.mcap", play),
    }


def of_member(folder: Path, name: str, read: Callable[[Path], object]) -> Target:
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


def _margins() -> dict[str, Target]:
    from tumortrack.models import margins
    from tumortrack.report.calibration_table import head_of, read_table

    shells = margins.Shells(
        confidence=0.9, radii={"tumor": margins.Radius(used="constant", constant_mm=3.0)}
    )
    valid = margins.ModelMargins(
        method=margins.METHOD, tumortrack="0", model_sha256="", table_sha256="", seed=0,
        widest_mm=8.0, limits={"rarity": 1.0}, shells=(shells,), groups=(), joined={},
        risk_bound=0.1, accepted=1.0, missed=0.0,
    )  # fmt: skip
    margins.write_sealed(path := scratch() / "margins.json", valid)
    row = {"scene": "s", "sha256": "", "label": ["a", "b", "c"], "misses": {"tumor": [[1.0, None]]}}
    table = "\n".join(map(json.dumps, (head_of("", 0), row))).encode()
    return {
        "margins": ([path.read_bytes()], of_file(".json", margins.read_sealed)),
        "margins table": ([table], of_file(".jsonl", read_table)),
    }


def _experiment() -> dict[str, Target]:
    """Kits, lenses, robots' poses, pictures of boards, and MCAPs with attachments."""
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
    poses = {"base_from_tool": [rows, rows], "unit": "mm", "frame_id": "base"}
    shots = [Shot(str(n), np.zeros((2, 2), np.uint8)) for n in range(2)]
    pictures = scratch()
    grey = np.arange(192, dtype=np.uint8).reshape(12, 16)

    def read_picture(content: bytes) -> object:
        (pictures / "a.png").write_bytes(content)
        return read_shots(pictures)

    return {
        "kit": ([json.dumps(kit).encode()], of_file(".json", read_kit)),
        "lens": (
            [json.dumps(lens | {"distortion": [0.0] * 5}).encode()],
            of_file(".json", read_lens),
        ),
        "robot poses": (
            [json.dumps(poses).encode()],
            of_file(".json", lambda path: with_poses(shots, path)),
        ),
        "picture": (
            [cv2.imencode(kind, grey)[1].tobytes() for kind in (".png", ".jpg")],
            read_picture,
        ),
    }


def of_base(base: Path) -> dict[str, Target]:
    """Case, scene, both kinds of model, run and plan, as ``attacks.make_base`` makes them."""
    from tumortrack.imaging.case import load_case
    from tumortrack.simulate.scene_folder import read_scene
    from tumortrack.tracking.model_files import load_model
    from tumortrack_resection.files import read_plan
    from tumortrack_resection.located import read_run

    scene = base / "scenes" / "0000"
    members: list[tuple[Path, str, Callable[[Path], object]]] = [
        *((base / "case", name, load_case) for name in ("manifest.json", "tumor_1.ply")),
        *((scene, name, read_scene) for name in ("meta.json", "targets.csv", "tumor_1.ply")),
        *((base / "run", name, read_run) for name in ("manifest.json", "report.json")),
        (base / "run", "occupancy.ply", read_run),
        *((base / "plan", name, read_plan) for name in ("plan.json", "motions.safetensors")),
        *(
            (base / kind, name, lambda folder: load_model(folder, "cpu"))
            for kind in ("model", "network")
            for name in ("manifest.json", "weights.safetensors", "shape.safetensors")
        ),
    ]
    return {
        f"{folder.parent.name if folder is scene else folder.name} {name}": of_member(
            folder, name, read
        )
        for folder, name, read in members
        if (folder / name).is_file()
    }


def targets(base: Path | None = None) -> dict[str, Target]:
    """All of them; those that need a model only with a ``base``."""
    found: dict[str, Target] = {}
    for make in (
        *(_cloud_files, _images, _volumes, _dicom, _meshes, _artifacts, _texts, _wire),
        *(_configurations, _recordings, _margins, _experiment),
    ):
        found |= make()
    return found | (of_base(base) if base is not None else {})
