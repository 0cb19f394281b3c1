"""Files in the module's flash; what writes there needs --allow-flash on real modules."""

from collections.abc import Iterator

import pytest

from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire.codes import FileError, PongCode
from xethru_protocol.wire.errors import DeviceError

pytestmark = pytest.mark.requires("settings", "files")

OURS = 0x8000007D  # a user-defined type (Protocol reference 4.11) that must be escaped


def test_files_are_listed(radar: X4M300) -> None:
    names = radar.files.find_all()
    assert len(names) <= 20
    assert len(set(names)) == len(names)
    for name in names:
        assert radar.files.length(name.file_type, name.identifier) >= 0


def test_files_that_are_not_there(radar: X4M300) -> None:
    with pytest.raises(DeviceError) as refusal:
        radar.files.length(OURS, 0x7E7E7E7E)
    assert refusal.value.code == FileError.NOT_FOUND
    assert radar.files.find(OURS) == ()
    assert radar.ping() is PongCode.XTS_SPRP_READY


def test_crash_dumps_can_be_asked_for(radar: X4M300) -> None:
    assert isinstance(radar.files.crash_dump(), bytes)


@pytest.fixture
def identifier(radar: X4M300) -> Iterator[int]:
    """Return a number no file of ours has; what a test leaves under it is deleted."""
    taken = {name.identifier for name in radar.files.find(OURS)}
    number = next(one for one in range(1, 100) if one not in taken)
    yield number
    if any(name.identifier == number for name in radar.files.find(OURS)):
        radar.files.delete(OURS, number)


@pytest.mark.writes_flash
@pytest.mark.parametrize(
    "content",
    [b"\x7f", bytes(range(256)), bytes([0x7D, 0x7E, 0x7F]) * 100, b"\xff" * 1000],
    ids=["one-special", "every-byte", "special-bytes", "erased"],
)
def test_what_is_written_is_read(radar: X4M300, identifier: int, content: bytes) -> None:
    radar.files.write(OURS, identifier, content)
    assert radar.files.length(OURS, identifier) == len(content)
    assert radar.files.read(OURS, identifier) == content
    assert identifier in {name.identifier for name in radar.files.find(OURS)}
    radar.files.delete(OURS, identifier)
    assert identifier not in {name.identifier for name in radar.files.find(OURS)}
    assert radar.statistics.clean


@pytest.mark.writes_flash
def test_files_outlive_a_reset(radar: X4M300, identifier: int) -> None:
    radar.files.write(OURS, identifier, b"still here")
    radar.reset(wait=True)
    assert radar.files.read(OURS, identifier) == b"still here"
