"""Hostile input: evidence in files, of `locate` and of a tool of `track`."""

from __future__ import annotations

import json
from typing import Any

from attack import Make, Room, attacks
from attack_artifacts import track
from attack_clouds import CPU, with_right_cloud

TOUCH: dict[str, Any] = {"kind": "touch", "place_mm": [0.0, 0.0, 150.0]}
NAN, INFINITE = float("nan"), float("inf")
HEADER = "piece,frame,kind,x_mm,y_mm,z_mm\n"
POSES = "stamp_ns,x_mm,y_mm,z_mm,qx,qy,qz,qw,frame_id,contact\n"


def _evidence(content: bytes, name: str = "evidence.json") -> Make:
    return lambda room: with_right_cloud("--evidence", room.file(name, content), *CPU)(room)


def told(*pieces: object, **changes: object) -> Make:
    """A file of these pieces."""
    content = {"frame": "camera", "unit": "mm", "evidence": pieces, **changes}
    return _evidence(json.dumps(content).encode())


def touch(**changes: object) -> Make:
    return told({**TOUCH, **changes})


def table(text: str) -> Make:
    return _evidence(text.encode(), "evidence.csv")


def alone(*places: tuple[float, float, float]) -> Make:
    """Touches in place of a cloud."""

    def make(room: Room) -> list[object]:
        pieces = [{**TOUCH, "place_mm": place} for place in places]
        _, model, _, out, _, file, *cpu = told(*pieces)(room)
        return ["locate", model, "-", out, "--evidence", file, *cpu]

    return make


def tool(name: str, content: bytes) -> Make:
    """`track` with a table of a tool's poses."""

    def make(room: Room) -> list[object]:
        still = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        frame = {"frame_id": "base", "unit": "mm", "robot_from_camera": still}
        file, where = room.file(name, content), room.file("base.json", json.dumps(frame).encode())
        source = room.file("in.mcap", b"")
        return [*track(room, source), "--tool", f"probe=file:{file}", "--frame", where]

    return make


ATTACKS = attacks(
    refused={
        "evidence_empty": _evidence(b""),
        "evidence_a_pickle": _evidence(b"\x80\x04\x95\x10\x00\x00\x00\x00\x00\x00\x00\x8c\x02os"),
        "evidence_nested": _evidence(b"[" * 1_000_000),
        "evidence_a_number": _evidence(b"1e400"),
        "evidence_of_20_mb": told(*[TOUCH] * 400_000),
        "evidence_is_a_fifo": lambda room: with_right_cloud("--evidence", room.fifo("e.json"))(
            room
        ),
        "evidence_without_end": lambda room: with_right_cloud("--evidence", room.endless("e.json"))(
            room
        ),
        "evidence_table_without_end": lambda room: with_right_cloud(
            "--evidence", room.endless("e.csv")
        )(room),
        "evidence_nan": touch(place_mm=[NAN, 0, 150]),
        "evidence_infinite": touch(std_mm=INFINITE),
        "evidence_at_1e300": touch(place_mm=[1e300, 0, 150]),
        "evidence_sure_to_nothing": touch(std_mm=1e-300),
        "evidence_in_metres": touch(place_mm=[0.01, 0.0, 0.15]),
        "evidence_of_no_part": touch(part="../../etc/passwd"),
        "evidence_of_a_stamp_of_100_bits": touch(stamp_ns=10**30),
        "evidence_of_an_unknown_kind": told({**TOUCH, "kind": "smell"}),
        "evidence_of_ragged_places": told({**TOUCH, "kind": "free", "places_mm": [[0], [1, 2]]}),
        "evidence_of_another_frame": told(TOUCH, frame="robot"),
        "evidence_older_than_rest": told({**TOUCH, "stamp_ns": 1}, still_since_ns=2),
        "evidence_table_of_words": table(HEADER + "1,camera,touch,one,two,three\n"),
        "evidence_table_of_a_huge_cell": table(
            HEADER + "1,camera,touch," + "9" * 200_000 + ",0,0\n"
        ),
        "evidence_table_with_nul": table(HEADER + "1,camera,touch,\0,0,150\n"),
        "evidence_table_of_no_rows": table(HEADER),
        "evidence_table_with_a_column_twice": table(
            HEADER.strip() + ",x_mm\n1,camera,touch,0,0,150,9\n"
        ),
        "evidence_with_a_key_twice": _evidence(b'{"frame": "camera", "unit": "mm", "unit": "m"}'),
        "evidence_of_5000_touches": told(*[TOUCH] * 5000),
        "evidence_outline_of_50000_places": told(
            {"kind": "outline", "part": "tumor_1", "places_mm": [[0, 0, 150.0]] * 50_000}
        ),
        "evidence_alone_in_one_place": alone(*[(0.0, 0.0, 150.0)] * 20),
        "evidence_alone_on_a_line": alone(*[(5.0 * n, 0.0, 150.0) for n in range(20)]),
        "evidence_alone_far_apart": alone(*[(90.0 * n, 60.0 * (n % 3), 150.0) for n in range(20)]),
        "tool_of_no_poses": tool("tool.csv", POSES.encode()),
        "tool_of_words": tool("tool.csv", (POSES + "now,a,b,c,d,e,f,g,base,yes\n").encode()),
        "tool_is_a_picture": tool("tool.csv", b"\x89PNG\r\n\x1a\n" + bytes(1000)),
    },
    either={
        "evidence_of_1000_touches": told(*[TOUCH] * 1000),
        "evidence_a_metre_off": touch(place_mm=[900.0, 0.0, 900.0]),
        "evidence_all_is_free": told(
            {"kind": "free", "places_mm": [[x, y, 150.0] for x in range(30) for y in range(30)]}
        ),
        "evidence_of_one_place_50_times_sure": told(*[{**TOUCH, "std_mm": 0.05}] * 50),
    },
)
