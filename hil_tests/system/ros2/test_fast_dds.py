"""SLAM with a robot on another DDS: eProsima's Fast DDS, by the C++ program `witness.cpp`.

Debian's packages libfastrtps-dev, libfastcdr-dev and fastddsgen build it here.
"""

import os
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from emulator.scene.scene import load_scene
from hil_tests.device.emulator_process import emulator
from hil_tests.system.short_scene import write_short_scene
from hil_tests.unit.slam.app.ros2_robot import ros_domain, unique_name
from slam.app.cli import main
from slam.app.rig.rig_files import write_rig
from slam.geometry import compose
from slam.library.rig_files import RigFile, RigRadar
from slam.live.odometry_track import TumSample, parse_tum_line
from slam.live.session import cdr
from slam.live.session.reader import open_session
from slam.live.session_records import Snapshot

pytestmark = pytest.mark.slow

HERE = Path(__file__).parent
HEADER = Path("/usr/include/fastrtps/fastrtps_all.h")


@pytest.fixture(scope="module")
def witness(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Generate the code of the messages and compile it with the program."""
    absent = [name for name in ("fastddsgen", "g++") if shutil.which(name) is None]
    if absent or not HEADER.exists():
        pytest.skip(
            "Fast DDS is not installed: "
            "apt-get install g++ libfastrtps-dev libfastcdr-dev fastddsgen"
        )
    folder = tmp_path_factory.mktemp("witness")
    shutil.copy(HERE / "messages.idl", folder)
    program = folder / "witness"
    for command in (
        ["fastddsgen", "-cs", "messages.idl"],
        [
            *("g++", "-O1", "-std=c++17", "-I.", "-o", str(program), str(HERE / "witness.cpp")),
            *("messages.cxx", "messagesPubSubTypes.cxx", "-lfastrtps", "-lfastcdr", "-lpthread"),
        ],
    ):
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    return program


def wheels_to(process: subprocess.Popen[str], path: str, sent: list[TumSample]) -> None:
    """Give a program the lines of an emulator's odometry until it is gone."""
    assert process.stdin is not None
    with socket.socket(socket.AF_UNIX) as line:
        line.connect(path)
        for text in line.makefile():
            try:
                process.stdin.write(text)
                process.stdin.flush()
            except (BrokenPipeError, ValueError):
                return
            if not text.startswith("#"):
                sent.append(parse_tum_line(text))


@pytest.fixture
def domain() -> Iterator[int]:
    with ros_domain() as number:
        yield number


@pytest.mark.rare
def test_fast_dds_drives_slam_and_gets_its_poses_to_the_last_bit(
    witness: Path, domain: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene_path, space = write_short_scene(tmp_path, repeats=5), unique_name()
    rig = tmp_path / "robot.toml"
    names = {"name", "serial", "x_m", "y_m", "yaw_deg"}
    specs = [each.model_dump(include=names) for each in load_scene(scene_path).radars]
    write_rig(rig, RigFile(radars=tuple(RigRadar(**each) for each in specs)))
    out, sent = tmp_path / "out", list[TumSample]()
    pace = ("--pace", "realtime", "--link-dir", tmp_path / "ports")
    with (
        emulator("serve", scene_path, *pace) as served,
        (tmp_path / "heard").open("w") as heard,
        subprocess.Popen(
            [witness, str(domain), space], stdin=subprocess.PIPE, stdout=heard, text=True
        ) as robot,
    ):
        assert served.odometry is not None
        wheels = threading.Thread(target=wheels_to, args=(robot, served.odometry, sent))
        wheels.start()
        command = [
            sys.executable,
            "-m",
            "slam.app.cli",
            "run",
            "--rig",
            str(rig),
            "--out",
            str(out),
        ]
        options = ["--odometry", f"ros2:/{space}/odom", "--publish", f"ros2:{space}"]
        done = subprocess.run(
            [*command, "--ports", *served.paths, *options, "--duration", "8"],
            env=os.environ | {"ROS_DOMAIN_ID": str(domain)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert robot.stdin is not None
        served.end()
        wheels.join()
        robot.stdin.close()
        robot.wait()
    assert done.returncode == 0, done.stderr

    records = list(open_session(out / "session.mcap").records())
    wheels_of_slam = [one for one in records if isinstance(one, TumSample)]
    assert len(wheels_of_slam) > 30
    first = sent.index(wheels_of_slam[0])
    assert wheels_of_slam == sent[first : first + len(wheels_of_slam)]  # none lost, all the same

    states = {one.t_ns: one for one in records if isinstance(one, Snapshot)}
    lines = [line.split() for line in (tmp_path / "heard").read_text().splitlines()]
    poses = [line for line in lines if line[0] == "pose"]
    assert [int(line[2]) for line in poses] == sorted(states)
    assert len(poses) > 5
    for _, frame, t_ns, *numbers in poses:
        state = states[int(t_ns)]
        x_m, y_m, qz, qw, *covariance = map(float, numbers)
        assert frame == "map"
        assert (x_m, y_m, 0.0, 0.0, 0.0, qz, qw) == cdr.planar(state.estimate)
        planar = np.reshape(covariance, (6, 6))[np.ix_((0, 1, 5), (0, 1, 5))]
        np.testing.assert_array_equal(planar, state.pose_covariance)

    transforms = [line[1:] for line in lines if line[0] == "tf"]
    assert {(parent, child) for parent, child, *_ in transforms} == {("map", "odom")}
    stamps = [int(t_ns) for _, _, t_ns, *_ in transforms]
    assert stamps == sorted(set(stamps))
    for _, _, t_ns, *numbers in transforms:
        if (at_state := states.get(int(t_ns))) is not None:
            x_m, y_m, qz, qw = map(float, numbers)
            placed = compose(np.array([x_m, y_m, 2.0 * np.arctan2(qz, qw)]), at_state.odometry)
            np.testing.assert_allclose(placed, at_state.estimate, atol=1e-12)

    capsys.readouterr()
    assert main(["replay", str(out), "--out", str(tmp_path / "again")]) == 0
    assert f"all {len(states)} recorded states came again" in capsys.readouterr().err
