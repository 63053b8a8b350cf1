"""Fits processes to simulated logs with known parameters."""

import math
import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rtd3jax as rtd
from rtd3jax.envs.rover import Rover, RoverParams
from rtd3jax.envs.rover.slip import Ar1Slip, SineSlip
from rtd3jax.errors import UserError
from rtd3jax.identification import sine
from rtd3jax.identification.picture import autocorrelation, played, spectrum

STEPS = 150


def logs_of(process, logs, episodes, seed=5):
    """Simulated logs: [logs, episodes, STEPS, 2]; the slip as an observer of the motion sees it."""
    slip = isinstance(process, Ar1Slip | SineSlip)
    signal = jnp.full((2,), 0.5 if slip else 0.0, jnp.float32)

    def episode(key):
        state = process.init(key, STEPS, 2)

        def step(state, key):
            out, state = process.step(key, state, signal)
            return state, out

        keys = jax.random.split(jax.random.fold_in(key, 1), STEPS)
        return jax.lax.scan(step, state, keys)[1]

    keys = jax.random.split(jax.random.key(seed), logs * episodes)
    out = np.asarray(jax.jit(jax.vmap(episode))(keys), np.float64)
    out = out.reshape(logs, episodes, STEPS, 2)
    return 1.0 - out / 0.5 if slip else out


def shares(fits, truth, factor=1.0, quantile=1.96):
    """Of each parameter: the share of 95% intervals that cover ``factor`` times the truth."""
    found = {}
    for name, true in truth.items():
        estimates = [fit.estimates[name] for fit in fits]
        away = [abs(e.value - factor * true) / e.standard_error for e in estimates]
        found[name] = float(np.mean(np.array(away) < quantile))
    return found


KNOWN = {
    "ar1": (Ar1Slip(rho=0.9, sigma=0.08), 3, {"rho": 0.9, "sigma": 0.08}),
    "ornstein-uhlenbeck": (
        rtd.OrnsteinUhlenbeck(sigma=0.7, time_constant=5.0, mean=0.3),
        10,
        {"sigma": 0.7, "time_constant": 5.0, "mean": 0.3, "coefficient": math.exp(-0.2)},
    ),
    "noise": (rtd.GaussianNoise(sigma=0.4), 3, {"sigma": 0.4}),
}


@pytest.mark.parametrize("kind", KNOWN)
def test_the_truth_lies_within_the_standard_errors_as_often_as_they_say(kind):
    process, episodes, truth = KNOWN[kind]
    logs = logs_of(process, 200, episodes)
    fits = [rtd.fit_process(log, kind) for log in logs]
    for name, share in shares(fits, truth).items():
        assert 0.90 <= share <= 0.99, (name, share)
    # An estimator that is off by a tenth would be found out.
    assert all(share < 0.90 for share in shares(fits, truth, factor=1.1).values())
    for name, true in truth.items():
        value, error = fits[0].estimates[name]
        assert abs(value - true) < 4.0 * error
        if name != "coefficient":
            assert getattr(fits[0].process, name) == value
    assert type(fits[0].process) is type(process)
    if kind == "ar1":
        assert fits[0].process.max_slip == pytest.approx(0.5, abs=1e-5)


def noisy_waves(logs, episodes):
    """Slip in waves of one amplitude and period, seen with noise, far from the bounds."""
    process = SineSlip(amplitude_min=0.2, amplitude_max=0.2, period_min=30, period_max=30)
    slip = logs_of(process.replace(offset=0.5, max_slip=1.0), logs, episodes)
    return slip + 0.02 * np.random.default_rng(0).standard_normal(slip.shape)


@pytest.mark.slow
def test_waves_are_found():
    logs = noisy_waves(30, 6)
    fits = [rtd.fit_process(log, "sine", max_slip=1.0) for log in logs]
    truth = {"amplitude": 0.2, "period": 30.0, "offset": 0.5, "deviation": 0.02}
    # An average of twelve waves, whose spread is estimated too, follows Student's t.
    for name, share in shares(fits, truth, quantile=2.2).items():
        assert 0.90 <= share <= 1.0, (name, share)
    assert all(share < 0.5 for share in shares(fits, truth, factor=1.1).values())
    alone = [rtd.fit_process(log[:1, :, :1], "sine", max_slip=1.0) for log in logs]
    for name, share in shares(alone, truth).items():
        assert 0.90 <= share <= 1.0, (name, share)


