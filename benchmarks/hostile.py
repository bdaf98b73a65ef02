"""A daemon at full load among attackers: does it publish in time, stay small, and account for everything it received?

    python -m benchmarks.hostile [--seconds 20] [--seed 1] [--attacks NAME,...] [--together] [--as-installed]

The load is that of benchmarks.latency, in real time. The attackers are another process on the same machine and use nothing
but loopback; ATTACKS says what each does and how often. Each attack has a run and a row of its own; with --together there
is one run with all of them (benchmarks.soak --attacked is that, for an hour). Every row has what was sent to the daemon,
what became of it, and the difference, which must be 0. The attackers' bytes follow from the seed. With --as-installed the
daemon has the priority and the timer slack of systemd/fusiond.service; the other processes never have.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import pty
import random
import signal
import socket
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Collection
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import NamedTuple

import msgspec
from pymavlink.dialects.v20 import common

from benchmarks.latency import (
    CAN_HZ,
    GNSS_HZ,
    IMU_HZ,
    NICE,
    PUBLISH_HZ,
    TIMER_SLACK_NS,
    WARM_UP,
    Reading,
    configuration,
    free_port,
    process,
    quantiles,
    sent_by_autopilot,
    set_timer_slack,
    since_due_ms,
    turn_wheels,
)
from fusiond.app.live.daemon import Daemon
from fusiond.app.live.serve import serve
from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond.config.toml import ConfigError
from fusiond_adapters.mavlink.signing import EPOCH_NS, TICK_NS

BEGIN_NS = 10**12  # the autopilot's clock in the frames that are mutated
TICK_S = 0.005  # between two looks at what is due
PORTS = 40  # of the strangers
SETTLE_S = 0.5  # after the last datagram
START_S = 3.0  # from the start of the daemon to that of the attackers: slcan takes two seconds to open
OUTLAST_S = 4.0  # the subscriber receives for this much longer than the attackers send
LONGER_S = 8.0  # the vehicle sends for this much longer than the attackers, who take some seconds to start
OUTCOMES = ("decoded", "skipped", "other systems", "other components", "bad checksum", "undecodable")
NOT_OUTCOMES = ("sessions", "lost in the kernel's queue", "garbled", "lost")  # other counts of a CAN bus


class Attack(NamedTuple):
    """One kind of attack."""

    rate_hz: float
    about: str


ATTACKS = {
    "0xFE": Attack(1285, "datagrams of 1400 bytes of 0xFE, 1.8 MB/s"),
    "beginnings": Attack(28, "the first 10 bytes of frames of 280"),
    "unknown": Attack(100, "whole frames of a message that no dialect knows, as if from the autopilot"),
    "mutated": Attack(200, "the autopilot's own frames, cut off or with a bit flipped"),
    "noise": Attack(200, "random bytes, up to 300"),
    "strangers": Attack(200, f"valid frames of other systems, from {PORTS} ports, that want the replies"),
    "forged": Attack(100, "to a link with signing: frames unsigned, signed with another key, or played back"),
    "tiny": Attack(20_000, "datagrams of one byte, 20,000 a second"),
    "thief": Attack(2, "attempts to open the port as well, with SO_REUSEADDR"),
    "clients": Attack(20, "TCP clients that connect beside the first one"),
    "slcan": Attack(50, "garbled lines of a serial CAN adapter, between good ones"),
    "scrapes": Attack(20, "connections to Prometheus that ask for nothing and stay"),
    "viewers": Attack(20, "connections to Foxglove that ask for nothing and stay"),
    "stopped": Attack(0, "a Zenoh subscriber that is stopped (SIGSTOP) for the whole run"),
    "reloads": Attack(0.2, "reloads of a configuration that is refused"),
}
KEY = bytes(range(32))
HEARTBEAT_S = 0.1  # between two of the first TCP client, and of the autopilot that signs
DATAGRAMS = ("0xFE", "beginnings", "unknown", "mutated", "noise", "strangers", "tiny")
HELD = 400  # connections that an attacker keeps open
MOST_AT_ONCE = 200  # times that an attack is made at once, after the attackers' process had to wait
CONNECT_S = 0.1  # within which a connection is made or given up


class Ports(msgspec.Struct):
    """Where the daemon listens."""

    udp: int
    zenoh: int
    tcp: int
    prometheus: int
    foxglove: int
    signed: int  # UDP, a link with signing
    recorded: str = ""  # a frame that was sent to it, in hexadecimal digits


class Account(NamedTuple):
    """What was received at one place, and what became of it."""

    what: str
    received: int
    outcomes: dict[str, int]

    @property
    def difference(self) -> int:
        return self.received - sum(self.outcomes.values())

    def __str__(self) -> str:
        parts = " + ".join(f"{count} {name}" for name, count in self.outcomes.items() if count)
        return f"{self.what}: {self.received} = {parts or 0}; difference {self.difference}"


class Result(NamedTuple):
    """The result of a run."""

    sent: dict[str, int]  # by the attackers
    accounts: list[Account]
    reading: Reading
    notes: list[str]  # what must not happen and did

    def p99_ms(self) -> float:
        found = sorted(map(since_due_ms, self.reading.arrivals))
        return found[round(0.99 * (len(found) - 1))]

    def good(self) -> bool:
        return not self.notes and all(account.difference == 0 for account in self.accounts)


def heartbeat(link: common.MAVLink, kind: int = common.MAV_TYPE_GROUND_ROVER, maker: int = 3) -> bytes:
    """The next frame of a sender."""
    packed = bytes(common.MAVLink_heartbeat_message(kind, maker, 0, 0, 0, 3).pack(link))
    link.seq = (link.seq + 1) & 0xFF
    return packed


def signing(key: bytes) -> common.MAVLink:
    """A sender that signs."""
    made = common.MAVLink(None, srcSystem=1, srcComponent=1)
    made.signing.secret_key, made.signing.sign_outgoing = key, True
    made.signing.timestamp = (time.time_ns() - EPOCH_NS) // TICK_NS
    return made


# --- The attackers


class Attackers:
    """All attacks of one process. `sent` has the numbers of what was sent, by attack."""

    def __init__(self, ports: Ports, attacks: Collection[str], seed: int, stack: ExitStack) -> None:
        self.sent = dict.fromkeys(attacks, 0)
        self.stolen = 0  # times that the port could be opened
        self._ports, self._stack = ports, stack
        self._noise = random.Random(seed)
        self._sockets = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(PORTS)]
        self._frames = [one for data in sent_by_autopilot(BEGIN_NS, 2.0) for one in data]
        self._held: list[socket.socket] = []
        self._signing = signing(b"another key".ljust(32))
        self._links = [common.MAVLink(None, srcSystem=2 + number, srcComponent=1) for number in range(PORTS)]

    def attack(self, name: str) -> None:
        """Once."""
        action: Callable[[], None] = {
            "thief": self._steal,
            "clients": lambda: self._connect(self._ports.tcp, self._heartbeat(), keep=False),
            "scrapes": lambda: self._connect(self._ports.prometheus, b"GET /metr", keep=True),
            "viewers": lambda: self._connect(self._ports.foxglove, b"GET / HT", keep=True),
        }.get(name, lambda: self._send(name))
        with suppress(OSError):  # refused: that is the daemon's right
            action()
            self.sent[name] += 1

    def _send(self, name: str) -> None:
        place = self.sent[name] % PORTS if name == "strangers" else 0
        port = self._ports.signed if name == "forged" else self._ports.udp
        self._sockets[place].sendto(self._datagram(name, place), ("127.0.0.1", port))

    def _datagram(self, name: str, place: int) -> bytes:
        if name in ("beginnings", "unknown"):
            head = bytes((0xFD, 255, 0, 0, self._noise.randrange(256), 1, 1, 0xFF, 0xFF, 0xFF))
            return head if name == "beginnings" else head + self._noise.randbytes(257)
        if name == "mutated":
            frame = bytearray(self._noise.choice(self._frames))
            frame[self._noise.randrange(len(frame))] ^= 1 << self._noise.randrange(8)
            return bytes(frame[: self._noise.randrange(1, len(frame) + 1)])
        if name == "forged":
            return (self._heartbeat(), heartbeat(self._signing), bytes.fromhex(self._ports.recorded))[self.sent[name] % 3]
        if name == "strangers":
            return self._heartbeat(place)
        return {"0xFE": b"\xfe" * 1400, "tiny": b"\xfd"}.get(name) or self._noise.randbytes(self._noise.randrange(1, 300))

    def _heartbeat(self, place: int = 0) -> bytes:
        return heartbeat(self._links[place], common.MAV_TYPE_GCS, 8)

    def _steal(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as thief:
            thief.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                thief.bind(("127.0.0.1", self._ports.udp))
            except OSError:
                return
            self.stolen += 1

    def _connect(self, port: int, data: bytes, *, keep: bool) -> None:
        made = socket.socket()
        made.settimeout(CONNECT_S)
        try:
            made.connect(("127.0.0.1", port))
            made.sendall(data)
        finally:
            if keep:
                self._held.append(made)
            else:
                made.close()
            if len(self._held) > HELD:
                self._held.pop(0).close()


def attack(ports: Ports, seconds: float, attacks: Collection[str], seed: int) -> None:
    """The attackers' process: attack for a time, then write what was sent."""
    with ExitStack() as stack:
        attackers = Attackers(ports, attacks, seed, stack)
        begin = time.monotonic()

        def act(names: Collection[str]) -> None:
            done = dict.fromkeys(names, 0)
            while (elapsed_s := time.monotonic() - begin) < seconds:
                for name in names:
                    for _ in range(min(round(ATTACKS[name].rate_hz * elapsed_s) - done[name], MOST_AT_ONCE)):
                        attackers.attack(name)
                        done[name] += 1
                time.sleep(TICK_S)

        parts = [[name for name in attacks if (name in DATAGRAMS) == wanted] for wanted in (True, False)]
        threads = [threading.Thread(target=act, args=(part,)) for part in parts]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        print(msgspec.json.encode([attackers.sent, attackers.stolen]).decode())


