"""A motor with all effects of the library and others outside it, and its own integrator.

    L(i) di/dt    = u - R (1 + x1 + x2) i - e(theta) Kb w - brush(i)
    J_m dw/dt     = Kt(i, theta) i - f w - drag - cogging(theta) - friction(w, t) - coupling
    J_l dw_l/dt   = coupling - T_load                        J_m + J_l = J; rigid unless asked for
    tau dx/dt     = rise P - x,  P the copper loss           relative rise of resistance
    lag dy/dt     = w - y,  speed read at t_k is y(t_k - delay)

Integration is RK4 in 20 or more fine steps per sample. Dry friction and the brush drop are
set-valued: at zero speed (zero current) they take the value within their level that keeps it
there, and the times of entering or leaving that state are found by bisection. Row k of a record is the
state at t_k, before the voltage of row k acts; that voltage is held until t_(k+1). SI throughout.

Nothing here is taken from pmdc_jax; the formulas are those of the textbooks: B. Armstrong-Helouvry
et al., Automatica 30 (1994) 1083 (Stribeck); C. Canudas de Wit et al., IEEE TAC 40 (1995) 419
(LuGre); M. Nordin and P.-O. Gutman, Automatica 38 (2002) 1633 (backlash); A. Hughes and B. Drury,
"Electric Motors and Drives" (brushes, saturation, cogging, heating).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

# without the GIL, so that runs can be simulated in parallel; checked divisions would be slow
compiled = njit(cache=True, nogil=True, error_model="numpy")
Samples = NDArray[np.float64]


class Plant(NamedTuple):
    """All constants of one motor in one run; an effect whose amplitude is 0 is absent."""

    R: float
    L: float
    Kb: float
    Kt: float
    J: float
    f: float
    # dry friction: level + excess g(w / speed), with g falling from 1 at rest to 0
    friction_forward_Nm: float = 0.0
    friction_backward_Nm: float = 0.0
    friction_excess_Nm: float = 0.0
    stribeck_speed_rad_s: float = 1.0
    stribeck_shape: float = 2.0  # g = exp(-|w/speed|^shape); 0 is 1 / (1 + (w/speed)^2)
    presliding_rad: float = 0.0  # LuGre bristles of that deflection; 0: set-valued
    bristle_damping: float = 0.0
    drag: float = 0.0  # drag |w|^exponent
    drag_exponent: float = 2.0
    cogging_Nm: float = 0.0
    cogging_periods: float = 1.0
    cogging_phase: float = 0.0
    cogging_second: float = 0.0  # amplitude at twice the periods, relative
    cogging_second_phase: float = 0.0
    ripple: float = 0.0
    ripple_periods: float = 1.0
    ripple_phase: float = 0.0
    ripple_in_emf: float = 0.0
    load_Nm: float = 0.0
    # flexible or loose coupling: torque on the load; stiffness 0 is rigid
    stiffness: float = 0.0
    damping: float = 0.0
    load_share: float = 0.0
    gap_rad: float = 0.0  # total backlash
    brush_V: float = 0.0
    brush_onset_A: float = 0.0  # brush_V tanh(i / onset); 0: set-valued
    heat_per_W: float = 0.0
    heat_s: float = 1.0
    slow_heat_per_W: float = 0.0
    slow_heat_s: float = 1.0
    kt_saturation: float = 0.0  # c of 1 / (1 + c i^2), 1 / A^2
    kt_curve: float = 0.0  # 0 that; 1: tanh(s i) / (s i), 2: 1 / (1 + s |i|) with s = sqrt(c)
    l_saturation: float = 0.0
    l_curve: float = 0.0
    dead_zone_V: float = 0.0  # half width: u = 0 for |v| below it
    lag_s: float = 0.0
    delay_s: float = 0.0
    offset_A: float = 0.0
    # outside the library
    shake_Nm: float = 0.0  # external torque, periodic in time
    shake_Hz: float = 1.0
    shake_phase: float = 0.0
    bump_Nm: float = 0.0  # friction at one speed
    bump_speed_rad_s: float = 1.0
    bump_width_rad_s: float = 1.0
    seizing_Nm: float = 0.0  # dry friction from this time on
    seizing_from_s: float = 0.0
    eccentric_Nm: float = 0.0  # weight on an arm behind a gear
    eccentric_gear: float = 1.0
    eccentric_phase: float = 0.0
    sag_ohm: float = 0.0  # the recorded voltage is the duty cycle times the nominal bus, which drops under current
    sag_s: float = 1.0
    bus_V: float = 24.0
    pwm_Hz: float = 0.0  # centred pulses of the bus; 0: ideal amplifier


# a record is passed to compiled functions by reference, a tuple of this length by copying
PACKED = np.dtype([(name, np.float64) for name in Plant._fields])

# the states
CURRENT, SPEED, ANGLE, LOAD_SPEED, TWIST, HEAT, SLOW_HEAT, BRISTLE, READ, SAG = range(10)
STATES = 10


# ------------------------------------------------------------------------------------ the formulas


@compiled
def _stribeck(w, p):
    """g of dry friction: 1 at rest, 0 far above the Stribeck speed."""
    ratio = abs(w / p.stribeck_speed_rad_s)
    if p.stribeck_shape == 0.0:
        return 1.0 / (1.0 + ratio * ratio)
    return math.exp(-(ratio**p.stribeck_shape))


@compiled
def _dry_level(w, direction, t, p):
    """Magnitude of dry friction in a direction (N m)."""
    level = p.friction_forward_Nm if direction > 0 else p.friction_backward_Nm
    if p.friction_excess_Nm != 0.0:
        level += p.friction_excess_Nm * _stribeck(w, p)
    if p.seizing_Nm != 0.0 and t >= p.seizing_from_s:
        level += p.seizing_Nm
    return level


@compiled
def _sticks(p):
    return p.presliding_rad == 0.0 and (
        p.friction_forward_Nm + p.friction_backward_Nm + p.friction_excess_Nm + p.seizing_Nm > 0.0
    )


@compiled
def _saturated(c, curve, i):
    """Relative decrease of a constant with current: three curves, the same size at c i^2 ~ 1."""
    if c == 0.0:
        return 1.0
    if curve == 0.0:
        return 1.0 / (1.0 + c * i * i)
    s = math.sqrt(c) * abs(i) + 1e-12
    return math.tanh(s) / s if curve == 1.0 else 1.0 / (1.0 + s)


@compiled
def _ripple(angle, p):
    if p.ripple == 0.0:
        return 1.0
    return 1.0 + p.ripple * math.sin(p.ripple_periods * angle + p.ripple_phase)


@compiled
def _coupling(x, p):
    """Torque through a spring with play; teeth push and do not pull."""
    slip = x[SPEED] - x[LOAD_SPEED]
    if p.gap_rad == 0.0:
        return p.stiffness * x[TWIST] + p.damping * slip
    beyond = abs(x[TWIST]) - 0.5 * p.gap_rad
    if beyond <= 0.0:
        return 0.0
    side = 1.0 if x[TWIST] > 0.0 else -1.0
    return side * max(0.0, p.stiffness * beyond + p.damping * slip * side)


@compiled
def _load_torque(x, t, load, p):
    """Torque of all external loads (N m); `load` is held."""
    torque = load + p.load_Nm
    if p.shake_Nm != 0.0:
        torque += p.shake_Nm * math.sin(2.0 * math.pi * p.shake_Hz * t + p.shake_phase)
    if p.eccentric_Nm != 0.0:
        torque += p.eccentric_Nm * math.sin(x[ANGLE] / p.eccentric_gear + p.eccentric_phase)
    return torque


@compiled
def _drive(x, t, load, disturbance, p):
    """All torque on the rotor but dry friction (N m)."""
    i, w, angle = x[CURRENT], x[SPEED], x[ANGLE]
    torque = p.Kt * _saturated(p.kt_saturation, p.kt_curve, i) * _ripple(angle, p) * i
    torque -= p.f * w + disturbance
    if p.drag != 0.0:
        torque -= math.copysign(p.drag * abs(w) ** p.drag_exponent, w)
    if p.cogging_Nm != 0.0:
        a = p.cogging_periods * angle
        cogging = math.sin(a + p.cogging_phase)
        cogging += p.cogging_second * math.sin(2.0 * a + p.cogging_second_phase)
        torque -= p.cogging_Nm * cogging
    if p.bump_Nm != 0.0:
        off = (abs(w) - p.bump_speed_rad_s) / p.bump_width_rad_s
        torque -= math.copysign(p.bump_Nm * math.exp(-off * off), w)
    if p.stiffness != 0.0:
        return torque - _coupling(x, p)
    return torque - _load_torque(x, t, load, p)


@compiled
def _electric(x, v, p):
    """Voltage left for the winding's own drops: supply less back-EMF (V)."""
    emf = p.Kb * x[SPEED]
    if p.ripple_in_emf != 0.0:
        emf *= _ripple(x[ANGLE], p)
    return v - x[SAG] * v / p.bus_V - emf


