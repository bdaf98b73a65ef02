"""A daemon among hostile processes of the same machine: by default, with signing, and in a network namespace."""

from __future__ import annotations

import random
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common

from fusiond.app.live.daemon import Daemon
from fusiond_adapters.mavlink.decoder import message_id
from fusiond_adapters.mavlink.signing import EPOCH_NS, TICK_NS
from tests.helpers.live import Autopilot, aligned, configuration, drive, running
from tests.helpers.network import free_port, read_line, udp

KEY = bytes(range(32))
SIGNING = 'signing_key_file = "key"\nsigning_timestamp_file = "stamp"'
NOISE = random.Random(11)


def beginning(number: int) -> bytes:
    return bytes((0xFD, 255, 0, 0, number & 0xFF, 7, 1, 0xFF, 0xFF, 0xFF))


def mutated(number: int) -> bytes:
    frame = bytearray(Autopilot().imu())
    frame[NOISE.randrange(len(frame))] ^= 1 << NOISE.randrange(8)
    return bytes(frame[: NOISE.randrange(1, len(frame))] if number % 2 else frame)


ATTACKS: dict[str, Callable[[int], bytes]] = {
    "0xFE": lambda _: b"\xfe" * 1400,
    "beginnings": beginning,
    "unknown messages": lambda number: beginning(number * 37) + NOISE.randbytes(257),
    "mutated frames": mutated,
    "random bytes": lambda _: NOISE.randbytes(NOISE.randrange(1, 300)),
}


@pytest.mark.parametrize("name", ATTACKS)
def test_no_frame_of_the_vehicle_is_lost_among(name: str, tmp_path: Path) -> None:
    """Three hostile datagrams beside each of the vehicle's; every datagram and every frame is accounted for."""
    port, sent, samples = free_port(), [0, 0], [0]
    with running(configuration(tmp_path, f"udpin:127.0.0.1:{port}")) as run:
        peer, to_link = udp(port)
        with closing(peer), closing(udp(port)[0]) as stranger:
            link = run.daemon.inputs["mavlink.fc"]

            def send(data: bytes) -> None:
                for _ in range(3):
                    stranger.sendto(ATTACKS[name](sent[1]), ("127.0.0.1", port))
                    sent[1] += 1
                to_link(data)
                sent[0] += 1
                samples[0] += message_id(data) == common.MAVLINK_MSG_ID_HIGHRES_IMU

            drive(run, send, None, lambda: aligned(run) and sent[0] > 60, Autopilot())
            run.until(lambda: link.counts()["datagrams"] == sum(sent))
    counts, fusion = link.counts(), run.daemon.live.engine.fusion
    assert counts["lost in the kernel's queue"] == link.inbox.dropped == 0
    assert counts["lost"] <= (name == "mutated frames") * sent[1]  # a flipped bit can be in the counter
    kinds = ("decoded", "skipped", "other systems", "other components", "bad checksum", "undecodable")
    assert sum(counts[kind] for kind in kinds) == link.inbox.received
    assert sum(fusion.outcomes()["imu0"].values()) == samples[0]
    assert sum(fusion.totals().values()) == run.daemon.live.offered


def signing_autopilot(key: bytes) -> Autopilot:
    made = Autopilot()
    made._link.signing.secret_key, made._link.signing.sign_outgoing = key, True
    made._link.signing.timestamp = (time.time_ns() - EPOCH_NS) // TICK_NS
    return made


@pytest.fixture
def signed(tmp_path: Path) -> Iterator[tuple[int, Path]]:
    (tmp_path / "key").write_bytes(KEY)
    (tmp_path / "key").chmod(0o600)
    yield free_port(), tmp_path


