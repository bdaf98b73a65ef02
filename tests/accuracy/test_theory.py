"""Consistency by Monte Carlo: the errors of many runs against the covariance that the filter claims. Rival hypotheses: their
weights, their mixture and the decision between them against the closed forms."""

from __future__ import annotations

import math
from typing import get_args

import numpy as np
import pytest

from fusiond.config.schema import Estimate
from fusiond.estimator.fusion import Fusion
from fusiond.filter import rivals
from fusiond.filter.measurement_update import difference, inject
from fusiond.filter.parameters import Parameters, make_parameters
from fusiond.filter.state import (
    ACCEL_BIAS_B,
    ATTITUDE,
    EXCLUDED,
    GYRO_BIAS_B,
    MAIN_WEIGHT,
    POSITION,
    POSITION_E,
    QUATERNION_EB,
    RESET_REASON,
    SUSPECT,
    VELOCITY,
    VELOCITY_E,
    FilterState,
    ResetReason,
)
from fusiond.maths.rotation import matrix
from tests.conftest import needs_compiled
from tests.helpers.streams import SECOND, T0, Drive, config, measurements, running_state, town
from tests.oracles.decision import posterior
from tests.oracles.mixture import Loss, Mixture, collapse, estimate

RUNS, SECONDS = 10, 60.0
BLOCKS = {"position": POSITION, "velocity": VELOCITY, "attitude": ATTITUDE}
SETTINGS = config(
    filter={"heading_deg": math.degrees(0.7)},
    imu={"accel_bias_sigma": 0.05, "gyro_bias_sigma": 0.005},
    gnss={"position_sigma_m": 1.0, "height_sigma_m": 1.0, "velocity_sigma_mps": 0.1},
    wheel={"sigma_mps": 0.05, "least_mps": 0.1},
)


def errors(fusion: Fusion, truth: Drive, k: int) -> np.ndarray:
    """Position [m], velocity [m/s], attitude [rad], as true = estimate (+) error."""
    x = fusion.history.head.nominal
    turn = truth.mat_eb[k] @ matrix(x[QUATERNION_EB]).T
    small = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    return np.concatenate([truth.position_e[k] - x[POSITION_E], truth.velocity_e[k] - x[VELOCITY_E], small])


