"""Export of a sampled law to C99, as one header."""

from __future__ import annotations

from pathlib import Path
from string import Template

from ..files import write_text
from .controller_file import gains_of
from .law import Law

HEADER = Template("""\
/* A $type speed controller for a brushed permanent-magnet DC motor.
 *
 * Written by pmdc_jax. C99; no memory is allocated and no function is called. Every $sample_time s:
 *
 *     voltage = pmdc_step(&state, reference, speed, current);
 *
 * reference and speed in rad/s, current in A${ignored}; the voltage, in V, is within the limits and is
 * to be applied $moment.
 * After a reading that is no number (NaN or infinite) the last voltage remains, and nothing else changes.
 * Before the first step, with the motor at rest, call pmdc_start(&state).
 *
 * Double precision; #define PMDC_REAL float before including this file for single.
 */
#ifndef PMDC_CONTROLLER_H
#define PMDC_CONTROLLER_H

#include <math.h>

#ifndef PMDC_REAL
#define PMDC_REAL double
#endif

typedef PMDC_REAL pmdc_real;

$constants

typedef struct {
    pmdc_real integral; /* V */
    pmdc_real filtered; /* rad/s, speed after the derivative filter */
    pmdc_real current;  /* A, as estimated */
    pmdc_real voltage;  /* V, last command */
    pmdc_real missing;  /* V, missing in the model by the measured currents; used by a current limit */
} pmdc_state;

static inline pmdc_real pmdc_clip(pmdc_real value, pmdc_real lowest, pmdc_real highest)
{
    return value < lowest ? lowest : value > highest ? highest : value;
}

static inline void pmdc_start(pmdc_state *state)
{
    state->integral = 0;
    state->filtered = 0;
    state->current = 0;
    state->voltage = 0;
    state->missing = 0;
}

static inline pmdc_real pmdc_step(pmdc_state *state, pmdc_real reference, pmdc_real speed,
                                  pmdc_real current)
{
$body
}

#endif
""")


def export(law: Law, c: str | Path) -> None:
    """Write a law as one C99 header, atomically: the same arithmetic, with limits and anti-windup.

    **Arguments**: `law`, from `tune(...).law` or `load_controller`; `c`, the file to write.
    """
    write_text(c, c_header(law))


def c_header(law: Law) -> str:
    """The text of the header."""
    hardware = law.hardware
    return HEADER.substitute(
        type=law.controller.name.upper() if len(law.controller.name) < 4 else law.controller.name,
        sample_time=f"{float(hardware.sample_time):g}",
        ignored="" if hardware.measures_current else " (ignored: it is estimated)",
        moment="from the next sample on" if hardware.delay else "at once",
        constants="\n".join(
            f"#define PMDC_{name.upper()} ((pmdc_real){value!r})" for name, value in _constants(law).items()
        ),
        body="\n".join(f"    {line}" for line in _body(law)),
    )


def _constants(law: Law) -> dict[str, float]:
    hardware = law.hardware
    constants = gains_of(law.controller)
    constants |= {"sample_time": float(hardware.sample_time), "voltage_limit": float(hardware.voltage_limit)}
    if hardware.current_limit is not None:
        constants["current_limit"] = float(hardware.current_limit)
    return constants | {f"model_{name}": float(v) for name, v in law.model._asdict().items()}


def _body(law: Law) -> list[str]:
    """The statements of one step, in the order of `Law.step`."""
    readings = ("reference", "speed", *(["current"] if law.hardware.measures_current else []))
    return [
        f"if (!({' && '.join(f'isfinite({reading})' for reading in readings)})) {{",
        "    return state->voltage;",
        "}",
        *_predicted_state(law),
        *_command(law),
        *_limited_voltage(law),
        *_memory_update(law),
        *_estimated_current(law),
        "state->voltage = applied;",
        "return applied;",
    ]


def _predicted_state(law: Law) -> list[str]:
    """Statements that predict current and speed to when the voltage takes effect; `here` is the present current."""
    lines = []
    if not law.hardware.measures_current:
        lines += ["(void)current;", "current = state->current;"]
    lines += ["const pmdc_real here = current;", "pmdc_real ahead = speed;"]
    if _corrects_its_prediction(law):
        lines += [
            "/* integrate half of what the prediction lacked */",
            "state->missing += (1 - PMDC_MODEL_II) / (2 * PMDC_MODEL_IV) * (here - state->current);",
        ]
    if law.hardware.delay:
        lines += [
            "/* the last command acts until this one does */",
            f"ahead = {_next_sample('W', 'state->voltage')};",
            f"current = {_next_sample('I', 'state->voltage')};",
        ]
    return lines


def _corrects_its_prediction(law: Law) -> bool:
    """Whether the missing voltage is used: by a current limit, where a current is measured."""
    return law.hardware.measures_current and law.hardware.current_limit is not None


def _next_sample(row: str, voltage: str) -> str:
    """Expression for current (I) or speed (W) one sample later, by the law's model of the motor."""
    model = f"PMDC_MODEL_{row}"
    return f"{model}I * here + {model}W * speed + {model}V * {voltage}"


def _command(law: Law) -> list[str]:
    """Statements that compute the commanded voltage."""
    lines = []
    if law.controller.filters_derivative:
        lines += ["const pmdc_real slope = (speed - state->filtered) / (PMDC_FILTER_TIME + PMDC_SAMPLE_TIME);"]
    return [*lines, f"const pmdc_real asked = {law.controller.c_command};"]


def _limited_voltage(law: Law) -> list[str]:
    """Statements that limit the voltage."""
    lines = ["pmdc_real applied = asked;"]
    if law.hardware.current_limit is not None:
        if law.hardware.delay:
            lines += [
                "/* by then the missing voltage has acted, too */",
                "current += PMDC_MODEL_IV * state->missing;",
                "ahead += PMDC_MODEL_WV * state->missing;",
            ]
        lines += [
            "/* voltage with which the current peaks at its limit */",
            "const pmdc_real drift = PMDC_MODEL_PI * current + PMDC_MODEL_PW * ahead + PMDC_MODEL_PV * state->missing;",
            "applied = pmdc_clip(applied, (-PMDC_CURRENT_LIMIT - drift) / PMDC_MODEL_PV,",
            "                    (PMDC_CURRENT_LIMIT - drift) / PMDC_MODEL_PV);",
        ]
    return [*lines, "applied = pmdc_clip(applied, -PMDC_VOLTAGE_LIMIT, PMDC_VOLTAGE_LIMIT);"]


def _memory_update(law: Law) -> list[str]:
    """Statements that update the controller's memory."""
    lines = []
    if law.controller.integrates:
        lines += [
            "/* anti-windup: the integral tracks the voltage applied */",
            "const pmdc_real tracking = PMDC_TRACKING_TIME > PMDC_SAMPLE_TIME ? PMDC_TRACKING_TIME : PMDC_SAMPLE_TIME;",
            "state->integral += PMDC_SAMPLE_TIME * (PMDC_INTEGRAL * (reference - speed)",
            "                                       + (applied - asked) / tracking);",
        ]
    if law.controller.filters_derivative:
        lines += ["state->filtered += PMDC_SAMPLE_TIME * slope;"]
    return lines


def _estimated_current(law: Law) -> list[str]:
    """Statements that estimate the current at the next sample."""
    acting = "state->voltage" if law.hardware.delay else "applied"
    if _corrects_its_prediction(law):
        acting = f"({acting} + state->missing)"
    # some laws do not use `ahead`, and compilers warn of a variable that is set but not used
    return [f"state->current = {_next_sample('I', acting)};", "(void)ahead;"]
