"""What may be missing: effects in the shapes that are tried, and curves."""