@compiled
def _slope(x, t, v, load, disturbance, mode_i, mode_w, p, dx):
    """Time derivative of the state; a mode is the direction of a dry element, 0 held at zero."""
    i, w = x[CURRENT], x[SPEED]
    R = p.R * (1.0 + x[HEAT] + x[SLOW_HEAT])
    dx[CURRENT] = 0.0
    if mode_i != 0:
        brush = p.brush_V * (mode_i if p.brush_onset_A == 0.0 else math.tanh(i / p.brush_onset_A))
        L = p.L * _saturated(p.l_saturation, p.l_curve, i)
        dx[CURRENT] = (_electric(x, v, p) - R * i - brush) / L
    dx[BRISTLE] = 0.0
    dx[SPEED] = 0.0
    if mode_w != 0:
        torque = _drive(x, t, load, disturbance, p)
        if p.presliding_rad != 0.0:
            level = _dry_level(w, w, t, p)
            dx[BRISTLE] = w - abs(w) * x[BRISTLE] / p.presliding_rad
            torque -= level * x[BRISTLE] / p.presliding_rad + p.bristle_damping * dx[BRISTLE]
        elif _sticks(p):
            torque -= mode_w * _dry_level(w, mode_w, t, p)
        dx[SPEED] = torque / (p.J * (1.0 - p.load_share))
    dx[ANGLE] = w
    dx[LOAD_SPEED] = 0.0
    dx[TWIST] = 0.0
    if p.stiffness != 0.0:
        push = _coupling(x, p) - _load_torque(x, t, load, p)
        dx[LOAD_SPEED] = push / (p.J * p.load_share)
        dx[TWIST] = w - x[LOAD_SPEED]
    heat = R * i * i
    dx[HEAT] = (p.heat_per_W * heat - x[HEAT]) / p.heat_s
    dx[SLOW_HEAT] = (p.slow_heat_per_W * heat - x[SLOW_HEAT]) / p.slow_heat_s
    dx[READ] = (w - x[READ]) / p.lag_s if p.lag_s != 0.0 else 0.0
    dx[SAG] = (p.sag_ohm * i * v / p.bus_V - x[SAG]) / p.sag_s


