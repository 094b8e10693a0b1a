"""Tracked ultrasound from files: places in mm for every form, orientation and chain of transforms;
masks beside it; what is left out and said; hostile files; and the story on the command line."""

from __future__ import annotations

import json
import zlib

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import tumortrack as tt
from refused import refused
from stories import cloud_by_rays, looking_down, refusal, tumortrack
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.store import sha256_of
from tumortrack.io.case import load_case
from tumortrack.io.csv_tables import COLUMNS
from tumortrack.io.ply import write_cloud_ply
from tumortrack.live.poses import pose_row
from ultrasound_objects import keys_of, stamped, words, write_meta_image, write_nrrd

# Not square, off the middle, and 40 x 20 mm in the image: turned or flipped it lies elsewhere.
COUNT, ROWS, COLUMNS_PX = 6, 48, 64
LABELS = np.zeros((COUNT, ROWS, COLUMNS_PX), np.uint8)
LABELS[:, 20:40, 10:30] = 1
LABELS[:, 24:32, 12:20] = 2
IMAGE_TO_PROBE = np.diag([2.0, 1.0, 0.3, 1.0])
IMAGE_TO_PROBE[:3, 3] = [-3.0, 7.0, 1.0]
TURN = Rotation.from_euler("xyz", [20, -35, 70], degrees=True).as_matrix()
PROBE_TO_TRACKER = np.array([rigid(TURN, np.array([5.0, -2.0, 100.0 + n])) for n in range(COUNT)])
REFERENCE_TO_TRACKER = np.array(
    [
        rigid(Rotation.from_rotvec([0, 0.02 * n, 0.3]).as_matrix(), np.array([n, 30.0, 2.0]))
        for n in range(COUNT)
    ]
)
CALIBRATED = {"ImageToProbeTransform": words(IMAGE_TO_PROBE)}
MF = {"UltrasoundImageOrientation": "MF"}
FRAMES = stamped({"ProbeToTracker": PROBE_TO_TRACKER})


def recording(path, images=LABELS, frames=FRAMES, fields=MF | CALIBRATED, **options):
    return tt.read_ultrasound(
        write_meta_image(path / "scan.igs.mha", images, frames, fields), **options
    )


def check_places(found, pose=PROBE_TO_TRACKER, parts=("kidney", "tumor_1"), planes=range(COUNT)):
    """Each lies on its part's rectangle, in pixels of its image, and they are all about it."""
    assert found.parts == parts
    assert set(found.plane.tolist()) == {*planes}
    boxes = {"kidney": (9.5, 29.5, 19.5, 39.5), "tumor_1": (11.5, 19.5, 23.5, 31.5)}
    places_mm = found.places_mm()
    for n in planes:
        for k, part in enumerate(parts):
            mine = (found.plane == n) & (found.part == k)
            back = np.linalg.inv(pose[n] @ IMAGE_TO_PROBE)
            column, row, off = transform_points(back, places_mm[mine]).T
            left, right, top, bottom = boxes[part]
            assert np.abs(off).max() < 1e-6
            on = [
                np.abs(column - left),
                np.abs(column - right),
                np.abs(row - top),
                np.abs(row - bottom),
            ]
            assert np.min(on, axis=0).max() < 1e-6
            assert (np.min(on, axis=1) < 1e-6).all()


def test_a_place_in_mm_is_what_its_pixel_is_by_hand(tmp_path):
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    still = np.array([rigid(turn, np.array([1.0, 2.0, 3.0 + n])) for n in (0, 1)])
    images = np.zeros((2, 8, 8), np.uint8)
    images[0, 0:, 0:4] = 1  # the image's edge is no border of it
    found = recording(tmp_path, images, stamped({"ProbeToTracker": still}))
    places_px = found.places_px
    assert set(places_px[:, 0]) == {3.5}
    x_mm, y_mm = 2 * 3.5 - 3, places_px[:, 1] + 7
    np.testing.assert_allclose(
        found.places_mm(), np.column_stack([1 - y_mm, 2 + x_mm + 0 * y_mm, 4 + 0 * y_mm]), atol=1e-9
    )
    assert (found.frame, found.tool, found.shared_std_mm) == ("Tracker", "Probe", 1.0)


