"""IO pins. Protocol reference 4.8 and 5.1."""

import pytest

from emulator.module.outbox import MessageKind
from hil_tests.unit.emulator.doubles import BareHost
from xethru_protocol.wire import messages as m

OUTPUT, PUSH_PULL, ACTIVE_LOW, PULL_UP = 1, 2, 4, 8
DISABLE, DEFAULT, PASSIVE, PRESENCE, MOVEMENT, BREATHING, NO_PRESENCE = range(7)


def control(host: BareHost, pin: int, setup: int, feature: int) -> m.Message:
    return host.ask(m.IoPinSetControl(pin_id=pin, pin_setup=setup, pin_feature=feature))


def level(host: BareHost, pin: int) -> int:
    reply = host.ask(m.IoPinGetValue(pin_id=pin))
    assert isinstance(reply, m.ReplyInt)
    assert reply.content_id == 0x21
    return reply.values[0]


def test_pins_are_shipped_disabled(host: BareHost) -> None:
    for pin in range(1, 7):
        reply = host.ask(m.IoPinGetControl(pin_id=pin))
        assert reply == m.ReplyInt(content_id=0x11, values=(0, DISABLE))
        assert level(host, pin) == 0


@pytest.mark.parametrize("pin", [7, 41, 90, 255])
def test_wrong_pins(host: BareHost, pin: int) -> None:
    assert control(host, pin, 1, PASSIVE) == m.Error(code=1)
    assert host.ask(m.IoPinGetControl(pin_id=pin)) == m.Error(code=1)
    assert host.ask(m.IoPinSetValue(pin_id=pin, pin_value=1)) == m.Error(code=1)
    assert host.ask(m.IoPinGetValue(pin_id=pin)) == m.Error(code=1)


def test_functions_and_setups_that_do_not_exist(host: BareHost) -> None:
    assert control(host, 1, OUTPUT, 7) == m.Error(code=2)
    assert control(host, 1, OUTPUT, BREATHING) == m.Error(code=2), "not of a presence profile"
    assert control(host, 1, 16, PASSIVE) == m.Error(code=4)


@pytest.mark.parametrize(("inverted", "high"), [(0, 1), (ACTIVE_LOW, 0)])
def test_a_passive_output_shows_its_value(host: BareHost, inverted: int, high: int) -> None:
    assert control(host, 4, OUTPUT | PUSH_PULL | inverted, PASSIVE) == m.Ack()
    assert host.ask(m.IoPinSetValue(pin_id=4, pin_value=1)) == m.Ack()
    assert level(host, 4) == high
    assert host.ask(m.IoPinSetValue(pin_id=4, pin_value=0)) == m.Ack()
    assert level(host, 4) == 1 - high


def test_an_open_input_is_low_unless_pulled_up(host: BareHost) -> None:
    assert control(host, 5, PULL_UP, PASSIVE) == m.Ack()
    assert level(host, 5) == 1
    assert control(host, 5, 0, PASSIVE) == m.Ack()
    assert level(host, 5) == 0


def test_pin_0_is_all(host: BareHost) -> None:
    assert control(host, 0, OUTPUT, PASSIVE) == m.Ack()
    assert host.ask(m.IoPinSetValue(pin_id=0, pin_value=1)) == m.Ack()
    assert [level(host, pin) for pin in range(1, 7)] == [1] * 6


# presence state, then the levels of IO1 and IO2 with the datasheet's functions
STATES = [(0, (1, 0)), (1, (0, 1)), (2, (1, 1)), (3, (1, 1))]


@pytest.mark.parametrize(("state", "levels"), STATES)
def test_default_functions_follow_presence(
    host: BareHost, state: int, levels: tuple[int, int]
) -> None:
    """IO1 is low in presence, IO2 low in no-presence; the setup does not matter."""
    assert control(host, 0, 0, DEFAULT) == m.Ack()
    host.device.module.pins.presence = state
    assert (level(host, 1), level(host, 2)) == levels
    assert [level(host, pin) for pin in range(3, 7)] == [0] * 4, "unused inputs"


def test_chosen_functions(host: BareHost) -> None:
    for pin, feature in ((1, PRESENCE), (2, NO_PRESENCE), (3, MOVEMENT)):
        assert control(host, pin, OUTPUT, feature) == m.Ack()
    pins = host.device.module.pins
    pins.presence, pins.movement = 1, True
    assert [level(host, pin) for pin in (1, 2, 3)] == [1, 0, 1]
    assert host.ask(m.IoPinGetControl(pin_id=3)) == m.ReplyInt(
        content_id=0x11, values=(OUTPUT, MOVEMENT)
    )


def test_pins_follow_the_presence_messages_of_a_running_profile(host: BareHost) -> None:
    """IO1 goes low when a message says presence; stopped, nothing is known."""

    def say(state: int, direction: int) -> None:
        message = m.PresenceSingle(
            counter=1, state=state, distance_m=1.0, direction=direction, signal_quality=5
        )
        host.device._outbox.put(MessageKind.FRAME, message, 0)
        assert message in host.hear(1)

    assert control(host, 0, 0, DEFAULT) == m.Ack()
    assert control(host, 3, OUTPUT, MOVEMENT) == m.Ack()
    say(1, 2)
    assert [level(host, pin) for pin in (1, 2, 3)] == [0, 1, 1]
    say(0, 0)
    assert [level(host, pin) for pin in (1, 2, 3)] == [1, 0, 0]
    say(1, 0)
    assert host.ask(m.SetMode(mode=0x13)) == m.Ack()
    assert [level(host, pin) for pin in (1, 2, 3)] == [1, 1, 0]
