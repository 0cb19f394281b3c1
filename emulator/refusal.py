"""How a module says no to a command, or says nothing."""

from __future__ import annotations

__all__ = ["Refusal", "Silence"]


class Refusal(Exception):  # noqa: N818 - a refusal is an answer of the module, not an error of ours
    """A command the module answers with ERROR.

    Attributes
    ----------
    code
        The u32 of the ERROR reply, an `ErrorCode` or `X4Error` (their numbers overlap).
    """

    def __init__(self, code: int) -> None:
        super().__init__(f"refused with ERROR {code}")
        self.code = code


class Silence(Exception):  # noqa: N818 - as above
    """A command the module does not answer."""