@pytest.mark.parametrize(
    ("orientation", "rows", "columns"),
    [("UF", 1, -1), ("MN", -1, 1), ("UN", -1, -1), ("MFA", 1, 1)],
)
def test_images_are_turned_as_their_orientation_says(tmp_path, orientation, rows, columns):
    fields = CALIBRATED | {"UltrasoundImageOrientation": orientation}
    check_places(recording(tmp_path, LABELS[:, ::rows, ::columns], fields=fields))


@pytest.mark.parametrize("orientation", ["FM", "NU", "XX", "NORTH"])
def test_scan_lines_as_rows_are_refused(tmp_path, orientation):
    with refused(InputError, "UltrasoundImageOrientation", orientation):
        recording(tmp_path, fields=CALIBRATED | {"UltrasoundImageOrientation": orientation})


def meta(compressed=True, images=LABELS, name="scan.mha", **fields):
    return lambda folder: write_meta_image(
        folder / name, images, FRAMES, MF | CALIBRATED | fields, compressed
    )


def nrrd(images=LABELS, kinds="domain domain list", encoding="gzip"):
    keys = {**MF, **CALIBRATED, **keys_of(FRAMES)}
    return lambda folder: write_nrrd(folder / "scan.seq.nrrd", images, kinds, keys, encoding)


def big_endian(folder):
    """Of ushort, which no writer at hand swaps."""
    path = write_meta_image(
        folder / "b.mha", LABELS.astype(np.uint16), FRAMES, MF | CALIBRATED, False
    )
    head, last, data = path.read_bytes().partition(b"ElementDataFile = LOCAL\n")
    head = head.replace(b"ByteOrderMSB = False", b"ByteOrderMSB = True")
    path.write_bytes(head + last + np.frombuffer(data, "<u2").astype(">u2").tobytes())
    return path


COLOUR = np.repeat(LABELS[..., None], 3, -1)
FORMATS = {
    "mha": meta(),
    "mha as it is": meta(compressed=False),
    "w h 1 n": meta(images=LABELS[:, None]),
    "mhd": meta(name="scan.mhd"),
    "mhd as it is": meta(False, name="scan.mhd"),
    "kinds": meta(Kinds="domain domain list"),
    "ushort": meta(images=LABELS.astype(np.uint16)),
    "short": meta(images=LABELS.astype(np.int16)),
    "float": meta(images=LABELS.astype(np.float32)),
    "colour": meta(images=COLOUR),
    "big-endian": big_endian,
    "nrrd": nrrd(),
    "nrrd as it is": nrrd(encoding="raw"),
    "nrrd w h 1 n": nrrd(LABELS[:, None], "domain domain domain list"),
    "nrrd list first": nrrd(np.moveaxis(LABELS[:, None], 0, -1), "list domain domain domain"),
    "nrrd colour": nrrd(COLOUR, "vector domain domain time"),
    "nrrd big-endian": nrrd(LABELS.astype(">u2")),
}


@pytest.mark.parametrize("form", FORMATS)
def test_every_form_of_a_sequence_gives_the_same_places(tmp_path, form):
    check_places(tt.read_ultrasound(FORMATS[form](tmp_path)))


def test_frames_from_10_000_on_have_five_digits(tmp_path):
    images = np.zeros((10_003, 16, 16), np.uint8)
    images[10_001, 4:12, 4:12] = 1
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    poses[:, 2, 3] = 0.01 * np.arange(len(images))
    path = tmp_path / "scan.mha"
    frames = keys_of(stamped({"ProbeToTracker": poses}))
    packed = zlib.compress(images.tobytes())
    path.write_bytes(header(packed, DimSize="16 16 10003", **frames))  # SimpleITK takes minutes
    found = tt.read_ultrasound(path)
    assert set(found.plane.tolist()) == {10_001}
    np.testing.assert_allclose(found.places_mm()[:, 2], 100.01 + 1.0, atol=1e-9)


