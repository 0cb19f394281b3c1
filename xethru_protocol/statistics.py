"""What a link has carried and what was wrong with it, as running totals."""

from collections import Counter
from dataclasses import dataclass, field

from xethru_protocol.packets import FaultKind


@dataclass(slots=True, kw_only=True)
class LinkStatistics:
    """Totals since the link was opened; each part of the receiver counts what it alone can see.

    The receiver: ``bytes`` received, ``packets`` found, ``junk_bytes`` that belong to no packet,
    ``resyncs`` (starts that were rejected and scanned on behind) and ``faults`` by kind, one per
    damaged place. So ``bytes`` = bytes of packets + ``junk_bytes`` + bytes not judged yet.
    The connection: ``unknown`` packets, intact but described by no row of the message table.
    The frame queue: ``frames_lost`` by gaps of the frame counter, and ``off_lattice_samples``,
    which no chip counter can give, so that they were damaged although nothing else showed it
    (NoEscape packets carry no checksum).

    >>> statistics = LinkStatistics(bytes=8, junk_bytes=8, resyncs=1)
    >>> statistics.faults[FaultKind.CHECKSUM] += 1
    >>> statistics.checksum_failures, statistics.summary()["faults"]
    (1, {'wrong checksum': 1})
    """

    bytes: int = 0
    packets: int = 0
    junk_bytes: int = 0
    resyncs: int = 0
    unknown: int = 0
    frames_lost: int = 0
    off_lattice_samples: int = 0
    faults: Counter[FaultKind] = field(default_factory=Counter)

    @property
    def checksum_failures(self) -> int:
        """Damaged places that were a Normal packet with a wrong checksum."""
        return self.faults[FaultKind.CHECKSUM]

    @property
    def clean(self) -> bool:
        """Whether nothing was wrong so far."""
        return not (
            self.faults
            or self.junk_bytes
            or self.resyncs
            or self.unknown
            or self.frames_lost
            or self.off_lattice_samples
        )

    def summary(self) -> dict[str, int | dict[str, int]]:
        """JSON-able totals; faults by the text of their kind."""
        return {
            "bytes": self.bytes,
            "packets": self.packets,
            "junk_bytes": self.junk_bytes,
            "resyncs": self.resyncs,
            "checksum_failures": self.checksum_failures,
            "unknown": self.unknown,
            "frames_lost": self.frames_lost,
            "off_lattice_samples": self.off_lattice_samples,
            "faults": {kind.value: count for kind, count in self.faults.items() if count},
        }
