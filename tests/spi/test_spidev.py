"""The real py-spidev, unmodified, against a device behind a preloaded shim."""

from __future__ import annotations

import json
import os
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import pytest

from acquisition.capture import capture
from acquisition.protocol import Command, Mode
from tests.acquisition.fake_mcu import FakeMcu
from tests.spi.server import SpiServer, build_shim

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def shim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The compiled shim. In CI nothing may be missing."""
    if find_spec("spidev") is None and not os.environ.get("CI"):
        pytest.skip("spidev is not installed (it is compiled from source, and for Linux only)")
    try:
        return build_shim(tmp_path_factory.mktemp("shim"))
    except FileNotFoundError as error:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(error))


class Echo:
    """Sends back every byte plus one."""

    def wait_ready(self, timeout: float) -> bool:  # noqa: ARG002
        return True

    def transfer(self, tx: bytes) -> bytes:
        return bytes((byte + 1) % 256 for byte in tx)


def run(server: SpiServer, shim: Path, code: str, **options: Any) -> Any:
    result = server.run(shim, "import json\n" + code, **options)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    return json.loads(result.stdout)


OPEN = """
import spidev
spi = spidev.SpiDev()
spi.open(0, 0)
spi.mode = 0
spi.max_speed_hz = 15600000
"""


def test_transfer_is_cut_into_pieces_of_bufsiz(shim: Path, tmp_path: Path) -> None:
    with SpiServer(Echo(), tmp_path) as server:
        tx = [n % 251 for n in range(7388)]
        code = f"{OPEN}\nprint(json.dumps(spi.xfer3(bytes({tx}))))"
        assert run(server, shim, code) == [(n + 1) % 256 for n in tx]
        assert server.sizes == [4096, 3292]
        assert server.settings == {(0, 15600000, 8)}


def test_longer_messages_are_refused_as_by_the_kernel(shim: Path, tmp_path: Path) -> None:
    code = f"""{OPEN}
import errno
found = []
for call in (spi.xfer, spi.xfer2):
    for size in (4096, 4097):
        try:
            found.append(len(call([0] * size)))
        except OverflowError as error:
            found.append("overflow")
        except OSError as error:
            found.append(errno.errorcode[error.errno])
found.append(len(spi.readbytes(100)))
spi.writebytes([1, 2, 3])
spi.close()
print(json.dumps(found))"""
    with SpiServer(Echo(), tmp_path) as server:
        assert run(server, shim, code) == [4096, "overflow", 4096, "overflow", 100]
        assert server.sizes == [4096, 4096, 100, 3]
    with SpiServer(Echo(), tmp_path) as server:
        found = run(server, shim, code, bufsiz=4000)
        assert found == ["EMSGSIZE", "overflow", "EMSGSIZE", "overflow", 100]


def test_message_longer_than_the_drivers_buffer_fails_clearly(shim: Path, tmp_path: Path) -> None:
    code = """
from acquisition.links import LinkError, SpiLink
with SpiLink() as link:
    try:
        link.transfer(bytes(7388))
    except LinkError as error:
        print(json.dumps(str(error)))"""
    with SpiServer(Echo(), tmp_path) as server:
        assert "7388 bytes failed" in run(server, shim, code, bufsiz=2048)


CAPTURE = """
from acquisition.capture import capture
from acquisition.links import SpiLink
from acquisition.protocol import Command, Mode
with SpiLink() as link:
    assert link._polling is not {edges}
    frames = list(capture(link, {command}, timeout=60))  # real time, and the device's is its own
print(json.dumps([
    (frame.sequence, frame.leds, int(frame.flags), int(frame.elements.astype(int).sum()))
    for frame in frames
]))"""


@pytest.mark.parametrize("edges", [False, True])
@pytest.mark.parametrize(
    "command",
    ["Command(100, 30000, 2)", "Command(100, 30000, 4, Mode.STREAM, [{0: 90}, {1: 80}])"],
)
def test_the_same_frames_as_without_spidev(
    shim: Path, tmp_path: Path, command: str, edges: bool
) -> None:
    asked = eval(command, {"Command": Command, "Mode": Mode})  # noqa: S307
    wanted = [
        [frame.sequence, frame.leds, int(frame.flags), int(frame.elements.astype(int).sum())]
        for frame in capture(FakeMcu(), asked)
    ]
    device = FakeMcu()
    with SpiServer(device, tmp_path) as server:
        code = CAPTURE.format(command=command, edges=edges)
        assert run(server, shim, code, edges=edges) == wanted
    assert set(server.sizes) <= {4096, 3292, 3328}
    assert server.settings == {(0, 15600000, 8)}


def test_shim_leaves_other_files_alone(shim: Path, tmp_path: Path) -> None:
    path = tmp_path / "file"
    code = f"""
import os, pathlib
path = pathlib.Path({str(path)!r})
path.write_text("hello")
try:
    os.open("/dev/null-and-void", os.O_RDONLY)
except FileNotFoundError:
    print(json.dumps([path.read_text(), path.stat().st_mode & 0o777]))"""
    with SpiServer(Echo(), tmp_path) as server:
        mask = os.umask(0)
        os.umask(mask)
        assert run(server, shim, code) == ["hello", 0o666 & ~mask]
        assert server.sizes == []


@pytest.mark.parametrize("edges", [False, True])
@pytest.mark.parametrize(
    "command", ["Command(100, 30000, 2)", "Command(100, 20000, 5, Mode.STREAM)"]
)
def test_the_twin_through_spidev(shim: Path, tmp_path: Path, command: str, edges: bool) -> None:
    if not os.environ.get("CI"):
        pytest.importorskip("unicorn")
    from twin.link import TwinLink

    with TwinLink() as twin, SpiServer(twin, tmp_path) as server:
        code = CAPTURE.format(command=command, edges=edges)
        found = run(server, shim, code, edges=edges)
    asked = eval(command, {"Command": Command, "Mode": Mode})  # noqa: S307
    with TwinLink() as twin:
        wanted = [
            [frame.sequence, frame.leds, int(frame.flags), int(frame.elements.astype(int).sum())]
            for frame in capture(twin, asked)
        ]
    assert found == wanted