def test_with_signing_forged_frames_reach_nothing(signed: tuple[int, Path]) -> None:
    """Unsigned ones, ones signed with another key, and recorded ones that are played back."""
    port, folder = signed
    settings = configuration(folder, f"udpin:127.0.0.1:{port}", link=SIGNING)
    with running(settings) as run:
        peer, to_link = udp(port)
        with closing(peer), closing(udp(port)[0]) as stranger:
            forgers, recorded, forged = (Autopilot(), signing_autopilot(bytes(32))), list[bytes](), [0]

            def send(data: bytes) -> None:
                to_link(data)
                recorded.append(data)
                for fake in (*(forger.imu() for forger in forgers), recorded[0]):
                    stranger.sendto(fake, ("127.0.0.1", port))
                    forged[0] += 1

            true = signing_autopilot(KEY)
            drive(run, send, None, lambda: aligned(run) and len(recorded) > 50, true)
            link = run.daemon.inputs["mavlink.fc"]
            run.until(lambda: link.counts()["datagrams"] == len(recorded) + forged[0])
    counts = link.counts()
    assert counts["unsigned"] == forged[0] // 3
    assert counts["wrongly signed"] == forged[0] - forged[0] // 3
    assert counts["bad checksum"] == counts["lost"] == 0
    samples = sum(message_id(frame) == common.MAVLINK_MSG_ID_HIGHRES_IMU for frame in recorded)
    assert sum(run.daemon.live.engine.fusion.outcomes()["imu0"].values()) == samples


def test_without_signing_a_local_process_can_forge_a_frame(tmp_path: Path) -> None:
    """What docs/security.md warns of."""
    port = free_port()
    with running(configuration(tmp_path, f"udpin:127.0.0.1:{port}")) as run, closing(udp(port)[0]) as stranger:
        link = run.daemon.inputs["mavlink.fc"]
        run.until(lambda: link.counts()["sessions"] == 1)
        stranger.sendto(Autopilot().imu(), ("127.0.0.1", port))
        run.until(lambda: run.daemon.live.offered == 1)


INSIDE = """
import fcntl, socket, struct, subprocess, sys
from fusiond_adapters.mavlink.transport import opener
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
    up = struct.pack("16sh14x", b"lo", 0x49)  # IFF_UP, IFF_LOOPBACK, IFF_RUNNING
    fcntl.ioctl(control, 0x8914, up)  # SIOCSIFFLAGS
port = int(sys.argv[1])
link = opener(f"udpin:127.0.0.1:{port}", 57600)()
print("ready", flush=True)
sys.stdin.readline()
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as inside:
    inside.sendto(b"from inside", ("127.0.0.1", port))
print([data for data, _ in link.read(5.0)], flush=True)
"""


def test_in_a_network_namespace_only_its_own_processes_reach_a_link() -> None:
    command = ["unshare", "--user", "--map-root-user", "--net"]
    try:
        subprocess.run([*command, "true"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this machine does not let a user make a network namespace")
    port = free_port()
    arguments = [*command, sys.executable, "-c", INSIDE, str(port)]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as made:
        try:
            assert read_line(made) == "ready"
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as outside:
                outside.bind(("127.0.0.1", 0))
                for _ in range(10):
                    outside.sendto(b"from outside", ("127.0.0.1", port))
            assert made.stdin is not None
            print(file=made.stdin, flush=True)
            assert read_line(made) == "[b'from inside']"
        finally:
            made.kill()


def test_a_second_daemon_cannot_take_the_link(tmp_path: Path) -> None:
    """It says so, tries again, and the first goes on."""
    settings = configuration(tmp_path, f"udpin:127.0.0.1:{free_port()}")
    with running(settings) as run:
        first = run.daemon.inputs["mavlink.fc"]
        run.until(lambda: first.counts()["sessions"] == 1)
        second = Daemon(settings, zenoh=False).inputs["mavlink.fc"]
        with pytest.raises(Exception, match="cannot be opened: Address already in use"):
            second.session(run.daemon._stopping)
        assert first.counts()["sessions"] == 1


def test_frames_of_strangers_do_not_become_the_vehicles(tmp_path: Path) -> None:
    """A ground station and other systems, from many ports; only the autopilot's system is decoded."""
    port = free_port()
    with running(configuration(tmp_path, f"udpin:127.0.0.1:{port}", link="system = 7")) as run:
        link, strangers = run.daemon.inputs["mavlink.fc"], [udp(port)[0] for _ in range(20)]
        run.until(lambda: link.counts()["sessions"] == 1)
        for number, stranger in enumerate(strangers):
            sender = common.MAVLink(None, srcSystem=20 + number, srcComponent=1)
            stranger.sendto(bytes(common.MAVLink_heartbeat_message(10, 3, 0, 0, 4, 3).pack(sender)), ("127.0.0.1", port))
            stranger.close()
        run.until(lambda: link.counts()["other systems"] == len(strangers))
        assert run.daemon.live.offered == 0