IN_REFERENCE = np.linalg.inv(REFERENCE_TO_TRACKER) @ PROBE_TO_TRACKER
TO_TRANSDUCER = np.diag([2.0, 1.0, 0.3, 1.0])
FROM_TRANSDUCER = IMAGE_TO_PROBE @ np.linalg.inv(TO_TRANSDUCER)
CHAINS = {
    "a reference is applied": (
        {"ProbeToTracker": PROBE_TO_TRACKER, "ReferenceToTracker": REFERENCE_TO_TRACKER},
        CALIBRATED, IN_REFERENCE, "Reference",
    ),
    "or has been": ({"ProbeToReference": IN_REFERENCE}, CALIBRATED, IN_REFERENCE, "Reference"),
    "of the image itself": (
        {"ImageToReference": IN_REFERENCE @ IMAGE_TO_PROBE}, {}, IN_REFERENCE, "Reference",
    ),
    "the other way round": (
        {"TrackerToProbe": np.linalg.inv(PROBE_TO_TRACKER)},
        CALIBRATED, PROBE_TO_TRACKER, "Tracker",
    ),
    "in steps": (
        {"ProbeToTracker": PROBE_TO_TRACKER},
        {"ImageToTransducerTransform": words(TO_TRANSDUCER),
         "TransducerToProbeTransform": words(FROM_TRANSDUCER)},
        PROBE_TO_TRACKER, "Tracker",
    ),
    "in a frame of any name": (
        {"ProbeToRoom": PROBE_TO_TRACKER}, CALIBRATED, PROBE_TO_TRACKER, "Room",
    ),
}  # fmt: skip


@pytest.mark.parametrize("chain", CHAINS)
def test_transforms_are_chained_from_the_image_to_the_reference(tmp_path, chain):
    poses, constant, pose, frame = CHAINS[chain]
    found = recording(tmp_path, frames=stamped(poses), fields=MF | constant)
    assert found.frame == frame
    check_places(found, pose)


def test_the_frame_that_is_asked_for_counts_and_one_that_nothing_leads_to_is_named(tmp_path):
    frames = stamped(
        {"ProbeToTracker": PROBE_TO_TRACKER, "ReferenceToTracker": REFERENCE_TO_TRACKER}
    )
    check_places(recording(tmp_path, frames=frames, frame="Tracker"), PROBE_TO_TRACKER)
    with refused(InputError, "Image", "base_link", "ProbeToTracker"):
        recording(tmp_path, frames=frames, frame="base_link")
    with refused(InputError, "Image", "ProbeToTracker", "--image-to-probe"):
        recording(tmp_path, fields=MF)
    two = stamped({"ProbeToA": PROBE_TO_TRACKER, "ProbeToB": PROBE_TO_TRACKER})
    with refused(InputError, "A, B"):
        recording(tmp_path, frames=two)


def test_a_calibration_beside_the_recording_counts_instead_of_its_own(tmp_path):
    wrong = MF | {"ImageToProbeTransform": words(2 * IMAGE_TO_PROBE - np.diag([0, 0, 0, 1]))}
    plus, file = tmp_path / "plus.xml", tmp_path / "image.json"
    plus.write_text(
        '<PlusConfiguration version="2.0"><CoordinateDefinitions>\n<Transform From="Image" '
        f'To="Probe" Matrix="\n{words(IMAGE_TO_PROBE)}" Error="0.5"/>'
        "</CoordinateDefinitions></PlusConfiguration>"
    )
    check_places(recording(tmp_path, fields=wrong, image_to_probe=plus))
    metres = IMAGE_TO_PROBE.copy()
    metres[:3] /= 1000
    file.write_text(json.dumps({"unit": "m", "probe_from_image": metres.tolist()}))
    check_places(recording(tmp_path, fields=wrong, image_to_probe=file))
    mm = IMAGE_TO_PROBE @ np.diag([0.5, 1, 1, 1])
    file.write_text(json.dumps({"unit": "mm", "probe_from_image": mm.tolist()}))
    check_places(recording(tmp_path, image_to_probe=file, mm_per_pixel=(2.0, 1.0)))


def changed(n, **fields):
    return [*FRAMES[:n], FRAMES[n] | fields, *FRAMES[n + 1 :]]


@pytest.mark.parametrize(
    "fields",
    [
        {"ProbeToTrackerTransformStatus": "INVALID"},
        {"ProbeToTrackerTransformStatus": "OUT_OF_VIEW"},
        {"ProbeToTrackerTransform": words(np.zeros((4, 4)))},
        {"ProbeToTrackerTransform": words(np.full((4, 4), np.nan))},
        {"ProbeToTrackerTransform": words(np.diag([1, 1, 2, 1.0]))},
        {"ProbeToTrackerTransform": words(np.diag([1, 1, -1, 1.0]))},
    ],
)
def test_a_pose_that_is_none_is_left_out_and_counted(tmp_path, fields):
    found = recording(tmp_path, frames=changed(2, **fields))
    assert len(found.stamps_s) == COUNT - 1
    assert "1 of 6" in found.notes[0]
    check_places(found)  # its plane's place is between its neighbours'


