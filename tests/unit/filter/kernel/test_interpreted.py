"""The compiled and the interpreted kernel give the same bits, operation by operation; and the compiled one gives them on
every processor."""

from __future__ import annotations

import math
import os
import pickle
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion
from fusiond.events import GnssPosition, GnssVelocity, GnssYaw, ImuSample, Measurement, Payload, WheelSpeed
from fusiond.filter.kernel.interpreted import Kernel, compiled_available, make_kernel
from fusiond.filter.north_east_down import COVARIANCE_N, GEODETIC, QUATERNION_NB, VELOCITY_N
from fusiond.filter.observations.model import mat_eb
from fusiond.filter.parameters import make_parameters
from fusiond.filter.rows import Outcome
from fusiond.filter.state import (
    CONSTRAINT_FUSED,
    ERROR_SIZE,
    GYRO_BIAS_B,
    MEAN_FORCE_B,
    MEAN_RATE_B,
    MEAN_WEIGHT,
    NEVER,
    NOMINAL_SIZE,
    PHASE,
    POSITION_E,
    QUATERNION_EB,
    RATE_B,
    RUNNING,
    SCATTER_FORCE,
    SCATTER_RATE,
    T_IMU,
    T_LAST,
    T_STILL,
    VELOCITY_E,
    WIDE_SIZE,
    FilterState,
)
from fusiond.maths.rotation import matrix, matrix_from_euler, quaternion
from fusiond.maths.wgs84 import ecef, geodetic, mat_ne
from tests.conftest import needs_compiled
from tests.helpers.paths import ROOT
from tests.helpers.streams import (
    MS,
    SECOND,
    T0,
    apply,
    bits,
    config,
    fuse,
    measurements,
    running_state,
    same_bits,
    same_state,
    town,
)

pytestmark = needs_compiled
LEARNT = {"lever_arm_sigma_m": 0.3, "delay_sigma_ms": 100.0, "velocity_delay_sigma_ms": 50.0}


def sample(t_ns: int, rng: np.random.Generator) -> Measurement:
    force, rate = rng.normal(0.0, 3.0, 3) - [0, 0, 9.8], rng.normal(0.0, 0.4, 3)
    return Measurement(t_ns, "imu0", 0, t_ns, ImuSample(tuple(force.tolist()), tuple(rate.tolist())))


def both(settings: Config, state: FilterState, events: list[Measurement]) -> tuple[Fusion, Fusion]:
    """Events run by both kernels from one state: states, rows and counts are asserted to be the same bits."""
    fusions = apply(settings, state, events, True), apply(settings, state, events, False)
    first, second = (fusion.history for fusion in fusions)
    same_state(first.head, second.head)
    np.testing.assert_array_equal(first.counts, second.counts)
    assert first.rows.tobytes() == second.rows.tobytes()
    return fusions


@pytest.mark.parametrize("wide", [False, True], ids=["", "wide"])
@pytest.mark.parametrize("seed", range(20))
def test_propagate(seed: int, wide: bool) -> None:
    rng, layout = np.random.default_rng(seed), make_parameters(config(gnss=LEARNT if wide else {}))
    state = running_state(rng, size=layout.size)
    other, dt = state.copy(), float(rng.uniform(1e-6, 0.12))
    force, rate = rng.normal(0.0, 5.0, 3) - [0, 0, 9.8], rng.normal(0.0, 0.5, 3)
    make_kernel(layout, True).propagate(state, dt, force, rate)
    make_kernel(layout, False).propagate(other, dt, force, rate)
    same_state(state, other)


