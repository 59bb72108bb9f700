"""The same sampled PID loop in hand-written numba, python-control and gym-electric-motor."""

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray


@njit(cache=True, parallel=True, fastmath=True)
def numba_speeds(gains: NDArray, motion: NDArray, setpoint: float, volts: float, step: float, samples: int):
    """Last speed and largest speed of each loop, (loops, 2).

    `gains` (loops, 6): Kp, Ki, Kd, filter time, set-point weight, tracking time; `motion`, the exact
    step of the motor, (2, 3): current and speed from current, speed and voltage. One sample of delay.
    """
    loops = gains.shape[0]
    seen = np.empty((loops, 2))
    for n in prange(loops):
        kp, ki, kd, filter_time, weight, tracking = gains[n]
        tracking = max(tracking, step)
        current = speed = integral = filtered = pending = most = 0.0
        for _ in range(samples):
            slope = (speed - filtered) / (filter_time + step)
            asked = kp * (weight * setpoint - speed) + integral - kd * slope
            applied = min(max(asked, -volts), volts)
            integral += step * (ki * (setpoint - speed) + (applied - asked) / tracking)
            filtered += step * slope
            moved = motion[0, 0] * current + motion[0, 1] * speed + motion[0, 2] * pending
            speed = motion[1, 0] * current + motion[1, 1] * speed + motion[1, 2] * pending
            current = moved
            pending = applied
            most = max(most, speed)
        seen[n, 0], seen[n, 1] = speed, most
    return seen


def control_speeds(gains: NDArray, motion: NDArray, setpoint: float, step: float, samples: int):
    """Last and largest speed by `control.forced_response`: the linear loop, without any limit."""
    import control as ct

    time = step * np.arange(samples)
    reference = np.full(samples, setpoint)
    seen = np.empty((len(gains), 2))
    for n, (kp, ki, kd, filter_time, weight, _) in enumerate(gains):
        # states: current, speed, last voltage command, integral, filtered
        lead = kd / (filter_time + step)
        asked = np.array([0.0, -kp - lead, 0.0, 1.0, lead])
        A = np.zeros((5, 5))
        A[:2, :3] = motion
        A[2] = asked
        A[3] = [0.0, -step * ki, 0.0, 1.0, 0.0]
        share = step / (filter_time + step)
        A[4] = [0.0, share, 0.0, 0.0, 1 - share]
        B = np.array([[0.0], [0.0], [kp * weight], [step * ki], [0.0]])
        loop = ct.ss(A, B, [[0, 1, 0, 0, 0]], 0, step)
        speed = ct.forced_response(loop, time, reference).outputs
        seen[n] = speed[-1], speed.max()
    return seen


def gym_speeds(gains: NDArray, motor: dict[str, float], setpoint: float, volts: float, step: float, samples: int):
    """Last and largest speed in the physical system of gym-electric-motor, without its rewards and references."""
    import gym_electric_motor as gem
    from gym_electric_motor.physical_systems import converters, mechanical_loads, voltage_supplies

    most = {"omega": 2000.0, "i": 1000.0, "u": volts, "torque": 100.0}
    rotor = {"r_a": motor["R"], "l_a": motor["L"], "psi_e": motor["Kb"], "j_rotor": motor["J"] / 2}
    load = {"a": 0.0, "b": motor["f"], "c": 0.0, "j_load": motor["J"] / 2}
    system = gem.make(
        "Cont-SC-PermExDc-v0",
        motor={"motor_parameter": rotor, "limit_values": most, "nominal_values": most},
        load=mechanical_loads.PolynomialStaticLoad(load_parameter=load),
        supply=voltage_supplies.IdealVoltageSupply(u_nominal=volts),
        converter=converters.ContFourQuadrantConverter(tau=step),
        tau=step,
        constraints=(),
    ).unwrapped.physical_system
    seen = np.zeros((len(gains), 2))
    for n, (kp, ki, kd, filter_time, weight, tracking) in enumerate(gains):
        speed = most["omega"] * system.reset()[0]
        integral = filtered = pending = 0.0
        for _ in range(samples):
            slope = (speed - filtered) / (filter_time + step)
            asked = kp * (weight * setpoint - speed) + integral - kd * slope
            applied = min(max(asked, -volts), volts)
            back = (applied - asked) / max(tracking, step)
            integral += step * (ki * (setpoint - speed) + back)
            filtered += step * slope
            speed = most["omega"] * system.simulate(np.array([pending / volts]))[0]
            pending = applied
            seen[n, 1] = max(seen[n, 1], speed)
        seen[n, 0] = speed
    return seen
