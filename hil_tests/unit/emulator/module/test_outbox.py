"""The firmware's 50-slot queue (protocol reference 8.4) and the lossless one."""

from dataclasses import dataclass

from emulator.module.outbox import FirmwareOutbox, LosslessOutbox, MessageKind, MessageStream
from xethru_protocol.wire import messages as m

SECOND = 1_000_000_000
FRAME, REPLY, DEBUG = MessageKind.FRAME, MessageKind.REPLY, MessageKind.DEBUG


@dataclass
class Ticker(MessageStream):
    period_ns: int
    counter: int = 0
    taken: int = 0
    skipped: int = 0

    def next_due_ns(self) -> int | None:
        return self.counter * self.period_ns

    def take(self) -> m.Response:
        self.counter += 1
        self.taken += 1
        return m.Pong(value=self.counter - 1)

    def skip_due_before(self, time_ns: int) -> None:
        first = max(-(-time_ns // self.period_ns), self.counter)
        self.skipped += first - self.counter
        self.counter = first

    def command_done(self, command: m.Command[m.Response], now_ns: int) -> None: ...


def numbers(outbox: FirmwareOutbox, now_ns: int) -> list[int]:
    found = []
    while (message := outbox.take(now_ns)) is not None:
        assert isinstance(message, m.Pong)
        found.append(message.value)
    return found


def filled(count: int, kind: MessageKind = FRAME) -> FirmwareOutbox:
    outbox = FirmwareOutbox()
    for value in range(count):
        outbox.put(kind, m.Pong(value=value), 0)
    return outbox


def test_a_full_queue_loses_the_new_frame_but_never_a_reply() -> None:
    outbox = filled(50)
    outbox.put(FRAME, m.Pong(value=50), SECOND // 2)
    assert len(outbox) == 50
    outbox.put(REPLY, m.Pong(value=999), SECOND // 2)
    assert numbers(outbox, SECOND // 2) == [*range(1, 50), 999]


def test_after_a_second_the_oldest_go_until_a_quarter_is_free() -> None:
    outbox = filled(50)
    outbox.put(FRAME, m.Pong(value=50), SECOND)
    # a quarter of 50 slots is 12: 38 stay, the new one joins
    assert numbers(outbox, SECOND) == list(range(12, 51))


def test_debug_messages_go_first() -> None:
    outbox = filled(30)
    for value in range(30, 50):
        outbox.put(DEBUG, m.Pong(value=value), 0)
    outbox.put(FRAME, m.Pong(value=50), SECOND)
    assert numbers(outbox, SECOND) == [*range(30), 50]


def test_reading_again_ends_the_stall() -> None:
    outbox = filled(45)
    assert outbox.take(3 * SECOND) is not None
    outbox.put(FRAME, m.Pong(value=45), 3 * SECOND + 1)
    assert len(outbox) == 45


def test_frames_that_have_no_slot_are_not_made() -> None:
    outbox, ticker = FirmwareOutbox(), Ticker(period_ns=SECOND // 400)
    for now_ns in range(0, SECOND * 9 // 10, SECOND // 400):
        outbox.refill_on_time(ticker, now_ns)
    assert ticker.taken == len(outbox) == 50
    assert ticker.skipped == ticker.counter - 50


def test_a_stalled_host_leaves_gaps_and_bounded_memory() -> None:
    outbox, ticker = FirmwareOutbox(), Ticker(period_ns=SECOND // 17)
    for now_ns in range(0, 60 * SECOND, SECOND // 17):
        outbox.refill_on_time(ticker, now_ns)
        assert len(outbox) <= 50
    values = numbers(outbox, 60 * SECOND)
    assert values == sorted(values)
    assert values[-1] == ticker.counter - 1, "the newest survive"


def test_one_visit_makes_a_bounded_number_of_frames() -> None:
    outbox, ticker = FirmwareOutbox(), Ticker(period_ns=1)
    outbox.refill_on_time(ticker, SECOND // 2)
    assert ticker.taken == FirmwareOutbox.STEPS_PER_REFILL


def test_what_fell_due_more_than_a_second_ago_is_lost() -> None:
    outbox, ticker = FirmwareOutbox(), Ticker(period_ns=SECOND // 100)
    outbox.refill_on_time(ticker, 10 * SECOND)
    assert ticker.skipped == 900, "those due before 9 s"
    assert numbers(outbox, 10 * SECOND)[0] == 900


def test_unread_replies_leave_no_room_for_more() -> None:
    assert filled(50, FRAME).takes_replies, "a reply displaces a frame"
    assert filled(49, REPLY).takes_replies
    outbox = filled(50, REPLY)
    assert not outbox.takes_replies
    assert outbox.take(0) is not None
    assert outbox.takes_replies


def test_lossless_fetches_only_when_nothing_waits() -> None:
    outbox, ticker = LosslessOutbox(), Ticker(period_ns=SECOND)
    for _ in range(5):
        outbox.refill_on_demand(ticker, 0)
    assert (ticker.taken, len(outbox)) == (1, 1)
    assert outbox.wake_ns(ticker, 0) == SECOND
    outbox.take(0)
    outbox.refill_on_demand(ticker, SECOND - 1)
    assert len(outbox) == 0
    assert outbox.wake_ns(ticker, SECOND) is None, "due and waiting for the line"
