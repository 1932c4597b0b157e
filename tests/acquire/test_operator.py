"""The key that is held, as a terminal tells of it."""

from limbfit.acquire.protocol import Abort, Signal
from limbfit.acquire.session import Keyboard


def test_a_touch_of_the_key_moves_nothing() -> None:
    keyboard = Keyboard(0.12)
    assert keyboard.read(b" ", 0.0) == []
    assert keyboard.check_release(0.5) == []
    assert keyboard.read(b" ", 5.0) == []  # and neither do two touches apart


def test_a_held_key_repeats_and_a_released_one_stops() -> None:
    keyboard = Keyboard(0.12)
    assert keyboard.read(b" ", 0.0) == []
    assert keyboard.read(b" ", 0.4) == [Signal.KEY_DOWN]
    for k in range(1, 30):
        assert keyboard.read(b" ", 0.4 + 0.033 * k) == []
        assert keyboard.check_release(0.4 + 0.033 * k + 0.03) == []
    end = 0.4 + 0.033 * 29
    assert keyboard.check_release(end + 0.11) == []
    assert keyboard.check_release(end + 0.13) == [Signal.KEY_UP]
    assert keyboard.check_release(end + 0.2) == []


def test_enter_confirms_and_anything_else_stops() -> None:
    keyboard = Keyboard(0.12)
    assert keyboard.read(b"\r", 0.0) == [Signal.CONFIRM]
    for other in (b"q", b"\x1b", b"\x03", b"x"):
        (event,) = keyboard.read(other, 0.0)
        assert isinstance(event, Abort)
