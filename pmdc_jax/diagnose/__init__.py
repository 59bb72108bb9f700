"""Find where simulation and measurement disagree, name the missing effect, add it, show the gap shrink."""

from .diagnosis import Diagnosis
from .pipeline import diagnose

__all__ = ["Diagnosis", "diagnose"]