class Slcan:
    """A serial CAN adapter: good lines, and with `rate_hz` garbled ones."""

    NOISE = (b"t1q0\r", b"T12\r", b"\xff\xfe\r", b"t1002XY\r", b"\x80" * 40 + b"\r")

    def __init__(self, seed: int) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.channel = os.ttyname(self._slave)
        self.good = self.bad = 0
        self._noise = random.Random(seed)

    def play(self, seconds: float, rate_hz: float) -> None:
        """In a thread. The commands to the adapter are read and ignored."""
        begin = time.monotonic()
        while (elapsed_s := time.monotonic() - begin) < seconds:
            with suppress(BlockingIOError):
                os.read(self._master, 4096)
            while self.good < CAN_HZ * elapsed_s:
                os.write(self._master, b"t1002ABCD\r")
                self.good += 1
            while self.bad < rate_hz * elapsed_s:
                os.write(self._master, self._noise.choice(self.NOISE))
                self.bad += 1
            time.sleep(TICK_S)

    def close(self) -> None:
        os.close(self._master)
        os.close(self._slave)


# --- The daemon


def settings(folder: Path, ports: Ports, attacks: Collection[str], slcan: str) -> Config:
    """That of benchmarks.latency; a second link, a second bus and more outputs where they are attacked."""
    configuration(folder, ports.udp, ports.zenoh)
    file = folder / "latency.toml"
    more = f'[mavlink.spare]\nconnection = "tcpin:127.0.0.1:{ports.tcp}"\n'
    if "slcan" in attacks:
        more += f'[can.aux]\ndbc = ["wheels.dbc"]\ninterface = "slcan"\nchannel = "{slcan}"\n'
    if "scrapes" in attacks:
        more += f"[prometheus]\nenabled = true\nport = {ports.prometheus}\n"
    if "viewers" in attacks:
        more += f"[foxglove]\nenabled = true\nport = {ports.foxglove}\n"
    if "forged" in attacks:
        (folder / "key").write_bytes(KEY)
        (folder / "key").chmod(0o600)
        more += f'[mavlink.signed]\nconnection = "udpin:127.0.0.1:{ports.signed}"\nsigning_key_file = "key"\n'
        more += 'signing_timestamp_file = "timestamp"\n'
    file.write_text(file.read_text() + more + '[state]\nfile = "state.json"\n')
    return config.load(file)