def test_turns_and_pauses_of_every_size() -> None:
    """The attitude after a turn shows sine and cosine, the weight of the means the exponential."""
    rng, layout = np.random.default_rng(1), make_parameters(config())
    compiled, interpreted = make_kernel(layout, True), make_kernel(layout, False)
    for _ in range(200):
        state = running_state(rng)
        other, rate = state.copy(), rng.normal(0.0, 1.0, 3) * 10.0 ** rng.uniform(-6, 1.5)
        for kernel, moved in ((compiled, state), (interpreted, other)):
            kernel.propagate(moved, 0.05, np.array([0.0, 0.0, -9.8]), rate)
        same_state(state, other)
    state = running_state(rng)
    state.stamps[T_IMU], state.auxiliary[12:21] = T0, 0.0
    stamps = T0 + np.cumsum(rng.integers(1, 190 * MS, 200))
    both(config(), state, [sample(int(t_ns), rng) for t_ns in stamps])


@pytest.mark.parametrize("wide", [False, True], ids=["", "wide"])
@pytest.mark.parametrize("seed", range(20))
def test_answer(seed: int, wide: bool) -> None:
    """In north-east-down, all over the Earth; and the frame's definition."""
    rng, layout = np.random.default_rng(seed), make_parameters(config(gnss=LEARNT if wide else {}))
    state = running_state(rng, size=layout.size)
    state.nominal[POSITION_E] = ecef(rng.uniform(-1.57, 1.57), rng.uniform(-3.14, 3.14), rng.uniform(-100.0, 9000.0))
    found, fast = (make_kernel(layout, which).to_north_east_down(state.nominal, state.covariance) for which in (False, True))
    np.testing.assert_array_equal(bits(found), bits(fast))
    to_n = mat_ne(state.nominal[POSITION_E])
    assert np.allclose(ecef(*found[GEODETIC]), state.nominal[POSITION_E], atol=1e-8)
    assert np.allclose(found[VELOCITY_N], to_n @ state.nominal[VELOCITY_E])
    assert np.allclose(matrix(found[QUATERNION_NB]), to_n @ matrix(state.nominal[QUATERNION_EB]))
    turn = np.kron(np.eye(3), to_n)
    assert np.allclose(found[COVARIANCE_N].reshape(9, 9), turn @ state.covariance[:9, :9] @ turn.T)


@pytest.mark.parametrize("ahead_ms", [0, 1, 40, 200, 201, 350, 5000])
@pytest.mark.parametrize("silent_ms", [0, 5, 199, 200, 3000])
def test_predict(ahead_ms: int, silent_ms: int) -> None:
    """On the held sample, coasting, and one after the other."""
    layout, state = make_parameters(config()), running_state(np.random.default_rng(2))
    state.stamps[T_IMU] = T0 - silent_ms * MS
    other = state.copy()
    make_kernel(layout, True).predict(state, T0 + ahead_ms * MS)
    make_kernel(layout, False).predict(other, T0 + ahead_ms * MS)
    same_state(state, other)


def test_predict_leaves_a_state_that_does_not_run() -> None:
    state = FilterState(7)
    before = state.numbers.copy()
    make_kernel(make_parameters(config()), True).predict(state, T0)
    np.testing.assert_array_equal(state.numbers, before)


def near(state: FilterState, kind: str, rng: np.random.Generator) -> Payload:
    """A reading that fits the state but for a little."""
    x = state.nominal
    speed = float((mat_eb(state).T @ x[VELOCITY_E])[0])
    if kind == "position":
        return GnssPosition(*geodetic(x[POSITION_E] + rng.normal(0.0, 1.0, 3)), 0.7, 1.1)
    if kind == "velocity":
        return GnssVelocity(*(rng.normal(0.0, 10.0, 3)).tolist(), 8.0)
    if kind == "velocity 2-D":
        return GnssVelocity(*(rng.normal(0.0, 10.0, 2)).tolist(), None, 8.0)
    if kind == "wheel slow":
        return WheelSpeed(abs(float(rng.normal(0.0, 0.5))))
    if "yaw" in kind:
        forward_n = mat_ne(x[POSITION_E]) @ mat_eb(state)[:, 0]
        return GnssYaw(math.atan2(forward_n[1], forward_n[0]) + float(rng.normal(0.0, 0.01)), 0.01)
    return WheelSpeed(abs(speed) if kind == "wheel unsigned" else speed)


