"""ROS 2 output live: zenoh-ros2-sdk receives it in another process by way of a router, and routers that go and come."""

import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread, Timer
from typing import Any

import numpy as np
import pytest
import xxhash
import zenoh
from numpy.testing import assert_allclose

from fusiond.config.outputs import Ros2, Zenoh
from fusiond.config.schema import Config
from fusiond.estimator.solution import Mode
from fusiond.maths.rotation import matrix
from fusiond.messages.local_frame import LocalFrame, LocalState
from fusiond.messages.types import Message, State, StateMessage
from fusiond.ports.outputs import OutputLost
from fusiond.units import SECOND
from fusiond_adapters.ros2 import wire
from fusiond_adapters.ros2.convert import Converter
from fusiond_adapters.ros2.output import Ros2Output, make, topics
from fusiond_adapters.zenoh.session import open_session
from tests.helpers.network import DEADLINE, free_port
from tests.helpers.ros2 import T0, definitions, health, state_numbered

SUBSCRIBER = """
import atexit, json, os, queue, sys
import numpy as np
from zenoh_ros2_sdk import ROS2Subscriber
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.discovery import get_topic_info
from zenoh_ros2_sdk.session import ZenohSession

atexit.register(os._exit, 0)  # Zenoh's threads must not hold up the end, whatever it is
port, asked = int(sys.argv[1]), json.loads(sys.argv[2])
got, raw = queue.Queue(), queue.Queue()
manager = ZenohSession.get_instance("127.0.0.1", port)

def plain(value):
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list):
        return [plain(inner) for inner in value]
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__ if name != "__msgtype__"}
    return value

def hear(topic):
    return lambda message: got.put([topic, plain(message)])

for topic, kind, type_hash, definition, inside in asked:
    for name, text in inside.items():
        manager.register_message_type(text, name)
    subscriber = ROS2Subscriber(topic, kind, hear(topic), definition, domain_id=42, router_port=port, type_hash=type_hash)
    manager.session.declare_subscriber(subscriber.keyexpr, raw.put)
print(json.dumps("subscribed"), flush=True)
for _ in range(2 * len(asked)):
    print(json.dumps(got.get(timeout=15)), flush=True)
for _ in range(2 * len(asked)):
    sample = raw.get(timeout=15)
    attachment = Attachment.from_bytes(sample.attachment.to_bytes())
    found = [attachment.sequence_id, attachment.timestamp_ns, attachment.gid.hex(), sample.attachment.to_bytes().hex()]
    print(json.dumps([str(sample.key_expr), *found, sample.payload.to_bytes().hex()]), flush=True)
for topic, *_ in asked:
    seen = get_topic_info(topic, 42, router_port=port, verbose=True).publishers
    print(json.dumps([[p.node_name, p.node_namespace, p.topic_type, p.type_hash, p.qos] for p in seen]), flush=True)
"""


def router(port: int) -> zenoh.Session:
    return open_session(Zenoh(mode="router", listen=[f"tcp/127.0.0.1:{port}"]))


class Running:
    """An output whose session runs in a thread."""

    def __init__(self, port: int, **keys: Any) -> None:
        self.output = Ros2Output(Config(ros2=Ros2(domain=42, connect=[f"tcp/127.0.0.1:{port}"], **keys)))
        self.lost: OutputLost | None = None
        self._stop = Event()
        self._opened = Event()
        self.output.outbox.attend(lambda: T0, self._opened.set)
        self._thread = Thread(target=self._run)

    def _run(self) -> None:
        try:
            self.output.session(self._stop)
        except OutputLost as lost:
            self.lost = lost

    def put(self, *messages: Message) -> None:
        for message in messages:
            self.output.outbox.put(message)

    def wait(self) -> None:
        self._thread.join(DEADLINE)
        assert not self._thread.is_alive()

    def __enter__(self) -> "Running":
        self._thread.start()
        assert self._opened.wait(DEADLINE), self.lost
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self.output.outbox.rouse()
        self.wait()


