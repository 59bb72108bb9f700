"""Controllers, closed loops, and how to tune them."""

from .controllers import CONTROLLERS, PI, PID, StateFeedback, StateFeedbackIntegral
from .hardware import Hardware
from .law import Law
from .loop import Course, Response, closed_loop
from .metrics import LoadMetrics, StepMetrics, load_metrics, step_metrics
from .steady import steady_state
from .time_optimal import fastest_settling

__all__ = [
    "CONTROLLERS",
    "PI",
    "PID",
    "Course",
    "Hardware",
    "Law",
    "LoadMetrics",
    "Response",
    "StateFeedback",
    "StateFeedbackIntegral",
    "StepMetrics",
    "closed_loop",
    "fastest_settling",
    "load_metrics",
    "steady_state",
    "step_metrics",
]
