"""`uwb-slam image`: where rods of an emulated drive are bright, and what its files hold."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray
from PIL import Image
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from emulator.scene.scene import load_scene
from hil_tests.system.short_scene import write_short_scene
from hil_tests.unit.slam.app.sessions import odometry, run, session_info
from slam.app.cli import main
from slam.app.commands.demo import write_image
from slam.app.rig.emulated import rig_of, wheels_of
from slam.app.run.radar_image import RollingImage, path_of
from slam.app.run.replay import play_states
from slam.app.run.runner import RunRecord, execute
from slam.app.session.writer import SessionLog
from slam.app.sweep.run import loopback_source
from slam.config import load_preset
from slam.geometry import compose
from slam.library.slam import make_slam
from slam.live.odometry_track import OdometryTrack, Trajectory, write_tum
from slam.live.session.reader import open_session
from slam.live.session_records import RadarImage, Scan, SessionObserver, Snapshot
from xethru_protocol.operating_system import StopFlag
from xethru_protocol.processing.downconversion import downconvert, line_bins

RODS = np.array([[0.1, 0.9], [0.5, 1.3], [0.0, -1.0], [0.45, -0.8], [0.9, 0.8]])
SEEN = RODS[:4]  # in the beam of a radar for a patch or more


@dataclass(frozen=True)
class Drive:
    """A session of the short scene, and the poses at which its first radar was."""

    folder: Path
    truth: Path

    @property
    def session(self) -> Path:
        return self.folder / "session.mcap"


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    folder = tmp_path_factory.mktemp("drive")
    scene = load_scene(write_short_scene(folder))
    slam = make_slam(load_preset("robust"), rig_of(scene), wheels_of(scene))
    source = loopback_source(scene, "robust", slam, seed=3)
    assert isinstance(source.odometry, OdometryTrack)
    log = SessionLog(
        folder / "session.mcap", source.info, source.odometry, truth_at=source.truth_at
    )
    execute(source, [RollingImage(source.info, source.odometry, [log]), log])
    trajectory = scene.trajectory()
    stamps_ns = np.arange(0, trajectory.duration_ns, 100_000_000)
    truth = folder / "truth.tum"
    write_tum(truth, Trajectory(stamps_ns=stamps_ns, poses=trajectory.poses(stamps_ns)))
    return Drive(folder=folder, truth=truth)


@pytest.fixture(scope="module")
def played(drive: Drive) -> RunRecord:
    return play_states(open_session(drive.session), [], StopFlag())


def lost_until(record: RunRecord, state: int | None) -> RunRecord:
    """Return the record of a drive as of a robot that was lost until a state, or all the time."""
    assert record.last is not None
    lost, estimate = np.zeros(len(record.states), dtype=bool), record.states.estimate.copy()
    lost[:state], estimate[:state] = True, 9.0  # a guess
    return replace(
        record,
        smoothed=None,
        states=replace(record.states, lost=lost, estimate=estimate),
        last=replace(record.last, world_from_map=np.array([1.0, 2.0, 0.5])),
    )


def brightest_m(
    folder: Path, near: NDArray[np.float64], within_m: float = 0.2
) -> NDArray[np.float64]:
    """Return the middle of the brightest cell around a place, by the arrays of an image."""
    with np.load(folder / "image.npz") as arrays:
        image, cell_m = arrays["image"], float(arrays["cell_m"])
        corner = np.array([float(arrays["x_m"]), float(arrays["y_m"])])
    rows, columns = image.shape
    x = corner[0] + cell_m * (np.arange(columns) + 0.5)
    y = corner[1] + cell_m * (np.arange(rows) + 0.5)
    is_near = np.hypot(x[None, :] - near[0], y[:, None] - near[1]) < within_m
    row, column = np.unravel_index(
        np.argmax(np.where(is_near, np.nan_to_num(image), -1.0)), image.shape
    )
    return np.array([x[column], y[row]])


@pytest.fixture(scope="module")
def made(drive: Drive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the image of the drive along the smoothed path."""
    out = tmp_path_factory.mktemp("image")
    assert main(["image", str(drive.folder), "--out", str(out)]) == 0
    return out


