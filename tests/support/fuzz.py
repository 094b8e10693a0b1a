"""Damaged input for every reader of files and of bytes from the wire.

python tests/support/fuzz.py [--inputs N] [--target NAME] [--seed N] [--atheris]

Valid inputs are changed at random places; a reader may read what comes of it or refuse it with a
``TumortrackError``. Any other exception, a crash of the process, 5 s for one input, or memory over
1 GB is a fault; the input that did it is written to runs/fuzz/. The same seed gives the same
inputs. With --atheris (a package of its own) the inputs are led by the code that they reach.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import mmap
import os
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

SECONDS, MEGABYTES = 5, 1024
_NUMBERS = [0, 1, -1, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, -(2**31), 2**32 - 1]
_WORDS = [b"nan", b"inf", b"-1", b"1e308", b"99999999999999999999", b"\n", b" ", b"\0", b"{", b'"']

Read = Callable[[bytes], object]
Target = tuple[list[bytes], Read]


def changed(seed: bytes, rng: np.random.Generator) -> bytes:
    """The seed with one to eight changes: bits, bytes, numbers, words, pieces moved or missing."""
    data = bytearray(seed)
    for _ in range(int(rng.integers(1, 9))):
        # Headers are where readers decide: every second change is among the first 400 bytes.
        end = max(min(len(data), 400 if rng.random() < 0.5 else len(data)), 1)
        at, kind = int(rng.integers(end)), int(rng.integers(8))
        if kind == 0 and data:
            data[at] ^= 1 << int(rng.integers(8))
        elif kind == 1 and data:
            data[at] = int(rng.integers(256))
        elif kind == 2:
            size, order = int(rng.choice([1, 2, 4, 8])), "<" if rng.random() < 0.7 else ">"
            number = int(rng.choice(_NUMBERS)) & (2 ** (8 * size) - 1)
            code = {1: "B", 2: "H", 4: "I", 8: "Q"}[size]
            data[at : at + size] = struct.pack(order + code, number)
        elif kind == 3:
            value = rng.choice([np.nan, np.inf, -np.inf, 1e30, -1e-30, 0.0])
            data[at : at + 4] = struct.pack("<f", value)
        elif kind == 4:
            data[at:at] = _WORDS[int(rng.integers(len(_WORDS)))]
        elif kind == 5:
            del data[at : at + int(rng.integers(1, 64))]
        elif kind == 6:
            piece = data[at : at + int(rng.integers(1, 64))]
            to = int(rng.integers(len(data) + 1))
            data[to:to] = piece
        elif rng.random() < 0.2:
            del data[at:]
    return bytes(data)


def of_file(suffix: str, read: Callable[[Path], object]) -> Read:
    """A reader of files as one of bytes."""
    folder = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    path = folder / f"in{suffix}"

    def of_bytes(content: bytes) -> object:
        path.write_bytes(content)
        return read(path)

    return of_bytes


# What is read ---------------------------------------------------------------------------------


def _cloud_files() -> dict[str, Target]:
    from attacks import npz, pcd, ply
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

    from attacks import png_of
    from tumortrack.sense.files import read_depth_png, read_intrinsics

    camera = {"width": 16, "height": 12, "fx": 10.0, "fy": 10.0, "cx": 8, "cy": 6}
    text = json.dumps({**camera, "depth_unit_mm": 0.1}).encode()
    intrinsics = Path(tempfile.mkdtemp(), "intrinsics.json")
    intrinsics.write_bytes(text)
    png = png_of(16, 12, 16, zlib.compress(bytes(33 * 12)))
    return {
        "intrinsics": ([text], of_file(".json", read_intrinsics)),
        "depth image": ([png], of_file(".png", lambda path: read_depth_png(path, intrinsics))),
    }


def _volumes() -> dict[str, Target]:
    import gzip

    from attacks import ball, nifti_header
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
    from tumortrack.core.types import Volume
    from tumortrack.imaging.dicom import read_dicom
    from tumortrack.phantom.dicom import write_dicom_series

    series = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None), "ct")
    hu = np.zeros((12, 12, 12), np.float32)
    write_dicom_series(Volume(hu, np.diag([1.0, 1.0, 1.0, 1.0])), series)
    first = sorted(series.iterdir())[0]
    content = first.read_bytes()

    def read(changed: bytes) -> object:
        first.write_bytes(changed)
        return read_dicom(series)

    return {"dicom slice": ([content], read)}


def _meshes() -> dict[str, Target]:
    from attacks import sphere
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


def targets() -> dict[str, Target]:
    found: dict[str, Target] = {}
    for make in (_cloud_files, _images, _volumes, _dicom, _meshes, _artifacts, _texts, _wire):
        found |= make()
    return found


# How they are attacked ------------------------------------------------------------------------


def input_of(seeds: list[bytes], name: str, seed: int, index: int) -> bytes:
    start = int.from_bytes(hashlib.sha256(f"{name} {seed} {index}".encode()).digest()[:8], "big")
    rng = np.random.default_rng(start)
    return changed(seeds[index % len(seeds)], rng)


def _attack(
    name: str, target: Target, seed: int, indices: range, at: mmap.mmap, faults: Any
) -> None:
    """In a fork: one input after the other; ``at`` tells the parent which."""
    from tumortrack.core.errors import TumortrackError

    def late(*_: object) -> None:
        raise TimeoutError(f"took more than {SECONDS} s")

    signal.signal(signal.SIGALRM, late)
    for index in indices:
        struct.pack_into("<q", at, 0, index)
        content = input_of(target[0], name, seed, index)
        signal.setitimer(signal.ITIMER_REAL, SECONDS)
        try:
            target[1](content)
        except TumortrackError:
            pass
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            faults.write(
                json.dumps(
                    [index, f"{type(error).__name__}: {error}", f"{where.filename}:{where.lineno}"]
                )
                + "\n"
            )
            faults.flush()
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        if peak > MEGABYTES + struct.unpack_from("<d", at, 8)[0]:
            faults.write(json.dumps([index, f"{peak:.0f} MB of memory", ""]) + "\n")
            faults.flush()
            os._exit(3)


def fuzz(name: str, target: Target, inputs: int, seed: int, keep: Path) -> list[tuple[str, str]]:
    """Faults as (what, where), each kind once; the input that did it is kept."""
    at, start, found = mmap.mmap(-1, 16), 0, {}
    devnull = os.open(os.devnull, os.O_WRONLY)
    while start < inputs:
        with tempfile.TemporaryFile("w+") as faults:
            child = os.fork()
            if not child:
                os.dup2(devnull, 1)
                os.dup2(devnull, 2)
                resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
                peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
                struct.pack_into("<d", at, 8, peak)
                code = 2
                try:
                    _attack(name, target, seed, range(start, inputs), at, faults)
                    code = 0
                finally:
                    os._exit(code)
            last, since = -1, time.monotonic()
            while True:  # code that never comes back to Python sees no alarm
                ended, status = os.waitpid(child, os.WNOHANG)
                if ended:
                    break
                index = struct.unpack_from("<q", at, 0)[0]
                if index != last:
                    last, since = index, time.monotonic()
                elif time.monotonic() - since > 2 * SECONDS:
                    os.kill(child, signal.SIGKILL)
                time.sleep(0.02)
            faults.seek(0)
            told = [json.loads(line) for line in faults]
        start = inputs
        if status:
            last = struct.unpack_from("<q", at, 0)[0]
            code = os.waitstatus_to_exitcode(status)
            if code < 0:
                told.append([last, f"the process ended with {signal.Signals(-code).name}", ""])
            start = last + 1
        for index, what, where in told:
            kind = (what.split(":")[0], where)
            if kind not in found:
                found[kind] = (what, where)
                keep.mkdir(parents=True, exist_ok=True)
                content = input_of(target[0], name, seed, index)
                (keep / f"{name.replace(' ', '-')}-{index}").write_bytes(content)
    return list(found.values())


def _led_by_coverage(name: str, inputs: int) -> None:
    import atheris

    from tumortrack.core.errors import TumortrackError

    with atheris.instrument_imports(include=["tumortrack"]):
        seeds, read = targets()[name]
    corpus = Path(tempfile.mkdtemp())
    for n, seed in enumerate(seeds):
        (corpus / str(n)).write_bytes(seed)

    def one(content: bytes) -> None:
        with suppress(TumortrackError):
            read(content)

    options = [f"-runs={inputs}", f"-timeout={SECONDS}", f"-rss_limit_mb={4 * MEGABYTES}"]
    atheris.Setup([sys.argv[0], *options, str(corpus)], one)
    atheris.Fuzz()


def main() -> int:
    parser = argparse.ArgumentParser(description="damaged input for every reader")
    parser.add_argument("--inputs", type=int, default=1_000_000, help="over all targets")
    parser.add_argument("--target", default="", help="this one alone")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--atheris", action="store_true", help="led by coverage; needs --target")
    parser.add_argument("--keep", type=Path, default=Path("runs/fuzz"))
    given = parser.parse_args()
    if given.atheris:
        _led_by_coverage(given.target, given.inputs)
    chosen = {k: v for k, v in targets().items() if given.target in ("", k)}
    wrong = 0
    for name, target in chosen.items():
        started, share = time.perf_counter(), given.inputs // len(chosen)
        found = fuzz(name, target, share, given.seed, given.keep)
        seconds, wrong = time.perf_counter() - started, wrong + len(found)
        print(f"{name:20} {share:8,} inputs {share / seconds:8,.0f} a second", flush=True)
        for what, where in found:
            print(f"    {what[:110]}  {where}", flush=True)
    print(f"{wrong} faults")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