KINDS = {
    "position": "gps0.position",
    "velocity": "gps0.velocity",
    "velocity 2-D": "gps0.velocity",
    "wheel": "front_left",
    "wheel unsigned": "front_left",
    "wheel slow": "front_left",
    "wheel steered": "front_left",
    "yaw": "yaw0",
    "yaw, nearly vertical": "yaw0",
}


@pytest.mark.parametrize("wide", [False, True], ids=["", "wide"])
@pytest.mark.parametrize("correlation_s", [0.0, 0.7])
@pytest.mark.parametrize("kind", KINDS)
def test_every_measurement(kind: str, correlation_s: float, wide: bool) -> None:
    """Several of one kind, between two IMU samples: interpolated, judged and fused alike."""
    wheel = {"position_m": (1.3, -0.8, 0.4), "steered": "steered" in kind, "unsigned": kind != "wheel"}
    settings = config(
        gnss={
            "lever_arm_m": (0.4, -0.2, -1.1),
            "position_correlation_s": correlation_s,
            "velocity_correlation_s": correlation_s,
        }
        | (LEARNT if wide else {}),
        wheel=wheel | {"correlation_s": correlation_s},
        dual_antenna={"yaw0": {"link": "link", "correlation_s": correlation_s}},
        filter={"gate_probability": 0.9, "wheel_scale_by": "wheel" if wide else "vehicle"},
    )
    seen: set[int] = set()
    for seed in range(12):
        rng = np.random.default_rng(seed)
        state = running_state(rng, sources=8, size=WIDE_SIZE if wide else ERROR_SIZE)
        state.stamps[T_IMU] = T0
        if "vertical" in kind:
            mat_nb = matrix_from_euler(0.1, 1.5, float(rng.uniform(-3.0, 3.0)))
            state.nominal[QUATERNION_EB] = quaternion(mat_ne(state.nominal[POSITION_E]).T @ mat_nb)
        if kind == "wheel slow":
            state.nominal[VELOCITY_E] = rng.normal(0.0, 0.4, 3)
        events = [
            Measurement(T0 + t_ms * MS, KINDS[kind], i, T0, near(state, kind, rng))
            for i, t_ms in enumerate((1, 2, 6, 10, 14))
        ]
        fusion, _ = both(settings, state, [*events, sample(T0 + 10 * MS, rng), sample(T0 + 20 * MS, rng)])
        rows = fusion.history.rows
        seen |= set(rows["outcome"][rows["source"] == fusion.params.sources.index(KINDS[kind])].tolist())
    assert seen == {Outcome.REJECTED} if "vertical" in kind else Outcome.FUSED in seen


def test_rejected_leaves_the_state_and_fused_at_the_edge_of_the_gate() -> None:
    """A reading that is off by the gate's width and a billionth more or less."""
    settings, state = config(gnss={"velocity_sigma_mps": 0.5}), running_state(np.random.default_rng(3))
    state.stamps[T_IMU] = T0
    to_see = Measurement(T0, "gps0.velocity", 0, T0, GnssVelocity(0.0, 0.0, 0.0))
    row = apply(settings, state, [to_see], True).history.rows[0]
    h = -row["innovation"]  # what would have been expected
    along = row["innovation"] / math.sqrt(row["ratio"])  # at a ratio of one
    for factor, outcome in ((1 - 1e-9, Outcome.FUSED), (1 + 1e-9, Outcome.REJECTED)):
        reading = Measurement(T0, "gps0.velocity", 0, T0, GnssVelocity(*(h + along * factor).tolist()))
        for fusion in both(settings, state, [reading]):
            assert fusion.history.rows[0]["outcome"] == outcome
            assert fusion.history.rows[0]["ratio"] == pytest.approx(1.0, rel=3e-9)
            untouched = (fusion.history.head.nominal == state.nominal).all()
            assert bool(untouched) is (outcome == Outcome.REJECTED)