# ------------------------------------------------------------------------- fine-step integration


@compiled
def _rk4(x, t, h, v, load, disturbance, mode_i, mode_w, p, work, out):
    """One classical Runge-Kutta step in fixed modes, from x to out."""
    a, b, c, d, y = work[0], work[1], work[2], work[3], work[4]
    g = 0.5 * h
    _slope(x, t, v, load, disturbance, mode_i, mode_w, p, a)
    for n in range(STATES):
        y[n] = x[n] + g * a[n]
    _slope(y, t + g, v, load, disturbance, mode_i, mode_w, p, b)
    for n in range(STATES):
        y[n] = x[n] + g * b[n]
    _slope(y, t + g, v, load, disturbance, mode_i, mode_w, p, c)
    for n in range(STATES):
        y[n] = x[n] + h * c[n]
    _slope(y, t + h, v, load, disturbance, mode_i, mode_w, p, d)
    for n in range(STATES):
        out[n] = x[n] + h / 6.0 * (a[n] + 2.0 * (b[n] + c[n]) + d[n])
    if p.lag_s == 0.0:
        out[READ] = out[SPEED]


@compiled
def _brush_leaves(x, v, mode, p):
    """Whether the current has crossed zero, or the voltage has overcome the brushes."""
    if p.brush_V == 0.0 or p.brush_onset_A != 0.0:
        return False
    return abs(_electric(x, v, p)) > p.brush_V if mode == 0 else x[CURRENT] * mode < 0.0


