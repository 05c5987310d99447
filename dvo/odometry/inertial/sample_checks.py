"""Checks of inertial samples by themselves: stamps, units, range, and noise where the sensor is at rest."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations, product

import numpy as np

from dvo.data.files.files import MAX_NUMBER
from dvo.data.inertial import InertialSamples
from dvo.data.inertial_files.tables import RATES, SLOW, turn_of_gravity
from dvo.data.inertial_files.tidy import GRAVITY_RANGE, STANDARD_GRAVITY
from dvo.odometry.inertial.findings import Finding, Found, Level
from dvo.odometry.inertial.temporal import MAX_GAP, integrate_gyro

Array = np.ndarray
MIN_RATE = (20.0, 90.0)
"""Samples a second below which samples are unusable, and below which motion of a hand is not resolved."""
SHORT = (5.0, 2.0)
"""Seconds of a recording below which that is told, and below which nothing can be aligned."""
MISSING = (0.01, 0.3)
"""Share of missing samples that is told, and that makes them unusable."""
GRAVITY_ERROR = (0.4, 2.0)
"""Deviation of the force at rest from gravity that is told, and that makes samples unusable, m/s^2."""
SPEED_CHANGE = 2.0
"""Usual change of the speed within a stretch that seems to be rest, as in a lift, m/s."""
GYRO_BIAS = (0.1, 0.35)
"""Bias of the gyroscope that is told, and that makes samples unusable, rad/s."""
FASTEST = 70.0
"""Median of the angular rate that no sensor measures, rad/s: 4000 degrees a second."""
NOISE_RATIO = (0.1, 3.0)
"""Measured over stated density that is told."""
REST = (0.012, 0.015)
"""Deviations of means over a tenth of a second within a second at rest: rad/s, and share of gravity."""
_BLOCK = 0.1  # seconds of a mean
_MIN_REST = 2.0  # seconds at rest from which noise is measured
_REPEATED = 0.2  # share of samples that repeat the one before
_BURST = 5.0  # mean over median interval from which samples come in bursts
_CONSTANT = 20  # samples of which an axis should not be the same
_BOTH_ENDS = 1e-3  # relative difference of the plateaus of an axis that is clipped at both ends
_TURN, _MEAN, _STRETCH = 2.0, 1.0, 5  # (m/s^2)^2; seconds of a mean of the force; means that are compared
_ABOUT_TWO = 0.05  # rad/s, deviation of the rates about a second axis
_LONGEST = 120.0  # seconds that are compared
_BETTER = 0.2  # share of the variance of gravity that other axes must leave
_NEAR_AXES = 20.0  # degrees from a permutation of axes within which it is named
SIGNED_AXES = [
    np.eye(3)[list(order)] * np.array(signs)[:, None]
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
]
"""The 48 ways to swap and mirror axes."""
_FACTORS = {"g": STANDARD_GRAVITY, "mg": STANDARD_GRAVITY / 1000}


def check_stamps(samples: InertialSamples) -> tuple[InertialSamples, Found]:
    """Check the times of samples.

    Args:
        samples: in the order of the file; times may repeat and need not increase.

    Returns:
        The samples in order, the first of each time, without those that are not finite; and what was found.
    """
    times, findings = samples.timestamps, []
    finite = np.isfinite(times) & (np.abs(np.hstack([samples.gyro, samples.accel])) <= MAX_NUMBER).all(1)
    if not finite.all():
        text = f"{int((~finite).sum())} of {len(times)} samples have numbers that are not finite"
        findings.append(Finding("not finite", Level.WARNING, text, "remove these rows"))
    times = times[finite]
    back = int((np.diff(times) < 0).sum())
    if back:
        text = f"time goes back {back} times"
        findings.append(Finding("unordered stamps", Level.WARNING, text, "sort the samples by their time"))
    ordered, first = np.unique(times, return_index=True)
    repeated = len(times) - len(ordered)
    if repeated:
        text = f"{repeated} of {len(times)} samples have the stamp of another one"
        remedy = "remove repeated rows, or write stamps with more digits"
        level = Level.UNUSABLE if repeated > 0.5 * len(times) else Level.WARNING
        findings.append(Finding("duplicate stamps", level, text, remedy))
    tidy = replace(
        samples, timestamps=ordered, gyro=samples.gyro[finite][first], accel=samples.accel[finite][first]
    )  # fmt: skip
    values = {"samples": len(samples), "duplicate stamps": repeated, "unordered stamps": back}
    if len(ordered) < 3:
        text = f"{len(ordered)} sample{'s' * (len(ordered) != 1)} at different times"
        findings.append(Finding("too few samples", Level.UNUSABLE, text, "record for longer"))
        return tidy, Found(values, tuple(findings))
    more = _rhythm(ordered)
    return tidy, Found({**values, **more.values}, (*findings, *more.findings))


def _rhythm(times: Array) -> Found:
    """Rate, missing samples and gaps of increasing times."""
    steps = np.diff(times)
    spacing, duration = float(np.median(steps)), float(times[-1] - times[0])
    findings = []
    if duration < SHORT[0]:
        level = Level.UNUSABLE if duration < SHORT[1] else Level.WARNING
        findings.append(Finding("short recording", level, f"{duration:.3g} s", "record for thirty seconds"))
    mean = float(np.minimum(steps, np.quantile(steps, 0.99)).mean())  # but for gaps
    if mean > _BURST * spacing:
        bursts = int((steps > _BURST * spacing).sum()) + 1
        text = f"{len(times) / bursts:.3g} samples at a time, {1 / mean:.3g} a second in the mean"
        remedy = "write the stamps of the sensor, not those of arrival"
        findings.append(Finding("bursts", Level.UNUSABLE, text, remedy))
        values = {"rate, Hz": 1 / mean, "duration, s": duration, "longest gap, s": float(steps.max())}
        return Found(values, tuple(findings))
    lost = np.where(steps > 1.6 * spacing, np.round(steps / spacing) - 1, 0)
    share = float(lost.sum() / (lost.sum() + len(times)))
    gaps = steps[steps > max(MAX_GAP, 3 * spacing)]
    uneven = float(np.mean(np.abs(steps - spacing) > 0.5 * spacing))
    values = {
        "rate, Hz": 1 / spacing, "duration, s": duration, "missing share": share,
        "gaps": len(gaps), "longest gap, s": float(steps.max()),
    }  # fmt: skip
    if 1 / spacing < MIN_RATE[1]:
        level = Level.UNUSABLE if 1 / spacing < MIN_RATE[0] else Level.WARNING
        remedy = "record at 100 to 400 Hz" + (", and check the unit of the times" if 1 / spacing < SLOW else "")
        findings.append(Finding("low rate", level, f"{1 / spacing:.3g} samples a second", remedy))
    if 1 / spacing > RATES[1]:
        text, remedy = f"{1 / spacing:.4g} samples a second", "check the unit of the times"
        findings.append(Finding("high rate", Level.UNUSABLE, text, remedy))
    if share > MISSING[0]:
        level = Level.UNUSABLE if share > MISSING[1] else Level.WARNING
        text = f"{100 * share:.3g} % of the samples are not there, at {1 / spacing:.4g} Hz"
        findings.append(Finding("missing samples", level, text, "write to a faster disk, or at a lower rate"))
    if len(gaps):
        text = f"{len(gaps)} gaps of {gaps.min():.3g} to {gaps.max():.3g} s, {gaps.sum():.3g} s together"
        remedy = "record again, or leave out these stretches"
        findings.append(Finding("gaps", Level.WARNING, text, remedy))
    if uneven > 0.5:
        text = f"{100 * uneven:.0f} % of the intervals differ from their median by more than half"
        remedy = "write the stamps of the sensor, not those of arrival"
        findings.append(Finding("uneven stamps", Level.WARNING, text, remedy))
    return Found(values, tuple(findings))


def check_values(samples: InertialSamples) -> tuple[InertialSamples, Found]:
    """Check units, range, and what stands still tells.

    Args:
        samples: with increasing times.

    Returns:
        The samples in rad/s and m/s^2, if they are in other units that can be told; and what was found.
    """
    samples, units = _in_units(samples)
    parts = [units, _range(samples), _at_rest(samples)]
    values = {name: value for part in parts for name, value in part.values.items()}
    return samples, Found(values, tuple(finding for part in parts for finding in part.findings))


def _in_units(samples: InertialSamples) -> tuple[InertialSamples, Found]:
    size = float(np.median(np.linalg.norm(samples.accel, axis=1)))
    findings, values = [], {"median of accelerometer, m/s^2": size}
    unit = next((name for name, factor in _FACTORS.items() if 0.8 < size * factor / STANDARD_GRAVITY < 1.25), None)
    if unit is not None:
        samples = replace(samples, accel=samples.accel * _FACTORS[unit])
        text = f"the accelerometer is in {unit}: its median is {size:.4g}"
        remedy = f"multiply by {_FACTORS[unit]:.6g}, or name the unit in the header"
        findings.append(Finding("accelerometer unit", Level.UNUSABLE, text, remedy))
    elif size < 0.4 * STANDARD_GRAVITY:
        text = f"gravity is not in the accelerometer: its median is {size:.3g} m/s^2"
        remedy = "record the accelerometer with gravity, not the linear acceleration"
        findings.append(Finding("no gravity", Level.UNUSABLE, text, remedy))
    elif not GRAVITY_RANGE[0] <= size <= GRAVITY_RANGE[1]:
        text = f"the median of the accelerometer is {size:.4g} m/s^2, not about {STANDARD_GRAVITY:.3g}"
        findings.append(Finding("accelerometer unit", Level.UNUSABLE, text, "give it in m/s^2, with gravity"))
    times = samples.timestamps
    ratio = turn_of_gravity(times, samples.gyro, times, samples.accel)
    if ratio is not None:
        values["turn of gravity over gyroscope"] = ratio
    if ratio is not None and 0.5 < np.rad2deg(ratio) < 2:
        samples, finding = in_radians(samples, f"gravity turns {1 / ratio:.3g} times slower than it says")
        findings.append(finding)
    rate = float(np.median(np.linalg.norm(samples.gyro, axis=1)))
    if rate > FASTEST and not any(finding.name == "gyroscope unit" for finding in findings):
        text = f"the median of the gyroscope is {rate:.4g} rad/s, which no sensor measures"
        findings.append(Finding("gyroscope unit", Level.UNUSABLE, text, "give it in rad/s; counts are no unit"))
    return samples, Found(values, tuple(findings))


def in_radians(samples: InertialSamples, why: str) -> tuple[InertialSamples, Finding]:
    """Samples of a gyroscope in degrees/s, and the finding.

    Args:
        samples: gyroscope in degrees/s.
        why: how it is known.
    """
    text, remedy = f"the gyroscope is in deg/s: {why}", "multiply by 0.0174533, or name the unit in the header"
    return replace(samples, gyro=np.radians(samples.gyro)), Finding("gyroscope unit", Level.UNUSABLE, text, remedy)


def _range(samples: InertialSamples) -> Found:
    """Clipped plateaus, and values that stay the same."""
    findings = []
    sensors = (("gyroscope", samples.gyro, 2.0, "rad/s"), ("accelerometer", samples.accel, 15.0, "m/s^2"))
    for name, rows, least, unit in sensors:
        clipped, bound = 0, 0.0
        for axis in rows.T:
            ends = [_plateau(values) for values in (axis, -axis)]
            tops = [end[0] for end in ends]
            both = all(count for _, count in ends) and abs(tops[0] - tops[1]) <= _BOTH_ENDS * max(tops)
            for top, count in ends:
                if top > least and count and (both or top > 3 * float(np.median(np.abs(axis)))):
                    clipped, bound = clipped + count, max(bound, top)
        if clipped:
            text = f"{clipped} samples of the {name} stand at {bound:.4g} {unit}"
            remedy = "set a larger range of the sensor, or move less violently"
            findings.append(Finding("saturation", Level.WARNING, text, remedy))
        same = np.diff(rows, axis=0) == 0
        share = float(same.all(1).mean())
        if share > _REPEATED:
            text = f"{100 * share:.0f} % of the samples of the {name} repeat the one before"
            remedy = "record at the rate of the sensor: samples are held, or it stands still in a stuck driver"
            if share == 1:
                text = f"the {name} is {', '.join(f'{value:.4g}' for value in rows[0])} {unit} in all samples"
                remedy = "check that the sensor is on, and its columns"
            level = Level.UNUSABLE if share > 0.95 else Level.WARNING
            findings.append(Finding("repeated samples", level, text, remedy))
        elif len(rows) > _CONSTANT:
            for axis in np.flatnonzero(same.all(0)):
                text = f"{'xyz'[axis]} of the {name} is {rows[0, axis]:.4g} {unit} in all samples"
                remedy = "check the sensor and its columns; a simulation may move like this"
                findings.append(Finding("constant axis", Level.WARNING, text, remedy))
    return Found({}, tuple(findings))


def _plateau(values: Array) -> tuple[float, int]:
    """Largest value, and how many samples stand at it for a while."""
    top = float(values.max())
    at = np.flatnonzero(values >= top - 1e-6 * abs(top))
    runs = [len(run) for run in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1) if len(run) >= 3]
    # one short run may be a slow turning point between steps of the converter
    return top, sum(runs) if len(runs) > 1 or max(runs, default=0) >= 10 else 0


def check_axes(samples: InertialSamples) -> Finding | None:
    """Check that gravity turns in the accelerometer as the gyroscope says, without a camera.

    The force is turned by the gyroscope from a second to the next for some seconds, with the 48 ways to swap and mirror
    the axes of the gyroscope; with the right ones its means are the same, but for changes of the velocity.

    Args:
        samples: with increasing times, in rad/s and m/s^2.

    Returns:
        A finding if the axes of the sensors differ, or are left-handed; None where the motion does not tell.
    """
    part = samples.between(-np.inf, float(samples.timestamps[0]) + _LONGEST)
    times = part.timestamps
    number = ((times - times[0]) / _MEAN).astype(int)
    blocks = int(number[-1]) // _STRETCH * _STRETCH  # whole ones
    counts = np.bincount(number, minlength=blocks)[:blocks]
    if blocks < 2 * _STRETCH or counts.min() < 5 or np.linalg.eigvalsh(np.cov(part.gyro.T))[1] < _ABOUT_TWO**2:
        return None  # an arm that swings about one axis turns forces like gravity
    products = []
    for gyro in (part.gyro, -part.gyro):
        turns = integrate_gyro(times, gyro, np.zeros(3)).rotations
        each = (turns[..., None] * part.accel[:, None, None]).reshape(-1, 27)
        sums = np.stack([np.bincount(number, column, blocks)[:blocks] for column in each.T], 1)
        products.append((sums / counts[:, None]).reshape(-1, 3, 3, 3))
    spread, sizes = [], []
    for option in SIGNED_AXES:
        is_mirrored = bool(np.linalg.det(option) < 0)
        rotation = -option if is_mirrored else option
        force = np.einsum("ai,bijk,kj->ba", rotation, products[is_mirrored], rotation)
        force = force.reshape(-1, _STRETCH, 3)
        spread.append(float(force.var(1).sum(1).mean()))
        sizes.append(float(np.median(np.linalg.norm(force.mean(1), axis=1))))
    same = spread[next(k for k, option in enumerate(SIGNED_AXES) if np.array_equal(option, np.eye(3)))]
    least = int(np.argmin(spread))
    best, is_gravity = SIGNED_AXES[least], abs(sizes[least] - STANDARD_GRAVITY) < 0.1 * STANDARD_GRAVITY
    if same < _TURN or spread[least] > _BETTER * same or not is_gravity:
        return None
    named = named_axes(best)
    if np.linalg.det(best) > 0:
        text = f"gravity turns as the gyroscope taken as {named} says: the axes of the sensors differ"
        remedy = f"give the accelerometer as {named_axes(best.T)}, or with the other signs if that reads -9.8 upwards"
    else:
        text = f"gravity turns as the gyroscope taken as {named} says: a sign is wrong, or axes are left-handed"
        remedy = f"give the gyroscope as {named}; of left-handed axes, change the sign of one of both sensors"
    return Finding("accelerometer axes", Level.UNUSABLE, text, remedy)


def named_axes(matrix: Array) -> str | None:
    """Order and signs of axes that a nearly signed permutation means, such as ``(y, x, -z)``.

    Args:
        matrix: ``(3, 3)`` orthogonal.

    Returns:
        None if it is not near one, or changes nothing.
    """
    best = max(SIGNED_AXES, key=lambda option: float((option * matrix).sum()))
    turn = matrix @ best.T
    cosine = (np.trace(turn) - 1) / 2
    if cosine < np.cos(np.radians(_NEAR_AXES)) or np.array_equal(best, np.eye(3)):
        return None
    parts = []
    for row in best:
        axis = int(np.argmax(np.abs(row)))
        parts.append(("-" if row[axis] < 0 else "") + "xyz"[axis])
    return f"({', '.join(parts)})"


def still_stretches(samples: InertialSamples) -> list[slice]:
    """Stretches of at least a second in which the sensor rests.

    Args:
        samples: with increasing times, rad/s; the accelerometer in any unit.
    """
    rate = samples.rate
    block, count = max(1, round(_BLOCK * rate)), len(samples)
    blocks = count // block
    if blocks < 10:
        return []
    scale = np.array([*[REST[0]] * 3, *[REST[1] * np.median(np.linalg.norm(samples.accel, axis=1))] * 3])
    rows = np.hstack([samples.gyro, samples.accel])[: blocks * block] / np.maximum(scale, 1e-12)
    means = rows.reshape(blocks, block, 6).mean(1)
    windows = np.lib.stride_tricks.sliding_window_view(means, 10, axis=0)
    is_still = np.zeros(blocks, bool)
    for start in np.flatnonzero((windows.std(-1) < 1).all(-1)):
        is_still[start : start + 10] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[0], is_still.astype(int), [0]])))
    return [slice(int(a) * block, int(b) * block) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _at_rest(samples: InertialSamples) -> Found:
    """Gravity, biases and noise of still stretches."""
    parts = still_stretches(samples)
    seconds = sum(part.stop - part.start for part in parts) / samples.rate
    values: dict[str, object] = {"at rest, s": seconds}
    findings = []
    if seconds >= 1:
        gyro = np.median(np.concatenate([samples.gyro[part] for part in parts]), 0)
        force, sure = _gravity(samples, parts)
        values |= {"gyroscope at rest, rad/s": gyro.tolist(), "gravity at rest, m/s^2": force}
        is_told = abs(force - STANDARD_GRAVITY) > sure
        findings += [finding for finding in (gyro_bias(gyro, "at rest"),) if finding]
        findings += [finding for finding in (gravity_error(force, "at rest"),) if finding and is_told]
    if seconds < _MIN_REST:
        text = f"at rest for {seconds:.2g} s only: noise and bias are not measured"
        remedy = "lay the device down for five seconds at the start"
        return Found(values, (*findings, Finding("no rest", Level.NOTE, text, remedy)))
    densities = [_density(samples, name, parts) for name in ("gyro", "accel")]
    values |= {"gyro noise, rad/s/sqrt(Hz)": densities[0], "accel noise, m/s^2/sqrt(Hz)": densities[1]}
    if samples.noise is not None:
        stated = (samples.noise.gyro, samples.noise.accel)
        ratios = [d / s for d, s in zip(densities, stated, strict=True) if d is not None and s > 0]
        if ratios and max(ratios) > NOISE_RATIO[1]:
            text = f"at rest the noise is {max(ratios):.3g} times the stated one"
            remedy = f"state noise_factor: {max(ratios):.2g}, or a preset such as phone"
            findings.append(Finding("noise", Level.WARNING, text, remedy))
        elif ratios and max(ratios) < NOISE_RATIO[0]:
            text = f"at rest the noise is {max(ratios):.2g} times the stated one"
            findings.append(Finding("noise", Level.NOTE, text, "state smaller densities, if motion is slow"))
    return Found(values, tuple(findings))


def _gravity(samples: InertialSamples, parts: list[slice]) -> tuple[float, float]:
    """Size of the force at rest, by means over a second, as a sensor may turn slowly; and how much an acceleration
    that is as steady as rest can change it: over the longest stretch it is a change of speed."""
    second = 10 * max(1, round(_BLOCK * samples.rate))  # no stretch is shorter
    sizes, longest = [], 0.0
    for part in parts:
        means = [samples.accel[k : k + second].mean(0) for k in range(part.start, part.stop - second + 1, second)]
        sizes += [float(np.linalg.norm(mean)) for mean in means]
        longest = max(longest, (part.stop - part.start) / samples.rate)
    return float(np.median(sizes)), SPEED_CHANGE / longest


def gyro_bias(bias: Array, where: str) -> Finding | None:
    """Finding about a bias of the gyroscope.

    Args:
        bias: ``(3,)`` rad/s.
        where: how it was measured.

    Returns:
        None if it is small.
    """
    size = float(np.linalg.norm(bias))
    if size <= GYRO_BIAS[0]:
        return None
    text = f"{size:.3g} rad/s ({np.degrees(size):.3g} deg/s) {where}, as of a sensor that was dropped"
    remedy = f"calibrate the sensor at rest, or subtract {np.array2string(bias, precision=4, separator=', ')}"
    return Finding("gyroscope bias", Level.UNUSABLE if size > GYRO_BIAS[1] else Level.WARNING, text, remedy)


def gravity_error(force: float, where: str) -> Finding | None:
    """Finding about the size of gravity.

    Args:
        force: m/s^2.
        where: how it was measured.

    Returns:
        None if it is near gravity.
    """
    error = abs(force - STANDARD_GRAVITY)
    if error <= GRAVITY_ERROR[0]:
        return None
    level = Level.UNUSABLE if error > GRAVITY_ERROR[1] else Level.WARNING
    text = f"the force {where} is {force:.4g} m/s^2: the bias or the scale of the accelerometer is wrong"
    return Finding("accelerometer bias", level, text, "calibrate the accelerometer in six positions")


def _density(samples: InertialSamples, name: str, parts: list[slice]) -> float | None:
    """White noise by the Allan deviation over a tenth of a second, times its root; the median of the differences, as a
    stretch may begin and end with motion."""
    block = max(1, round(_BLOCK * samples.rate))
    steps = []
    for part in parts:
        rows = getattr(samples, name)[part]
        means = rows[: len(rows) // block * block].reshape(-1, block, 3).mean(1)
        steps += [np.abs(np.diff(means, axis=0)).ravel()]
    deviation = float(np.median(np.concatenate(steps))) / 0.6745 / np.sqrt(2) if steps else 0.0
    return float(deviation * np.sqrt(block / samples.rate)) if deviation > 0 else None
