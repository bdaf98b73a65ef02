"""The state's memory: every number has a place of its own, a snapshot is the whole of it, an empty state holds nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.filter import hot_start, state
from fusiond.filter.state import (
    ALIGNING,
    CALIBRATIONS,
    CHOOSING,
    ERROR_SIZE,
    HYPOTHESES,
    INERTIAL_DOUBT,
    MEMORY_SIZE,
    NEVER,
    NOMINAL_SIZE,
    PHASE,
    POSITION_E,
    QUATERNION_EB,
    RUNNING,
    SOURCE_STAMPS_SIZE,
    STAMPS_SIZE,
    WIDE_SIZE,
    FilterState,
    Verdict,
)
from tests.helpers.streams import bits, running_state

NOMINAL = (
    "POSITION_E", "VELOCITY_E", "QUATERNION_EB", "GYRO_BIAS_B", "ACCEL_BIAS_B", "WHEEL_SCALE", "MOUNT", "GNSS_ERROR_E",
    "FURTHER_SCALES", "ANTENNA_B", "DELAYS", "HEIGHT_OFFSET", "INERTIAL_DELAYS", "SLIP",
    "YAW_RATE_OFFSET", "STEERING_OFFSET", "STEERING_FACTOR", "UNDERSTEER",
)  # fmt: skip
ERROR = (
    "POSITION", "VELOCITY", "ATTITUDE", "GYRO_BIAS", "ACCEL_BIAS", "SCALE", "MOUNT_ERROR", "GNSS_ERROR",
    "FURTHER_SCALES_ERROR", "ANTENNA_ERROR", "DELAYS_ERROR", "HEIGHT_OFFSET_ERROR", "INERTIAL_DELAYS_ERROR", "SLIP_ERROR",
    "YAW_RATE_OFFSET_ERROR", "STEERING_OFFSET_ERROR", "STEERING_FACTOR_ERROR", "UNDERSTEER_ERROR",
)  # fmt: skip
WIDTHS = (3, 3, 3, 3, 3, 1, 2, 3, 3, 3, 2, 1, 2, 1, 1, 1, 1, 1)  # of the error states


def test_each_error_state_has_its_place_behind_the_one_before() -> None:
    ends = np.cumsum(WIDTHS).tolist()
    found = [getattr(state, name) for name in ERROR]
    assert found == [slice(end - width, end) for end, width in zip(ends, WIDTHS, strict=True)]
    assert (ends[7], ends[-1]) == (ERROR_SIZE, WIDE_SIZE)


def test_each_nominal_state_has_its_place_behind_the_one_before() -> None:
    """The quaternion takes a number more than its error: what comes after it lies one higher."""
    begin = 0
    for name, width in zip(NOMINAL, WIDTHS, strict=True):
        end = begin + width + (name == "QUATERNION_EB")
        assert getattr(state, name) == slice(begin, end), name
        begin = end
    assert begin == INERTIAL_DOUBT == WIDE_SIZE + 1 == NOMINAL_SIZE - 1  # which no error adds to
    for nominal, error in zip(NOMINAL[5:], ERROR[5:], strict=True):
        assert getattr(state, nominal).start == getattr(state, error).start + 1
        assert getattr(state, error).start >= CALIBRATIONS


@pytest.mark.parametrize("size", [ERROR_SIZE, WIDE_SIZE])
def test_the_parts_fill_the_memory_and_do_not_meet(size: int) -> None:
    whole = FilterState(4, size)
    whole.numbers[:], whole.whole[:] = 0.0, 0
    for part in (whole.nominal, whole.covariance, whole.auxiliary, whole.memory, whole.bank):
        np.add(part, 1.0, out=part)
    assert (whole.numbers == 1.0).all()
    for stamps in (whole.stamps, whole.source_stamps):
        np.add(stamps, 1, out=stamps)
    assert (whole.whole == 1).all()
    assert whole.sources == 4
    assert (whole.memory.shape, whole.source_stamps.shape) == ((4, MEMORY_SIZE), (4, SOURCE_STAMPS_SIZE))
    assert whole.bank.shape == (HYPOTHESES, 1 + NOMINAL_SIZE + size * size)
    whole.core[:] = 2.0
    assert (whole.bank == 1.0).all()
    assert whole.core.size + whole.bank.size == whole.numbers.size


def test_an_empty_state() -> None:
    empty = running_state(np.random.default_rng(1))
    empty.bank[:], empty.whole[:] = 1.0, 5
    empty.clear()
    assert empty.nominal[QUATERNION_EB].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert np.count_nonzero(empty.numbers) == 1
    assert (empty.stamps[:PHASE] == NEVER).all()  # stamps never; phase, counts and reasons nothing
    assert (empty.stamps[PHASE:] == 0).all()
    assert (empty.source_stamps == NEVER).all()
    assert empty.stamps.shape == (STAMPS_SIZE,)


@pytest.mark.parametrize("phase", [ALIGNING, RUNNING, CHOOSING])
@pytest.mark.parametrize("before", [RUNNING, CHOOSING])
def test_a_copy_is_the_whole_state(phase: int, before: int) -> None:
    """The bank is copied, or emptied, where one of the two chooses."""
    rng = np.random.default_rng(2)
    original, copy = running_state(rng), running_state(rng)
    original.stamps[PHASE], copy.stamps[PHASE] = phase, before
    original.memory[:] = rng.normal(size=original.memory.shape)
    for one in (original, copy):
        if one.stamps[PHASE] == CHOOSING:
            one.bank[:] = rng.normal(size=one.bank.shape)
    copy.copy_from(original)
    for one in (copy, original.copy()):
        np.testing.assert_array_equal(bits(one.numbers), bits(original.numbers))
        np.testing.assert_array_equal(one.whole, original.whole)
    copy.nominal += 1.0
    assert (copy.nominal != original.nominal).any()


def test_a_hypothesis_is_a_state_that_shares_all_but_its_own() -> None:
    whole = running_state(np.random.default_rng(3), size=WIDE_SIZE)
    before = whole.nominal.copy(), whole.covariance.copy()
    view = whole.hypothesis(5)
    view.nominal[:], view.covariance[:] = 7.0, 8.0
    assert (whole.bank[5, 1:] == [7.0] * NOMINAL_SIZE + [8.0] * WIDE_SIZE**2).all()
    assert not whole.bank[[4, 6]].any()
    assert whole.bank[5, 0] == 0.0  # the weight is the bank's
    np.testing.assert_array_equal(whole.nominal, before[0])
    np.testing.assert_array_equal(whole.covariance, before[1])
    for part in ("auxiliary", "memory", "stamps", "source_stamps"):
        getattr(view, part).flat[5] = 9
        assert getattr(whole, part).flat[5] == 9
    assert (view.size, view.sources) == (WIDE_SIZE, whole.sources)
    assert view.nominal[POSITION_E].tolist() == [7.0] * 3


def test_every_verdict_has_its_words() -> None:
    assert set(hot_start.WORDS) == set(Verdict)
    assert len(set(hot_start.WORDS.values())) == len(Verdict)


@pytest.mark.parametrize(
    ("place", "value", "sound"),
    [((0, 0), 1e12, True), ((1, 1), 1e14, False), ((2, 2), -1e6, False), ((4, 4), math.inf, False)],
)
def test_a_state_is_sound_while_its_place_is_known(place: tuple[int, int], value: float, sound: bool) -> None:
    """To better than the Earth's size: one that is not begins anew, before its sums overflow."""
    found = running_state(np.random.default_rng(1))
    assert state.is_sound(found)
    found.covariance[place] = value
    assert state.is_sound(found) is sound