def test_infinitely_correlated_samples_tell_nothing() -> None:
    settings = config(gnss={"velocity_correlation_s": 1e14, "velocity_sigma_mps": 30.0})
    state = running_state(np.random.default_rng(4))
    events = [Measurement(T0 + k, "gps0.velocity", k, T0, GnssVelocity(0.0, 0.0, 0.0)) for k in range(2)]
    one, _ = both(settings, state, events[:1])
    two, _ = both(settings, state, events)
    assert two.history.rows["outcome"].tolist() == [Outcome.FUSED, Outcome.REJECTED]
    np.testing.assert_allclose(one.history.head.nominal[3:], two.history.head.nominal[3:], rtol=1e-7)  # it turns for 1 ns


@pytest.mark.parametrize(("apart_ms", "coasts"), [(200, False), (201, True)])
def test_imu_samples_too_far_apart_are_not_interpolated(apart_ms: int, coasts: bool) -> None:
    rng = np.random.default_rng(8)
    settings = config(filter={"imu_gap_s": 0.2}, motion={"non_holonomic": False, "standstill": False})
    state = running_state(rng)
    state.stamps[T_IMU] = T0
    state.auxiliary[RATE_B] = state.nominal[GYRO_BIAS_B]  # it does not turn
    wheel = Measurement(T0 + 100 * MS, "front_left", 0, T0, WheelSpeed(500.0))  # rejected: it only carries the state on
    fusion, _ = both(settings, state, [wheel, sample(T0 + apart_ms * MS, rng)])
    head = fusion.history.head
    expected = state.nominal[POSITION_E] + state.nominal[VELOCITY_E] * apart_ms / 1e3
    assert bool(np.abs(head.nominal[POSITION_E] - expected).max() < 1e-8) is coasts
    assert bool(np.abs(head.nominal[QUATERNION_EB] - state.nominal[QUATERNION_EB]).max() < 1e-14) is coasts


@pytest.mark.parametrize("still", [True, False])
def test_constraints(still: bool) -> None:
    """Zero velocity and zero rotation, or the non-holonomic constraint, at an IMU sample."""
    settings = config((), motion={"point_m": (-1.0, 0.2, 0.3), "still_after_s": 0.3})
    fused = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        state = running_state(rng, sources=3)
        state.nominal[VELOCITY_E] = mat_eb(state) @ (8.0, 0.1, -0.1)
        if still:
            state.nominal[VELOCITY_E], state.auxiliary[RATE_B] = 0.01, state.nominal[10:13]
            state.auxiliary[[MEAN_WEIGHT, SCATTER_FORCE, SCATTER_RATE]] = 1.0, 1e-6, 1e-9
            state.auxiliary[MEAN_FORCE_B], state.auxiliary[MEAN_RATE_B] = (0.0, 0.0, -9.8), state.nominal[10:13]
        state.stamps[[T_IMU, T_STILL]] = T0, T0 - SECOND if still else NEVER
        quiet = ImuSample((0.0, 0.0, -9.8), tuple(state.nominal[10:13].tolist()))
        event = Measurement(T0 + 10 * MS, "imu0", 0, T0, quiet) if still else sample(T0 + 10 * MS, rng)
        fusion, _ = both(settings, state, [event])
        fused.append(fusion.history.head.stamps[CONSTRAINT_FUSED].tolist())
    assert np.array(fused).sum(axis=0).astype(bool).tolist() == [not still, still, still]


def test_sizes() -> None:
    """A kernel is compiled for a number of error states, and takes no state of other sizes."""
    from fusiond.filter.kernel import narrow, wide  # noqa: PLC0415 - only where they were built

    with pytest.raises(ValueError, match=f"21 error states, not {WIDE_SIZE}"):
        narrow.Kernel(make_parameters(config(gnss=LEARNT)))
    with pytest.raises(ValueError, match=f"{WIDE_SIZE} error states, not 21"):
        wide.Kernel(make_parameters(config()))
    kernel = make_kernel(make_parameters(config()), True)
    with pytest.raises(ValueError, match="numbers"):
        kernel.predict(FilterState(2), T0)
    with pytest.raises(ValueError, match="21 error states is needed, not 30"):
        kernel.to_north_east_down(np.zeros(NOMINAL_SIZE), np.zeros((30, 30)))
    assert compiled_available()
    assert isinstance(make_kernel(make_parameters(config()), False), Kernel)
    assert not isinstance(make_kernel(make_parameters(config())), Kernel)