@pytest.mark.parametrize("rows", [8, 9, 97, 150])
def test_the_profile_over_the_period_against_each_periods_own_least_squares(rows):
    time = np.arange(rows)
    wave = 0.3 + 0.2 * np.sin(0.2 * time) + 0.02 * np.random.default_rng(rows).normal(size=rows)
    angles, coefficients, explained = sine._profile(wave)
    periods = rows / np.arange(0.5, rows / 3.0, 0.125)
    np.testing.assert_allclose(angles, 2.0 * np.pi / periods)
    away = wave - wave.mean()
    for angle, found, square in zip(angles, coefficients, explained, strict=True):
        turns = np.outer(time, angle)
        line = np.hstack((np.sin(turns), np.cos(turns), np.ones_like(turns)))
        own, *_ = np.linalg.lstsq(line, away)
        # The ridge of the profile moves a coefficient by a billionth of it.
        np.testing.assert_allclose(found, own, rtol=1e-7, atol=1e-8)
        assert square == pytest.approx(away @ line @ own, rel=1e-7, abs=1e-12)


def test_a_long_log_takes_memory_like_its_rows():
    rows, period = 100_000, 37.3
    noise = 0.02 * np.random.default_rng(0).standard_normal(rows)
    slip = 0.5 + 0.2 * np.sin(2.0 * np.pi * np.arange(rows) / period) + noise
    tracemalloc.start()
    try:
        fit = rtd.fit_process(slip, "sine", max_slip=1.0)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most < 2**28, most
    value, error = fit.estimates["period"]
    assert abs(value - period) < 4.0 * error < 1e-3


def test_clipped_waves_and_the_ranges_they_are_drawn_from():
    (log,) = logs_of(SineSlip(), 1, 12)
    fit = rtd.fit_process(log, "sine")
    process = fit.process
    assert process.offset == pytest.approx(0.12, abs=1e-4)
    assert 0.08 <= process.amplitude_min < 0.11 and 0.19 < process.amplitude_max <= 0.2201
    assert 40 <= process.period_min < 48 and 82 < process.period_max <= 90
    assert type(process.period_min) is int and fit.error < 1e-5
    assert math.isnan(fit.estimates["period_min"].standard_error)


def test_the_right_kind_explains_a_log_best():
    (log,) = logs_of(Ar1Slip(), 1, 8)
    fits = {kind: rtd.fit_process(log, kind) for kind in ("ar1", "sine", "ornstein-uhlenbeck")}
    assert min(fits, key=lambda kind: fits[kind].error) == "ar1"
    assert "clipped and contributes a probability" in fits["ar1"].summary()
    (log,) = logs_of(KNOWN["ornstein-uhlenbeck"][0], 1, 8)
    both = [rtd.fit_process(log, kind) for kind in ("ornstein-uhlenbeck", "noise")]
    assert both[0].aic < both[1].aic and "GaussianNoise has zero mean" in both[1].summary()
    (log,) = logs_of(rtd.GaussianNoise(), 1, 8)
    assert "GaussianNoise has zero mean" not in rtd.fit_process(log, "noise").summary()


def test_likelihoods_against_slow_sums():
    (log,) = logs_of(KNOWN["ornstein-uhlenbeck"][0], 1, 2)
    fit = rtd.fit_process(log, "ornstein-uhlenbeck")
    process = fit.process
    decay = math.exp(-1.0 / process.time_constant)
    spread = process.sigma * math.sqrt(1.0 - decay**2)

    def density(x, mean, deviation):
        away = (x - mean) / deviation
        return math.exp(-0.5 * away**2) / (deviation * math.sqrt(2.0 * math.pi))

    total = 0.0
    for wave in (wave for part in log for wave in part.T):
        for x, y in zip(wave[:-1], wave[1:], strict=True):
            total += math.log(density(y, process.mean + decay * (x - process.mean), spread))
    assert fit.log_likelihood == pytest.approx(total)

    (log,) = logs_of(Ar1Slip(rho=0.97, sigma=0.08), 1, 2)
    fit = rtd.fit_process(log, "ar1")
    rho, sigma = fit.process.rho, fit.process.sigma
    total = 0.0
    for wave in (wave for part in np.clip(log, 0.0, fit.process.max_slip) for wave in part.T):
        for x, y in zip(wave[:-1], wave[1:], strict=True):
            if 1e-5 < y < fit.process.max_slip - 1e-5:
                total += math.log(density(y, rho * x, sigma))
            else:
                beyond = (0.0 - rho * x) if y < 0.1 else (rho * x - fit.process.max_slip)
                total += math.log(0.5 * math.erfc(-beyond / sigma / math.sqrt(2.0)))
    assert fit.log_likelihood == pytest.approx(total)


