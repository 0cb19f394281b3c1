"""`uwb-slam image`: the room as the radars of a session, or one of a recording, see it."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from slam.app.errors import UsageError, naming
from slam.app.rig.rig_files import load_rig
from slam.app.run.output import note, print_table
from slam.app.run.pictures import draw_image, picture
from slam.app.run.radar_image import (
    ImagePath,
    NoImageError,
    RoomPicture,
    image_of,
    path_of,
    session_image,
)
from slam.app.run.replay import play_states
from slam.app.run.result_files import IMAGE, hold_folder, remove_earlier
from slam.front_end.pulse import PulseModel
from slam.geometry import Mount
from slam.imaging.back_projection import Grid
from slam.imaging.patches import RecordedFrame
from slam.imaging.room import RoomImage
from slam.live.errors import AppError, OdometryError
from slam.live.odometry_track import read_tum
from slam.live.session.reader import RecordedSession, begins_with, open_session
from slam.live.session_records import SessionInfo
from xethru_protocol.operating_system import StopFlag, written_whole
from xethru_protocol.recordings.loading import load
from xethru_protocol.recordings.mcap import MAGIC
from xethru_protocol.recordings.recorded_messages import NO_TIME_NS, RecordingError

_ARRAYS, _MAP, _MAP_CELLS = "image.npz", "map.yaml", "map.pgm"
_MOST_CELLS, _MOST_CELL_M = 1 << 22, 1.0
_BIN_M = 1e-3, 0.1  # Shortest and longest bin: an X4's are 6 mm of RF, 51 mm of I/Q
_OCCUPIED, _FREE = 0.5, 0.196
"""Of nav2's map, shares of 40 dB: what is brighter than -20 dB counts as an obstacle."""
_UNKNOWN = 205  # what nav2 writes for it: neither of both


def run_image(
    stop: StopFlag,
    *,
    source: Path,
    path: str | None,
    out: Path,
    cell_m: float,
    reach_m: float,
    area_m: Sequence[float] | None,
    rig: str | None,
    mount: Sequence[float] | None,
    frame_area_m: Sequence[float] | None,
) -> None:
    """Image a session or a recording, and write the image into a folder."""
    area = None
    if cell_m > _MOST_CELL_M:
        raise UsageError(
            f"--cell {cell_m:g}: must be {_MOST_CELL_M:g} m at most; rods are 2 to 4 cm"
        )
    if area_m is not None:
        x0, y0, x1, y1 = area_m
        if not (x0 < x1 and y0 < y1):
            raise UsageError("--area: X0 Y0 must be its lower left corner, X1 Y1 the opposite one")
        _check_cells(x1 - x0, y1 - y0, cell_m)
        area = Grid.over((x0, x1), (y0, y1), cell_m)
    given = None
    if path is not None and path.endswith(".tum"):
        tum = read_tum(Path(path))
        given = ImagePath(Path(path).name, "", tum.stamps_ns, tum.poses)

    def room(along: ImagePath) -> RoomImage:
        if area is None:
            width_m, height_m = (np.ptp(along.poses[:, :2], axis=0) + 2 * reach_m).tolist()
            _check_cells(width_m, height_m, cell_m)
        return RoomImage(cell_m=cell_m, area=area, most_cells=_MOST_CELLS)

    info: SessionInfo | None = None
    try:
        if (session := _session_at(source, stop)) is not None:
            if mount or rig or frame_area_m:
                raise UsageError(f"{source}: a session has mounts and frame areas of its own")
            info = session.info
            along = given
            if along is None:
                record = play_states(session, [], stop)
                along = path_of(record, session.odometry(), info, path)
            image = session_image(session, along, room(along), reach_m=reach_m)
        else:
            frames = _recorded_frames(source, frame_area_m)
            if given is None:
                raise UsageError(
                    f"{source}: a recording has no path; give --path FILE.tum, the poses of the "
                    "robot or cart by the same clock"
                )
            mounts = [_mount(source, mount, rig)]
            image = image_of(
                lambda: stop.each(frames()),
                *(mounts, given, room(given)),
                model=PulseModel(),
                reach_m=reach_m,
            )
    except (NoImageError, OdometryError) as error:
        raise AppError(f"{source}: {error}") from None
    except RecordingError as error:  # which names the file
        raise AppError(str(error)) from None
    if given is not None and image.n_placed < image.n_frames:
        note(
            f"{source}: {image.n_frames - image.n_placed} of {image.n_frames} frames are left out: "
            f"they lie before, behind or in gaps of {given.name}"
        )
    with ExitStack() as held:
        hold_folder(out, held)
        remove_earlier(out, (IMAGE, _ARRAYS, _MAP, _MAP_CELLS))
        with picture(out / IMAGE, width_in=9.0, height_in=8.2, dpi=120) as figure:
            draw_image(figure, image, info, source.name)
        _write(out, image)
    _print(out, source, image)


