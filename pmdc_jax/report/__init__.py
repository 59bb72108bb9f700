"""Presentation of results as HTML reports, terminal tables and JSON."""