def test_a_fit_disturbs_the_elements_that_the_recording_disturbs(tmp_path):
    steps = np.random.default_rng(0).normal(size=400)
    log = 0.3 * np.convolve(steps, 0.9 ** np.arange(40), "same")
    recorded = rtd.Recorded(log, elements=(1,))
    fit = rtd.fit_process(recorded, "ornstein-uhlenbeck")
    assert fit.process.elements == (1,) and fit.notes == ()
    fit.plot(tmp_path / "fit.png")  # of the one column, which belongs to element 1
    (note,) = rtd.fit_process(recorded, "noise").notes[-1:]
    assert note == "The recording disturbs the elements [1], but GaussianNoise disturbs all."
    assert rtd.fit_process(log, "ornstein-uhlenbeck").process.elements == ()


def test_summary_and_picture(tmp_path):
    (log,) = logs_of(Ar1Slip(), 1, 4)
    fit = rtd.fit_process(rtd.Recorded(log, channel="slip", bounds=(0.0, 1.0)), "ar1")
    text = fit.summary()
    rho, error = fit.estimates["rho"]
    assert f"{rho:.5g} ± {error:.2g}" in text and "4 recordings, 600 rows of 2" in text
    path = tmp_path / "fit.png"
    fit.plot(path)
    assert path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 10_000
    with pytest.raises(UserError, match="exists"):
        fit.plot(path)
    with pytest.raises(UserError, match=r"use a name that ends in .png"):
        fit.plot(tmp_path / "fit.xyz")
    env = Rover(RoverParams(slip=fit.process, max_steps_in_episode=20))
    assert rtd.evaluate(rtd.bayes_policy(env), env, 2).shape == (2,)


def test_what_the_picture_shows():
    process = rtd.OrnsteinUhlenbeck(sigma=0.7, time_constant=5.0, mean=3.0)
    waves = [wave for part in played(process, 300, 2, 100, 1) for wave in part.T]
    assert np.mean(waves) == pytest.approx(3.0, abs=0.05)
    expected = np.exp(-np.arange(10) / 5.0)
    np.testing.assert_allclose(autocorrelation(waves, 10), expected, atol=0.04)
    power = spectrum(waves, 300)
    # Half of a white spectrum's power lies in each half; a period of the whole is the variance.
    assert np.sum(power[1:-1]) / 300 == pytest.approx(0.49, rel=0.1)
    assert spectrum(waves, 301) is None
    slip = played(Ar1Slip(), 50, 2, 5, 0)
    assert slip.min() >= 0.0 and slip.max() <= 0.5 + 1e-6 and slip.std() > 0.01


@pytest.mark.parametrize(
    ("log", "kind", "arguments", "match"),
    [
        (np.zeros((5, 1)), "noise", {}, "too few to fit"),
        (np.ones((50, 2)), "noise", {}, "all values of the log are equal"),
        (np.arange(50.0), "arima", {}, "kind 'arima' must be one of"),
        (np.arange(50.0), "ar1", {}, "needs slip.*goes from 0 to 49"),
        (np.arange(50.0) / 100, "ar1", {"max_slip": 0.3}, "less than the largest slip"),
        (np.arange(50.0) / 100, "ar1", {"max_slip": 3}, "at most 1"),
        (np.arange(50.0), "noise", {"max_slip": 0.5}, "max_slip is a parameter of ar1 and sine"),
        (np.arange(50.0), "ornstein-uhlenbeck", {}, "is not stationary"),
        (np.tile([0.0, 1.0], 30), "ornstein-uhlenbeck", {}, "has no memory, or alternates"),
        (np.repeat([0.0, 0.5], 30), "ar1", {}, "nearly all slip in the log is at a bound"),
        (rtd.Recorded(np.arange(50.0)), "noise", {"columns": 1}, "for a log, not for a Recorded"),
        (rtd.Recorded(np.arange(50.0)), "noise", {"step": 1}, "pass both period= .*, or neither"),
        (
            rtd.Recorded(np.arange(50.0), period=0.1, step=0.05),
            "noise",
            {},
            "was interpolated when it was read, which biases a fit: read it without",
        ),
        (
            rtd.Recorded(np.arange(50.0), period=0.1, step=0.05).split(0.5)[0].replace(mirror=True),
            "noise",
            {},
            "was interpolated when it was read",
        ),
        (
            rtd.Recorded(np.arange(50.0), period=0.1, step=0.2),
            "noise",
            {"period": 0.1, "step": 0.2},
            "is for a log, not for a Recorded",
        ),
        ([np.arange(6.0) / 10] * 5, "sine", {}, "no recording has 8 rows"),
        (np.full(50, np.nan), "noise", {}, "has no row with a number in every column"),
    ],
)
def test_what_cannot_be_fitted_is_one_line(log, kind, arguments, match):
    with pytest.raises(UserError, match=match) as raised:
        rtd.fit_process(log, kind, **arguments)
    assert "\n" not in str(raised.value)