def _print(out: Path, source: Path, image: RoomPicture) -> None:
    grid = image.room.grid
    size = f"{grid.columns * grid.cell_m:.2f} x {grid.rows * grid.cell_m:.2f} m"
    frame = f", in the frame of the {image.path.frame}" if image.path.frame else ""
    rows = [
        ("image", size, f"x from {grid.x_m:.2f}, y from {grid.y_m:.2f} m{frame}"),
        ("path", image.path.name, f"gives {image.n_placed} of {image.n_frames} frames a place"),
        ("patches", f"{image.n_patches}", f"on cells of {1e3 * grid.cell_m:g} mm"),
    ]
    print_table(f"the radar image of {source}, in {out}", None, rows)


def _check_cells(width_m: float, height_m: float, cell_m: float) -> None:
    n_cells = (width_m / cell_m) * (height_m / cell_m)
    if n_cells > _MOST_CELLS:
        raise UsageError(
            f"{width_m:.4g} x {height_m:.4g} m in cells of {cell_m:g} m are {n_cells:.2g} cells, "
            f"{_MOST_CELLS:.2g} at most: give a smaller --area, or a larger --cell"
        )


def _session_at(source: Path, stop: StopFlag) -> RecordedSession | None:
    """Open a session; None of what other programs than a run have recorded."""
    if not source.exists():
        raise AppError(f"{source}: there is no such file")
    if not begins_with(source, MAGIC):
        return None
    try:
        return open_session(source, stop)
    except AppError:
        if not load(source, lambda _: None).radars:
            raise
        return None


def _mount(source: Path, mount: Sequence[float] | None, rig: str | None) -> Mount:
    """Return where the radar of a recording sits, by one of the options."""
    if (mount is None) == (rig is None):
        raise UsageError(
            f"{source}: does not say where its radar sits; give --mount X Y DEGREES, or --rig with "
            "that radar alone"
        )
    if mount is not None:
        x_m, y_m, degrees = mount
        return Mount(x_m=x_m, y_m=y_m, yaw_rad=math.radians(degrees))
    mounts = load_rig(str(rig)).rig.mounts
    if len(mounts) != 1:
        raise UsageError(f"--rig {rig}: has {len(mounts)} radars, and a recording is of one")
    return mounts[0]


def _recorded_frames(
    source: Path, frame_area_m: Sequence[float] | None
) -> Callable[[], Iterator[tuple[int, RecordedFrame]]]:
    """Return what reads the frames of a recording, RF or I/Q, whose time is known."""
    area_m = None if frame_area_m is None else (frame_area_m[0], frame_area_m[1])
    radar = load(source, lambda fault: note(str(fault)), area_m=area_m).radar
    ranges_m, t_ns = radar.true_ranges_m, radar.t_ns
    if ranges_m is None or len(ranges_m) < 2:
        raise UsageError(
            f"{source}: does not say where its bins lie; give --frame-area START END, as the "
            "module read it back"
        )
    if t_ns is None:
        raise AppError(f"{source}: does not say when its frames came, so none has a pose")
    bin_m = float(ranges_m[-1] - ranges_m[0]) / (len(ranges_m) - 1)
    if not _BIN_M[0] <= bin_m <= _BIN_M[1]:
        raise UsageError(
            f"{source}: its bins lie from {ranges_m[0]:.4g} to {ranges_m[-1]:.4g} m, {bin_m:.4g} m "
            "apart, as of no radar; give --frame-area START END, as the module read it back"
        )

    def frames() -> Iterator[tuple[int, RecordedFrame]]:
        for block in radar.blocks():
            samples, times_ns = block.rf if block.kind == "rf" else block.iq, block.t_ns
            assert samples is not None
            assert times_ns is not None
            for at_ns, row in zip(times_ns.tolist(), samples, strict=True):
                if at_ns != NO_TIME_NS:
                    yield (
                        0,
                        RecordedFrame(
                            t_ns=at_ns,
                            samples=row,
                            range_start_m=float(ranges_m[0]),
                            bin_length_m=bin_m,
                        ),
                    )

    return frames


def _write(out: Path, image: RoomPicture) -> None:
    """Write the arrays, and nav2's map: the brightest cells are black, unknown ones grey."""
    room, grid, arrays = image.room, image.room.grid, io.BytesIO()
    np.savez_compressed(
        arrays,
        image=room.values,
        coherence=room.coherence,
        x_m=grid.x_m,
        y_m=grid.y_m,
        cell_m=grid.cell_m,
        frame=image.path.frame,
    )
    greys = np.where(room.levels < 0, _UNKNOWN, np.rint(255 - 2.55 * room.levels))
    header = f"P5\n{grid.columns} {grid.rows}\n255\n".encode()
    text = (
        f"image: {_MAP_CELLS}\nmode: trinary\nresolution: {grid.cell_m}\n"
        f"origin: [{grid.x_m}, {grid.y_m}, 0.0]\nnegate: 0\n"
        f"occupied_thresh: {_OCCUPIED}\nfree_thresh: {_FREE}\n"
    )
    for name, data in (
        (_ARRAYS, arrays.getvalue()),
        (_MAP_CELLS, header + greys[::-1].astype(np.uint8).tobytes()),  # the first row on top
        (_MAP, text.encode()),
    ):
        with naming(out / name), written_whole(out / name) as fresh:
            fresh.write_bytes(data)
