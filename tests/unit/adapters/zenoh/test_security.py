"""The sample configurations for TLS and access control: who has no certificate stays out, who has one does only its own.
Without certificates, who connects can only read."""

from __future__ import annotations

import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import Literal

import msgspec
import pytest
import zenoh

from fusiond.app.client import Client, ClientError
from fusiond.config.outputs import Zenoh
from fusiond.config.schema import Config, Vehicle
from fusiond.messages.types import EventMessage
from fusiond_adapters.zenoh.queries import Answers
from fusiond_adapters.zenoh.session import ZenohPublisher, open_session, session_config
from tests.helpers.certificates import certify, openssl
from tests.helpers.paths import ROOT
from tests.helpers.zenoh import endpoint as free_endpoint
from tests.helpers.zenoh import publishing, sees, settings

SAMPLES = ROOT / "configs" / "zenoh"
DEADLINE = 15.0  # s
PLACE = "/etc/fusiond/zenoh"


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The samples, with certificates, in a folder of their own."""
    if shutil.which("openssl") is None:
        pytest.skip("makes its certificates with openssl")
    folder = tmp_path_factory.mktemp("zenoh")
    certify(folder, "router", "rover", "reader")
    for sample in SAMPLES.glob("*.json5"):
        (folder / sample.name).write_text(sample.read_text().replace(PLACE, str(folder)))
    return folder


@pytest.fixture(scope="module")
def endpoint(samples: Path) -> Iterator[str]:
    """The router of the sample, on a free port of loopback."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"tls/127.0.0.1:{probe.getsockname()[1]}"
    with zenoh.open(session_config(Zenoh(mode="router", listen=[address], config_file="router.json5"), samples)):
        yield address


@contextmanager
def vehicle(samples: Path, endpoint: str, file: str = "vehicle.json5", name: str = "rover") -> Iterator[ZenohPublisher]:
    section = Zenoh(mode="client", listen=[], connect=[endpoint], config_file=file)
    answers = Answers(Config(vehicle=Vehicle(name=name)))
    answers.keep(event("latest", name))
    with (
        open_session(section, samples) as session,
        ZenohPublisher(session, name, "json") as publisher,
        answers.declared(session),
    ):
        yield publisher


def event(text: str, vehicle: str = "rover") -> EventMessage:
    return EventMessage(vehicle=vehicle, t_ns=1, kind="mode", severity="info", subject="nominal", text=text)


def test_a_reader_gets_the_messages_of_its_vehicle(samples: Path, endpoint: str) -> None:
    with (
        vehicle(samples, endpoint) as publisher,
        Client(endpoint, "rover", config_file=samples / "reader.json5") as client,
    ):
        assert sees(client, "rover")
        assert client.latest(EventMessage).text == "latest"
        publisher.publish(event("before"))
        heard = client.stream(EventMessage, timeout_s=DEADLINE)
        assert next(heard).text == "before"  # from the publisher's memory
        publisher.publish(event("after"))
        assert next(heard).text == "after"


def test_a_reader_cannot_publish_for_a_vehicle(samples: Path, endpoint: str) -> None:
    """The vehicle's message arrives; the forged one, which the router received before, does not."""
    came = Event()
    heard: list[str] = []

    def listen(message: EventMessage) -> None:
        heard.append(message.text)
        if message.text == "true":
            came.set()

    with (
        Client(endpoint, "*", config_file=samples / "reader.json5") as client,
        client.subscribed(EventMessage, listen),
        vehicle(samples, endpoint, "reader.json5") as forger,
        vehicle(samples, endpoint, "vehicle.json5", "other") as foreign,
        vehicle(samples, endpoint) as rover,
    ):
        forger.publish(event("forged"))
        foreign.publish(event("of another", "other"))
        for liar in (forger, foreign):  # an answer shows that the router has processed everything before
            assert list(liar._session.get("fusiond/x/info", timeout=1.0)) == []
        rover.publish(event("true"))
        assert came.wait(DEADLINE)
        assert sees(client, "rover")
    assert heard == ["true"]


def test_a_vehicle_cannot_read(samples: Path, endpoint: str) -> None:
    with (
        vehicle(samples, endpoint) as rover,
        Client(endpoint, "rover", config_file=samples / "vehicle.json5", timeout_s=1.0) as spy,
    ):
        rover.publish(event("secret"))
        with pytest.raises(ClientError, match="fusiond/rover/events: no answer"):
            spy.latest(EventMessage)


def test_no_access_without_a_certificate(samples: Path, endpoint: str) -> None:
    bare = samples / "bare.json5"
    bare.write_text('{transport: {link: {tls: {root_ca_certificate: "%s"}}}}' % (samples / "ca.pem"))
    with pytest.raises(ClientError, match="no Zenoh answers there"):
        Client(endpoint, "rover", config_file=bare)


def test_a_router_of_another_authority_is_not_trusted(samples: Path, endpoint: str, tmp_path: Path) -> None:
    openssl("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-subj", "/CN=rogue",
            "-days", 2, "-keyout", tmp_path / "ca.key", "-out", tmp_path / "ca.pem")  # fmt: skip
    text = (samples / "reader.json5").read_text().replace(f"{samples}/ca.pem", str(tmp_path / "ca.pem"))
    (tmp_path / "reader.json5").write_text(text)
    with pytest.raises(ClientError, match="no Zenoh answers there"):
        Client(endpoint, "rover", config_file=tmp_path / "reader.json5")


@pytest.mark.parametrize("file", [None, SAMPLES / "read-only.json5"])
@pytest.mark.parametrize("mode", ["client", "peer"])
def test_a_process_that_connects_can_publish_unless_forbidden(file: Path | None, mode: Literal["client", "peer"]) -> None:
    """A reader and a forger, both connected to fusiond; no certificates."""
    where, came, heard = free_endpoint(), Event(), list[str]()
    config = settings(where)
    config = msgspec.structs.replace(config, zenoh=msgspec.structs.replace(config.zenoh, config_file=file and str(file)))

    def listen(message: EventMessage) -> None:
        heard.append(message.text)
        if message.text == "true":
            came.set()

    with (
        publishing(config) as output,
        Client(where, "rover") as client,
        client.subscribed(EventMessage, listen),
        open_session(Zenoh(mode=mode, listen=[], connect=[where])) as session,
        ZenohPublisher(session, "rover", "json") as forger,
    ):
        forger.publish(event("forged"))
        list(session.get("fusiond/rover/info", timeout=1.0))  # an answer shows that fusiond has processed everything before
        output.outbox.put(event("true"))
        assert came.wait(DEADLINE)
    assert ("forged" in heard) == (file is None)
