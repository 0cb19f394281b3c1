"""The module's firmware as part of a driver: ``radar.firmware``.

An update restarts the module into its bootloader, which on USB is another device (03EB:2404), so
its port may vanish and come back. Page 0 announces the sum of the image's bytes and unlocks the
flash; from then on only a whole image ends the bootloader. Protocol reference 4.12.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

from xethru_protocol.driver import reconnect
from xethru_protocol.driver.files import OnProgress
from xethru_protocol.driver.link import (
    SLOW_TIMEOUT_S,
    TIMEOUT_S,
    KindT,
    Link,
    Part,
    SetLineRate,
    Steps,
    sends_once,
)
from xethru_protocol.operating_system import read_bounded
from xethru_protocol.validation import shown
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codec import encode
from xethru_protocol.wire.codes import (
    POWER_UP_BAUD,
    BootloaderKey,
    BootloaderReply,
    ErrorCode,
    InfoItem,
    PongCode,
)
from xethru_protocol.wire.errors import (
    DeviceError,
    Disconnected,
    RemoteProtocolError,
    ResponseTimeout,
    XeThruError,
)
from xethru_protocol.wire.framing import is_misread

PAGE_BYTES = 512
FLASH_START = 0x400000
FIRST_PAGE = 128  # where the application begins; before it is the bootloader itself
LAST_PAGE = 3455  # the bootloader takes one more, with which the file system begins
START_TIMEOUT_S = 12.0  # as the vendor's procedure gives START_APP
UNFINISHED = (
    "the firmware in the module is incomplete, so it stays in its bootloader; write an image again "
    "(xethru flash)"
)
_ASK_S = 0.5
_LOOK_AGAIN_S = 0.1
_ATTEMPTS = 3  # to write one page over a line that damages packets
_LARGEST_FILE = 1 << 24
_PADDING = b"\xff"


class FirmwareError(XeThruError):
    """An image cannot be used, or an update was not finished; says what to do about it."""


# --- images -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class FirmwareImage:
    """An application for the module.

    Attributes
    ----------
    data
        Whole pages from page 128 (address 410000h) on, the last one padded with FF.
    certificate
        What the vendor's own bootloader wants as page 0; None: an image for the open bootloader
        (xtOpenBootloader), whose page 0 is the checksum.
    """

    data: bytes
    certificate: bytes | None = None

    @property
    def pages(self) -> int:
        return len(self.data) // PAGE_BYTES

    @property
    def checksum(self) -> int:
        """Sum of all bytes modulo 2**32, with which the open bootloader compares the flash."""
        return sum(self.data) & 0xFFFFFFFF

    @property
    def page_zero(self) -> bytes:
        announced = self.certificate or self.checksum.to_bytes(4, "little")
        return announced.ljust(PAGE_BYTES, _PADDING)

    @classmethod
    def load(cls, path: str) -> Self:
        """Read an image from a file; raises `FirmwareError` if it cannot be used."""
        try:
            content = read_bounded(Path(path), _LARGEST_FILE)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise FirmwareError(f"{path} cannot be read: {reason}") from None
        try:
            return cls.parse(content)
        except FirmwareError as error:
            raise FirmwareError(f"{path}: {error}") from None

    @classmethod
    def parse(cls, content: bytes) -> Self:
        """Make an image of a file's content: Intel hex, or the bytes from address 410000h on.

        Raises `FirmwareError` if it is damaged, does not fit the flash, or is not an application
        for a module with bootloader.
        """
        if content.startswith(b"\x7fELF"):
            raise FirmwareError("this is an ELF file; convert it with objcopy -O ihex")
        if content.lstrip()[:1] == b":":
            flash, used = _intel_hex(content)
        else:
            start = bytes(FIRST_PAGE * PAGE_BYTES)
            flash, used = start + content, start + b"\x01" * len(content)
        announced = used[:PAGE_BYTES].count(1)
        first = FIRST_PAGE * PAGE_BYTES
        if any(used[PAGE_BYTES:first]) or (announced and not used[0]):
            raise FirmwareError(
                "it has data below address 410000h, where the bootloader is; "
                "take the image that is made for the bootloader (the vendor's are named ..._4bl)"
            )
        end = used.rfind(1) + 1
        if end <= first:
            raise FirmwareError("it has no data from address 410000h on, where firmware begins")
        last = (end - 1) // PAGE_BYTES
        if last > LAST_PAGE:
            raise FirmwareError(
                f"it ends at address {FLASH_START + end:X}h; firmware has room up to 5B0000h"
            )
        data = bytes(flash[first:end]).ljust((last + 1) * PAGE_BYTES - first, _PADDING)
        image = cls(data=data, certificate=bytes(flash[:PAGE_BYTES]) if announced > 4 else None)
        image._check_start(FLASH_START + end)
        image._check_pages()
        if announced and image.certificate is None:
            checksum = int.from_bytes(flash[:4], "little")
            if announced < 4 or checksum != image.checksum:
                raise FirmwareError(
                    f"its bytes add up to {image.checksum:08X}, but it announces {checksum:08X}; "
                    "it is damaged or was changed, so get it anew"
                )
        return image

    def _check_start(self, end: int) -> None:
        """Check the second word of the vector table: where the bootloader jumps to."""
        entry = int.from_bytes(self.data[4:8], "little")
        first = FLASH_START + FIRST_PAGE * PAGE_BYTES
        if not (first <= entry < end and entry & 1):
            raise FirmwareError(
                f"its start address, {entry:X}h, lies outside of it; "
                "is it firmware for a module with bootloader, which begins at 410000h?"
            )

    def _check_pages(self) -> None:
        """Refuse what the bootloader would misread, before it has a part of it."""
        pages = [(FIRST_PAGE + at, self.page(at)) for at in range(self.pages)]
        for number, page in [(0, self.page_zero), *pages]:
            payload = encode(m.BootloaderWritePage(page=number, data=page))
            if is_misread(payload):
                raise FirmwareError(
                    f"page {number} has four bytes 7C in a row, or three and the checksum of its "
                    "packet; the bootloader takes them for the start of another packet and "
                    "answers no more until its power was off. Build the image so that they move"
                )

    def page(self, at: int) -> bytes:
        """Return page ``at`` of `pages`."""
        return self.data[at * PAGE_BYTES : (at + 1) * PAGE_BYTES]


def _intel_hex(content: bytes) -> tuple[bytes, bytes]:
    """Return the flash that a file describes, FF where it does not, and where it does (1)."""
    flash, used = bytearray(), bytearray()
    base = 0
    for number, line in enumerate(content.split(b"\n"), 1):
        text = line.strip()
        if not text:
            continue
        kind, address, data = _record(text, number)
        if kind == 1:
            return bytes(flash), bytes(used)
        if kind == 4 and len(data) == 2:
            base = int.from_bytes(data, "big") << 16
        elif kind == 2 and len(data) == 2:
            base = int.from_bytes(data, "big") << 4
        elif kind == 0:
            start = base + address - FLASH_START
            end = start + len(data)
            if start < 0 or end > 1 << 21:
                raise FirmwareError(
                    f"line {number} is for address {base + address:X}h, outside the module's flash"
                )
            if end > len(flash):
                flash += _PADDING * (end - len(flash))
                used += bytes(end - len(used))
            if any(used[start:end]):
                raise FirmwareError(f"line {number} has an address that an earlier line has, too")
            flash[start:end] = data
            used[start:end] = b"\x01" * len(data)
        elif kind not in {3, 5}:  # these name the entry, which is in the data, too
            raise FirmwareError(f"line {number} is of an unknown kind, {kind:02X}")
    raise FirmwareError("it has no end record (:00000001FF); is the file cut off?")


def _record(text: bytes, number: int) -> tuple[int, int, bytes]:
    try:
        if text[:1] != b":":
            raise ValueError
        record = bytes.fromhex(text[1:].decode("ascii"))
    except ValueError:
        raise FirmwareError(f"line {number} is not a line of an Intel hex file") from None
    if len(record) < 5 or len(record) != record[0] + 5:
        raise FirmwareError(f"line {number} has another length than it says")
    if sum(record) & 0xFF:
        raise FirmwareError(f"line {number} has a wrong checksum; the file is damaged")
    return record[3], int.from_bytes(record[1:3], "big"), record[4:-1]


# --- the bootloader -----------------------------------------------------------------------------


def device_info(link: Link, timeout_s: float = TIMEOUT_S) -> Steps[str]:
    """Ask the bootloader for its banner; `DeviceError` if the application runs."""
    reply = yield from link.request(m.BootloaderGetDeviceInfo(), timeout_s)
    return reply.data.decode("latin-1").rstrip()


def _enter(link: Link) -> Steps[str]:
    try:
        return (yield from device_info(link))
    except DeviceError as error:  # the application does not know the command
        if error.code != ErrorCode.XTS_SPRE_NOT_RECOGNIZED:
            raise
    except ResponseTimeout:
        raise ResponseTimeout(
            f"at {link.path} neither a firmware nor a bootloader answers; is a module there, and "
            "powered? 'xethru doctor' finds out more"
        ) from None
    link.conversation.matcher.answer_owed = True  # this error may have been an earlier request's
    core_id = yield from _core_id(link)
    yield from _leave_application(link)
    banner = ""

    def is_ours(link: Link, path: str) -> Steps[bool]:
        nonlocal banner
        try:
            banner = yield from device_info(link, _ASK_S)
        except DeviceError as error:
            if path not in {link.path, link.home}:
                return False
            raise ResponseTimeout(f"the application at {path} runs still") from error
        if core_id and "ID:" in banner:
            return f"ID:{core_id}" in banner
        return path in {link.path, link.home}

    yield from _await(link, is_ours, core_id is not None)
    return banner


def _core_id(link: Link) -> Steps[str | None]:
    return (yield from link.info_text(InfoItem.XTID_SSIC_SYSTEMCOREID)) or None


def ask_for_bootloader(link: Link) -> Steps[None]:
    """Have the application start the bootloader; older firmware has another key."""
    try:
        yield from link.request(m.StartBootloader(key=BootloaderKey.CURRENT))
    except DeviceError as error:
        if error.code != ErrorCode.XTS_SPRE_NOT_RECOGNIZED:
            raise
        yield from link.request(m.StartBootloader(key=BootloaderKey.OLD))


def _leave_application(link: Link) -> Steps[None]:
    yield from ask_for_bootloader(link)
    _forget_application(link)
    if link.baudrate != POWER_UP_BAUD:
        yield SetLineRate(POWER_UP_BAUD)
        link.baudrate = POWER_UP_BAUD


def _forget_application(link: Link) -> None:
    link.raw_mode = False
    link.plan = None
    link.identified, link.serial_number = False, None  # other firmware may report none
    link.frames.rate_hz = 0.0
    link.frames.restart()
    link.frames.clear()


def _check(link: Link, image: FirmwareImage, banner: str) -> Steps[bool]:
    """Refuse an image that is not for this bootloader; returns whether that is the open one."""
    is_open = "OPENBOOTLOADER" in banner
    if is_open and image.certificate is not None:
        raise FirmwareError(
            f"the image is signed for the vendor's bootloader, but the module has {shown(banner)}; "
            "nothing was written. Switch the module off and on, and take an image without signature"
        )
    if not is_open:
        if image.certificate is None:
            raise FirmwareError(
                f"the module's bootloader is {shown(banner)}, which takes signed images only, and "
                "this one is not signed; nothing was written. Switch the module off and on"
            )
        return False
    size = yield from link.request(m.BootloaderPageSize())
    count = yield from link.request(m.BootloaderPageCount())
    page_bytes, pages = (int.from_bytes(reply.data, "little") for reply in (size, count))
    if page_bytes != PAGE_BYTES or image.pages > pages:
        raise FirmwareError(
            f"the image has {image.pages} pages of {PAGE_BYTES} bytes, the module's flash {pages} "
            f"of {page_bytes}; nothing was written. Switch the module off and on"
        )
    return True


def _write(link: Link, image: FirmwareImage, is_open: bool, on_progress: OnProgress) -> Steps[None]:
    """Write page 0 and all others upwards, since every sixteenth erases those behind it."""
    attempts = _ATTEMPTS if is_open else 1  # in between an ECHO is asked for
    yield from _write_page(link, 0, image.page_zero, attempts)
    for done in range(image.pages):
        on_progress(done, image.pages)
        answer = yield from _write_page(link, FIRST_PAGE + done, image.page(done), attempts)
        if is_open and answer != b"\x33":
            raise RemoteProtocolError(
                f"{link.path} did not write page {FIRST_PAGE + done}; switch its power off and on"
            )
    on_progress(image.pages, image.pages)


def _write_page(link: Link, number: int, data: bytes, attempts: int) -> Steps[bytes]:
    """Write a page, again if the line damaged it; to write it twice does no harm."""
    for attempt in range(attempts):
        try:
            command = m.BootloaderWritePage(page=number, data=data)
            return (yield from link.request(command, SLOW_TIMEOUT_S)).data
        except (DeviceError, ResponseTimeout) as error:
            damaged = (
                isinstance(error, ResponseTimeout) or error.code == BootloaderReply.FRAMING_ERROR
            )
            if not damaged or attempt == attempts - 1:
                raise
            link.warn(f"page {number} is written again: {error}")
            link.conversation.matcher.answer_owed = True  # more reports of the damage may follow
    raise AssertionError("the last attempt returns or raises")


def _remedy(error: XeThruError, unlocked: bool) -> str:
    code = error.code if isinstance(error, DeviceError) else None
    if code == BootloaderReply.WRITING_REFUSED:
        return f"{error}; it refuses until its power was off: switch it off and on, and try again"
    if code == BootloaderReply.WRONG_CHECKSUM:
        return (
            f"{error}: what is in the flash is not what was sent. {UNFINISHED}, "
            "after its power was off"
        )
    if unlocked:
        return f"{error}; {UNFINISHED}"
    return f"{error}; nothing was written: a module that is switched off and on starts as before"


def _await_application(link: Link, core_id: str | None, readies: int) -> Steps[None]:
    """Wait for the application that was just written and verified."""
    _forget_application(link)

    def is_ours(link: Link, path: str) -> Steps[bool]:
        if link.conversation.readies > readies and path == link.path:
            return True
        if (yield from link.ping(_ASK_S)) is PongCode.XTS_SPRP_NOTREADY:
            raise ResponseTimeout(f"the module at {path} is not ready yet")
        found = yield from _core_id(link)
        return found == core_id if core_id and found else path in {link.path, link.home}

    try:
        yield from _await(link, is_ours, core_id is not None)
    except (ResponseTimeout, Disconnected) as error:
        raise FirmwareError(
            f"the firmware was written and its checksum is right, but it does not answer: {error}"
        ) from error


def _await(link: Link, is_ours: reconnect.Recognise, everywhere: bool) -> Steps[None]:
    """Wait until what restarts answers, at its port or at another that is found to be its own."""
    deadline_ns = link.conversation.deadline_ns(reconnect.RESTART_S)
    try:
        while True:
            link.conversation.new_line(link.path)  # it will not answer earlier requests
            try:
                yield from is_ours(link, link.path)
            except ResponseTimeout:
                if link.left_s(deadline_ns) <= 0:
                    raise
                yield from link.listen(lambda: False, _LOOK_AGAIN_S)
            else:  # the line was never lost, so it is the same module
                return
    except Disconnected:
        yield from reconnect.find_again(
            link,
            deadline_ns,
            reconnect.RESTART_S,
            restore=False,
            is_ours=is_ours,
            everywhere=everywhere,
        )


class Firmware(Part[KindT]):
    """The firmware of a module. Protocol reference 4.12.

    A radar stops and forgets its settings when its bootloader starts.
    """

    __slots__ = ()

    @sends_once
    def start_bootloader(link: Link) -> Steps[str]:
        """Restart into the bootloader, unless it runs already; returns how it describes itself.

        Until something is written, a module that is switched off and on starts its firmware again.
        """
        return _enter(link)

    @sends_once
    def write(
        link: Link, image: FirmwareImage, on_progress: OnProgress | None = None
    ) -> Steps[None]:
        """Write a firmware, have the bootloader compare it with its checksum, and start it.

        Works with a module in its bootloader, too. Returns when the new firmware answers.

        Parameters
        ----------
        image
            As read by `FirmwareImage.load`.
        on_progress
            Called with the pages written and their total: when the flash was unlocked, and after
            each page. From the first call on, the module stays in its bootloader until a whole
            image is written.

        Raises
        ------
        FirmwareError
            If the image is not for this bootloader or the update was not finished; says what to do.
        ResponseTimeout
            If neither firmware nor bootloader answers.
        """
        banner = yield from _enter(link)
        unlocked = False

        def note(done: int, total: int) -> None:
            nonlocal unlocked
            unlocked = True
            if on_progress is not None:
                on_progress(done, total)

        try:
            is_open = yield from _check(link, image, banner)
            yield from _write(link, image, is_open, note)
            readies = link.conversation.readies
            yield from link.request(m.BootloaderStartApp(), START_TIMEOUT_S)
        except FirmwareError:
            raise
        except XeThruError as error:
            raise FirmwareError(_remedy(error, unlocked)) from error
        core_id = banner.partition("ID:")[2][:16] or None
        yield from _await_application(link, core_id, readies)