def test_stamps_that_do_not_rise_and_images_that_are_invalid_are_left_out(tmp_path):
    found = recording(tmp_path, frames=changed(2, Timestamp="10.05"))
    assert "1 of 6" in found.notes[0]
    check_places(found, planes=(0, 1, 3, 4, 5))
    check_places(
        recording(tmp_path, frames=changed(2, ImageStatus="INVALID")), planes=(0, 1, 3, 4, 5)
    )


def test_images_without_a_pose_in_time_are_left_out_and_counted(tmp_path):
    """The tracker lost the probe for a second, from the third image on."""
    late = [f | {"Timestamp": str(10 + n / 20 + (n > 2))} for n, f in enumerate(FRAMES)]
    late[2] = late[2] | {"ProbeToTrackerTransformStatus": "INVALID"}
    found = recording(tmp_path, frames=late)
    assert np.isnan(found.places_mm()[found.plane == 2]).all()
    assert np.isfinite(found.places_mm()[found.plane != 2]).all()
    assert "1 images" in found.notes[-1]


def test_an_orientation_that_is_not_stated_is_taken_as_mf_and_said(tmp_path):
    found = recording(tmp_path, fields=CALIBRATED)
    check_places(found)
    assert "MF" in found.notes[0]


def test_filtered_stamps_count_and_else_unfiltered_ones(tmp_path):
    both = [frame | {"UnfilteredTimestamp": str(99 + n)} for n, frame in enumerate(FRAMES)]
    found = recording(tmp_path, frames=both)
    assert found.stamps_s.tolist() == [10 + n / 20 for n in range(COUNT)]
    assert found.notes == ()
    raw = [{k: v for k, v in frame.items() if k != "Timestamp"} for frame in both]
    found = recording(tmp_path, frames=raw)
    assert found.stamps_s[0] == 99
    with refused(InputError, "Seq_Frame0000_Timestamp"):
        recording(tmp_path, frames=[{k: v for k, v in f.items() if "stamp" not in k} for f in raw])


# Masks beside a sequence, and without one.
BRIGHT = np.random.default_rng(0).integers(1, 255, LABELS.shape).astype(np.uint8)


def write_masks(folder, labels=LABELS, name="m_{}.png"):
    folder.mkdir()
    for n, each in enumerate(labels):
        Image.fromarray(each).save(folder / name.format(n + 7))
    return folder


def test_masks_of_a_sequence_lie_in_a_folder_in_natural_order(tmp_path):
    moving = LABELS.copy()
    moving[3:] = 0  # m_10, which a dictionary has first
    found = recording(tmp_path, BRIGHT, masks=write_masks(tmp_path / "m", moving))
    check_places(found, planes=(0, 1, 2))
    check_places(recording(tmp_path, BRIGHT, masks=tmp_path / "m" / "*.png"), planes=(0, 1, 2))


def test_or_have_the_number_of_their_frame(tmp_path):
    folder = tmp_path / "m"
    folder.mkdir()
    for n in (1, 4):
        Image.fromarray(LABELS[n]).save(folder / f"frame{n:04d}.png")
    found = recording(tmp_path, BRIGHT, masks=folder)
    assert sorted(set(found.image_stamps_s.tolist())) == [10.05, 10.2]
    assert {n: z for n, z in zip(found.plane, found.image_stamps_s, strict=True)} == {
        0: 10.05,
        1: 10.2,
    }
    check_places(found, PROBE_TO_TRACKER[[1, 4]], planes=(0, 1))
    Image.fromarray(LABELS[0]).save(folder / "frame0099.png")
    with refused(InputError, 3, 6):
        recording(tmp_path, BRIGHT, masks=folder)


def test_masks_are_turned_as_the_images_that_they_are_of_unless_they_say(tmp_path):
    fields = CALIBRATED | {"UltrasoundImageOrientation": "UN"}
    turned = LABELS[:, ::-1, ::-1]
    found = recording(tmp_path, BRIGHT, fields=fields, masks=write_masks(tmp_path / "m", turned))
    check_places(found)
    drawn = write_meta_image(tmp_path / "drawn.mha", LABELS, [], MF)
    check_places(recording(tmp_path, BRIGHT, fields=fields, masks=drawn))
    silent = write_meta_image(tmp_path / "silent.mha", turned, [])
    check_places(recording(tmp_path, BRIGHT, fields=fields, masks=silent))


