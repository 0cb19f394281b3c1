"""Exceptions of the package, as one tree, by whose fault it was.

::

    XeThruError
    ├── ProtocolError
    │   ├── LocalProtocolError    we asked for something the protocol cannot express
    │   │   └── OldFirmwareError  ... or what the module's firmware does not know
    │   └── RemoteProtocolError   the peer sent something the protocol does not allow
    ├── DeviceError               the module answered ERROR
    └── TransportError
        ├── ResponseTimeout       nothing came in time (also a TimeoutError)
        ├── Disconnected          the port went away while open
        └── PortUnavailable       the port could not be opened

Bad bytes on the line are not exceptions: they are ``FramingFault`` events.

>>> issubclass(ResponseTimeout, TimeoutError)
True
"""


class XeThruError(Exception):
    """Root of everything this package raises on purpose."""


class ProtocolError(XeThruError):
    """A rule of the protocol was broken."""


class LocalProtocolError(ProtocolError):
    """We tried to send what the protocol cannot express."""


class OldFirmwareError(LocalProtocolError):
    """A command was not sent: the module's firmware does not know it."""


class RemoteProtocolError(ProtocolError):
    """The peer sent an intact packet that makes no sense here."""


class DeviceError(XeThruError):
    """The module answered a command with ERROR.

    Parameters
    ----------
    code
        Numeric code as sent, 0 ... 2**32 - 1. The number space depends on the command
        (Protocol reference 5.1).
    command
        Name of the failed command, for example ``"X4DRIVER_SET FPS"``.
    meaning
        Name of the code in that command's number space; empty if unknown.
    """

    def __init__(self, code: int, command: str, meaning: str = "") -> None:
        name = f" ({meaning})" if meaning else ""
        super().__init__(f"the module refused {command}: error {code}{name}")
        self.code = code
        self.command = command
        self.meaning = meaning


class TransportError(XeThruError):
    """The way to the module failed."""


class ResponseTimeout(TransportError, TimeoutError):  # noqa: N818 - reads as the event it is
    """The module did not answer in time."""


class Disconnected(TransportError):  # noqa: N818 - reads as the event it is
    """The port vanished or was closed by the other end."""


class PortUnavailable(TransportError):  # noqa: N818 - reads as the state it is
    """The port does not exist, is in use, or may not be opened."""
