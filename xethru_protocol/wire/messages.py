"""Every message of the wire, in one place to import from."""

from xethru_protocol.wire.commands import *  # noqa: F403
from xethru_protocol.wire.responses import *  # noqa: F403
from xethru_protocol.wire.table import *  # noqa: F403