CHILD = """
import hashlib, math, pickle, sys
import numpy as np
from tests.helpers.streams import config, fuse, SECOND, T0
from fusiond.filter.kernel.interpreted import compiled_available
events = pickle.load(open(sys.argv[1], "rb"))
numbers = [k * 1.2345e-5 for k in range(1, 100000)]
library = hashlib.sha256(repr([x ** 2 for x in numbers] + [math.exp(-x) for x in numbers]).encode())
print(library.hexdigest())
for settings in (config(), config(filter={"heading_deg": 40.0}, gnss={"lever_arm_m": (0.4, 0.1, -1.0)})):
    fusion = fuse(settings, events, True)
    head, estimate = fusion.history.head, fusion.solution_at(T0 + 13 * SECOND)
    answer = repr([f.hex() if isinstance(f, float) else f for f in (estimate.state.latitude, estimate.state.longitude,
        *estimate.state.velocity_n, *estimate.state.quaternion_nb, *estimate.state.euler())])
    for part in (head.numbers, head.whole, fusion.settled().state.covariance, estimate.state.covariance):
        print(hashlib.sha256(np.ascontiguousarray(part).tobytes()).hexdigest())
    print(hashlib.sha256(answer.encode()).hexdigest())
"""


def child(events: Path, environment: dict[str, str]) -> list[str]:
    command = [sys.executable, "-W", "error", "-c", CHILD, str(events)]
    clean = {name: value for name, value in os.environ.items() if name not in ("GLIBC_TUNABLES", "OPENBLAS_CORETYPE")}
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    ran = subprocess.run(
        command, env=clean | {"PYTHONPATH": path} | environment, cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout.split()


def numpy_features() -> list[str]:
    """Those which NumPy uses beyond its baseline here, and can be told not to."""
    core: Any = np._core._multiarray_umath if hasattr(np, "_core") else np.core._multiarray_umath
    return [name for name in core.__cpu_dispatch__ if core.__cpu_features__.get(name)]


@pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() != "x86_64", reason="the variants of x86-64's C library on Linux"
)
def test_the_same_bits_with_and_without_avx(tmp_path: Path) -> None:
    """Start, drive and published answer: what the processor has makes the C library and BLAS differ, and nothing here."""
    late = sorted(
        measurements(town(12.0, rate=50.0)), key=lambda event: event.t_ns + 200 * MS * event.source.startswith("gps0")
    )
    events = tmp_path / "events.pickle"
    events.write_bytes(pickle.dumps(late))
    names = ("AVX", "AVX2", "FMA", "FMA4", "AVX512F", "AVX512VL", "AVX2_Usable", "FMA_Usable", "AVX512F_Usable")
    plain, old = (
        child(events, environment)
        for environment in (
            {},
            {
                "GLIBC_TUNABLES": "glibc.cpu.hwcaps=" + ",".join(f"-{name}" for name in names),
                "NPY_DISABLE_CPU_FEATURES": " ".join(numpy_features()),
                "OPENBLAS_CORETYPE": "Nehalem",
            },
        )
    )
    assert plain[1:] == old[1:]
    assert len(plain) == 11
    if plain[0] == old[0]:
        pytest.skip("the C library's variants cannot be switched here, so this tells of NumPy's alone")


def test_the_compiled_kernel_is_the_default() -> None:
    stretch = measurements(town(3.0, rate=50.0))
    same_bits(fuse(config(filter={"heading_deg": 40.0}), stretch), fuse(config(filter={"heading_deg": 40.0}), stretch, True))
    state = fuse(config(filter={"heading_deg": 40.0}), stretch).history.head
    assert state.stamps[PHASE] == RUNNING
    assert (state.source_stamps[:, T_LAST] > T0).all()