def test_the_brightest_cells_of_a_session_are_within_two_cells_of_true_rods(made: Path) -> None:
    for rod in SEEN:
        assert np.abs(brightest_m(made, rod) - rod).max() < 2 * 0.02 + 0.01
    with np.load(made / "image.npz") as arrays:
        assert str(arrays["frame"]) == "world"
        seen = np.isfinite(arrays["image"])
        np.testing.assert_array_equal(seen, np.isfinite(arrays["coherence"]))
        assert np.all(arrays["coherence"][seen] <= 1 + 1e-5)


@pytest.mark.parametrize(
    "path",
    [
        pytest.param("estimate", marks=pytest.mark.rare),  # `--area` has it
        "odometry",
        pytest.param("truth", marks=pytest.mark.rare),
    ],
)
def test_other_paths_show_the_same_rods(
    drive: Drive, path: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = str(drive.truth) if path == "truth" else path
    assert run(capsys, "image", drive.folder, "--path", given, "--out", tmp_path)[0] == 0
    for rod in SEEN:
        assert np.abs(brightest_m(tmp_path, rod) - rod).max() < 0.06


def test_the_path_of_wheels_is_laid_on_the_first_pose_that_was_found(
    drive: Drive, played: RunRecord
) -> None:
    session = open_session(drive.session)
    record = lost_until(played, 5)
    path = path_of(record, session.odometry(), session.info, "odometry")
    assert path.frame == "world"
    expected = compose(record.world_from_map, record.states.estimate[5])
    np.testing.assert_allclose(path.place_at(int(record.states.t_ns[5])), expected, atol=1e-9)
    path = path_of(lost_until(played, None), session.odometry(), session.info, "odometry")
    assert path.frame == "odom"
    np.testing.assert_array_equal(path.poses[0], session.odometry().pose_at(int(path.t_ns[0])))


def test_the_map_of_nav2_has_the_image_as_its_server_reads_it(made: Path) -> None:
    described = YAML(typ="safe").load(made / "map.yaml")
    assert described["mode"] == "trinary"
    assert described["negate"] == 0
    with Image.open(made / described["image"]) as picture:
        pixels = np.asarray(picture)
    occupied = (255.0 - pixels) / 255.0  # nav2_map_server, map_io
    with np.load(made / "image.npz") as arrays:
        image = arrays["image"]
        assert described["resolution"] == float(arrays["cell_m"])
        assert described["origin"] == [float(arrays["x_m"]), float(arrays["y_m"]), 0.0]
    assert pixels.shape == image.shape
    upwards = occupied[::-1]  # its first row is on top
    below_db = 20 * np.log10(np.maximum(np.nan_to_num(image), 1e-9) / np.nanmax(image))
    is_obstacle = upwards > described["occupied_thresh"]
    is_free = upwards < described["free_thresh"]
    assert np.all(below_db[is_obstacle] > -20.5)
    assert np.all(is_obstacle[below_db > -19.5])
    assert np.all(below_db[is_free & np.isfinite(image)] < -31.5)
    is_unknown = ~is_obstacle & ~is_free
    assert np.all(is_unknown[np.isnan(image)])
    assert is_obstacle.sum() > 20
    assert is_free.sum() > is_unknown.sum() > 0


def test_the_picture_is_a_png(made: Path) -> None:
    with Image.open(made / "image.png") as picture:
        assert picture.format == "PNG"
        assert min(picture.size) > 500


def test_cells_and_area_are_as_asked_for(
    drive: Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = ("--cell", "0.05", "--area", "-0.5", "0.5", "1.0", "1.5", "--range", "1.5")
    along = ("--path", "estimate", "--out", tmp_path)
    assert run(capsys, "image", drive.folder, *more, *along)[0] == 0
    with np.load(tmp_path / "image.npz") as arrays:
        assert arrays["image"].shape == (20, 30)
        assert (float(arrays["x_m"]), float(arrays["y_m"])) == (-0.5, 0.5)
    for rod in RODS[:2]:
        assert np.abs(brightest_m(tmp_path, rod) - rod).max() < 0.06


@pytest.mark.parametrize("kind", [pytest.param("rf", marks=pytest.mark.rare), "iq"])
def test_one_radar_of_a_recording_is_imaged_by_poses_of_its_own(
    drive: Drive, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = open_session(drive.session)
    frames = [frame for frame in session.frames() if frame.radar == 0]
    samples = np.array([frame.samples for frame in frames])
    ranges_m = frames[0].range_start_m + frames[0].bin_length_m * np.arange(samples.shape[1])
    if kind == "iq":
        samples = downconvert(samples)
        ranges_m = ranges_m[line_bins(len(ranges_m))]
    recording = tmp_path / "cart.npz"
    arrays: dict[str, Any] = {
        kind: samples,
        "t_ns": np.array([frame.t_ns for frame in frames]),
        "ranges_m": ranges_m * 3.0e8 / 299_792_458.0,  # module metres
    }
    np.savez(recording, **arrays)
    mount = session.rig.mounts[0]
    more = ("--path", drive.truth, "--mount", mount.x_m, mount.y_m, 90)
    code, _, _ = run(capsys, "image", recording, *more, "--out", tmp_path / "out")
    assert code == 0
    for rod in RODS[:2]:
        # 5 cm is one bin: no document says whether the chip removes its filter's delay.
        assert np.abs(brightest_m(tmp_path / "out", rod) - rod).max() < 0.05
    rig = tmp_path / "cart.toml"
    rig.write_text(
        f'[[radars]]\nname = "cart"\nserial = "000000000001"\nx_m = {mount.x_m}\n'
        f"y_m = {mount.y_m}\nyaw_deg = 90.0\nrange_offset_m = 0.1\n"
    )
    by_rig = ("--path", drive.truth, "--rig", rig)
    assert run(capsys, "image", recording, *by_rig, "--out", tmp_path / "nearer")[0] == 0
    nearer = brightest_m(tmp_path / "nearer", RODS[0] - np.array([0.0, 0.1]), 0.1)
    assert nearer[1] == pytest.approx(RODS[0][1] - 0.1, abs=0.04)


class TestErrors:
    @pytest.mark.parametrize(
        ("more", "expected"),
        [
            (("--cell", "0"), 2),
            (("--cell", "-0.1"), 2),
            (("--cell", "1e-5"), 2),
            (("--cell", "50"), 2),
            (("--area", "0", "0", "1000", "1000"), 2),
            (("--area", "1", "1", "0", "0"), 2),
            (("--area", "50", "50", "51", "51"), 1),
            (("--path", "elsewhere"), 2),
            (("--path", "nowhere.tum"), 1),
            (("--mount", "0", "0", "90"), 2),
            (("--range", "nan"), 2),
        ],
    )
    def test_bad_options(
        self,
        drive: Drive,
        more: tuple[str, ...],
        expected: int,
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        code: object
        try:
            code, printed, errors = run(
                capsys, "image", drive.folder, *more, "--out", tmp_path / "out"
            )
        except SystemExit as wrong_usage:  # of argparse
            code = wrong_usage.code
            printed, errors = capsys.readouterr()
        assert (code, printed) == (expected, "")
        assert errors.strip().splitlines()[-1].startswith("uwb-slam")
        assert not (tmp_path / "out").exists()

    def test_a_path_of_another_time(
        self, drive: Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        late = tmp_path / "late.tum"
        late.write_text("1700000000 0 0 0 0 0 0 1\n1700000060 1 0 0 0 0 0 1\n")
        code, _, errors = run(
            capsys, "image", drive.folder, "--path", late, "--out", tmp_path / "out"
        )
        assert code == 1
        assert "1700000000" in errors

    def test_a_path_of_a_part_is_noted(
        self, drive: Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        part = tmp_path / "part.tum"
        lines = drive.truth.read_text().splitlines(keepends=True)
        part.write_text("".join(lines[: len(lines) // 2]))
        code, _, errors = run(
            capsys, "image", drive.folder, "--path", part, "--out", tmp_path / "out"
        )
        assert code == 0
        assert "part.tum" in errors

    def test_sessions_without_states_or_frames(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        SessionLog(tmp_path / "empty.mcap", session_info(), odometry(3)).close()
        for more in ((), ("--path", "smoothed"), ("--path", "estimate"), ("--path", "odometry")):
            code, printed, errors = run(
                capsys, "image", tmp_path / "empty.mcap", *more, "--out", tmp_path / "out"
            )
            assert (code, printed) == (1, "")
            assert "empty.mcap" in errors

    def test_a_robot_that_was_lost_all_the_time(
        self,
        drive: Drive,
        played: RunRecord,
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        record = lost_until(played, None)
        monkeypatch.setattr("slam.app.commands.image.play_states", lambda *_: record)
        code, printed, errors = run(capsys, "image", drive.folder, "--out", tmp_path / "out")
        assert (code, printed, errors.count("\n")) == (1, "", 1)
        assert "lost all the time" in errors
        write_image(drive.folder, record, open_session(drive.session).odometry())  # of demo
        assert "lost all the time" in capsys.readouterr().err
        assert not (drive.folder / "image.png").exists()

    def test_a_recording_needs_a_path_and_a_mount(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        recording = tmp_path / "cart.npz"
        np.savez(recording, rf=np.zeros((3, 50), np.float32), t_ns=np.arange(3) * 10**9)
        path = tmp_path / "path.tum"
        path.write_text("0 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
        for more in (
            (),
            ("--path", "smoothed"),
            ("--path", path),
            ("--path", path, "--mount", "0", "0", "90"),
        ):
            code, _, errors = run(capsys, "image", recording, *more, "--out", tmp_path / "out")
            assert code == 2
            assert str(recording) in errors

    @pytest.mark.parametrize(
        ("change", "expected"),
        [
            ({"ranges_m": np.zeros(50)}, 2),
            ({"ranges_m": np.full(50, np.nan)}, 2),
            ({"ranges_m": 1e-9 * np.arange(50.0)}, 2),
            ({"ranges_m": 2.0 - 0.0064 * np.arange(50.0)}, 2),
            ({"rf": np.full((60, 50), np.nan, np.float32)}, 1),
            ({"rf": np.zeros((60, 50), np.float32)}, 1),
            ({"mount": ("1e300", "0", "90")}, 1),
            ({"end": "1e300"}, 1),
        ],
    )
    def test_what_no_radar_or_robot_sends(
        self,
        change: dict[str, Any],
        expected: int,
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        recording, path = tmp_path / "cart.npz", tmp_path / "path.tum"
        arrays: dict[str, Any] = {
            "rf": np.ones((60, 50), np.float32),
            "t_ns": np.arange(60) * 10**8,
            "ranges_m": 0.2 + 0.0064 * np.arange(50.0),
        }
        np.savez(recording, **arrays | {k: change[k] for k in arrays.keys() & change})
        path.write_text(f"0 0 0 0 0 0 0 1\n6 {change.get('end', '0.6')} 0 0 0 0 0 1\n")
        more = ("--path", path, "--mount", *change.get("mount", ("0", "0", "90")))
        area = ("--area", "0", "0", "1", "1", "--out", tmp_path / "out")
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # which a user would see
            code, printed, errors = run(capsys, "image", recording, *more, *area)
        assert (code, printed) == (expected, "")
        assert str(recording) in errors
        assert not (tmp_path / "out").exists()

    def test_a_fault_of_a_recording_is_noted(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        recording, path = tmp_path / "cart.npz", tmp_path / "path.tum"
        t_ns = np.arange(60) * 10**8
        t_ns[40:] -= 3 * 10**9  # the recorder's clock was set back
        ranges_m = 0.2 + 0.0064 * np.arange(50.0)
        np.savez(recording, rf=np.ones((60, 50), np.float32), t_ns=t_ns, ranges_m=ranges_m)
        path.write_text("0 0 0 0 0 0 0 1\n6 0.6 0 0 0 0 0 1\n")
        more = ("--path", path, "--mount", "0", "0", "90", "--out", tmp_path / "out")
        _, _, errors = run(capsys, "image", recording, *more)
        assert f"{recording.name}: frame " in errors
        assert "RecordingFault" not in errors

    def test_what_is_no_recording(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        text, path = tmp_path / "notes.txt", tmp_path / "path.tum"
        text.write_text("notes")
        path.write_text("0 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
        for given in (tmp_path / "missing.mcap", text):
            for more in ((), ("--path", path, "--mount", "0", "0", "90")):
                code, _, errors = run(capsys, "image", given, *more, "--out", tmp_path / "out")
                assert code == 1
                assert str(given) in errors


class TestWhileDriving:
    def test_the_session_has_an_occupancy_grid_that_grows(self, drive: Drive) -> None:
        images = [
            one for one in open_session(drive.session).records() if isinstance(one, RadarImage)
        ]
        assert len(images) >= 2
        assert np.all(np.diff([one.t_ns for one in images]) >= 0)
        seen = [int((one.levels >= 0).sum()) for one in images]
        assert seen == sorted(seen)
        last = images[-1]
        assert last.levels.max() == 100
        x = last.grid.x_m + last.grid.cell_m * (np.arange(last.grid.columns) + 0.5)
        y = last.grid.y_m + last.grid.cell_m * (np.arange(last.grid.rows) + 0.5)
        for rod in SEEN:  # the map frame is the world's: the scene begins at its origin
            is_near = np.hypot(x[None, :] - rod[0], y[:, None] - rod[1]) < 0.08
            assert last.levels[is_near].max() > 60

    def test_rosbags_reads_it(self, drive: Drive) -> None:
        store = get_typestore(Stores.ROS2_HUMBLE)
        with drive.session.open("rb") as stream:
            messages = [
                message
                for _, channel, message in make_reader(stream).iter_messages(topics=["/image"])
                if channel.topic == "/image"
            ]
        grid: Any = store.deserialize_cdr(messages[-1].data, "nav_msgs/msg/OccupancyGrid")
        last = [
            one for one in open_session(drive.session).records() if isinstance(one, RadarImage)
        ][-1]
        assert grid.header.frame_id == "map"
        assert (grid.info.width, grid.info.height) == (last.grid.columns, last.grid.rows)
        assert grid.info.resolution == pytest.approx(0.025)
        assert grid.info.origin.position.x == last.grid.x_m
        assert grid.info.origin.orientation.w == 1.0
        np.testing.assert_array_equal(grid.data.reshape(last.levels.shape), last.levels)
        assert grid.data.min() == -1

    def test_images_come_ever_rarer_and_once_at_the_end(self, drive: Drive) -> None:
        images = [
            one for one in open_session(drive.session).records() if isinstance(one, RadarImage)
        ]
        gaps_s = np.diff([one.t_ns for one in images[:-1]]) * 1e-9
        assert np.all(gaps_s >= 5.0)

    def test_patches_are_left_out_while_slam_is_late(self, drive: Drive) -> None:
        session = open_session(drive.session)
        given: list[RadarImage] = []

        class Outlet(SessionObserver):
            def on_image(self, image: RadarImage) -> None:
                given.append(image)

        rolling = RollingImage(session.info, session.odometry(), [Outlet()], is_late=lambda: True)
        for record in session.played():
            if isinstance(record, Scan):
                rolling.on_scan(record)
            elif isinstance(record, Snapshot):
                rolling.on_snapshot(record)
        rolling.close()
        assert not given
        assert rolling.n_patches == 0
        assert rolling.n_left_out > 10
