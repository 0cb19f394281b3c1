"""`xethru-emulator serve --state-dir`: another process finds a module as it was left."""

from pathlib import Path

from hil_tests.device.serving import emulator, open_radar
from xethru_protocol.driver.files import FileName

FILE = FileName(file_type=0x80000001, identifier=7)


def test_a_file_survives_the_emulator(tmp_path: Path) -> None:
    content = bytes(range(256)) * 3
    serve = ("serve", "--bare", "--state-dir", tmp_path)
    with emulator(*serve) as served:
        with open_radar(served.paths[0]) as radar:
            radar.files.write(FILE.file_type, FILE.identifier, content)
        assert served.end() == 0
    assert [path.name for path in tmp_path.iterdir()] == [f"{served.serials[0]}.json"]
    with emulator(*serve) as served, open_radar(served.paths[0]) as radar:
        assert radar.files.find_all() == (FILE,)
        assert radar.files.read(FILE.file_type, FILE.identifier) == content
        radar.files.delete(FILE.file_type, FILE.identifier)
        assert not radar.files.find_all()


def test_without_a_state_dir_nothing_is_kept() -> None:
    for _ in range(2):
        with emulator("serve", "--bare") as served, open_radar(served.paths[0]) as radar:
            assert not radar.files.find_all()
            radar.files.write(FILE.file_type, FILE.identifier, b"x")