def test_at_its_bound_rho_has_no_error_and_sigma_has_its_own():
    """Slip that drifts upwards: the likelihood of rho still rises at one."""
    steps = np.random.default_rng(0).normal(0.003, 0.003, (10, 150, 1))
    fit = rtd.fit_process(list(np.clip(0.1 + np.cumsum(steps, axis=1), 0, 1)), "ar1")
    assert fit.estimates["rho"].value == 1 and np.isnan(fit.estimates["rho"].standard_error)
    sigma, error = fit.estimates["sigma"]
    assert error == pytest.approx(sigma / np.sqrt(2 * 10 * 149), rel=0.05)


def test_what_waves_leave_out_is_said_and_aic_counts_what_the_others_count(tmp_path):
    chance = np.random.default_rng(0)
    wave = 0.25 + 0.2 * np.sin(np.arange(100) / 7)[:, None] + chance.normal(0, 0.01, (100, 1))
    short = [chance.uniform(0, 0.5, (7, 1)) for _ in range(5)]
    fit = rtd.fit_process([wave, *short], "sine")
    assert "5 of 6 recordings of an element are shorter than 8 rows" in fit.summary()
    assert "26% of the values" in fit.summary()
    whole = rtd.fit_process([wave], "sine")
    assert not any("left out" in note for note in whole.notes)
    # 99 values with a previous value, as for ar1.
    expected = -0.5 * 99 * (np.log(2 * np.pi * whole.error**2) + 1)
    assert whole.log_likelihood == pytest.approx(expected)


def test_slip_of_more_than_two_elements_has_a_picture(tmp_path):
    log = np.random.default_rng(0).uniform(0, 0.5, (3, 40, 4))
    rtd.fit_process(list(log), "ar1").plot(tmp_path / "fit.png")
    assert (tmp_path / "fit.png").stat().st_size > 5_000


def test_noise_of_a_log_that_is_zero_after_its_first_value_is_refused():
    with pytest.raises(rtd.UserError, match="all values except the first are zero"):
        rtd.fit_process(np.array([1.0] + [0.0] * 20), "noise")


def test_slip_without_a_random_part_is_refused():
    with pytest.raises(rtd.UserError, match="ar1: the log has no random part"):
        rtd.fit_process([np.full((50, 1), 0.2), np.full((50, 1), 0.3)], "ar1")


RATES = {"period": 0.1, "step": 0.05}
"""Two steps of the environment for each row of the log."""


@pytest.mark.parametrize("rows", [0.5, 1.5, 3.0])
@pytest.mark.parametrize("kind", KNOWN)
def test_a_log_of_another_rate_gives_the_process_of_the_environment(kind, rows):
    """Interpolated rows would be smoother: twice the time constant, and less noise."""
    process, episodes, truth = KNOWN[kind]
    if kind == "ar1":  # never clipped, so that the conversion is exact
        process = Ar1Slip(rho=0.99, sigma=0.003, max_slip=1.0)
    log = logs_of(process, 1, 4 * episodes)[0]
    if kind == "ar1":
        log = log[(log.min(axis=(1, 2)) > 0.0)]
    fit = rtd.fit_process(log, kind, period=0.1, step=0.1 * rows)
    own = fit.process_of_rows or fit.process
    if kind == "ar1":
        decay = 0.99**rows
        sigma = 0.003 * math.sqrt((1.0 - decay**2) / (1.0 - 0.99**2))
        truth = {"rho": decay, "sigma": sigma}
        assert own.rho == pytest.approx(0.99, abs=0.003)
    if kind == "ornstein-uhlenbeck":
        truth = {**truth, "time_constant": 5.0 / rows, "coefficient": math.exp(-0.2 * rows)}
        assert own.time_constant == pytest.approx(5.0, rel=0.15)
    for name, true in truth.items():
        value, error = fit.estimates[name]
        assert abs(value - true) < 3.0 * error < 0.5 * abs(true)
        if name != "coefficient":
            assert getattr(fit.process, name) == value
    assert f"steps of {0.1 * rows:g} s" in fit.summary()
    recorded = rtd.Recorded(log, channel="slip" if kind == "ar1" else "observation")
    other = rtd.fit_process(recorded, kind, period=0.1, step=0.1 * rows)
    for name in truth:
        assert other.estimates[name].value == pytest.approx(fit.estimates[name].value, rel=1e-3)