@compiled
def _rotor_leaves(x, t, load, disturbance, mode, p):
    """Whether the speed has crossed zero, or the driving torque has overcome static friction."""
    if not _sticks(p):
        return False
    if mode != 0:
        return x[SPEED] * mode < 0.0
    drive = _drive(x, t, load, disturbance, p)
    return abs(drive) > _dry_level(0.0, drive, t, p)


@compiled
def _settle(x, t, v, load, disturbance, mode_i, mode_w, p):
    """Modes just after an event; a state that crossed zero is set to zero."""
    if _brush_leaves(x, v, mode_i, p):
        x[CURRENT] = 0.0
        push = _electric(x, v, p)
        mode_i = 0 if abs(push) <= p.brush_V else (1 if push > 0.0 else -1)
    if _rotor_leaves(x, t, load, disturbance, mode_w, p):
        x[SPEED] = 0.0
        drive = _drive(x, t, load, disturbance, p)
        held = abs(drive) <= _dry_level(0.0, drive, t, p)
        mode_w = 0 if held else (1 if drive > 0.0 else -1)
    return mode_i, mode_w


@compiled
def _event(x, t, v, load, disturbance, mode_i, mode_w, p):
    return _brush_leaves(x, v, mode_i, p) or _rotor_leaves(x, t, load, disturbance, mode_w, p)


@compiled
def _advance(x, t, h, v, load, disturbance, mode_i, mode_w, p, work):
    """One fine step, in place, broken where a dry element starts or stops slipping."""
    out = work[5]
    for _ in range(16):  # more events than occur in one fine step
        _rk4(x, t, h, v, load, disturbance, mode_i, mode_w, p, work, out)
        if not _event(out, t + h, v, load, disturbance, mode_i, mode_w, p):
            break
        before, after = 0.0, h
        for _ in range(40):  # bisection to the last digits; events are rare
            middle = 0.5 * (before + after)
            _rk4(x, t, middle, v, load, disturbance, mode_i, mode_w, p, work, out)
            if _event(out, t + middle, v, load, disturbance, mode_i, mode_w, p):
                after = middle
            else:
                before = middle
        _rk4(x, t, after, v, load, disturbance, mode_i, mode_w, p, work, out)
        x[:] = out
        t += after
        h -= after
        mode_i, mode_w = _settle(x, t, v, load, disturbance, mode_i, mode_w, p)
        out[:] = x
        if h <= 0.0:
            break
    x[:] = out
    return mode_i, mode_w


@compiled
def _applied(v, t, h, p):
    """Mean voltage of a fine step at the terminals: after the dead zone, and as pulses."""
    v = math.copysign(max(0.0, abs(v) - p.dead_zone_V), v)
    if p.pwm_Hz == 0.0 or abs(v) >= p.bus_V:
        return v
    period = 1.0 / p.pwm_Hz
    begin = t - period * math.floor(t / period + 1e-9)
    on, off = 0.5 * period * (1.0 - abs(v) / p.bus_V), 0.5 * period * (1.0 + abs(v) / p.bus_V)
    overlap = max(0.0, min(begin + h, off) - max(begin, on))
    return math.copysign(p.bus_V * overlap / h, v)


