"""An external torque that is periodic in time: one line in the spectra of the residuals of most runs.

No effect of the library has a frequency of its own, and the whitening filter would absorb a steady oscillation as
noise.
"""

from __future__ import annotations

import numpy as np

from ...identify.fit.run_series import series_of_runs
from ...identify.noise.spectral_lines import Line, common_line, spectrum
from ..model import Model


def line_of(model: Model) -> Line | None:
    """The steady oscillation that a model leaves in most of the runs, if it leaves one."""
    spectra = []
    for run, fit in zip(model.prepared.training, series_of_runs(model.prepared, model.fit), strict=True):
        # a current drives only where there is no voltage
        current = run.current if run.voltage is None else None
        drives = [x for x in (run.voltage, run.torque, run.load, current) if x is not None]
        step, _ = fit.residual.kind
        interval = round(step / run.sample_time)  # of the readings
        residuals = np.where(fit.residual.known[:, None], fit.residual.values, 0.0)[: len(run) // interval]
        driving = np.nan_to_num(np.stack(drives, axis=1))[: len(residuals) * interval]
        spectra.append(spectrum(residuals, driving, step))
    return common_line(spectra)
