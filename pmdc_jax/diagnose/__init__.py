"""Find where simulation and measurement disagree, name the missing effects, and add them to the model."""

from .diagnosis import Diagnosis
from .pipeline import diagnose

__all__ = ["Diagnosis", "diagnose"]