def test_a_mask_of_one_value_is_told_its_part(tmp_path):
    one = np.where(LABELS == 2, 255, 0).astype(np.uint8)
    folder = write_masks(tmp_path / "m", one)
    with refused(InputError, 255, "--mask-part"):
        recording(tmp_path, BRIGHT, masks=folder)
    found = recording(tmp_path, BRIGHT, masks=folder, mask_part="tumor_1")
    check_places(found, parts=("tumor_1",))
    with refused(InputError, "image 0"):
        recording(tmp_path, BRIGHT, masks=write_masks(tmp_path / "two"), mask_part="tumor_1")


def segmented(path, labels, layers=None, names=("Kidney", "Tumor")):
    """As 3D Slicer writes it: frame, row, column, and perhaps layer, the fastest last."""
    keys = {}
    for n, name in enumerate(names):
        layer = n if layers is not None else 0
        value = 1 if layers is not None else n + 1
        keys |= {f"Segment{n}_ID": f"s{n}", f"Segment{n}_Name": name,
                 f"Segment{n}_LabelValue": str(value), f"Segment{n}_Layer": str(layer)}  # fmt: skip
    array = labels if layers is None else np.stack(layers, -1)
    directions = ("none " if layers is not None else "") + "(1,0,0) (0,1,0) (0,0,1)"
    space = (
        f"space: left-posterior-superior\nspace directions: {directions}\nspace origin: (0,0,0)\n"
    )
    kinds = ("list " if layers is not None else "") + "domain domain domain"
    return write_nrrd(path, array, kinds, keys, fields=space)


def test_segments_of_slicer_count_by_their_names_also_overlapping(tmp_path):
    drawn = segmented(tmp_path / "a.seg.nrrd", LABELS)
    check_places(recording(tmp_path, BRIGHT, masks=drawn))
    swapped = np.choose(LABELS, [0, 2, 1]).astype(np.uint8)
    drawn = segmented(tmp_path / "b.seg.nrrd", swapped, names=("tumor_1", "left kidney"))
    check_places(recording(tmp_path, BRIGHT, masks=drawn))
    both = [(LABELS > 0).astype(np.uint8), (LABELS == 2).astype(np.uint8)]
    drawn = segmented(tmp_path / "d.seg.nrrd", LABELS, layers=both)
    check_places(recording(tmp_path, BRIGHT, masks=drawn))
    other = segmented(tmp_path / "e.seg.nrrd", LABELS, names=("Kidney", "Needle"))
    found = recording(tmp_path, BRIGHT, masks=other)
    assert "Needle" in found.notes[-1]
    assert set(found.part.tolist()) == {0}
    with refused(InputError, "Tumor"):
        recording(tmp_path, BRIGHT, masks=drawn, parts=("kidney", "tumor_1", "tumor_2"))
    for n, box in enumerate((LABELS[1:5], LABELS[:, 20:40, 10:30])):  # which Slicer crops if asked
        with refused(InputError, f"c{n}.seg.nrrd"):
            recording(tmp_path, BRIGHT, masks=segmented(tmp_path / f"c{n}.seg.nrrd", box))


def test_the_edge_of_what_the_probe_sees_is_no_border(tmp_path):
    """A fan that cuts the organ's mask on its right."""
    fan = np.broadcast_to(np.arange(COLUMNS_PX) < 25, LABELS.shape)
    images, masks = np.where(fan, BRIGHT, 0), np.where(fan, LABELS, 0)
    found = recording(tmp_path, images.astype(np.uint8), masks=write_masks(tmp_path / "m", masks))
    organ = found.places_px[found.part == 0]
    assert organ[:, 0].max() < 25 - 2
    assert organ[:, 0].min() == 9.5
    other = recording(tmp_path, masks.astype(np.uint8))  # alone they do not say what was seen
    assert other.places_px[other.part == 0][:, 0].max() == 24.5


def table(path, poses, step_ns=50_000_000, start_ns=1_700_000_000_000_000_000):
    rows = [pose_row(start_ns + n * step_ns, "base_link", pose) for n, pose in enumerate(poses)]
    path.write_text(COLUMNS + "\n" + "".join(rows))
    return path


