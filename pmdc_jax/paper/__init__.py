"""The wheelchair-motor paper: its printed values and their reproduction."""