@compiled
def _run(time, voltage, load, disturbance, substeps, start, p):
    """Readings of ideal sensors at each sample: current, speed, angle, shape (samples, 3)."""
    samples = time.size
    read = np.empty((samples, 3))
    history = np.empty((samples - 1) * substeps + 1)
    x, work = start.copy(), np.empty((6, STATES))
    history[0] = x[READ]
    mode_i = 1 if x[CURRENT] > 0.0 else (-1 if x[CURRENT] < 0.0 else 0)
    mode_w = 1 if x[SPEED] > 0.0 else (-1 if x[SPEED] < 0.0 else 0)
    if p.brush_V == 0.0 or p.brush_onset_A != 0.0:
        mode_i = 1
    if not _sticks(p):
        mode_w = 1
    for k in range(samples):
        read[k, 0], read[k, 1], read[k, 2] = x[CURRENT] + p.offset_A, x[READ], x[ANGLE]
        if k == samples - 1:
            break
        h = (time[k + 1] - time[k]) / substeps
        for j in range(substeps):
            t = time[k] + j * h
            v, torque = _applied(voltage[k], j * h, h, p), disturbance[k, j]
            mode_i, mode_w = _settle(x, t, v, load[k], torque, mode_i, mode_w, p)
            mode_i, mode_w = _advance(x, t, h, v, load[k], torque, mode_i, mode_w, p, work)
            history[k * substeps + j + 1] = x[READ]
    if p.delay_s != 0.0:
        _delayed(time, history, substeps, p.delay_s, read[:, 1])
    return read


@compiled
def _delayed(time, history, substeps, delay, read):
    """The speed `delay` earlier, linear between fine steps; before the record, its initial value."""
    k = 0
    for n in range(time.size):
        t = time[n] - delay
        if t <= time[0]:
            read[n] = history[0]
            continue
        while time[k + 1] < t:
            k += 1
        place = (t - time[k]) / (time[k + 1] - time[k]) * substeps
        j = min(int(place), substeps - 1)
        a, b = history[k * substeps + j], history[k * substeps + j + 1]
        read[n] = a + (b - a) * (place - j)


@compiled
def ornstein_uhlenbeck(white, decay, sd):
    """Turn white unit noise, in place, into a stationary torque that decays by `decay` a step."""
    flat = white.reshape(-1)
    kick = sd * math.sqrt(1.0 - decay * decay)
    x = sd * flat[0]
    for k in range(flat.size):
        flat[k], x = x, decay * x + kick * flat[k]


def substeps(plant: Plant, interval: float, least: int = 20) -> int:
    """Fine steps per sample: at least `least`, more for fast effects, and a whole number per pulse."""
    stiff = 8.0 * plant.R / plant.L
    if plant.stiffness:
        reduced = plant.J * plant.load_share * (1.0 - plant.load_share)
        stiff = max(stiff, 2.0 * math.sqrt(plant.stiffness / reduced))
    if plant.presliding_rad:
        stiff = max(stiff, 1.3 * plant.bus_V / plant.Kb / plant.presliding_rad)
    if plant.brush_onset_A:
        stiff = max(stiff, plant.brush_V / plant.brush_onset_A / plant.L)
    need = max(float(least), stiff * interval)
    pulses = max(1, round(plant.pwm_Hz * interval))
    return pulses * math.ceil(max(need, 16.0 * pulses * bool(plant.pwm_Hz)) / pulses)


def simulate(
    plant: Plant,
    time: Samples,
    voltage: Samples,
    load: Samples,
    *,
    angle: float = 0.0,
    twist: float = 0.0,
    speed: float = 0.0,
    current: float = 0.0,
    disturbance: NDArray[np.float64] | None = None,
    least: int = 20,
    steps: int | None = None,
) -> NDArray[np.float64]:
    """Readings of ideal sensors: current (A), speed (rad/s), true angle (rad) per sample, (N, 3).

    `disturbance` is a torque (N m) for every fine step, shape (N, substeps). `steps` are the fine
    steps of a sample where accuracy matters less than time.
    """
    steps = steps or substeps(plant, float(np.median(np.diff(time))), least)
    if disturbance is None:
        disturbance = np.zeros((1, 1))
        disturbance = np.broadcast_to(disturbance, (time.size, steps))
    start = np.zeros(STATES)
    start[[CURRENT, SPEED, ANGLE, LOAD_SPEED, TWIST, READ]] = (current, speed, angle, speed, twist, speed)
    packed = np.array([plant], dtype=PACKED)[0]
    columns = (np.ascontiguousarray(c, float) for c in (time, voltage, load))
    return _run(*columns, np.ascontiguousarray(disturbance), disturbance.shape[1], start, packed)