def test_errors_of_converted_slip_are_those_of_many_logs():
    """The deviation of the estimates over the logs, with slip that is often clipped."""
    logs = logs_of(Ar1Slip(rho=0.9, sigma=0.08), 200, 3)
    fits = [rtd.fit_process(log, "ar1", **RATES) for log in logs]
    for name in ("rho", "sigma"):
        values, errors = np.array([fit.estimates[name] for fit in fits]).T
        assert np.mean(errors) == pytest.approx(values.std(), rel=0.15)
    assert np.mean([fit.process.rho for fit in fits]) == pytest.approx(0.9**0.5, abs=0.003)
    assert "approximate where slip is clipped" in fits[0].summary()


def test_waves_of_another_rate_have_the_periods_of_the_environment(tmp_path):
    time = np.arange(300)
    wave = (
        0.3
        + 0.1 * np.sin(2.0 * np.pi * time / 20)
        + 0.01 * np.random.default_rng(0).normal(size=300)
    )
    fit = rtd.fit_process(wave, "sine", max_slip=1.0, **RATES)
    assert fit.process.period_min == fit.process.period_max == 40
    assert fit.estimates["period"].value == pytest.approx(40.0, abs=0.2)
    assert fit.process_of_rows.period_min == 20
    fit.plot(tmp_path / "fit.png")
    slow = rtd.fit_process(wave, "sine", max_slip=1.0, period=0.1, step=1.5)
    assert slow.process.period_min == 1 and "they are aliased" in slow.summary()


def test_drifting_slip_is_converted_at_the_bound_of_rho():
    steps = np.random.default_rng(0).normal(0.003, 0.003, (10, 150, 1))
    log = list(np.clip(0.1 + np.cumsum(steps, axis=1), 0, 1))
    fit, fine = (rtd.fit_process(log, "ar1", **rates) for rates in ({}, RATES))
    assert fine.process.rho == 1.0
    assert fine.process.sigma == pytest.approx(fit.process.sigma * math.sqrt(0.5))


@pytest.mark.parametrize(("rows", "least"), [(30, 0.6), (200, 0.8), (400, 0.86)])
def test_short_logs_of_a_slow_bias(rows, least):
    """Without the correction, 28%, 70% and 80% of the intervals contain the time constant."""
    rng = np.random.default_rng(0)
    decay, logs = math.exp(-1.0 / 20.0), np.empty((300, rows))
    logs[:, 0] = rng.normal(size=300)
    for row in range(1, rows):
        logs[:, row] = decay * logs[:, row - 1] + math.sqrt(1 - decay**2) * rng.normal(size=300)
    fits = []
    for log in logs:
        try:
            fits.append(rtd.fit_process(log, "ornstein-uhlenbeck"))
        except UserError as error:
            assert "not stationary" in str(error)
    assert len(fits) > 280
    for name, share in shares(fits, {"time_constant": 20.0, "sigma": 1.0}).items():
        assert share > least, (name, share)
    narrow = np.mean(["intervals are too narrow" in fit.summary() for fit in fits])
    assert narrow > 0.9 if rows < 400 else narrow < 0.7
    limited = ["cannot tell its time constant" in fit.summary() for fit in fits]
    assert np.any(limited) == (rows < 400)


def test_the_amplitude_of_a_clipped_wave_does_not_depend_on_its_phase():
    time = np.arange(300)
    for phase in (0.0, 0.7, 1.5, 3.0):
        wave = np.clip(0.1 + 0.4 * np.sin(2.0 * np.pi * time / 50 + phase), 0.0, 0.2)
        fit = rtd.fit_process(wave, "sine", max_slip=0.2)
        assert fit.process.amplitude_max == pytest.approx(0.4, rel=1e-3)
        assert "that is tried" not in fit.summary()
    steep = np.clip(0.1 + 9.0 * np.sin(2.0 * np.pi * time / 50), 0.0, 0.2)
    assert (
        "1 of 1 waves have the largest amplitude or offset that is tried"
        in rtd.fit_process(steep, "sine").summary()
    )


@pytest.mark.parametrize(
    ("mean", "deviation", "differ"), [(0.0, 1.0, False), (3.0, 1.0, True), (0.0, 0.2, True)]
)
def test_elements_that_differ_too_much_are_said(mean, deviation, differ):
    log = np.random.default_rng(0).normal(size=(300, 2)) * [1.0, deviation] + [0.0, mean]
    notes = rtd.fit_process(log, "noise").notes
    assert any("The elements differ: means from" in note for note in notes) == differ