@pytest.mark.parametrize("step_ns", [50_000_000, 2_000_000_000])
def test_masks_with_a_table_of_poses_need_no_sequence(tmp_path, step_ns):
    """Also where the hand held still for each, two seconds apart."""
    file = tmp_path / "image.json"
    file.write_text(json.dumps({"unit": "mm", "probe_from_image": IMAGE_TO_PROBE.tolist()}))
    folder, poses = (
        write_masks(tmp_path / "m"),
        table(tmp_path / "p.csv", PROBE_TO_TRACKER, step_ns),
    )
    found = tt.read_ultrasound(folder, poses=poses, image_to_probe=file)
    assert found.frame == "base_link"
    check_places(found)
    with refused(InputError, "Image", "base_link"):
        tt.read_ultrasound(folder, poses=poses)
    (folder / "m_7.png").unlink()
    with refused(InputError, 5, 6):
        tt.read_ultrasound(folder, poses=poses, image_to_probe=file)


def test_names_of_masks_may_be_stamps_between_those_of_poses(tmp_path):
    file, folder, start = tmp_path / "image.json", tmp_path / "m", 1_700_000_000_000_000_000
    file.write_text(json.dumps({"unit": "mm", "probe_from_image": IMAGE_TO_PROBE.tolist()}))
    folder.mkdir()
    Image.fromarray(LABELS[0]).save(folder / f"{start + 75_000_000}.png")
    poses = table(tmp_path / "p.csv", PROBE_TO_TRACKER)
    found = tt.read_ultrasound(folder, poses=poses, image_to_probe=file)
    middle = (PROBE_TO_TRACKER[1] + PROBE_TO_TRACKER[2]) / 2
    places_mm = transform_points(middle @ IMAGE_TO_PROBE, np.c_[found.places_px, 0 * found.part])
    np.testing.assert_allclose(found.places_mm(), places_mm, atol=1e-5)  # of seconds since 1970


# Hostile files.
def header(data: bytes, **changes: str) -> bytes:
    fields = {
        "ObjectType": "Image", "NDims": "3", "BinaryData": "True", "CompressedData": "True",
        "DimSize": "64 48 6", "ElementType": "MET_UCHAR", **MF, **CALIBRATED, **keys_of(FRAMES),
        "ElementDataFile": "LOCAL",
    } | changes  # fmt: skip
    fields["ElementDataFile"] = fields.pop("ElementDataFile")
    return "".join(f"{name} = {value}\n" for name, value in fields.items()).encode() + data