@pytest.fixture(scope="module")
def study() -> dict[str, np.ndarray]:
    """Normalised squared errors (runs, instants) of each block, every second from the tenth on, and of all measurements."""
    truth, rng = town(SECONDS), np.random.default_rng(11)
    found: dict[str, list[list[float]]] = {name: [] for name in (*BLOCKS, "gnss")}
    for run in range(RUNS):
        gyro, accel = rng.normal(0.0, 0.005, 3), rng.normal(0.0, 0.05, 3)
        events = measurements(truth, seed=100 + run, gyro_bias=tuple(gyro), accel_bias=tuple(accel))
        fusion, row, tested = Fusion(SETTINGS, True), {name: [] for name in BLOCKS}, []
        for event in events:
            fusion.fuse(event)
            if event.source == "imu0" and event.sequence % 100 == 0 and event.sequence >= 1000:
                error, covariance = errors(fusion, truth, event.sequence), fusion.history.head.covariance
                for name, block in BLOCKS.items():
                    part = error[block]
                    row[name].append(float(part @ np.linalg.solve(covariance[block, block], part)))
                rows = fusion.history.rows
                fixes = rows[(rows["source"] == 2) & (rows["t_ns"] > T0 + (event.sequence - 100) * SECOND // 100)]
                tested += (fixes["ratio"] * fusion.params.gates[2]).tolist()
        assert fusion.totals()["REJECTED"] < 0.01 * len(events)
        assert np.abs(fusion.history.head.nominal[GYRO_BIAS_B] - gyro).max() < 2e-3
        assert np.abs(fusion.history.head.nominal[ACCEL_BIAS_B] - accel).max() < 0.15
        for name, values in row.items():
            found[name].append(values)
        found["gnss"].append(tested)
    return {name: np.array(values) for name, values in found.items()}


@needs_compiled
@pytest.mark.parametrize("block", BLOCKS)
def test_errors_are_as_large_as_claimed(study: dict[str, np.ndarray], block: str) -> None:
    """B2: the mean of the normalised squared error is 3 for an honest filter. Errors are correlated over seconds, so the
    band is that of a few independent samples a run: over-confidence beyond a third, or timidity beyond a half, fails."""
    nees = study[block]
    assert 1.5 < nees.mean() < 4.0
    assert (nees < 7.815).mean() > 0.9  # 95 % of a chi-square variable of 3 degrees


@needs_compiled
def test_innovations_are_as_large_as_claimed(study: dict[str, np.ndarray]) -> None:
    """NIS of the positions, horizontal: their noise is white, so its mean over all runs lies close to 2."""
    nis = study["gnss"]
    assert nis.mean() == pytest.approx(2.0, abs=0.2)


def contested(odds: dict[int, float], **costs: float) -> tuple[FilterState, Parameters, int]:
    """A state with rivals of these odds against it, the configuration's parameters, and the suspected receiver."""
    params, state = make_parameters(config(filter=costs)), running_state(np.random.default_rng(4))
    receiver = params.sources.index("gps0.position")
    state.stamps[SUSPECT] = receiver
    for slot, value in odds.items():
        rivals.open_slot(state, slot, value)
    return state, params, receiver


def test_rivals_are_weighed_by_bayes_rule() -> None:
    """D4: three rivals and three readings; the weights sum to 1, and a rival that has become unlikely is given up."""
    prior = {rivals.INERTIAL: 0.2, rivals.RECEIVER: 0.3, rivals.RETURN: 0.1}
    state, params, _ = contested(prior)
    likelihoods = np.array([[1.0, 0.5, 2.0, 0.3], [0.2, 0.9, 0.4, 0.1], [0.7, 0.1, 0.3, 0.002]])
    held = np.array([1.0, *prior.values()])
    for main, *others in likelihoods:
        for slot, own in zip(prior, others, strict=True):
            rivals.weigh(state, slot, own, main)
        rivals.decide(state, False, params)
    held = posterior(held, likelihoods)
    assert held[3] < rivals.BEGIN / 10
    found = [state.auxiliary[MAIN_WEIGHT], *state.bank[list(prior), 0]]
    np.testing.assert_allclose(found, [*held[:3], 0.0], rtol=1e-12)
    rivals.decide(state, False, params)
    assert state.auxiliary[MAIN_WEIGHT] + state.bank[:, 0].sum() == pytest.approx(1.0, abs=1e-12)


def test_what_is_published_has_the_moments_of_the_rivals() -> None:
    """B6 and A7: the mean, of least squared loss, and the covariance of the mixture of the main state and three rivals."""
    odds = {rivals.INERTIAL: 0.5, rivals.RECEIVER: 0.3, rivals.WHEELS: 0.2}
    state, _, _ = contested(odds)
    state.covariance *= 1e-6
    errors, spreads = [np.zeros(state.size)], [state.covariance.copy()]
    for number, slot in enumerate(odds):
        rival, error = state.hypothesis(slot), np.random.default_rng(number).normal(0.0, 1e-3, state.size)
        rival.covariance[:] = (2 + number) * state.covariance
        inject(rival, error)
        errors.append(error)
        spreads.append(rival.covariance.copy())
    before = state.copy()
    rivals.mix(state, rivals.MEAN)
    expected = collapse(Mixture(np.array([1.0, *odds.values()]) / 2, np.array(errors), np.array(spreads)))
    np.testing.assert_allclose(difference(state, before), expected.mean, atol=1e-8)
    np.testing.assert_allclose(state.covariance, expected.covariance, rtol=1e-6, atol=1e-11)


@pytest.mark.parametrize(("chosen", "loss"), [("mean", "squared"), ("median", "absolute"), ("map", "zero-one")])
def test_what_is_published_has_the_least_loss(chosen: Estimate, loss: Loss) -> None:
    """A7: of the main state and a rival 4 m above it, of two thirds of the weight, against the losses of their mixture along
    each axis; and the covariance about that."""
    state, _, _ = contested({rivals.RECEIVER: 2.0})
    error = np.zeros(state.size)
    error[POSITION] = (1.0, -2.0, 3.0)
    state.covariance[:] = 0.25 * np.eye(state.size)
    rival = state.hypothesis(rivals.RECEIVER)
    rival.covariance[:] = 0.25 * np.eye(state.size)
    inject(rival, error)
    before = state.copy()
    rivals.mix(state, get_args(Estimate).index(chosen))
    found, weights = difference(state, before), np.array([1.0, 2.0]) / 3
    for k in range(POSITION.start, POSITION.stop):
        along = Mixture(weights, np.array([[0.0], [error[k]]]), np.full((2, 1, 1), 0.25))
        if loss != "zero-one" or abs(error[k]) >= 3.0:  # nearer peaks overlap: the likeliest hypothesis is not the mode
            assert found[k] == pytest.approx(estimate(along, loss)[0], abs=1e-3)
    np.testing.assert_allclose(
        state.covariance, 0.25 * np.eye(state.size) + weights[0] * np.outer(found, found)
        + weights[1] * np.outer(error - found, error - found), atol=1e-6
    )  # fmt: skip


@pytest.mark.parametrize(("spoof", "reckoning"), [(3.0, 1.0), (1.0, 1.0), (1.0, 4.0)])
def test_a_receiver_is_left_where_that_costs_less(spoof: float, reckoning: float) -> None:
    """D5: a lie pulls the state by 6 m, dead reckoning has a sigma of 2 m. The rival without the receiver leads where its
    expected loss is a tenth of the other's."""
    needed = rivals.LEAD_BY_LOSS * (reckoning * 2.0) / (spoof * 6.0)
    for odds, leads in ((0.98 * needed, False), (1.02 * needed, True)):
        state, params, receiver = contested({rivals.RECEIVER: odds}, spoof_cost=spoof, dead_reckoning_cost=reckoning)
        rival = state.hypothesis(rivals.RECEIVER)
        rival.nominal[POSITION_E] += np.array([4.0, 4.0, -2.0])
        rival.covariance[:] = 0.01 * np.eye(state.size)
        rival.covariance[POSITION, POSITION] = 4 / 3 * np.eye(3)
        place = rival.nominal[POSITION_E].copy()
        rivals.decide(state, False, params)
        assert bool(state.memory[receiver, EXCLUDED]) is leads
        assert np.array_equal(state.nominal[POSITION_E], place) is leads
        assert bool(state.bank[rivals.RECEIVER, 0] == 0) is leads


@pytest.mark.parametrize(("spoof", "reckoning"), [(3.0, 1.0), (1.0, 1.0), (1.0, 4.0)])
def test_a_receiver_is_followed_again_where_that_costs_less(spoof: float, reckoning: float) -> None:
    """D5: the dearer a lie that is swallowed, the surer it must be that the state is wrong and the receiver right."""
    needed = rivals.LEAD_BY_LOSS * spoof / reckoning
    for odds, leads in ((0.98 * needed, False), (1.02 * needed, True)):
        state, params, receiver = contested({rivals.RETURN: odds}, spoof_cost=spoof, dead_reckoning_cost=reckoning)
        state.memory[receiver, EXCLUDED] = 1.0
        rivals.decide(state, False, params)
        assert bool(state.memory[receiver, EXCLUDED] == 0) is leads
        assert bool(state.stamps[RESET_REASON] == ResetReason.SOURCE_RETURNED) is leads
