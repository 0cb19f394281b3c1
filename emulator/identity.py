"""What a module says about itself: the strings of SYSTEM_GET_INFO."""

from __future__ import annotations

from dataclasses import dataclass

from xethru_protocol.codes import InfoItem

__all__ = ["Identity"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """The strings a stock X4M300 with sensor firmware answers.

    Attributes
    ----------
    serial
        Serial number, 12 digits.
    order_code
        Product name.
    item_number
        Novelda item number, form ``000ddd-ddd``.
    firmware_id
        Name of the firmware binary.
    version
        Firmware version.
    xep_version
        Version of the base firmware inside it.
    dsp_library
        Last entry of the version list; name and version are assumed, the reference gives none.
    build
        Source revision, 40 hexadecimal digits.

    Raises
    ------
    ValueError
        When the serial number is not 12 digits.

    Source: protocol reference 4.10, table of system info items.
    """

    serial: str
    order_code: str = "X4M300"
    item_number: str = "000112-001"
    firmware_id: str = "Annapurna"
    version: str = "1.6.8"
    xep_version: str = "3.4.8"
    dsp_library: str = "DSP:1.0.0"
    build: str = "0" * 40

    def __post_init__(self) -> None:
        """Check the one field that scenes choose."""
        if len(self.serial) != 12 or not self.serial.isascii() or not self.serial.isdigit():
            raise ValueError(f"serial number {self.serial!r}: an X4M300 has 12 digits")

    def info(self, item: int, *, base_firmware: bool = False) -> str | None:
        """Return the text of one info item; None for an item this firmware does not know.

        The base firmware knows no product: neither item number, order code nor serial number.

        Examples
        --------
        >>> Identity(serial="202611210001").info(0x01)
        'X4M300'
        >>> Identity(serial="202611210001").info(0x05) is None
        True
        """
        if base_firmware:
            return self._base_firmware_info(item)
        texts: dict[int, str] = {
            InfoItem.XTID_SSIC_ITEMNUMBER: self.item_number,
            InfoItem.XTID_SSIC_ORDERCODE: self.order_code,
            InfoItem.XTID_SSIC_FIRMWAREID: self.firmware_id,
            InfoItem.XTID_SSIC_VERSION: self.version,
            InfoItem.XTID_SSIC_BUILD: f"{self.version}+0.sha.{self.build}",
            # the application id list is answered with an error by released firmware
            InfoItem.XTID_SSIC_SERIALNUMBER: self.serial,
            InfoItem.XTID_SSIC_VERSIONLIST: (
                f"{self.firmware_id}:{self.version};XEP:{self.xep_version};X4C51:2.1.0"
                f";{self.dsp_library}"
            ),
            InfoItem.XTID_SSIC_SYSTEMCOREID: f"emulated-{self.serial}",
            InfoItem.XTID_SSIC_BOOTLOADER: "unknown",
        }
        return texts.get(item)

    def _base_firmware_info(self, item: int) -> str | None:
        texts: dict[int, str] = {
            InfoItem.XTID_SSIC_FIRMWAREID: "XEP",
            InfoItem.XTID_SSIC_VERSION: self.xep_version,
            InfoItem.XTID_SSIC_BUILD: f"{self.xep_version}+0.sha.{self.build}",
            InfoItem.XTID_SSIC_VERSIONLIST: f"XEP:{self.xep_version};X4C51:2.1.0",
            InfoItem.XTID_SSIC_SYSTEMCOREID: f"emulated-{self.serial}",
            InfoItem.XTID_SSIC_BOOTLOADER: "unknown",
        }
        return texts.get(item)