PACKED = zlib.compress(LABELS.tobytes())
BOMB = zlib.compress(bytes(2**26))
HOSTILE = {
    "millions of frames": header(PACKED, DimSize="64 48 99999999"),
    "a petabyte": header(PACKED, DimSize="1000000 1000000 1000"),
    "negative": header(PACKED, DimSize="-64 -48 6"),
    "no number": header(PACKED, DimSize="64 48 many"),
    "flat": header(PACKED, DimSize="64"),
    "deep": header(PACKED, DimSize="64 48 2 3"),
    "too few kinds": header(PACKED, Kinds="domain list"),
    "bomb": header(BOMB),
    "truncated": header(PACKED[:-30]),
    "cut by its size": header(PACKED, CompressedDataSize=str(len(PACKED) // 2)),
    "longer than the file": header(PACKED, CompressedDataSize=str(10 * len(PACKED))),
    "damaged": header(PACKED[:60] + bytes(20) + PACKED[80:]),
    "not compressed, short": header(LABELS.tobytes()[:-1], CompressedData="False"),
    "outside": header(b"", ElementDataFile="../secret.raw"),
    "absolute": header(b"", ElementDataFile="/etc/passwd"),
    "by a link": header(b"", ElementDataFile="link.raw"),
    "several": header(b"", ElementDataFile="LIST"),
    "strange numbers": header(PACKED, ElementType="MET_STRING"),
    "nan": header(PACKED, ImageToProbeTransform=words(np.full((4, 4), np.nan))),
    "singular": header(PACKED, ImageToProbeTransform=words(np.diag([0.2, 0, 1, 1]))),
    "a projection": header(PACKED, ImageToProbeTransform=words(np.eye(4) + np.eye(4)[::-1])),
    "few numbers": header(PACKED, ImageToProbeTransform="1 2 3"),
    "few numbers of a frame": header(PACKED, Seq_Frame0002_ProbeToTrackerTransform="1 2 3"),
    "pixels of metres": header(PACKED, ImageToProbeTransform=words(np.diag([900, 900, 900, 1.0]))),
    "no pose": header(PACKED, **dict.fromkeys(
        [f"Seq_Frame000{n}_ProbeToTrackerTransformStatus" for n in range(COUNT)], "INVALID")),
    "stamps": header(PACKED, Seq_Frame0000_Timestamp="1e300"),
    "no stamp": header(PACKED, Seq_Frame0003_Timestamp="noon"),
    "empty": b"",
    "no end": header(PACKED)[:900],
}  # fmt: skip


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_sequences_are_refused(tmp_path, kind):
    folder = tmp_path / "in"
    folder.mkdir()
    (tmp_path / "secret.raw").write_bytes(LABELS.tobytes())
    (folder / "link.raw").symlink_to(tmp_path / "secret.raw")
    (folder / "scan.mha").write_bytes(HOSTILE[kind])
    with refused(InputError, "in/"):
        tt.read_ultrasound(folder / "scan.mha")
    (folder / "scan.mha").write_bytes(header(PACKED))
    check_places(tt.read_ultrasound(folder / "scan.mha"))


def test_values_of_no_part_images_in_colour_and_other_sizes_are_refused(tmp_path):
    with refused(InputError, "--masks"):
        recording(tmp_path, BRIGHT)
    with refused(InputError, 3, "image 0"):
        recording(tmp_path, 3 * LABELS.clip(0, 1))
    with refused(InputError, "image 0"):
        recording(tmp_path, np.repeat(LABELS[..., None], 3, -1) * np.array([1, 2, 3], np.uint8))
    with refused(InputError, "image 0"):
        recording(tmp_path, LABELS.astype(np.int16) * 300)
    with refused(InputError, "kidney"):
        recording(tmp_path, 0 * LABELS)
    with refused(InputError, "32 x 48", "64 x 48"):
        recording(tmp_path, BRIGHT, masks=write_masks(tmp_path / "m", LABELS[:, :, ::2]))
    with refused(InputError, "empty"):
        (tmp_path / "empty").mkdir()
        recording(tmp_path, BRIGHT, masks=tmp_path / "empty")


def test_a_file_of_several_pages_is_no_mask(tmp_path):
    pages = [Image.fromarray(page.astype(np.uint8)) for page in LABELS[:2]]
    (tmp_path / "m").mkdir()
    pages[0].save(tmp_path / "m" / "0.tif", save_all=True, append_images=pages[1:])
    with refused(InputError, "0.tif", "2 images"):
        recording(tmp_path, BRIGHT, masks=tmp_path / "m")


def test_masks_without_poses_and_masks_of_a_table_are_refused(tmp_path):
    folder = write_masks(tmp_path / "m")
    with refused(InputError, "--poses"):
        tt.read_ultrasound(folder, ("kidney", "tumor_1"))
    with refused(InputError, "--masks"):
        tt.read_ultrasound(folder, ("kidney",), masks=folder, poses=tmp_path / "poses.csv")


def test_hostile_calibrations_are_refused(tmp_path):
    file = tmp_path / "plus.xml"
    for text in (
        "<a", "<PlusConfiguration/>",
        '<!DOCTYPE a [<!ENTITY b "c">]><PlusConfiguration>&b;</PlusConfiguration>',
        '<P><CoordinateDefinitions><Transform From="Image" To="Probe" Matrix="1 2"/>'
        "</CoordinateDefinitions></P>",
    ):  # fmt: skip
        file.write_text(text)
        with refused(InputError):
            recording(tmp_path, fields=MF, image_to_probe=file)
    rows = {"unit": "mm", "probe_from_image": np.eye(4).tolist()}
    for changed in ({"unit": "inch"}, {"probe_from_image": [[1, 0, 0, 0]] * 4}, {"probe": 7}):
        (tmp_path / "i.json").write_text(json.dumps(rows | changed))
        with refused(InputError, "i.json"):
            recording(tmp_path, image_to_probe=tmp_path / "i.json")
    (tmp_path / "i.json").write_text(json.dumps(rows))
    with refused(InputError, "--mm-per-pixel"):
        large = np.zeros((2, 8, 600), np.uint8)
        recording(tmp_path, large, FRAMES[:2], image_to_probe=tmp_path / "i.json")


# The story: a sweep over the phantom, in a tracker's frame, on the command line.
TRACKER_FROM_CAMERA = rigid(
    Rotation.from_euler("xyz", [15, 160, 40], degrees=True).as_matrix(),
    np.array([300.0, -80.0, 90]),
)
PIXEL_MM, SIZE_PX = 0.4, (240, 300)  # rows, columns


def sweep(case, camera_from_ct, planes=40):
    """Label images of planes through the case's own label map, and the probe's poses in the
    tracker's frame: across the organ, from above, each plane a little turned."""
    organ_mm = transform_points(camera_from_ct, case.anatomy.organ.vertices_mm)
    low_mm, high_mm = organ_mm.min(0), organ_mm.max(0)
    rows, columns = np.mgrid[: SIZE_PX[0], : SIZE_PX[1]]
    pixels = np.stack([columns, rows, 0 * rows], -1).reshape(-1, 3).astype(float)
    calibration = np.diag([PIXEL_MM, PIXEL_MM, PIXEL_MM, 1.0])
    calibration[:3, 3] = [-SIZE_PX[1] * PIXEL_MM / 2, 10.0, 0]
    images, poses = [], []
    for share in np.linspace(0.08, 0.92, planes):
        turn = Rotation.from_euler("xy", [0.3 * np.sin(6 * share), 0.25 * share]).as_matrix()
        across = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])  # deep is z, the sweep is along x
        middle = (low_mm + high_mm) / 2
        middle[0] = low_mm[0] + share * (high_mm[0] - low_mm[0])
        axes = turn @ across.T[:, [1, 2, 0]]
        probe = rigid(axes, middle - axes[:, 1] * (10 + SIZE_PX[0] * PIXEL_MM / 2))
        in_ct = transform_points(np.linalg.inv(camera_from_ct) @ probe @ calibration, pixels)
        index = transform_points(np.linalg.inv(case.labels.lps_from_index), in_ct)
        at = np.rint(index).astype(int)
        inside = ((at >= 0) & (at < case.labels.labels.shape)).all(1)
        image = np.zeros(len(pixels), np.uint8)
        image[inside] = case.labels.labels[tuple(at[inside].T)]
        images.append(image.reshape(SIZE_PX))
        poses.append(TRACKER_FROM_CAMERA @ probe)
    return np.array(images), np.array(poses), calibration


