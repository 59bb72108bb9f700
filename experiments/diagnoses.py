"""How does the diagnosis of two real motors compare with what others have published about them?

`python -m experiments.diagnoses [emps] [undcmotor]`; data: see experiments/data.py.

By its published model EMPS has Coulomb friction with an offset, which in motion is asymmetric friction. Its force error
is that of experiments/emps.py. For UNDCMotor the owners publish a delay of 20 ms and a dead zone; only voltage and
speed are recorded. Both diagnoses start without load and with viscous friction only. Reports go to experiments/out.
"""

import argparse
from pathlib import Path

from rich.console import Console
from rich.table import Table

from experiments import emps, undcmotor
from pmdc_jax import Diagnosis, diagnose
from pmdc_jax.report.diagnosis.page import write_diagnosis_report

OUT = Path(__file__).parent / "out"


def terms_of(found: Diagnosis) -> dict[str, float]:
    """Parameters of the EMPS axis with the added effects, by the names of the inverse dynamic model."""
    parameters = found.final.parameters
    terms = {"M": parameters["J"].value, "Fv": parameters["f"].value}
    value = {name: estimate.value for name, estimate in parameters.items()}
    if "asymmetric_friction.forward_Nm" in value:
        ends = [value[f"asymmetric_friction.{way}_Nm"] for way in ("forward", "backward")]
        terms |= {"Fc": sum(ends) / 2, "offset": (ends[0] - ends[1]) / 2}
    if "coulomb_friction.torque_Nm" in value:
        terms["Fc"] = value["coulomb_friction.torque_Nm"]
    if "constant_load.torque_Nm" in value:
        terms["offset"] = terms.get("offset", 0.0) + value["constant_load.torque_Nm"]
    return terms


def of_emps() -> tuple[Diagnosis, list[str]]:
    """The estimation record diagnosed, the validation record held out; force errors before and after."""
    runs = [emps.record(name) for name in (emps.ESTIMATION, emps.VALIDATION)]
    found = diagnose(runs[:1], runs[1:], unloaded=True)
    before = {name: found.base.parameters[p].value for name, p in (("M", "J"), ("Fv", "f"))}
    errors = [
        "force error " + " / ".join(f"{emps.force_error(run, terms):.2f}" for run in runs) + " %"
        for terms in (before, terms_of(found))
    ]
    return found, errors


def of_undcmotor() -> tuple[Diagnosis, list[str]]:
    """The first half of the record diagnosed, the second held out; free-run errors of the latter."""
    first, second = undcmotor.halves()
    found = diagnose([first], [second], unloaded=True)
    errors = [
        f"free run {one.fit[second.name].speed_rmse / undcmotor.DEGREE:.1f} deg/s" for one in (found.base, found.final)
    ]
    return found, errors


RECORDS = {"emps": of_emps, "undcmotor": of_undcmotor}


def main() -> None:
    """Diagnose, print, write the reports."""
    parser = argparse.ArgumentParser(prog="experiments.diagnoses", description=__doc__)
    parser.add_argument("record", nargs="*", choices=[*RECORDS, []], default=[])
    table = Table(title="Diagnoses of real records")
    for heading in ("record", "verdict", "effects", "before", "after", "gap closed", "s"):
        table.add_column(heading)
    OUT.mkdir(exist_ok=True)
    for name in parser.parse_args().record or RECORDS:
        found, (before, after) = RECORDS[name]()
        write_diagnosis_report(found, OUT / f"diagnosis_{name}.html")
        effects = "\n".join(
            f"{effect.name}: " + ", ".join(f"{field} {e.value:.4g}" for field, e in effect.parameters.items())
            for effect in found.effects
        )
        closed = "-" if found.closed_fraction is None else f"{found.closed_fraction:.3f}"
        seconds = f"{found.seconds['total']:.0f}"
        table.add_row(name, found.verdict, effects or "-", before, after, closed, seconds)
    Console(width=160).print(table)


if __name__ == "__main__":
    main()
