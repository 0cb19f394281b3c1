"""What else is on a module's board: IO pins, and what tests and watches it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from xethru_protocol.driver.link import SLOW_TIMEOUT_S, KindT, Link, Part, Steps, sends
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import InjectMode, IoPinFeature, IoPinSetup, TestCode
from xethru_protocol.wire.errors import LocalProtocolError, RemoteProtocolError

# It reports them as failed although they worked (Protocol reference 4.10).
_WITHOUT_VERDICT: Final = frozenset({TestCode.CERTIFICATION_ON, TestCode.CERTIFICATION_OFF})


@dataclass(frozen=True, slots=True, kw_only=True)
class PinControl:
    """What a pin does: `IoPinSetup` bits, and the `IoPinFeature` that drives it."""

    setup: IoPinSetup
    feature: int


@dataclass(frozen=True, slots=True, kw_only=True)
class TestResult:
    """Answer to a system test.

    ``data``: 256 bytes whose meaning depends on the test (Protocol reference 4.10); none of a test
    that is only acknowledged.
    """

    __test__ = False  # nothing for pytest

    code: int
    passed: bool
    data: bytes


class Pins(Part[KindT]):
    """IO pins of a module; ``pin`` is an `IoPin`. Protocol reference 4.8.

    Bare XEP firmware knows the feature PASSIVE only, and does not answer `control`.
    """

    __slots__ = ()

    @sends
    def set_control(
        link: Link, pin: int, setup: IoPinSetup, feature: int = IoPinFeature.PASSIVE
    ) -> Steps[None]:
        """Choose what a pin does; PASSIVE leaves it to `read` and `write`."""
        yield from link.request(m.IoPinSetControl(pin_id=pin, pin_setup=setup, pin_feature=feature))

    @sends
    def control(link: Link, pin: int) -> Steps[PinControl]:
        """Ask what a pin does."""
        setup, feature = yield from link.numbers(m.IoPinGetControl(pin_id=pin), 2)
        return PinControl(setup=IoPinSetup(setup), feature=feature)

    @sends
    def write(link: Link, pin: int, high: bool) -> Steps[None]:
        """Drive an output pin high or low."""
        yield from link.request(m.IoPinSetValue(pin_id=pin, pin_value=int(high)))

    @sends
    def read(link: Link, pin: int) -> Steps[bool]:
        """Ask whether a pin is high."""
        (value,) = yield from link.numbers(m.IoPinGetValue(pin_id=pin), 1)
        return bool(value)


class Diagnostics(Part[KindT]):
    """Tests of a module, trace output, injected frames."""

    __slots__ = ()

    @sends
    def run_test(link: Link, code: int) -> Steps[TestResult]:
        """Run a system test, a `TestCode`; `DeviceError` if the firmware does not have it.

        After TX_ONLY and TX_ONLY_TX_OFF the module sleeps until its power is cycled. The two
        CERTIFICATION codes change the mode from the next reset on. Protocol reference 4.10.
        """
        reply = yield from link.request(m.SystemTest(code=code), SLOW_TIMEOUT_S)
        if isinstance(reply, m.Ack):
            return TestResult(code=code, passed=True, data=b"")
        if reply.info & 0xFF != code:
            raise RemoteProtocolError(f"{link.name} answers test {code:02X}h as {reply.info:04X}h")
        passed = bool(reply.info >> 8 & 1) or code in _WITHOUT_VERDICT
        return TestResult(code=code, passed=passed, data=reply.values)

    @sends
    def set_debug_level(link: Link, level: int) -> Steps[None]:
        """Choose how much trace output comes, a `TraceLevel`; as DATA STRING, in `messages`."""
        yield from link.request(m.DebugLevel(level=level))

    @sends
    def prepare_injection(link: Link, frames: int, bins: int, mode: InjectMode) -> Steps[None]:
        """Announce frames that replace the chip's: how many, and of how many bins."""
        yield from link.request(m.PrepareInjectFrame(frames=frames, bins=bins, mode=mode))

    @sends
    def inject_frame(link: Link, counter: int, values: Sequence[float]) -> Steps[None]:
        """Give one of the announced frames: two numbers per bin, in an order not documented."""
        if len(values) % 2:
            raise LocalProtocolError(
                f"an injected frame has two numbers per bin, {len(values)} are none"
            )
        samples = tuple(float(value) for value in values)
        yield from link.request(m.InjectFrame(counter=counter, values=samples), SLOW_TIMEOUT_S)