def centres_off(folder, case, frame_from_ct):
    report = json.loads((folder / "report.json").read_text())
    parts = dict(zip(case.anatomy.names, (case.anatomy.organ, *case.anatomy.tumors), strict=True))
    off = {}
    for name, mesh in parts.items():
        true_mm = transform_points(frame_from_ct, mesh.vertices_mm)
        middle = (true_mm.min(0) + true_mm.max(0)) / 2
        off[name] = float(np.linalg.norm(report["parts"][name]["center_mm"] - middle))
    return report, off


def test_a_sweep_says_where_the_organ_is_with_and_without_a_camera(
    phantom_case, elastic_model, tmp_path
):
    case = load_case(phantom_case)
    camera_from_ct = looking_down(case)
    images, poses, calibration = sweep(case, camera_from_ct)
    scan = write_meta_image(
        tmp_path / "scan.igs.mha",
        images,
        stamped({"ProbeToTracker": poses}),
        MF | {"ImageToProbeTransform": words(calibration)},
    )
    write_cloud_ply(tmp_path / "cloud.ply", cloud_by_rays(case, camera_from_ct).astype(np.float32))
    camera = {"frame_id": "Tracker", "unit": "mm", "error_mm": 0.5}
    camera["robot_from_camera"] = TRACKER_FROM_CAMERA.tolist()
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    common = ("--grid", 48, "--device", "cpu", "--evidence", scan)
    seen = ("locate", elastic_model, tmp_path / "cloud.ply", *common, "--out", tmp_path / "seen")
    assert "--frame" in refusal(tumortrack(*seen))
    done = tumortrack(*seen, "--frame", tmp_path / "camera.json")
    assert done.returncode in (0, 4), done.stderr
    report, off = centres_off(tmp_path / "seen", case, camera_from_ct)
    assert max(off.values()) < 1.0
    assert {each["name"] for each in report["evidence"]} == {"outline"}
    assert report["evidence_sha256"] == sha256_of(scan)
    assert report["ultrasound_sha256"] == {"frame": [sha256_of(tmp_path / "camera.json")]}
    done = tumortrack("locate", elastic_model, "-", *common, "--out", tmp_path / "alone")
    assert done.returncode in (0, 4), done.stderr
    report, off = centres_off(tmp_path / "alone", case, TRACKER_FROM_CAMERA @ camera_from_ct)
    assert max(off.values()) < 1.0
    assert report["frame"] == "Tracker"
