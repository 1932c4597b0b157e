"""Addresses and ports that cannot be used: one clear line each, with what to do."""

import os
import socket
import threading

import pytest
from typer.testing import CliRunner

from limbfit.acquire import LineDevice, connect
from limbfit.acquire.virtual import Endpoint
from limbfit.cli import app
from limbfit.errors import InputError, RunError
from limbfit.pipeline.commands.acquire import acquire_site
from limbfit.study import load_study

ADDRESSES = {
    "127.0.0.1:7714": "not an address of a device; give tcp://HOST:PORT",
    "tcp://127.0.0.1:99999": "no port 99999; ports are 1 to 65535",
    "serial:/dev/ttyUSB0@12": "serial:PATH@BAUD",
    "serial:/dev/ttyUSB0@fast": "serial:PATH@BAUD",
    "serial:COM3": "serial:PATH@BAUD",
    "serial:/dev/none": "/dev/none cannot be opened: No such file or directory",
    "serial:/dev/null": "/dev/null cannot be opened: it is no serial port",
    "tcp://no.such.host.invalid": "no device at no.such.host.invalid, port 7714",
}


@pytest.mark.parametrize("address", ADDRESSES)
def test_addresses_of_no_device(address: str) -> None:
    if address.startswith("serial:/"):
        pytest.importorskip("serial", reason="needs pyserial")
    with pytest.raises((InputError, RunError), match=ADDRESSES[address]) as refused:
        connect(address)
    assert "\n" not in str(refused.value)
    assert "Exception" not in str(refused.value)


def test_a_serial_port_that_another_program_has() -> None:
    serial = pytest.importorskip("serial", reason="needs pyserial")
    _, slave = os.openpty()
    with (
        serial.Serial(os.ttyname(slave), exclusive=True),
        pytest.raises(RunError, match="another program uses it"),
    ):
        connect(f"serial:{os.ttyname(slave)}")


def test_a_device_that_another_host_has() -> None:
    """It closes the connection at once."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=lambda: listener.accept()[0].close(), daemon=True).start()
        with pytest.raises(RunError, match="one host at a time: does another have it"):
            LineDevice(connect(f"tcp://127.0.0.1:{listener.getsockname()[1]}"))


def test_ports_that_cannot_be_listened_at() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"port {port} cannot be taken: .*; give another, or 0"):
            Endpoint.listen_on_port("127.0.0.1", port)
    with pytest.raises(InputError, match=r"--host: no\.such\.host\.invalid is no address of this machine"):
        Endpoint.listen_on_port("no.such.host.invalid", 0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("virtual-fitsocket", "--speed", "0"), "--speed: 0 is no speed of the clock; 1 is the wall's"),
        (("virtual-fitsocket", "--speed", "nan"), "--speed: nan is no speed"),
        (("acquire", "--unattended", "--depth", "-3"), "-3 mm is not between acquire.min_depth_mm"),
        (("acquire", "--unattended", "--depth", "nan"), "nan mm is not between"),
        (("acquire", "--unattended", "--site", "9"), "no site is named '9'; the study has 1, 2"),
        (("acquire",), "needs a terminal; run it in a terminal, or with --unattended"),
    ],
)
def test_options_that_mean_nothing(ready, words: tuple[str, ...], said: str) -> None:
    found = CliRunner().invoke(app, [words[0], str(ready), *words[1:]])
    assert isinstance(found.exception, InputError)
    assert said in str(found.exception)


def test_a_file_where_records_are_kept_is_refused_before_the_device_is_asked(ready) -> None:
    (ready / "acquired").write_text("")
    with pytest.raises(InputError, match="acquired: is a file, where records are kept; move it away"):
        acquire_site(
            load_study(ready, recorded=False), "1", address="tcp://127.0.0.1:1", operator=None, depth_mm=3.0
        )
