"""The examination of `fusiond doctor`: a replay with its findings, and a second one with a lever arm that may be wrong."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from msgspec.structs import replace

from fusiond.app.diagnosis.finding import Finding, exit_code, located
from fusiond.app.diagnosis.lever import lever_findings, with_open_lever_arm
from fusiond.app.progress import shown
from fusiond.app.replay.files import delivering
from fusiond.app.replay.job import Options, replay
from fusiond.app.replay.summary import Summary, to_json
from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion
from fusiond_adapters.logs.merge import open_logs


def examine(
    config: Config, config_name: str, logs: Sequence[str], *, bar: bool = False, json: Path | None = None
) -> Summary:
    """The summary of a replay, with all findings. Raises ConfigError, LogError, OutputError."""
    summary = replay(Options(config, config_name, logs, bar=bar))
    if not exit_code(summary.findings):
        more = located(_lever(config, logs, bar=bar), config.path(config_name))
        summary = replace(summary, findings=[*summary.findings, *more])
    if json:
        with delivering(json):
            json.write_bytes(to_json(summary))
    return summary


def _lever(config: Config, paths: Sequence[str], *, bar: bool) -> list[Finding]:
    opened = with_open_lever_arm(config)
    if opened is None:
        return []
    logs, fusion = open_logs(paths, opened), Fusion(opened)
    first_ns = last_ns = 0
    events = shown(logs, lambda: logs.bytes_read / logs.bytes_total, lambda: last_ns - first_ns, sys.stderr) if bar else logs
    for event in events:
        first_ns, last_ns = first_ns or event.t_receive_ns, event.t_receive_ns
        fusion.feed(event)
    return list(lever_findings(config, fusion))