@contextmanager
def subscriber(port: int, asked: list[Any]) -> Iterator[Iterator[Any]]:
    """The SDK in another process; yields what it prints."""
    command = [sys.executable, "-c", SUBSCRIBER, str(port), json.dumps(asked)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        overdue = Timer(3 * DEADLINE, process.kill)
        overdue.start()
        try:
            yield map(json.loads, process.stdout)
        finally:
            overdue.cancel()
            process.kill()


def test_the_sdk_receives_every_number_in_another_process() -> None:
    pytest.importorskip("zenoh_ros2_sdk", reason="needs zenoh-ros2-sdk")
    port, name_of = free_port(socket.SOCK_STREAM), {}
    asked = []
    for name, topic in topics(Ros2(namespace="/rover")):
        name_of[topic.name] = name
        asked.append([topic.name, topic.kind, topic.hash, *definitions(topic.kind)])
    sent = [state_numbered(1), state_numbered(2)]
    states = [message.state for message in sent if message.state is not None]
    expected = Converter(Ros2(namespace="/rover"))
    diagnosed = [health(), health(T0 + SECOND, Mode.DEAD_RECKONING, resets=1)]
    want: dict[str, list[bytes]] = {name: [] for name in name_of.values()}
    for message, report in zip(sent, diagnosed, strict=True):
        for name, payload in (*expected.state(message), *expected.health(report)):
            want[name].append(payload)
    with router(port), subscriber(port, asked) as heard, Running(port, namespace="/rover") as running:
        assert next(heard) == "subscribed"
        wait_for_interest(running)
        decoded: dict[str, list[Any]] = {name: [] for name in want}
        for message, report in zip(sent, diagnosed, strict=True):
            running.put(message, report)
            for _ in want:
                topic_name, content = next(heard)
                decoded[name_of[topic_name]].append(content)
        raw = [next(heard) for _ in range(2 * len(want))]
        seen = dict(zip(name_of, [next(heard) for _ in asked], strict=True))
    check_numbers(decoded, states, sent)
    check_wire(raw, want, seen)
    assert running.output.counts() == {"sent": 2 * len(want), "states unfit": 0}


def wait_for_interest(running: Running) -> None:
    """Until every publisher knows of a subscriber."""
    publishers = running.output._publishers
    for publisher in publishers.values():
        matched = Event()

        def watch(status: Any, matched: Event = matched) -> None:
            if status.matching:
                matched.set()

        with publisher._publisher.declare_matching_listener(watch):
            status: Any = publisher._publisher.matching_status
            assert status.matching or matched.wait(DEADLINE), "no subscriber"


def check_numbers(decoded: dict[str, list[Any]], states: list[State], sent: list[StateMessage]) -> None:
    """What arrived, against the sent states by way of matrices."""
    enu, flu = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.diag([1.0, -1.0, -1.0])
    frame = LocalFrame.at(states[0])
    for number, (s, message) in enumerate(zip(states, sent, strict=True)):
        odometry, fix, speed = (decoded[name][number] for name in ("odometry", "fix", "twist"))
        for each in (odometry, fix, speed):
            stamp = each["header"]["stamp"]
            assert stamp["sec"] * SECOND + stamp["nanosec"] == message.t_ns
        assert [fix["latitude"], fix["longitude"], fix["altitude"]] == [s.lat_deg, s.lon_deg, s.height_m]
        position = np.reshape(s.covariance_position_m2, (3, 3))
        assert_allclose(np.reshape(fix["position_covariance"], (3, 3)), enu @ position @ enu.T, rtol=1e-14, atol=1e-14)
        assert (odometry["header"]["frame_id"], odometry["child_frame_id"]) == ("map", "base_link")
        assert speed["header"]["frame_id"] == fix["header"]["frame_id"] == "base_link"
        assert odometry["twist"] == speed["twist"]
        mat_nb = matrix(np.array(s.quaternion_nb)) @ flu
        linear = list(speed["twist"]["twist"]["linear"].values())
        assert_allclose(linear, mat_nb.T @ s.velocity_ned_mps, atol=1e-13)
        velocity = np.reshape(s.covariance_velocity_m2ps2, (3, 3))
        covariance = np.reshape(speed["twist"]["covariance"], (6, 6))
        assert_allclose(covariance[:3, :3], mat_nb.T @ velocity @ mat_nb, atol=1e-13)
        assert_allclose(np.diag(covariance)[3:], np.square(s.sigma_gyro_bias_rps), rtol=1e-14)
        pose = odometry["pose"]["pose"]
        local = frame.state(s)
        assert list(pose["position"].values()) == list(local.position_l)
        w, x, y, z = local.quaternion_lb
        assert list(pose["orientation"].values()) == [x, y, z, w]
        covariance = np.reshape(odometry["pose"]["covariance"], (6, 6))
        assert covariance[:3, :3].ravel().tolist() == list(local.covariance_position_l)
        assert covariance[3:, 3:].ravel().tolist() == list(local.covariance_attitude_l)
        transforms = decoded["/tf"][number]["transforms"]
        check_chain(transforms, local)
        drifting = decoded["odometry/local"][number]
        assert (drifting["header"]["frame_id"], drifting["child_frame_id"]) == ("odom", "base_link")
        assert drifting["twist"] == odometry["twist"]
        in_odom = drifting["pose"]["pose"]
        assert [in_odom["position"], in_odom["orientation"]] == [
            transforms[1]["transform"]["translation"], transforms[1]["transform"]["rotation"],
        ]  # fmt: skip
    assert [array["status"][0]["level"] for array in decoded["/diagnostics"]] == [0, 1]


def check_chain(transforms: list[Any], local: LocalState) -> None:
    """map to odom to base_link is map to base_link."""
    assert [(t["header"]["frame_id"], t["child_frame_id"]) for t in transforms] == [("map", "odom"), ("odom", "base_link")]
    position, mat = np.zeros(3), np.eye(3)
    for transform in transforms:
        position = position + mat @ list(transform["transform"]["translation"].values())
        x, y, z, w = transform["transform"]["rotation"].values()
        mat = mat @ matrix(np.array([w, x, y, z]))
    assert_allclose(position, local.position_l, atol=1e-8)
    assert_allclose(mat, matrix(np.array(local.quaternion_lb)), atol=1e-12)


def check_wire(raw: list[Any], want: dict[str, list[bytes]], seen: dict[str, Any]) -> None:
    """Keys, attachments, payloads and the graph as the SDK saw them."""
    named = {wire.topic_key(42, topic): (name, topic) for name, topic in topics(Ros2(namespace="/rover"))}
    expected = {name: list(enumerate(found, 1)) for name, found in want.items()}
    for key, sequence, stamp, source, attachment, payload in raw:
        name, topic = named[key]
        assert (sequence, bytes.fromhex(payload)) == expected[name].pop(0)
        assert len(bytes.fromhex(attachment)) == 33 and len(bytes.fromhex(source)) == 16
        assert stamp > T0
        depth = 100 if name == "/tf" else 10
        assert seen[topic.name] == [["fusiond", "/rover", topic.kind, topic.hash, f"::,{depth}:,:,:,,"]]
    assert not any(expected.values())


def test_the_gid_is_the_hash_of_the_token() -> None:
    """rmw_zenoh finds the publisher of a message by it."""
    port = free_port(socket.SOCK_STREAM)
    tokens: list[str] = []
    complete = Event()

    def hear(sample: zenoh.Sample) -> None:
        tokens.append(str(sample.key_expr))
        if len(tokens) == 7:
            complete.set()

    with (
        router(port) as session,
        session.liveliness().declare_subscriber("@ros2_lv/42/**", hear, history=True),
        Running(port) as running,
    ):
        assert complete.wait(DEADLINE), tokens
        assert sorted(token.split("/")[5] for token in tokens) == ["MP"] * 6 + ["NN"]
        assert {token.split("/")[4] for token in tokens} == set("0123456")
        gids = {publisher._gid for publisher in running.output._publishers.values()}
        assert gids == {xxhash.xxh3_128_digest(token.encode())[::-1] for token in tokens if "/MP/" in token}
    assert len(gids) == 6


def test_a_router_that_goes_and_comes_back() -> None:
    port = free_port(socket.SOCK_STREAM)
    first = router(port)
    running = Running(port)
    with running:
        first.close()
        running.wait()
    assert running.lost is not None and "router" in str(running.lost)
    with pytest.raises(OutputLost, match="cannot connect to tcp"):
        running.output.session(Event())
    with router(port) as session, Running(port) as again:
        heard: list[bytes] = []
        arrived = Event()
        with session.declare_subscriber("42/**", lambda sample: (heard.append(sample.payload), arrived.set())):
            wait_for_interest(again)
            again.put(state_numbered(1))
            assert arrived.wait(DEADLINE)
    assert again.output.counts()["sent"] == 5


def test_humble_has_no_hashes() -> None:
    assert {topic.hash for _, topic in topics(Ros2(type_hashes=False))} == {"TypeHashNotSupported"}


def test_it_describes_where_it_connects() -> None:
    (output,) = make(Config(ros2=Ros2(enabled=True)), None)  # type: ignore[arg-type]
    assert output.name == "ros2" and "tcp/127.0.0.1:7447" in output.about
