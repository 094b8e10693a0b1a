"""The command line of a model in use: see ``cli.main``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from tyro.conf import Positional


def locate(
    model: Positional[Path],
    cloud: Positional[Path],
    out: Positional[Path],
    /,
    *,
    grid: int = 160,
    seed: int = 0,
    range: tuple[float, float] | None = None,
    unit: Literal["mm", "m"] = "mm",
    intrinsics: Path | None = None,
    map: Path | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    overwrite: bool = False,
) -> None:
    """Locate kidney and tumors in one cloud or depth image.

    Args:
        model: folder that `train` wrote.
        cloud: .ply, .pcd or .npz in the camera frame, or a depth .png (with --intrinsics).
        out: folder to write.
        grid: voxels along the longest side of the labelled volume, up to 400.
        seed: of the random points and queries.
        range: keep depths between NEAR and FAR mm; a cloud is else used as it is, a depth image
            cropped by the range the model was trained for.
        unit: of the cloud's numbers.
        intrinsics: JSON with width, height, fx, fy, cx, cy in pixels.
        map: points of the CT, to be found before the camera (OUT/points.csv): a .csv with columns
            x,y,z (LPS, mm), or 3D Slicer's .mrk.json or .fcsv. Needs a model of preset clinic.
        device: auto takes CUDA where it is.
        overwrite: replace OUT if it exists.
    """
    from tumortrack.cli import commands

    commands.locate(
        model,
        cloud,
        out,
        commands.LocateOptions(grid, seed, range, unit, intrinsics, map, device, overwrite),
    )


def track(
    model: Positional[Path],
    source: Positional[str],
    sinks: Positional[tuple[str, ...]] = (),
    /,
    *,
    range: tuple[float, float] | None = None,
    box: tuple[float, float, float, float, float, float] | None = None,
    whole: bool = False,
    frame: Path | None = None,
    intrinsics: Path | None = None,
    smoothing: float = 0.0,
    rescan: float = 1.0,
    stale: float = 0.5,
    give_up: float = 60.0,
    seconds: float = 0.0,
    report: Path | None = None,
    seed: int = 0,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> None:
    """Follow kidney and tumors live, from a camera to viewers, recordings and robots.

    Sources and sinks are written kind:target?option=value&option=value. Sources: virtual:CASE,
    recording:PATH, realsense[:SERIAL|FILE], ros2:TOPIC, ros1:TOPIC. Sinks: viewer[:PORT],
    recording:FOLDER, ros2[:TOPIC], ros1[:TOPIC], openigtlink[:PORT]. A wrong one is answered with
    its options. docs/live.md has examples.

    Args:
        model: folder that `train` wrote.
        source: where frames come from.
        sinks: where estimates go; any number.
        range: keep depths between NEAR and FAR mm (default: those that the model has learned).
        box: keep what lies in a box: two opposite corners X Y Z X Y Z, camera frame, mm.
        whole: what is in range and box is the organ alone; do not look for it among other things.
        frame: JSON file that says where the camera is; results are then in the robot's frame.
        intrinsics: JSON with the camera's width, height, fx, fy, cx, cy in pixels, instead of what
            the source says.
        smoothing: time constant in s of a mean over past estimates; the lag is in the report.
        rescan: every so many s, look for the organ as in a first frame.
        stale: frames older than so many s are refused, and a pause so long is said.
        give_up: end after so many s without a frame.
        seconds: end so many s after the first frame; 0: never.
        report: file for latencies, counts and reasons (default: runs/track-TIME.json).
        seed: of the random points.
        device: auto takes CUDA where it is.
    """
    from tumortrack.cli import live

    live.track(
        model,
        source,
        sinks,
        live.TrackOptions(
            range,
            box,
            whole,
            frame,
            intrinsics,
            smoothing,
            rescan,
            stale,
            give_up,
            seconds,
            report,
            seed,
            device,
        ),
    )


def plan(
    run: Positional[Path],
    plan: Positional[Path],
    /,
    *,
    method: Literal["margin", "published"] | None = None,
    tumor: str | None = None,
    margin: float | None = None,
    sigmas: float | None = None,
    config: Path | None = None,
    frame: Path | None = None,
    stand: float | None = None,
    cell: Path | None = None,
    arms: bool = True,
    overwrite: bool = False,
) -> None:
    """Plan how to cut a located tumor out, and how two arms do it.

    Args:
        run: folder that `locate` wrote.
        plan: folder to write: plan.json, strokes.ply, plan.png, motions, the cell as URDF.
        method: margin (default) keeps the margin in all directions; published is the paper's
            planner.
        tumor: which one (tumor_1, ...; default: the one that lies farthest out of the organ).
        margin: least distance between tumor and cut in mm (default 5).
        sigmas: add so many standard deviations of the estimate's own uncertainty to the margin
            (default 0).
        config: JSON file with these and all other choices of the planner (docs/resection.md).
        frame: JSON file that says where the camera is; the plan is then in the robot's frame, whose
            z must point up. Without, the camera looks straight down.
        stand: height of the organ's lowest point over the table in mm, where no frame is given.
        cell: JSON file with arms, tools, table and their places (docs/resection.md).
        arms: also plan the motions of both arms.
        overwrite: replace PLAN if it exists.
    """
    from tumortrack.cli import planning

    given = {"method": method, "tumor": tumor, "margin_mm": margin, "sigmas": sigmas}
    choices = planning.choices(config, {k: v for k, v in given.items() if v is not None})
    planning.plan(run, plan, choices, planning.PlanOptions(frame, stand, cell, arms, overwrite))


def resect(
    plan: Positional[Path],
    sinks: Positional[tuple[str, ...]] = (),
    /,
    *,
    live: tuple[Path, str] | None = None,
    range: tuple[float, float] | None = None,
    box: tuple[float, float, float, float, float, float] | None = None,
    whole: bool = False,
    intrinsics: Path | None = None,
    speed: float = 1.0,
    moved: float = 2.0,
    film: Path | None = None,
    report: Path | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> None:
    """Carry a plan out with virtual arms, seen by sinks as those of `track`.

    Args:
        plan: folder that `plan` wrote.
        sinks: where arms, cuts and estimates go; see `track`. ur:ADDRESS is a real arm, and only
            says what it would do unless told execute=true.
        live: MODEL SOURCE: follow the organ meanwhile, as `track` does. Arms stand while there is
            no good estimate, and it is planned anew where the tumor has moved.
        range: of depths, as in `track`.
        box: as in `track`.
        whole: as in `track`.
        intrinsics: as in `track`.
        speed: of the arms' time; 2 is twice as fast.
        moved: the tumor has moved if its surface has by so many mm (root mean square).
        film: write an animated GIF of the stored plan instead.
        report: file for states, halts and what else there was (default: runs/resect-TIME.json).
        device: auto takes CUDA where it is.
    """
    from tumortrack.cli import resection

    resection.resect(
        plan,
        sinks,
        resection.ResectOptions(
            live, range, box, whole, intrinsics, speed, moved, film, report, device
        ),
    )