class Client:
    """The autopilot's TCP connection, which was first: a heartbeat ten times a second; it must never be closed."""

    def __init__(self, port: int) -> None:
        self.sent = self.lost = 0
        self._socket = socket.create_connection(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._link = common.MAVLink(None, srcSystem=1, srcComponent=1)

    def play(self, over: threading.Event) -> None:
        """In a thread."""
        while not over.wait(HEARTBEAT_S):
            packed = heartbeat(self._link)
            try:
                self.sent += self._socket.send(packed) == len(packed)
                with suppress(BlockingIOError):
                    self.lost += self._socket.recv(65536) == b""
            except OSError:
                self.lost += 1

    def close(self) -> None:
        self._socket.close()


class Signer:
    """The autopilot of the link with signing: a heartbeat ten times a second."""

    def __init__(self) -> None:
        self.sent = 0
        self._link = signing(KEY)
        self.first = heartbeat(self._link)

    def play(self, port: int, over: threading.Event) -> None:
        """In a thread."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
            while not over.wait(HEARTBEAT_S):
                peer.sendto(heartbeat(self._link) if self.sent else self.first, ("127.0.0.1", port))
                self.sent += 1


class Arena:
    """A daemon with its vehicle, for one run."""

    def __init__(self, folder: Path, seconds: float, attacks: Collection[str], seed: int) -> None:
        self.attacks, self.seconds, self.seed = attacks, seconds, seed
        tcp = [free_port(socket.SOCK_STREAM) for _ in range(4)]
        self.signer = Signer()
        self.ports = Ports(free_port(socket.SOCK_DGRAM), *tcp, free_port(socket.SOCK_DGRAM), self.signer.first.hex())
        self.slcan = Slcan(seed) if "slcan" in attacks else None
        made = settings(folder, self.ports, attacks, self.slcan.channel if self.slcan else "")
        self.daemon = Daemon(made, _refused)
        self.reloads = 0
        self.over = threading.Event()  # ends the connections of the vehicle that must outlast the attackers
        self.whole_s = seconds + START_S + LONGER_S  # how long the vehicle sends

    async def start(self, stack: ExitStack) -> None:
        """Start the daemon and its vehicle."""
        self.run = asyncio.create_task(serve(self.daemon))
        await self.daemon.up.wait()
        self.client = Client(self.ports.tcp)
        self.feed = stack.enter_context(process("--feed", self.ports.udp, "--seconds", self.whole_s))
        self.threads = [
            threading.Thread(target=turn_wheels, args=(self.whole_s,), name="(the benchmark's wheels)"),
            threading.Thread(target=self.client.play, args=(self.over,), name="(the benchmark's TCP client)"),
        ]
        if "forged" in self.attacks:
            given = (self.ports.signed, self.over)
            self.threads.append(threading.Thread(target=self.signer.play, args=given, name="(the benchmark's signer)"))
        for thread in self.threads:
            thread.start()
        if "stopped" in self.attacks:
            victim = stack.enter_context(process("--subscribe", self.ports.zenoh, "--seconds", self.whole_s))
            await asyncio.to_thread(_line, victim)
            victim.send_signal(signal.SIGSTOP)
        await asyncio.sleep(START_S)

    async def attack(self, stack: ExitStack, look: Callable[[float], None]) -> tuple[dict[str, int], int, Reading]:
        """Attack it. What was sent, how often the port was stolen, and what a subscriber received."""
        if self.slcan:
            given = (self.seconds, ATTACKS["slcan"].rate_hz)
            self.threads.append(threading.Thread(target=self.slcan.play, args=given, name="(the benchmark's slcan)"))
            self.threads[-1].start()
        reader = stack.enter_context(process("--subscribe", self.ports.zenoh, "--seconds", self.seconds + OUTLAST_S))
        await asyncio.to_thread(_line, reader)
        names = ",".join(name for name in self.attacks if name not in ("slcan", "stopped", "reloads"))
        options = ("--seconds", self.seconds, "--seed", self.seed, "--attacks", names)
        attackers = stack.enter_context(
            process("--ports", msgspec.json.encode(self.ports).decode(), *options, module="benchmarks.hostile")
        )
        output = asyncio.create_task(asyncio.to_thread(attackers.communicate))
        begin = time.monotonic()
        while not output.done():
            elapsed_s = time.monotonic() - begin
            look(elapsed_s)
            if "reloads" in self.attacks and self.reloads < ATTACKS["reloads"].rate_hz * elapsed_s:
                self.daemon.reload()
                self.reloads += 1
            await asyncio.sleep(1.0)
        sent, stolen = msgspec.json.decode((await output)[0])
        reading = msgspec.json.decode((await asyncio.to_thread(reader.communicate))[0], type=Reading)
        return sent, stolen, reading

    async def end(self) -> None:
        """Wait for the vehicle, let the daemon read the rest, and end it."""
        await asyncio.to_thread(self.feed.wait)
        self.over.set()
        for thread in self.threads:
            await asyncio.to_thread(thread.join)
        await asyncio.sleep(SETTLE_S)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as last:  # with it the kernel tells what it dropped before
            last.sendto(b"\0", ("127.0.0.1", self.ports.udp))
        await asyncio.sleep(SETTLE_S)
        self.client.close()
        self.daemon.stop()
        await self.run
        if self.slcan:
            self.slcan.close()

    def accounts(self, sent: dict[str, int]) -> list[Account]:
        """Every place at which something is received; `sent` is by the attackers."""
        own = round((IMU_HZ + GNSS_HZ + 1) * self.whole_s) + 1
        datagrams = own + sum(count for name, count in sent.items() if name in DATAGRAMS)
        found = []
        for name, one in self.daemon.inputs.items():
            counts, inbox = one.counts(), one.inbox
            if name == "mavlink.fc":
                read = {"read": counts["datagrams"], "lost in the kernel": counts["lost in the kernel's queue"]}
                found.append(Account("datagrams", datagrams, read))
            elif name == "mavlink.signed":
                read = {"read": counts["datagrams"], "lost in the kernel": counts["lost in the kernel's queue"]}
                found.append(Account("datagrams of the signed link", self.signer.sent + sent["forged"], read))
                refused = {kind: counts[kind] for kind in ("unsigned", "wrongly signed")}
                found.append(Account("frames there", counts["datagrams"], {"passed on": inbox.received} | refused))
            elif name == "mavlink.spare":
                found.append(Account("frames of the first TCP client", self.client.sent, {"received": inbox.received}))
            elif name == "can.aux" and self.slcan is not None:
                lines = {"frames": inbox.received, "garbled": counts.get("garbled", 0)}
                found.append(Account("lines of slcan", self.slcan.good + self.slcan.bad, lines))
            kinds = OUTCOMES if name.startswith("mavlink.") else [kind for kind in counts if kind not in NOT_OUTCOMES]
            outcomes = {kind: counts[kind] for kind in kinds} | {"thinned": inbox.dropped}
            found.append(Account(f"frames of {name}", inbox.received, outcomes))
        totals = {str(outcome): count for outcome, count in self.daemon.live.engine.fusion.totals().items()}
        return [*found, Account("measurements", self.daemon.live.offered, totals)]


async def under_attack(
    folder: Path, seconds: float, attacks: Collection[str], seed: int, look: Callable[[float], None] = lambda _: None
) -> Result:
    """Run a daemon for a time with these attackers. `look` is called each second with the time since the start."""
    arena = Arena(folder, seconds, attacks, seed)
    with ExitStack() as stack:
        await arena.start(stack)
        sent, stolen, reading = await arena.attack(stack, look)
        await arena.end()
    accounts = arena.accounts(sent)
    sent |= {"reloads": arena.reloads} if arena.reloads else {}
    sent |= {"slcan": arena.slcan.bad} if arena.slcan else {}
    sent |= {"stopped": 1} if "stopped" in attacks else {}
    notes = [f"the port was taken {stolen} times"] if stolen else []
    notes += [f"the first TCP client was displaced: {arena.client.lost} errors"] if arena.client.lost else []
    if len(reading.arrivals) < 0.9 * PUBLISH_HZ * seconds - WARM_UP:
        notes.append(f"only {len(reading.arrivals)} states arrived")
    return Result(sent, accounts, reading, notes)


def _refused() -> Config:
    raise ConfigError("the attacker's configuration")


def _line(made: subprocess.Popen[str]) -> None:
    assert made.stdout is not None
    made.stdout.readline()


def report(result: Result) -> str:
    """The result in words."""
    sent = ", ".join(f"{count} {name}" for name, count in result.sent.items())
    states = quantiles(list(map(since_due_ms, result.reading.arrivals)))
    calm = quantiles(list(map(since_due_ms, result.reading.undisturbed())))
    share = 100 * result.reading.stolen_share()
    lines = [f"attacks: {sent or 'none'}", f"states at the subscriber: {states}"]
    lines += [f"  the host took {share:.1f} % of the processors; while it took nothing: {calm}"]
    return "\n".join([*lines, *map(str, result.accounts), *(f"WRONG: {note}" for note in result.notes)])


def _off(account: Account) -> int:
    return abs(account.difference)


def row(name: str, result: Result) -> str:
    """A row of the table in docs/reliability.md."""
    received = sum(each.received for each in result.accounts)
    lost = sum(count for each in result.accounts for kind, count in each.outcomes.items() if kind in LOSSES)
    outcomes = sum(sum(each.outcomes.values()) for each in result.accounts) - lost
    about = ATTACKS[name].about if name in ATTACKS else "all of these at once" if name == "all" else "no attack"
    tried = result.sent[name] if name in result.sent else sum(result.sent.values())
    return f"| {about} | {tried:,} | {received:,} | {outcomes:,} | {lost:,} | {sum(map(_off, result.accounts))} |"


def as_installed() -> None:
    """Take the priority and the timer slack of systemd/fusiond.service."""
    os.nice(NICE - os.nice(0))
    set_timer_slack(TIMER_SLACK_NS)


LOSSES = ("lost in the kernel", "thinned", "garbled", "unsigned", "wrongly signed")
HEAD = """| scenario | tried | received | outcomes | counted losses | difference |
|---|---|---|---|---|---|"""


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.hostile", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--seconds", type=float, default=20.0, help="of each run")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--attacks", default=",".join(ATTACKS), help=f"of {', '.join(ATTACKS)}")
    parser.add_argument("--together", action="store_true", help="one run with all attacks")
    parser.add_argument("--as-installed", action="store_true", help=f"nice {NICE}, as the unit has it; needs a privilege")
    parser.add_argument("--out", type=Path, default=Path("out/hostile"))
    parser.add_argument("--ports", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    attacks = [name for name in options.attacks.split(",") if name]
    if unknown := set(attacks) - set(ATTACKS):
        parser.error(f"unknown attacks: {', '.join(sorted(unknown))}")
    if options.ports:
        attack(msgspec.json.decode(options.ports, type=Ports), options.seconds, attacks, options.seed)
        return 0
    options.out.mkdir(parents=True, exist_ok=True)
    if options.as_installed:
        as_installed()
    good, rows = True, [HEAD]
    for name in ["all"] if options.together else ["none", *attacks]:
        chosen = attacks if name == "all" else [name] if name != "none" else []
        result = asyncio.run(under_attack(options.out, options.seconds, chosen, options.seed))
        print(f"--- {name}\n{report(result)}", flush=True)
        good &= result.good()
        rows.append(row(name, result))
    print("\n".join(rows))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
